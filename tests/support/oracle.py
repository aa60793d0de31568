"""The slow world: the task in plain Python, written from its rules, one loop at a time.

Nothing here imports the environment, the rewards, the returns or the metrics of the package: the
arrays of a `SceneTables` are all that it reads. Names of classes are used wherever the package
uses indices.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.scenes import SceneTables

ACTIONS = ("MoveAhead", "RotateLeft", "RotateRight", "LookUp", "LookDown", "Done")
MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN, DONE = range(6)
MOVES = (MOVE_AHEAD, ROTATE_LEFT, ROTATE_RIGHT, LOOK_UP, LOOK_DOWN)
HEADINGS = (0, 45, 90, 135, 180, 225, 270, 315)  # degrees, clockwise from +z
ROOMS = ("kitchen", "living_room", "bedroom", "bathroom")

#: Target -> {parent: R_p}.
ParentRewards = Mapping[str, Mapping[str, float]]


class Pose(NamedTuple):
    """Where an agent stands and looks."""

    position: int  # index of the reachable point
    heading: int  # degrees, clockwise from +z
    horizon: int  # degrees, downwards


class Turns(NamedTuple):
    """What an agent's rotations and horizons are; a table's own grid has the same two fields."""

    rotations: int = 8
    horizons: tuple[int, ...] = (0, 30)  # degrees, downwards


ITHOR = Turns()


class Detection(NamedTuple):
    """What a detector says of an object (or of a class), as shares of the image."""

    name: str
    x: float
    y: float
    area: float


@dataclasses.dataclass
class Episode:
    """One episode in progress."""

    pose: Pose
    target: str
    steps: int = 0
    parents_seen: set[str] = dataclasses.field(default_factory=set)
    most_similar: float = 0.0

    def __post_init__(self) -> None:
        self.start = self.pose


class Outcome(NamedTuple):
    """What an action led to; the episode itself was changed."""

    reward: float
    terminated: bool
    truncated: bool
    success: bool


def views_of(turns: Any = ITHOR) -> list[tuple[int, int]]:
    """Heading and horizon of all poses at a position, in their order, in degrees."""
    headings = range(0, 360, 360 // turns.rotations)
    return [(heading, horizon) for heading in headings for horizon in turns.horizons]


def state_of(pose: Pose, turns: Any = ITHOR) -> int:
    """The pose's index in the tables."""
    views = views_of(turns)
    return pose.position * len(views) + views.index((pose.heading, pose.horizon))


