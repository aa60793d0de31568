"""The target's position: a slow list of rays in degrees, known points, and the rooms' truth."""

from __future__ import annotations

import copy
import functools
import itertools
import math
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.env import dynamics
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sensors import suite
from tdanet_jax.sensors.odometry import Odometry, OdometryReading, OdometryState
from tdanet_jax.sensors.sensor import Frame, Motion, Start
from tdanet_jax.sensors.triangulation import TargetEstimate, Triangulation, no_estimate
from tests.sensors.test_odometry import NOTHING, RUNS, SlowOdometry, toy_rooms
from tests.support.oracle import (
    DONE,
    LOOK_DOWN,
    LOOK_UP,
    MOVE_AHEAD,
    ROOMS,
    ROTATE_LEFT,
    ROTATE_RIGHT,
    pose_of,
)

#: A walk's actions are filled up to as many, and its frames up to as many boxes.
LONGEST, K = 60, 6
#: What the fast one may be off, as a rounding error of float32 for each sum.
ROUNDING = 4e-7
SENSOR = Triangulation()
SPEC = ObservationSpec(sensors=("odometry", "triangulation"))


class Box(NamedTuple):
    """A detection, as shares of the image."""

    x: float
    y: float
    area: float


class Ray(NamedTuple):
    """A ray to a target, in metres from the start of an episode."""

    start: np.ndarray  # [3]
    along: np.ndarray  # [3], of length 1
    pull: np.ndarray = np.zeros(3)  # added to the right side of the normal equations


class SlowEstimate:
    """All rays to one target in an episode, in float64."""

    def __init__(self) -> None:
        self.rays: list[Ray] = []
        self.radius = 0.0
        self.stood: tuple[int, int] | None = None  # where it was asked for the last time
        self.moved = False  # since the last ray
        self.sums = 0  # rays and moves since the first ray

    def arrive(self, agent: SlowOdometry) -> None:
        """The agent stands here now; asked in every step, so that it knows who came back."""
        here = agent.x, agent.z
        if self.stood is not None and here != self.stood:
            self.moved = True
            self.sums += 1
        self.stood = here

    def observe(self, agent: SlowOdometry, boxes: list[Box]) -> None:
        """What is in view of the target, from where the agent stands and looks."""
        self.arrive(agent)
        if not boxes:
            return
        box = self.nearest(agent, boxes)
        if box is not None and self.degrees_with(agent, box) < 12:
            if self.moved:
                self.rays.append(self.ray_to(agent, box))
                self.sums += 1
        else:
            box = max(boxes, key=lambda box: box.area)
            self.rays, self.sums = [Ray(camera(agent), ray(agent, box))], 1
        self.moved = False
        distance = float(np.linalg.norm(self.seen_from(agent)))
        _, _, ahead = axes(agent.heading, 30 * agent.horizon)
        depth = distance * float(ray(agent, box) @ ahead)
        self.radius = min(math.sqrt(box.area) * depth, 1.0)

    def ray_to(self, agent: SlowOdometry, box: Box) -> Ray:
        """One more ray to what was seen before."""
        return Ray(camera(agent), ray(agent, box))

    def degrees(self, agent: SlowOdometry, box: Box) -> float:
        """How far a box is from the direction of the estimate, as the agent stands and looks."""
        return angle(ray(agent, box), self.seen_from(agent))

    def nearest(self, agent: SlowOdometry, boxes: list[Box]) -> Box | None:
        """The box of what was seen before, if it was that; None if nothing was."""
        if not self.rays:
            return None
        return min(boxes, key=lambda box: self.degrees(agent, box))

    def following(self, agent: SlowOdometry, box: Box) -> SlowEstimate:
        """What is known if the box is of what was seen before."""
        after = copy.copy(self)
        if self.moved:
            after.rays = [*self.rays, self.ray_to(agent, box)]
            after.sums += 1
        return after

    def degrees_with(self, agent: SlowOdometry, box: Box) -> float:
        """How far a box is from the position re-estimated with it."""
        return self.following(agent, box).degrees(agent, box)

    def unclear(self, agent: SlowOdometry, boxes: list[Box]) -> bool:
        """Whether rounding might decide which box it is, or whether it is of what was seen."""
        self.arrive(agent)
        area = sorted((box.area for box in boxes), reverse=True)
        if any(a - b < 1e-5 for a, b in itertools.pairwise(area[:2])):
            return True
        if not self.rays or not boxes:
            return False
        off = self.degrees_off(agent)
        away = sorted(boxes, key=lambda box: self.degrees(agent, box))
        gap = self.degrees(agent, away[min(1, len(away) - 1)]) - self.degrees(agent, away[0])
        tied = away if len(away) > 1 and gap < 2 * off else away[:1]
        after = [self.following(agent, box) for box in tied]
        borders = [12 + known.degrees_off(agent) for known in after]
        ends = [known.degrees(agent, box) for known, box in zip(after, tied, strict=True)]
        if len(tied) > 1:
            return any(end < border for end, border in zip(ends, borders, strict=True))
        return abs(ends[0] - 12) < borders[0] - 12

    def degrees_off(self, agent: SlowOdometry) -> float:
        """By how much float32 may miss the direction of the position, and some more; who stands in
        it may see it anywhere."""
        distance = float(np.linalg.norm(self.seen_from(agent)))
        return math.inf if distance < 0.2 else 1 + math.degrees(self.rounding(agent)) / distance

    def equations(self) -> tuple[np.ndarray, np.ndarray]:
        """Three rows for each ray: a point's distance from it; and for the weak prior."""
        rows, right = [], []
        for start, along, _ in self.rays:
            across = np.eye(3) - np.outer(along, along)
            rows.append(across)
            right.append(across @ start)
        start, along, _ = self.rays[0]
        weight = math.sqrt(1e-3)
        rows.append(weight * np.eye(3))
        right.append(weight * (start + 1.5 * along))
        return np.concatenate(rows), np.concatenate(right)

    def seen_from(self, agent: SlowOdometry) -> np.ndarray:
        """The target's position, from the camera along the axes of the start."""
        rows, right = self.equations()
        moment = rows.T @ right + sum(ray.pull for ray in self.rays)
        return np.asarray(np.linalg.solve(rows.T @ rows, moment) - camera(agent))

    def certainty(self, agent: SlowOdometry) -> float:
        """The weight along the line of sight, that is half at 0.03."""
        rows, _ = self.equations()
        place = self.seen_from(agent)
        along = place / np.linalg.norm(place)
        weight = 1 / float(along @ np.linalg.pinv(rows.T @ rows) @ along)
        return weight / (weight + 0.03)

    def rounding(self, agent: SlowOdometry) -> float:
        """By how many metres float32 may miss the position: sums of many over what is left."""
        if not self.rays:
            return 0.0
        rows, _ = self.equations()
        least = float(np.linalg.svd(rows, compute_uv=False)[-1]) ** 2
        far = 1 + float(np.linalg.norm(self.seen_from(agent)))
        return ROUNDING * self.sums * far / least

    def read(self, agent: SlowOdometry) -> list[float]:
        """The nine numbers."""
        if not self.rays:
            return [0.0] * 9
        place = self.seen_from(agent)
        parts = [float(place @ axis) for axis in axes(agent.heading)]
        near = 1.5 - math.hypot(place[0], place[2])
        within = [min(max(d / 0.25, -1.0), 1.0) for d in (near, near + self.radius)]
        certain = self.certainty(agent)
        return [
            *(min(max(x / 4, -2.0), 2.0) for x in parts), self.radius, certain,
            *within, *(d * certain for d in within),
        ]  # fmt: skip

    def tolerance(self, agent: SlowOdometry) -> list[float]:
        """What the nine numbers may be off; where the agent stands in the target, nobody knows."""
        if not self.rays:
            return [0.0] * 9
        off = 1e-5 + self.rounding(agent)
        inside = float(np.linalg.norm(self.seen_from(agent))) < 0.2
        return [*[off] * 4, *[math.inf if inside else 4e-4 + 4 * off] * 5]


