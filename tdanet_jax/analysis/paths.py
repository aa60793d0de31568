"""Where the paths of an agent are longer than the shortest ones."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from tdanet_jax.analysis import trace
from tdanet_jax.analysis.episode_lookup import Recorded
from tdanet_jax.env.types import EnvParams
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.vocabulary import Action

#: The parts of a successful path, in order.
PARTS = {
    "search": "until the target is first in view",
    "approach": "from there until it is first in reach",
    "stop": "from there until Done",
}


class Trajectory(NamedTuple):
    """A recorded episode of T actions, and what held before each of them and at the end."""

    record: Recorded
    goal: int  # index of the target
    pose: np.ndarray  # [T + 1] int
    distance: np.ndarray  # [T + 1] int, actions without Done until the target is in reach
    in_view: np.ndarray  # [T + 1] bool, the target has a box in the image

    @property
    def success(self) -> bool:
        """Done with the target in reach."""
        return self.record.actions[-1] == Action.DONE and self.distance[-1] == 0


class Parts(NamedTuple):
    """Means over the successes of a group; each field but the last two is by part, [3].

    The shortest path is L actions long, the agent's e. The parts and the Done add up to e, and
    their excess to e - L.
    """

    actions: np.ndarray  # without Done
    excess: np.ndarray  # actions that the shortest path does without
    spl_without: np.ndarray  # percent: SPL if the part's excess were not there
    spl: float  # percent, over all episodes of the group
    successes: int


def follow(
    records: Sequence[Recorded], tables: SceneTables, params: EnvParams
) -> Iterator[Trajectory]:
    """The paths of recorded episodes, in their order.

    Args:
      records: as `episode_lookup.read_records` gives them.
      tables: the rooms in which they were recorded.
      params: of the same rooms (`Task.eval_params`).
    """
    starts = Episodes(
        np.concatenate([record.episode.pose for record in records]),
        np.concatenate([record.episode.target for record in records]),
    )
    actions = np.full((len(records), max(len(r.actions) for r in records)), -1)
    for row, record in zip(actions, records, strict=True):
        row[: len(record.actions)] = record.actions
    poses = trace.follow(starts, actions, params)
    in_view = targets_in_view(tables)
    for i, record in enumerate(records):
        goal, pose = int(starts.target[i]), poses[i, : len(record.actions) + 1]
        distance = tables.distance[pose, goal].astype(int)
        yield Trajectory(record, goal, pose, distance, in_view[pose, goal])


def targets_in_view(tables: SceneTables) -> np.ndarray:
    """Whether a target has a box in the image: [S, G] bool."""
    goal = np.full(len(tables.classes), -1)
    for i, name in enumerate(tables.targets):
        if name in tables.classes:
            goal[tables.classes.index(name)] = i
    rows = np.flatnonzero((goal[tables.row_class] >= 0) & (tables.row_box[:, 0] >= 0))
    in_view = np.zeros((tables.num_states, len(tables.targets)), bool)
    in_view[tables.row_state[rows], goal[tables.row_class[rows]]] = True
    return in_view


def parts(paths: Sequence[Trajectory]) -> Parts | None:
    """What the parts of the paths of a group cost; None without a success.

    Args:
      paths: all of the group, failures as well, which count as 0 in SPL.
    """
    actions, excess, length, shortest = [], [], [], []
    for path in (path for path in paths if path.success):
        last, least = len(path.record.actions) - 1, int(path.distance[0])
        reached = int(np.argmax(path.distance == 0))
        # A target can be in reach without a box.
        seen = min(int(np.argmax(path.in_view)) if path.in_view.any() else reached, reached)
        left = int(path.distance[seen])
        actions.append((seen, reached - seen, last - reached))
        excess.append((seen + left - least, reached - seen - left, last - reached))
        length.append(last + 1)
        shortest.append(least + 1)
    if not actions:
        return None
    each, more = np.array(actions), np.array(excess)
    taken, least_taken = np.array(length), np.array(shortest)

    def spl(taken: np.ndarray) -> float:
        return 100 * float((least_taken / taken).sum()) / len(paths)

    without = np.array([spl(taken - more[:, part]) for part in range(len(PARTS))])
    return Parts(each.mean(axis=0), more.mean(axis=0), without, spl(taken), len(actions))
