"""The reachable points of a room, completed from a published grid that lacks some of them.

AI2-THOR's agent is a capsule, and its reachable points are a flood fill by capsule casts on a
0.25 m grid. The published grids keep only points at which an agent could take every pose, which
costs most points next to walls and furniture: of the places where agents stood in published test
episodes, a quarter is missing. `complete` continues the flood fill from the published points,
with the boxes of the objects in place of their meshes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes.scene import SceneObject
from tdanet_jax.scenes.visibility.geometry import gap_to_box

RADIUS, HEIGHT = 0.2, 1.8  # metres: AI2-THOR's agent, a capsule around its position
#: Flat things on walls. Their boxes reach into the room, or out of it, by more than they do.
FLAT = frozenset(["Blinds", "Curtains", "LightSwitch", "Mirror", "Painting", "Poster", "Window"])

_NEIGHBOURS = np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])


def complete(points: np.ndarray, objects: Sequence[SceneObject]) -> np.ndarray:
    """The points that AI2-THOR reaches and `points` lacks: [A, 3] metres, sorted by x and z.

    A neighbour of a point, one grid step along x or z, is reachable if the agent's capsule stands
    free of the boxes of all objects there. Walls are not published, but a first ring of such
    neighbours stops at them. So beyond the first ring, a neighbour must not lie farther out than
    what is known: in each of the four directions, some point of the grid or of the first ring is
    at least as far out, in the neighbour's row (or column) of the grid or an adjacent one.

    Args:
      points: [P, 3] published points in metres, P >= 1.
      objects: the objects of the room, those with unknown boxes (NaN) left out of the test.
    """
    level = float(np.median(points[:, 1]))
    found = known = _cells(points)
    bounds: np.ndarray | None = None
    while len(found):
        near = np.unique((found[:, None] + _NEIGHBOURS).reshape(-1, 2), axis=0)
        near = near[~(near[:, None] == known).all(axis=2).any(axis=1)]
        if bounds is not None:
            near = near[_within(near, bounds)]
        found = near[clear(near * GRID_SIZE, level, objects)]
        known = np.concatenate([known, found])
        bounds = known if bounds is None else bounds
    added = np.unique(known[len(points) :], axis=0) * GRID_SIZE
    return np.stack([added[:, 0], np.full(len(added), level), added[:, 1]], axis=1)


def _cells(points: np.ndarray) -> np.ndarray:
    """Columns and rows of the grid [P, 2] at `points` [P, 3]."""
    return np.rint(points[:, [0, 2]] / GRID_SIZE).astype(int)


def _within(cells: np.ndarray, bounds: np.ndarray) -> np.ndarray:
    """Whether `bounds` [B, 2] reach at least as far as each of `cells` [N, 2], in each direction,
    in the cell's row or column of the grid or an adjacent one: [N] bool."""
    offset = bounds - cells[:, None]
    result = np.ones(len(cells), bool)
    for along, across in ((0, 1), (1, 0)):
        adjacent = np.abs(offset[..., across]) <= 1
        result &= (adjacent & (offset[..., along] >= 0)).any(axis=1)
        result &= (adjacent & (offset[..., along] <= 0)).any(axis=1)
    return result


def clear(places: np.ndarray, level: float, objects: Sequence[SceneObject]) -> np.ndarray:
    """Whether a capsule at each of `places` [N, 2] (x, z) stands free of all boxes: [N] bool."""
    middle = np.stack([places[:, 0], np.full(len(places), level), places[:, 1]], axis=1)
    half = HEIGHT / 2 - RADIUS  # of the capsule's axis
    result = np.ones(len(places), bool)
    for item in objects:
        if item.object_class in FLAT or not np.isfinite(item.box).all():
            continue
        over = max(item.box[0, 1] - (level + half), (level - half) - item.box[1, 1], 0.0)
        result &= gap_to_box(item, middle) + over**2 >= RADIUS**2
    return result