def pose_of(state: int, turns: Any = ITHOR) -> Pose:
    """The pose that the tables call `state`."""
    views = views_of(turns)
    return Pose(state // len(views), *views[state % len(views)])


class World:
    """All rooms of some tables, and what an action does in them."""

    def __init__(
        self,
        tables: SceneTables,
        parents: ParentRewards,
        step_limits: Sequence[int],
        ahead: Callable[[int, int], int] | None = None,
        similarity: Mapping[str, Mapping[str, float]] | None = None,
    ) -> None:
        """Args:
        tables: the rooms.
        parents: what seeing a parent of a target is worth.
        step_limits: actions in an episode, by room type.
        ahead: (position, heading in degrees) -> position one step on; by default the tables'
          own. `walk_on_grid` derives it from the coordinates instead.
        similarity: target -> class -> cosine; given, it is paid for in place of parents.
        """
        self.tables = tables
        self.parents = parents
        self.step_limits = step_limits
        self.ahead = ahead or self.ahead_in_table
        self.similarity = similarity
        self.turn = 360 // tables.grid.rotations

    def state_of(self, pose: Pose) -> int:
        """The pose's index in the tables."""
        return state_of(pose, self.tables.grid)

    def pose_of(self, state: int) -> Pose:
        """The pose that the tables call `state`."""
        return pose_of(state, self.tables.grid)

    def ahead_in_table(self, position: int, heading: int) -> int:
        """The point that the tables name as next."""
        return int(self.tables.next_position[position, heading // self.turn])

    def moved(self, pose: Pose, action: int) -> Pose:
        """The pose after an action; an impossible one leaves it as it is."""
        name = ACTIONS[action]
        if name == "MoveAhead":
            return pose._replace(position=self.ahead(pose.position, pose.heading))
        if name == "RotateLeft":
            return pose._replace(heading=(pose.heading - self.turn) % 360)
        if name == "RotateRight":
            return pose._replace(heading=(pose.heading + self.turn) % 360)
        horizons = self.tables.grid.horizons
        if name == "LookUp":
            higher = [horizon for horizon in horizons if horizon < pose.horizon]
            return pose._replace(horizon=max(higher, default=pose.horizon))
        if name == "LookDown":
            lower = [horizon for horizon in horizons if horizon > pose.horizon]
            return pose._replace(horizon=min(lower, default=pose.horizon))
        return pose

    def rows(self, state: int) -> list[int]:
        """Indices of the detection rows of a state."""
        return list(range(self.tables.row_start[state], self.tables.row_start[state + 1]))

    def class_of(self, row: int) -> str:
        """Class of the object that a detection row shows."""
        tables = self.tables
        return tables.classes[tables.object_class[tables.row_object[row]]]

    def visible(self, state: int) -> set[str]:
        """Classes with an instance in view and within 1.5 m."""
        return {self.class_of(row) for row in self.rows(state) if self.tables.row_visible[row]}

    def detections(self, state: int, merge: bool) -> list[Detection]:
        """What is in view: one entry per object, or per class if `merge`.

        A class's entry has the mean of its instances' corners as its centre and their common
        extent as its area.
        """
        side = self.tables.image * self.tables.subpixel
        boxes: dict[tuple[str, int], list[list[float]]] = {}
        for row in self.rows(state):
            name = self.class_of(row)
            group = (name, 0 if merge else int(self.tables.row_object[row]))
            box = [float(edge) / side for edge in self.tables.row_box[row]]
            boxes.setdefault(group, []).append(box)
        found = []
        for (name, _), members in boxes.items():
            xs = [x for x1, _, x2, _ in members for x in (x1, x2)]
            ys = [y for _, y1, _, y2 in members for y in (y1, y2)]
            area = (max(xs) - min(xs)) * (max(ys) - min(ys))
            found.append(Detection(name, sum(xs) / len(xs), sum(ys) / len(ys), area))
        return found

    def room(self, position: int) -> str:
        """Room type that a position lies in."""
        return ROOMS[self.tables.position_room_type[position]]

    def act(self, episode: Episode, action: int) -> Outcome:
        """One action of an episode: Eq. 3's reward and how it ends, if it does."""
        episode.pose = self.moved(episode.pose, action)
        episode.steps += 1
        limit = self.step_limits[ROOMS.index(self.room(episode.start.position))]
        timed_out = action != DONE and episode.steps >= limit
        success = action == DONE and episode.target in self.visible(self.state_of(episode.pose))
        partial = self.seen_parents if self.similarity is None else self.seen_likeness
        new, anyway = partial(episode)
        if action == DONE:
            return Outcome(5.0 + anyway if success else -0.01, True, False, success)
        return Outcome(-0.01 if new is None else new, False, timed_out, False)

    def seen_parents(self, episode: Episode) -> tuple[float | None, float]:
        """R_p of the parents that are visible for the first time, and of all that are visible."""
        visible = self.visible(self.state_of(episode.pose))
        worth = self.parents.get(episode.target, {})
        in_view = {name for name in worth if name in visible}
        new = in_view - episode.parents_seen
        episode.parents_seen |= in_view
        newest = max(worth[name] for name in new) if new else None
        return newest, max((worth[name] for name in in_view), default=0.0)

    def seen_likeness(self, episode: Episode) -> tuple[float | None, float]:
        """0.1 times the largest cosine in view: if it has risen, and in any case."""
        assert self.similarity is not None
        cosines = self.similarity[episode.target]
        rows = self.rows(self.state_of(episode.pose))
        greatest = max((cosines[self.class_of(row)] for row in rows), default=0.0)
        risen = greatest > episode.most_similar
        episode.most_similar = max(greatest, episode.most_similar)
        return (0.1 * greatest if risen else None), max(0.1 * greatest, 0.0)

    @cache  # noqa: B019 - worlds live as long as a test
    def distances(self, scene: int, target: str) -> dict[int, int]:
        """Fewest moves from each state of a scene until the target is visible; plain BFS."""
        came_from: dict[int, list[int]] = {}
        queue: deque[int] = deque()
        away: dict[int, int] = {}
        for position in np.flatnonzero(self.tables.position_scene == scene):
            for state in self.states_at(position):
                for action in MOVES:
                    after = self.state_of(self.moved(self.pose_of(state), action))
                    came_from.setdefault(after, []).append(state)
                if target in self.visible(state):
                    away[state] = 0
                    queue.append(state)
        while queue:
            state = queue.popleft()
            for before in came_from.get(state, []):
                if before not in away:
                    away[before] = away[state] + 1
                    queue.append(before)
        return away

    def distance(self, state: int, target: str) -> int | None:
        """Fewest moves from a state until the target is visible, None if there is none."""
        scene = int(self.tables.position_scene[self.pose_of(state).position])
        return self.distances(scene, target).get(state)

    def best_action(self, pose: Pose, target: str) -> int:
        """An action on a shortest path; Done where the target is visible."""
        here = self.distance(self.state_of(pose), target)
        if here is None:
            raise ValueError(f"{target} cannot be reached from {pose}")
        for action in MOVES if here else ():
            if self.distance(self.state_of(self.moved(pose, action)), target) == here - 1:
                return action
        return DONE

    def valid_starts(self, scene: int, target: str, room: str | None = None) -> set[int]:
        """Positions of a scene, or of its rooms of a type, from which the target can be reached."""
        positions = np.flatnonzero(self.tables.position_scene == scene)
        reached = self.distances(scene, target)
        return {
            int(p)
            for p in positions
            if room in (None, self.room(p)) and any(s in reached for s in self.level_states(p))
        }

    def valid_targets(self, scene: int, among: Sequence[str]) -> list[str]:
        """The targets that can be reached from somewhere in a scene."""
        return [target for target in among if self.valid_starts(scene, target)]

    def states_at(self, position: int) -> list[int]:
        """The states of a position."""
        views = views_of(self.tables.grid)
        return [self.state_of(Pose(int(position), *view)) for view in views]

    def level_states(self, position: int) -> list[int]:
        """The states of a position that look level."""
        return [s for s in self.states_at(position) if self.pose_of(s).horizon == 0]


def walk_on_grid(tables: SceneTables) -> Callable[[int, int], int]:
    """Where MoveAhead leads, from coordinates: to the neighbour that is nearest to the heading."""
    index = {
        (int(scene), round(float(x), 2), round(float(z), 2)): i
        for i, (scene, (x, _, z)) in enumerate(
            zip(tables.position_scene, tables.position, strict=True)
        )
    }

    def ahead(position: int, heading: int) -> int:
        x, _, z = tables.position[position]
        nearest = min((*HEADINGS, 360), key=lambda direction: abs(direction - heading)) % 360
        east = {0: 0, 45: 1, 90: 1, 135: 1, 180: 0, 225: -1, 270: -1, 315: -1}[nearest]
        north = {0: 1, 45: 1, 90: 0, 135: -1, 180: -1, 225: -1, 270: 0, 315: 1}[nearest]
        scene, size = int(tables.position_scene[position]), tables.grid.grid_size
        place = (scene, round(float(x) + size * east, 2), round(float(z) + size * north, 2))
        return index.get(place, position)

    return ahead


def parent_rewards(
    tables: SceneTables,
    targets: Mapping[str, Sequence[str]],
    candidates: Sequence[str],
    least_support: float,
) -> dict[str, dict[str, float]]:
    """R_p of every target's parents: R_t * Pr(t | p) * 0.1, at most three of them.

    Pr(t | p) is the share, among the rooms that hold both, in which the nearest two are within
    1.5 m. A candidate counts if it stands in enough of the rooms that hold the target.
    """
    centres: dict[int, dict[str, list[np.ndarray]]] = {}  # scene -> class -> one per instance
    for kind, place, box in zip(
        tables.object_class, tables.object_scene, tables.object_box, strict=True
    ):
        here = centres.setdefault(int(place), {})
        here.setdefault(tables.classes[kind], []).append((box[:3] + box[3:]) / 2)
    result: dict[str, dict[str, float]] = {}
    for room, names in targets.items():
        pairs = zip(tables.position_scene, tables.position_room_type, strict=True)
        scenes = sorted({scene for scene, kind in pairs if ROOMS[kind] == room})
        for target in names:
            with_target = [s for s in scenes if target in centres.get(s, {})]
            ranked = []
            for parent in candidates:
                if parent == target:
                    continue
                gaps = [
                    min(
                        float(np.linalg.norm(a - b))
                        for a in centres[scene][target]
                        for b in centres[scene][parent]
                    )
                    for scene in with_target
                    if parent in centres[scene]
                ]
                near = [gap for gap in gaps if gap <= 1.5]
                if near and len(gaps) >= least_support * len(with_target):
                    share = len(near) / len(gaps)
                    ranked.append((-share, sum(gaps) / len(gaps), parent))
            result[target] = {p: 5.0 * -share * 0.1 for share, _, p in sorted(ranked)[:3]}
    return result


class Step(NamedTuple):
    """One step of an episode as the critic sees it."""

    reward: float
    value: float  # of the state that it started from


def generalised_advantages(
    episode: Sequence[Step], last_value: float, gamma: float, lam: float
) -> list[float]:
    """GAE of one piece of an episode, as the sum that defines it.

    `last_value` is the value of the state after the last step: 0 where the episode ended there,
    the critic's where it was cut (by a step limit or by the end of the rollout).
    """
    values = [step.value for step in episode] + [last_value]
    errors = [step.reward + gamma * values[t + 1] - values[t] for t, step in enumerate(episode)]
    return [
        sum((gamma * lam) ** (k - t) * errors[k] for k in range(t, len(errors)))
        for t in range(len(errors))
    ]


def paired_differences(
    ours: Mapping[str, Sequence], theirs: Mapping[str, Sequence], chosen: Sequence[int]
) -> list[tuple[float, tuple[float, float] | None]]:
    """Of SR and of SPL: the difference, and the ends of its interval, from whole samples.

    A sample takes as many clusters as there are, with replacement, and all their episodes; the
    counts are drawn as the package draws them, so that the ends are the same ones.
    """

    def rates(agent: Mapping[str, Sequence], episodes: Sequence[int]) -> np.ndarray:
        named = ([agent[name][i] for i in episodes] for name in ("success", "shortest", "length"))
        return np.array(success_rate_and_spl(*named))

    clusters = sorted({ours["cluster"][i] for i in chosen})
    members = [[i for i in chosen if ours["cluster"][i] == cluster] for cluster in clusters]
    rng = np.random.default_rng(0)
    samples = []
    for _ in range(2000):
        counts = rng.multinomial(len(clusters), np.full(len(clusters), 1 / len(clusters)))
        drawn = [i for count, own in zip(counts, members, strict=True) for i in own * count]
        samples.append(rates(ours, drawn) - rates(theirs, drawn))
    means = rates(ours, chosen) - rates(theirs, chosen)
    low, high = np.percentile(samples, [2.5, 97.5], axis=0)
    return [(means[k], (low[k], high[k]) if len(clusters) > 1 else None) for k in (0, 1)]


def success_rate_and_spl(
    success: Sequence[bool], shortest: Sequence[int], length: Sequence[int]
) -> tuple[float, float]:
    """SR and SPL, in percent."""
    total = wins = 0.0
    for won, least, taken in zip(success, shortest, length, strict=True):
        if won:
            wins += 1
            total += least / taken if taken > least else 1.0
    return 100 * wins / len(success), 100 * total / len(success)