def camera(agent: SlowOdometry) -> np.ndarray:
    """Where the agent's camera is."""
    return 0.25 * np.array([agent.x, 0, agent.z])


def axes(heading: float, down: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and ahead of a camera, in degrees."""
    sine, cosine = (f(math.radians(heading)) for f in (math.sin, math.cos))
    low, level = (f(math.radians(down)) for f in (math.sin, math.cos))
    right = np.array([cosine, 0, -sine])
    ahead = np.array([sine * level, -low, cosine * level])
    return right, np.cross(ahead, right), ahead


def ray(agent: SlowOdometry, box: Box) -> np.ndarray:
    """The direction of a box's centre: the image is 90 degrees wide and high."""
    right, up, ahead = axes(agent.heading, 30 * agent.horizon)
    along = ahead + (2 * box.x - 1) * right + (1 - 2 * box.y) * up
    return np.asarray(along / np.linalg.norm(along))


def angle(a: np.ndarray, b: np.ndarray) -> float:
    """Between two directions, in degrees."""
    return math.degrees(math.atan2(np.linalg.norm(np.cross(a, b)), a @ b))


def box_of(agent: SlowOdometry, place: np.ndarray, size: float) -> Box | None:
    """How a square of some size, in metres, is seen from a pose; None if its middle is not."""
    from_camera = place - camera(agent)
    x, y, depth = (float(from_camera @ axis) for axis in axes(agent.heading, 30 * agent.horizon))
    if depth < 0.1 or max(abs(x), abs(y)) > depth:
        return None
    return Box(0.5 + x / depth / 2, 0.5 - y / depth / 2, min((size / depth / 2) ** 2, 1.0))


class Frames(NamedTuple):
    """What is in view at the start of a walk and after each of its actions."""

    boxes: np.ndarray  # [N + 1, K, 3]
    is_target: np.ndarray  # [N + 1, K]


def frames_of(seen: list[list[Box]], rng: np.random.Generator) -> Frames:
    """The boxes of the target among others, in any order, with rows of padding."""
    boxes = rng.random((LONGEST + 1, K, 3))
    is_target = np.zeros((LONGEST + 1, K), bool)
    for t, found in enumerate(seen):
        rows = rng.permutation(K)[: len(found)]
        boxes[t, rows], is_target[t, rows] = np.reshape(found, (-1, 3)), True
        padding = np.arange(K) > rng.integers(K)
        boxes[t, padding & ~is_target[t]] = 0.0
    return Frames(boxes.astype(np.float32), is_target)


def frame_of(boxes: Any, is_target: Any) -> Frame:
    """The frame of boxes [K, 3], some of which are the target's; those without area are padding."""
    boxes, is_target = jnp.asarray(boxes), jnp.asarray(is_target)
    mask = (boxes[:, 2] > 0) | is_target
    classes = jnp.where(is_target | ~mask, 3, 1)  # of the target's class, padding counts neither
    return Frame(classes, boxes, mask, jnp.int32(3))


@functools.partial(jax.jit, static_argnames="spec")
def walked(
    diagonal: Any, horizon: Any, actions: Any, blocked: Any, frames: Frames, spec: Any = SPEC
) -> tuple[OdometryState, TargetEstimate, jax.Array]:
    """States and what is read of the target, [N + 1], at the start and after every action."""

    def step(states: Any, given: tuple) -> tuple[Any, Any]:
        action, blocked, frame = given
        states = suite.update(spec, states, Motion(action, blocked))
        states = suite.observe(spec, states, frame_of(*frame))
        pose = states["odometry"].replace(cells=jnp.zeros(0))
        name = spec.sensors[-1]
        return states, (pose, states[name], suite.read(spec, states)[name])

    begun = suite.init(spec, Start(jnp.int32(diagonal), jnp.int32(horizon)))
    actions = jnp.concatenate([jnp.array([NOTHING]), actions])
    return jax.lax.scan(step, begun, (actions, jnp.append(True, blocked), frames))[1]


def filled(walk: list[tuple[int, bool]]) -> tuple[np.ndarray, np.ndarray]:
    """Actions and flags of a walk, filled up with turns: one shape is compiled."""
    rows = [*walk, *[(ROTATE_LEFT, False)] * LONGEST][:LONGEST]
    return np.array([a for a, _ in rows], np.int32), np.array([b for _, b in rows])


# Known places


def walked_past(
    place: np.ndarray,
    size: float,
    walk: list[tuple[int, bool]],
    diagonal: bool = False,
    last: int = LONGEST,
) -> tuple[list[SlowOdometry], np.ndarray, int]:
    """Where the agent stands at each step, what is read of a target, and how often it was in view.

    After the step `last` the agent sees no more.
    """
    agents, seen, agent = [], [], SlowOdometry(diagonal, 0)
    for t in range(len(walk) + 1):
        if t:
            agent.update(*walk[t - 1])
        agents.append(copy.copy(agent))
        box = box_of(agent, place, size) if t <= last else None
        seen.append([] if box is None else [box])
    frames = frames_of(seen, np.random.default_rng(0))
    *_, readings = walked(diagonal, 0, *filled(walk), frames)
    return agents, np.asarray(readings)[: len(walk) + 1], sum(map(bool, seen))


AHEAD = [(MOVE_AHEAD, False)]


def from_start(side: int, right: float, up: float, ahead: float, diagonal: bool) -> np.ndarray:
    """A point to the right or left, up and ahead of the start as it faces, in metres."""
    x, y, z = axes(45 * diagonal)
    return np.asarray(side * right * x + up * y + ahead * z)


@pytest.mark.parametrize("place", [(0.8, 0.3, 3.0), (-1.0, -0.6, 2.0), (0.1, 0.0, 0.7)])
def test_one_ray_gives_a_position_within_reach_and_little_certainty(place: tuple) -> None:
    target = np.array(place)
    agents, readings, _ = walked_past(target, 0.3, 10 * AHEAD, last=0)
    guess = 1.5 * target / np.linalg.norm(target)
    nearer = 1.5 / float(np.linalg.norm(target))  # a square of 0.3 m there looks as large
    for agent, row in zip(agents, readings, strict=True):
        np.testing.assert_allclose(4 * row[:3], guess - camera(agent), atol=2e-3)
        np.testing.assert_allclose(row[3], 0.15 * nearer, rtol=1e-3)
    assert 0.01 < readings[0, 4] < 0.05


@pytest.mark.parametrize("horizon", [0, 1])
@pytest.mark.parametrize("turns", range(8))
def test_the_first_estimate_lies_along_the_ray_wherever_the_agent_looks(
    turns: int, horizon: int
) -> None:
    agent, box = SlowOdometry(False, horizon), Box(0.8, 0.3, 0.1)
    walk = turns * [(ROTATE_RIGHT, False)]
    for action in walk:
        agent.update(*action)
    frames = frames_of([*([] for _ in walk), [box]], np.random.default_rng(0))
    *_, readings = walked(False, horizon, *filled(walk), frames)
    right, up, ahead = axes(agent.heading)
    expected = [1.5 * float(ray(agent, box) @ axis) for axis in (right, up, ahead)]
    np.testing.assert_allclose(4 * np.asarray(readings[turns, :3]), expected, atol=2e-3)
    # Up by hand: the box is as much as 0.4 over the middle where the image ends at 1.
    level = 0.4 * math.cos(math.pi / 6) - 0.5 if horizon else 0.4
    assert expected[1] == pytest.approx(1.5 * level / math.sqrt(0.6**2 + 0.4**2 + 1))


def test_nothing_is_read_before_the_target_was_seen() -> None:
    for walk in ([], 10 * AHEAD, [(LOOK_DOWN, False), (ROTATE_LEFT, False), *AHEAD]):
        behind = from_start(1, 0.0, 0.0, -3.0, diagonal=False)
        _, readings, times = walked_past(behind, 1.0, walk)
        assert times == 0
        np.testing.assert_array_equal(readings, np.zeros((len(walk) + 1, 9)))


@pytest.mark.parametrize("size", [0.2, 0.6, 3.0])
def test_the_radius_is_half_a_side_and_how_far_the_reach_goes(size: float) -> None:
    target = from_start(1, 0.8, 0.0, 3.0, diagonal=False)
    agents, readings, times = walked_past(target, size, 10 * AHEAD)
    assert 6 < times <= 10
    # The nearer the estimate is to the target, the better.
    expected = [target - camera(agent) for agent in agents[:times]]
    missed = np.linalg.norm(4 * readings[:times, :3] - expected, axis=1)
    depth = np.array([target[2] - camera(agent)[2] for agent in agents[:times]])
    off = np.abs(readings[:times, 3] - min(size / 2, 1.0))
    assert (off <= size / 2 * missed / depth + 1e-4).all()
    assert off[times - 2 : times].max() < 0.02 * min(size / 2, 1.0)
    # Out of view it stays as it was last seen.
    np.testing.assert_array_equal(readings[times:, 3], readings[times - 1, 3])
    level = 4 * np.hypot(readings[:, 0], readings[:, 2])
    for column, near in ((5, 0.0), (6, readings[:, 3])):
        within = np.clip((1.5 - level + near) / 0.25, -1, 1)
        np.testing.assert_allclose(readings[:, column], within, atol=1e-4)
        certainly = readings[:, column] * readings[:, 4]
        np.testing.assert_allclose(readings[:, column + 2], certainly, atol=1e-6)


def test_a_plate_that_faces_the_camera_has_its_true_radius_anywhere_in_view() -> None:
    """Its position is known from three sides; then it is seen off axis and from above."""
    plates, known, horizons, boxes = [], [], [], []
    for horizon, side, up, (size, depth) in itertools.product(
        (0, 1), (-0.9, 0.0, 0.7), (-0.9, -0.3, 0.2), ((0.3, 2.0), (1.0, 1.2))
    ):
        right, above, ahead = axes(45, 30 * horizon)
        plate = depth * (ahead + side * right + up * above)
        normal, moment = np.zeros((3, 3)), np.zeros(3)
        for start in np.array([(-1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 0.0, 0.0)]):
            along = (plate - start) / np.linalg.norm(plate - start)
            across = np.eye(3) - np.outer(along, along)
            normal, moment = normal + across, moment + across @ start
        box = box_of(SlowOdometry(True, horizon), plate, size)
        assert box is not None
        plates.append(size / 2)
        known.append((np.float32(normal), np.float32(moment)))
        horizons.append(horizon)
        boxes.append([box])

    @jax.jit
    @jax.vmap
    def radius(normal: jax.Array, moment: jax.Array, horizon: jax.Array, box: jax.Array) -> Any:
        before = no_estimate().replace(normal=normal, moment=moment)
        pose = {"odometry": Odometry().init(Start(jnp.int32(1), horizon))}
        return SENSOR.observe(before, frame_of(box, jnp.ones(1, bool)), pose).radius

    normals, moments = (jnp.stack(x) for x in zip(*known, strict=True))
    found = radius(normals, moments, jnp.array(horizons), jnp.array(boxes))
    np.testing.assert_allclose(found, plates, rtol=1e-3)


@pytest.mark.parametrize("degrees", [5.0, 10.0, 14.0, 20.0])
@pytest.mark.parametrize("walk", [[(LOOK_UP, False)], [(MOVE_AHEAD, True), (DONE, False)]])
def test_of_several_it_tracks_the_one_it_saw_or_starts_anew_with_the_largest(
    degrees: float, walk: list
) -> None:
    known, large = Box(0.5, 0.5, 0.01), Box(0.1, 0.5, 0.3)
    other = known._replace(x=0.5 + math.tan(math.radians(degrees)) / 2)
    frames = frames_of([[known], *([] for _ in walk[1:]), [other, large]], np.random.default_rng(0))
    *_, readings = walked(False, 0, *filled(walk), frames)
    right, _, ahead, radius, *_ = np.asarray(readings[len(walk)])
    found = math.degrees(math.atan2(right, ahead))
    assert 4 * math.hypot(right, ahead) == pytest.approx(1.5, abs=1e-3)
    if degrees < 12:  # it is the one that it knows, and from here was known before
        assert found == pytest.approx(0.0, abs=0.01)
        deep = 1.5 * math.cos(math.radians(degrees))
        assert radius == pytest.approx(0.1 * deep, abs=1e-4)
    else:
        assert found == pytest.approx(-math.degrees(math.atan(0.8)), abs=0.01)
        deep = 1.5 * math.cos(math.atan(0.8))
        assert radius == pytest.approx(math.sqrt(0.3) * deep, abs=1e-3)


TURN = 2 * [(ROTATE_RIGHT, False)]  # a quarter
TURN_BACK = 2 * [(ROTATE_LEFT, False)]


@pytest.mark.parametrize(
    ("place", "steps", "close"),
    [
        ((0.0, 0.0, 3.0), 3, 0.06), ((0.8, -0.4, 3.0), 4, 0.04), ((0.0, 0.2, 3.0), 8, 0.01),
        ((0.4, 0.3, 4.5), 6, 0.06), ((0.4, 0.3, 4.5), 8, 0.04), ((-0.5, -0.6, 6.0), 8, 0.1),
        ((-0.5, -0.6, 6.0), 3, 0.6),  # of nearly parallel rays, the prior matters
    ],
)  # fmt: skip
def test_what_was_seen_once_is_found_from_far_to_the_side(
    place: tuple, steps: int, close: float
) -> None:
    """It turns away, goes 0.75 to 2 m sideways without seeing it, and looks again."""
    target = np.array(place)
    walk = [*TURN, *steps * AHEAD, *TURN_BACK]
    agents, readings, _ = walked_past(target, 0.3, walk)
    seen = [agent for agent in agents if box_of(agent, target, 0.3)]
    assert {(agent.x, agent.z) for agent in seen} == {(0, 0), (steps, 0)}
    there = target - camera(agents[-1])
    guess = 1.5 * target / np.linalg.norm(target) - camera(agents[-1])
    assert angle(guess, there) > 12
    assert np.linalg.norm(4 * readings[-1, :3] - there) < close
    assert readings[-1, 4] > 5 * readings[0, 4]


@pytest.mark.parametrize("degrees", [0.0, 8.0])
def test_who_stands_still_learns_nothing_new_however_long_it_looks(degrees: float) -> None:
    first = Box(0.8, 0.3, 0.04)
    rng = np.random.default_rng(6)
    shift = math.tan(math.radians(degrees)) / 2 * rng.uniform(-0.5, 0.5, (300, 2))
    boxes = np.tile(np.array(first, np.float32), (300, 1))
    boxes[1:, :2] += shift[1:]

    def step(states: Any, box: jax.Array) -> tuple[Any, Any]:
        states = suite.update(SPEC, states, Motion(jnp.int32(DONE), jnp.array(True)))
        states = suite.observe(SPEC, states, frame_of(box[None], jnp.ones(1, bool)))
        return states, suite.read(SPEC, states)["triangulation"]

    begun = suite.init(SPEC, Start(jnp.int32(1), jnp.int32(1)))

    _, readings = jax.lax.scan(step, begun, jnp.asarray(boxes))
    assert readings.dtype == jnp.float32
    place_and_certainty = np.asarray(readings)[:, [0, 1, 2, 4]]
    np.testing.assert_array_equal(place_and_certainty, place_and_certainty[:1].repeat(300, 0))
    far = 4 * np.linalg.norm(place_and_certainty[-1, :3])
    assert far == pytest.approx(1.5, abs=1e-3)
    assert float(readings[-1, 4]) == pytest.approx(1e-3 / (1e-3 + 0.03), rel=1e-2)
    assert (np.ptp(np.asarray(readings[:, 3])) > 0) == (degrees > 0)  # the radius is renewed


def test_after_going_away_and_coming_back_rays_count_again() -> None:
    about = 4 * [(ROTATE_RIGHT, False)]
    away = [*about, *AHEAD, *about, *AHEAD]
    here = [*about, *about, (MOVE_AHEAD, True), (LOOK_DOWN, False), (LOOK_UP, False)]
    first, second = Box(0.5, 0.5, 0.01), Box(0.5 + math.tan(math.radians(8)) / 2, 0.5, 0.01)
    for walk, expected in ((here, 0.0), (away, 4.0)):
        frames = frames_of([[first], *([] for _ in walk[1:]), [second]], np.random.default_rng(0))
        pose, estimate, readings = walked(False, 0, *filled(walk), frames)
        assert not np.asarray(pose.cell[len(walk)]).any()
        right, _, ahead, *_ = np.asarray(readings[len(walk)])
        assert math.degrees(math.atan2(right, ahead)) == pytest.approx(expected, abs=0.1)
    # Once it has counted, it counts no more.
    assert not estimate.moved[len(walk)]


# On any walk


PLACES = st.tuples(
    st.sampled_from((-1, 1)), st.floats(0.8, 1.2), st.floats(-0.7, 0.4), st.floats(3.0, 4.0)
)


class Story(NamedTuple):
    """A walk past some targets, and what the slow one reads of them."""

    walk: list[tuple[int, bool]]
    frames: Frames
    readings: list[list[float]]  # at the start and after every action
    tolerance: list[list[float]]
    begun: int  # how often it began with another box


def told(
    diagonal: bool, horizon: int, runs: list, seed: int, noise: float, kind: Any = SlowEstimate
) -> Story:
    """A walk past one to three targets; nothing is in view where rounding would decide."""
    rng = np.random.default_rng(seed)
    walk = [(action, blocked) for action, blocked, times in runs for _ in range(times)][:LONGEST]
    targets = [
        (rng.uniform((-4, -1.5, -4), (4, 1, 4)), rng.uniform(0.05, 1.5))
        for _ in range(rng.integers(1, 4))
    ]
    agent, slow = SlowOdometry(diagonal, horizon), kind()
    seen, readings, tolerance, begun = [], [], [], 0
    for t in range(len(walk) + 1):
        if t:
            agent.update(*walk[t - 1])
        boxes = [box for place, size in targets if (box := box_of(agent, place, size))]
        if noise == 1:  # anything, anywhere
            boxes = [Box(*rng.random(3)) for _ in range(rng.integers(4))]
        elif noise:
            boxes = [Box(*np.clip(box + noise * rng.normal(size=3), 1e-3, 1)) for box in boxes]
        boxes = [Box(*map(float, np.float32(box))) for box in boxes]
        if rng.random() < 0.2 or slow.unclear(agent, boxes):
            boxes = []
        slow.observe(agent, boxes)
        begun += bool(boxes) and len(slow.rays) == 1
        seen.append(boxes)
        readings.append(slow.read(agent))
        tolerance.append(slow.tolerance(agent))
    return Story(walk, frames_of(seen, rng), readings, tolerance, begun)


def assert_as_told(story: Story, diagonal: bool, horizon: int, spec: Any = SPEC) -> None:
    *_, found = walked(diagonal, horizon, *filled(story.walk), story.frames, spec)
    off = np.abs(np.asarray(found)[: len(story.readings)] - story.readings)
    assert (off <= story.tolerance).all(), off.max(axis=0)


STORIES = {
    "diagonal": st.booleans(),
    "horizon": st.integers(0, 1),
    "runs": RUNS,
    "seed": st.integers(0, 2**32 - 1),
    "noise": st.sampled_from((0.0, 0.02, 1.0)),
}


@settings(max_examples=60)
@given(**STORIES)
def test_every_step_is_that_of_the_slow_estimate(
    diagonal: bool, horizon: int, runs: list, seed: int, noise: float
) -> None:
    assert_as_told(told(diagonal, horizon, runs, seed, noise), diagonal, horizon)


@settings(max_examples=25)
@given(place=PLACES, diagonal=st.booleans(), size=st.floats(0.05, 2.0))
def test_what_is_passed_is_found_to_within_centimetres_whatever_its_size(
    place: tuple, diagonal: bool, size: float
) -> None:
    target = from_start(*place, diagonal)
    agents, readings, times = walked_past(target, size, 16 * AHEAD, diagonal)
    assert times > 4
    last = [float((target - camera(agents[-1])) @ axis) for axis in axes(45 * diagonal)]
    np.testing.assert_allclose(4 * readings[-1, :3], last, atol=0.03)
    assert readings[times - 1, 4] > 0.7
    _, other, _ = walked_past(target, 0.3, 16 * AHEAD, diagonal)
    np.testing.assert_array_equal(readings[:, [0, 1, 2, 4, 5, 7]], other[:, [0, 1, 2, 4, 5, 7]])


#: What does not move the agent.
STILL = (
    (ROTATE_LEFT, False), (ROTATE_RIGHT, False), (LOOK_UP, False), (LOOK_DOWN, False),
    (MOVE_AHEAD, True), (DONE, True),
)  # fmt: skip


@settings(max_examples=25)
@given(place=PLACES, diagonal=st.booleans(), still=st.lists(st.sampled_from(STILL), max_size=12))
def test_who_stands_still_reads_the_same_in_another_direction(
    place: tuple, diagonal: bool, still: list
) -> None:
    target = from_start(*place, diagonal)
    agents, readings, _ = walked_past(target, 0.3, [*4 * AHEAD, *still], diagonal, last=4)
    there = np.stack(axes(45 * diagonal)).T @ readings[4, :3]
    assert np.linalg.norm(there) > 0.2
    for agent, row in zip(agents[4:], readings[4:], strict=True):
        np.testing.assert_allclose(row[3:], readings[4, 3:], atol=2e-5)
        np.testing.assert_allclose(np.stack(axes(agent.heading)).T @ row[:3], there, atol=1e-5)


@pytest.mark.slow
def test_compiled_is_eager_and_many_are_one_by_one() -> None:
    runs = [(MOVE_AHEAD, False, 3), (ROTATE_RIGHT, False, 1), (MOVE_AHEAD, True, 1)]
    starts = [(False, 0), (True, 1), (True, 0)]
    stories = [told(*start, runs, seed, 1.0) for seed, start in enumerate(starts)]
    walks = [(*start, *filled(s.walk), s.frames) for start, s in zip(starts, stories, strict=True)]
    alone = [walked(*walk) for walk in walks]
    close = {"rtol": 2e-3, "atol": 2e-3}  # of one ray, three decimals of the position are left
    together = jax.vmap(walked)(*jax.tree.map(lambda *x: jnp.stack(x), *walks))
    chex.assert_trees_all_close(together, jax.tree.map(lambda *x: jnp.stack(x), *alone), **close)
    assert all(np.asarray(readings).any() for *_, readings in alone)
    states = suite.init(SPEC, Start(jnp.int32(starts[0][0]), jnp.int32(starts[0][1])))
    for t, frame in enumerate(zip(*(x[:3] for x in stories[0].frames), strict=True)):
        motion = Motion(jnp.int32(MOVE_AHEAD if t else NOTHING), jnp.array(False))
        states = suite.update(SPEC, states, motion)
        states = suite.observe(SPEC, states, frame_of(*frame))
        eager = states["triangulation"], suite.read(SPEC, states)["triangulation"]
        now = jax.tree.map(lambda x, t=t: x[t], alone[0][1:])
        chex.assert_trees_all_close(eager, now, **close)
        chex.assert_trees_all_equal_dtypes(eager, now)


@pytest.mark.parametrize("changed", [False, True])
def test_of_another_target_there_is_no_estimate_and_the_pose_is_kept(changed: bool) -> None:
    ahead = Motion(jnp.int32(MOVE_AHEAD), jnp.array(False))
    states = suite.init(SPEC, Start(jnp.int32(1), jnp.int32(0)))
    states = suite.update(SPEC, states, ahead)
    states = suite.observe(SPEC, states, frame_of([[0.4, 0.6, 0.2]], [True]))
    states = suite.update(SPEC, states, ahead)
    after = suite.clear(SPEC, states, jnp.array(changed))
    assert states["triangulation"].normal.any()
    expected = {**states, "triangulation": no_estimate()} if changed else states
    chex.assert_trees_all_equal(after, expected)
    chex.assert_trees_all_equal_dtypes(after["triangulation"], no_estimate())


def test_the_features_of_the_target_are_its_reading_after_those_of_odometry() -> None:
    rng = np.random.default_rng(0)
    motion, target = (jnp.asarray(rng.normal(size=(2, 3, n)), jnp.float32) for n in (12, 9))
    window = jnp.asarray(rng.integers(0, 512, (2, 3, 9, 9)), jnp.uint16)
    reading = OdometryReading(motion, window)
    found = suite.features(SPEC, {"triangulation": target, "odometry": reading})
    assert SENSOR.width == 9
    assert found.shape == (2, 3, suite.width(SPEC)) == (2, 3, 741 + 9)
    assert found.dtype == jnp.float32
    np.testing.assert_array_equal(found[..., -9:], target)
    np.testing.assert_array_equal(found[..., :-9], Odometry().features(reading))


# In the environment


def params_of(tables: SceneTables, triangulation: bool, limit: int = 1000) -> EnvParams:
    """Episodes for every target in every room, of an agent with odometry."""
    targets, limits = dict.fromkeys(ROOMS, tables.targets), (limit,) * 4
    spec = SPEC if triangulation else ObservationSpec(sensors=("odometry",))
    return make_params(tables, targets, no_parents(tables), limits, spec)


@pytest.fixture(params=["real", pytest.param("toy", marks=pytest.mark.slow)])
def tables(request: pytest.FixtureRequest) -> SceneTables:
    if request.param == "toy":
        return toy_rooms()
    found: SceneTables = request.getfixturevalue("some_rooms")
    return found


class Walks(NamedTuple):
    """Random walks, half of their actions MoveAhead, that ask for something in their rooms."""

    pose: np.ndarray  # [N + 1, B]
    goal: np.ndarray  # [B]
    actions: np.ndarray  # [N, B]
    readings: np.ndarray  # [N + 1, B, 9]


@jax.jit
def readings_on(params: EnvParams, pose: Any, goal: Any, actions: Any) -> Any:
    """Poses and what is read of the target, at the start of episodes and after each action."""

    def step(state: EnvState, action: jax.Array) -> tuple[EnvState, Any]:
        state = jax.vmap(dynamics.transition, (0, 0, None))(state, action, params).state
        return state, shown(state)

    def shown(state: EnvState) -> Any:
        obs = jax.vmap(dynamics.observe, (0, None))(state, params)
        return state.pose, obs.sensors["triangulation"]

    start = jax.vmap(dynamics.start, (0, 0, None))(pose, goal, params)
    _, after = jax.lax.scan(step, start, actions)
    return jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), shown(start), after)


