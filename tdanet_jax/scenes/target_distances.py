"""Tables for other targets: the distances to any classes, computed when they are asked for."""

from __future__ import annotations

import dataclasses
import hashlib
import inspect
from collections.abc import Iterable, Sequence

import numpy as np

from tdanet_jax.scenes import cache
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility import geometry

#: Targets that are searched for together, one bit of a word each.
TOGETHER = 64
#: Fewer distances than these are computed faster than they are read.
KEPT = 1_000_000


def with_targets(tables: SceneTables, names: Iterable[str]) -> SceneTables:
    """The tables with these classes among their targets; those that were lacking come last.

    Args:
      names: classes of the tables.
    """
    lacking = tuple(name for name in dict.fromkeys(names) if name not in tables.targets)
    if not lacking:
        return tables
    if tables.num_states * len(lacking) < KEPT:
        further = distances(tables, lacking)
    else:
        made = (inspect.getsource(geometry), tables.data_version, *lacking)
        name = f"{cache.DISTANCES}{hashlib.sha256(repr(made).encode()).hexdigest()[:16]}.npz"
        further = cache.load(name, lambda: {"distance": distances(tables, lacking)})["distance"]
    return dataclasses.replace(
        tables,
        targets=tables.targets + lacking,
        distance=np.concatenate([tables.distance, further], axis=1),
    )


def distances(tables: SceneTables, names: Sequence[str]) -> np.ndarray:
    """Fewest actions until an object of each class is visible, as `tabulation.tabulate` has them.

    Returns:
      [S, len(names)] int16, -1 where it never is.
    """
    successor = geometry.transitions(tables.next_position, tables.grid)
    states, classes = tables.row_state[tables.row_visible], tables.row_class[tables.row_visible]
    found = np.empty((tables.num_states, len(names)), np.int16)
    for first in range(0, len(names), TOGETHER):
        part = names[first : first + TOGETHER]
        goals = np.zeros((tables.num_states, len(part)), bool)
        for goal, name in enumerate(part):
            goals[states[classes == tables.classes.index(name)], goal] = True
        found[:, first : first + TOGETHER] = geometry.action_distances(successor, goals)
    return found
