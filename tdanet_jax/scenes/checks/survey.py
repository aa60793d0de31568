"""What a user should know of a set of rooms before training: targets and parts out of reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility.rules import RULES


@dataclass(frozen=True)
class Unfindable:
    """A target class that is in a room but visible from none of its states."""

    scene: str
    target: str
    reason: str


def unfindable(tables: SceneTables) -> list[Unfindable]:
    """Targets that no state of a room that holds them sees, with the reason."""
    found = []
    best = _least_distance(tables)
    for scene, name in enumerate(tables.scenes):
        here = np.flatnonzero(tables.object_scene == scene)
        for goal, target in enumerate(tables.targets):
            if target not in tables.classes or best[scene, goal] >= 0:
                continue
            items = here[tables.object_class[here] == tables.classes.index(target)]
            if len(items):
                found.append(Unfindable(name, target, _reason(tables, scene, items)))
    return found


def _least_distance(tables: SceneTables) -> np.ndarray:
    """Largest distance entry per scene and target, -1 where no state has a way: [R, G]."""
    first = np.searchsorted(tables.state_scene, np.arange(len(tables.scenes)))
    return np.maximum.reduceat(tables.distance, first, axis=0)


def _reason(tables: SceneTables, scene: int, items: np.ndarray) -> str:
    points = tables.position[tables.position_scene == scene][:, None, [0, 2]]
    box = tables.object_box[items]
    gap = np.maximum(np.maximum(box[:, [0, 2]] - points, points - box[:, [3, 5]]), 0)
    nearest = np.sqrt((gap * gap).sum(axis=-1)).min()
    if nearest > RULES.reach:
        return f"{nearest:.2f} m from the nearest reachable point"
    if not np.isin(tables.row_object, items).any():
        return "seen from nowhere (inside something closed)"
    return "hidden wherever it is within reach"


def parts(tables: SceneTables) -> dict[str, int]:
    """Scenes whose reachable points are not all connected, and in how many parts they are."""
    count, heads = tables.next_position.shape
    tail = np.repeat(np.arange(count), heads)
    links = coo_array(
        (np.ones(count * heads, bool), (tail, tables.next_position.reshape(-1))), (count, count)
    )
    _, label = connected_components(links, directed=False)
    result = {}
    for scene, name in enumerate(tables.scenes):
        pieces = len(np.unique(label[tables.position_scene == scene]))
        if pieces > 1:
            result[name] = pieces
    return result