def random_walks(tables: SceneTables, batch: int = 256, steps: int = 40) -> Walks:
    rng = np.random.default_rng(5)
    state, goal = np.nonzero(tables.distance >= 0)
    chosen = rng.integers(len(state), size=batch)
    state, goal = state[chosen].astype(np.int32), goal[chosen].astype(np.int32)
    actions = rng.choice(5, (steps, batch), p=[0.5, 0.2, 0.2, 0.05, 0.05]).astype(np.int32)
    pose, readings = jax.device_get(readings_on(params_of(tables, True), state, goal, actions))
    return Walks(pose, goal, actions, readings)


def in_view(tables: SceneTables, pose: int, goal: int) -> list[Box]:
    """The boxes of a target from a pose; what has none is no detection."""
    boxes = []
    for row in range(tables.row_start[pose], tables.row_start[pose + 1]):
        x1, y1, x2, y2 = map(float, tables.row_box[row] / (tables.image * tables.subpixel))
        if tables.classes[tables.row_class[row]] == tables.targets[goal] and x1 >= 0:
            boxes.append(Box((x1 + x2) / 2, (y1 + y2) / 2, (x2 - x1) * (y2 - y1)))
    return boxes


class SlowEpisode:
    """What is read of the target in an episode, until rounding decides about a box."""

    def __init__(self, tables: SceneTables, pose: int, goal: int) -> None:
        start = pose_of(pose)
        self.tables, self.goal, self.clear = tables, goal, True
        self.agent = SlowOdometry(start.heading % 90 != 0, start.horizon // 30)
        self.estimate = SlowEstimate()
        self.observe(pose)

    def observe(self, pose: int) -> None:
        """What is in view from the pose."""
        boxes = in_view(self.tables, pose, self.goal)
        self.clear = self.clear and not self.estimate.unclear(self.agent, boxes)
        if self.clear:
            self.estimate.observe(self.agent, boxes)

    def update(self, action: int, before: int, after: int) -> None:
        """An action, from pose to pose."""
        self.agent.update(action, before == after)
        self.observe(after)

    def assert_read(self, found: np.ndarray) -> None:
        off = np.abs(np.asarray(found) - self.estimate.read(self.agent))
        assert (off <= self.estimate.tolerance(self.agent)).all(), off


def test_what_the_environment_reads_is_the_slow_estimate(tables: SceneTables) -> None:
    walks = random_walks(tables)
    compared = certain = 0
    for b in range(64):
        slow = SlowEpisode(tables, int(walks.pose[0, b]), int(walks.goal[b]))
        for t in range(41):
            if t:
                slow.update(int(walks.actions[t - 1, b]), *map(int, walks.pose[t - 1 : t + 1, b]))
            if not slow.clear:
                break
            slow.assert_read(walks.readings[t, b])
            compared += bool(slow.estimate.rays)
            certain += walks.readings[t, b, 4] > 0.5
    assert compared > 1000
    assert certain > 90


def test_who_is_certain_is_rarely_wrong_about_the_reach(some_rooms: SceneTables) -> None:
    walks, params = random_walks(some_rooms), params_of(some_rooms, triangulation=True)
    certain = walks.readings[..., 4] > 0.5
    pose, goal = walks.pose[certain], np.broadcast_to(walks.goal, certain.shape)[certain]
    in_sight = [len(in_view(some_rooms, *here)) == 1 for here in zip(pose, goal, strict=True)]
    classes = params.target_class[goal]
    visible = np.asarray(jax.vmap(dynamics.is_visible, (0, 0, None))(pose, classes, params))
    middle, side = walks.readings[certain][:, 5:7].T
    too_far, near = (side <= -1) & in_sight, (middle >= 1) & in_sight
    assert min(too_far.sum(), near.sum()) > 100
    assert visible[too_far].mean() < 0.03
    assert visible[near].mean() > 0.8


@pytest.mark.slow
def test_an_automatic_reset_begins_anew() -> None:
    tables, batch, rng = toy_rooms(), 32, np.random.default_rng(4)
    params = params_of(tables, triangulation=True, limit=7)
    reset, step = (jax.jit(jax.vmap(f, axes)) for f, axes in (
        (dynamics.reset, (0, None)), (dynamics.step, (0, 0, 0, None)),
    ))  # fmt: skip
    obs, state = reset(jax.random.split(jax.random.key(0), batch), params)

    def begun(b: int) -> SlowEpisode:
        return SlowEpisode(tables, int(state.pose[b]), int(state.target[b]))

    slow = [begun(b) for b in range(batch)]
    forgotten = compared = 0
    for t in range(25):
        actions = rng.choice(6, batch, p=[0.5, 0.1, 0.2, 0.05, 0.05, 0.1])
        keys = jax.random.split(jax.random.fold_in(jax.random.key(1), t), batch)
        before = state
        obs, state, _, terminated, truncated, info = step(keys, state, actions, params)
        final = jax.device_get(info["final_state"])
        for b in range(batch):
            slow[b].update(int(actions[b]), int(before.pose[b]), int(final.pose[b]))
            if terminated[b] or truncated[b]:
                known, slow[b] = slow[b].estimate.rays, begun(b)
                forgotten += bool(known) and not slow[b].estimate.rays
            if slow[b].clear:
                slow[b].assert_read(obs.sensors["triangulation"][b])
                compared += bool(slow[b].estimate.rays)
    assert forgotten > 10
    assert compared > 200


def test_without_triangulation_everything_else_is_the_same(some_rooms: SceneTables) -> None:
    state, goal = (x[::9999] for x in np.nonzero(some_rooms.distance == 3))
    found = []
    for triangulates in (False, True):
        params = params_of(some_rooms, triangulates)
        begun = jax.jit(jax.vmap(dynamics.start, (0, 0, None)))(state, goal, params)
        after = jax.jit(jax.vmap(dynamics.transition, (0, None, None)))(begun, jnp.int32(0), params)
        found.append((after, jax.jit(jax.vmap(dynamics.observe, (0, None)))(after.state, params)))
    (plain, obs), (tracking, more) = found
    assert list(plain.state.sensors) == list(obs.sensors) == ["odometry"]
    assert list(tracking.state.sensors) == list(more.sensors) == ["odometry", "triangulation"]

    def without(held: Any) -> Any:
        return held.replace(sensors={"odometry": held.sensors["odometry"]})

    tracking = tracking._replace(state=without(tracking.state))
    chex.assert_trees_all_equal(tracking, plain)
    chex.assert_trees_all_equal(without(more), obs)


@pytest.mark.parametrize(
    "grid",
    [PoseGrid(0.5, 4, (-60, 0)), PoseGrid(0.1, 12, (-60, 0, 20)), PoseGrid(0.25, 24, (-60, 0))],
    ids=str,
)
def test_on_other_grids_the_estimate_is_where_the_target_is(grid: PoseGrid) -> None:
    """Seen level and, from three steps on, looking up by 60 degrees; then from a quarter turn."""
    spec = ObservationSpec(sensors=SPEC.sensors, grid=grid)
    target, at = np.array([-0.1, 1.2, 1.4]), 3 * grid.grid_size  # right, up, ahead; metres ahead

    def frame(ahead: float, down: float, seen: bool = True) -> Frame:
        right, up, away = target - (0, 0, ahead)
        cosine, sine = math.cos(math.radians(down)), math.sin(math.radians(down))
        depth, height = away * cosine - up * sine, up * cosine + away * sine
        box = [(1 + right / depth) / 2, (1 - height / depth) / 2, 0.01]
        return Frame(jnp.ones(1, int), jnp.array([box]), jnp.array([seen]), jnp.int32(1))

    states = suite.init(spec, Start(jnp.int32(0), jnp.int32(1)))
    states = suite.observe(spec, states, frame(0, 0))
    turns = [ROTATE_RIGHT] * (grid.rotations // 4)
    for action in [MOVE_AHEAD] * 3 + [LOOK_UP]:
        states = suite.update(spec, states, Motion(jnp.int32(action), jnp.bool_(False)))
    states = suite.observe(spec, states, frame(at, -60))
    x, up, z, *_ = suite.read(spec, states)["triangulation"]
    np.testing.assert_allclose([4 * x, 4 * up, 4 * z], target - (0, 0, at), atol=0.05)
    for action in turns:
        states = suite.update(spec, states, Motion(jnp.int32(action), jnp.bool_(False)))
        states = suite.observe(spec, states, frame(at, 0, seen=False))
    x, up, z, *_ = suite.read(spec, states)["triangulation"]
    np.testing.assert_allclose([4 * x, 4 * up, 4 * z], [at - 1.4, 1.2, -0.1], atol=0.05)
