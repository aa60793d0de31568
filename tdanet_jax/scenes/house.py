"""Houses: scenes of several rooms, each with a type and the polygon of its floor."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Room(NamedTuple):
    """A room of a house."""

    room_type: str
    corners: np.ndarray  # [N, 2] float64, x and z in metres, of its floor, in order


def types_at(points: np.ndarray, rooms: Sequence[Room]) -> tuple[str, ...]:
    """The type of the room at each point: the room with the point in its polygon, or the nearest.

    Args:
      points: [P, 2] x and z in metres.
      rooms: of several that contain a point, or are as near, the first counts.
    """
    nearest = np.argmin([_distance_squared(points, room.corners) for room in rooms], axis=0)
    return tuple(rooms[i].room_type for i in nearest)


def _distance_squared(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Square of the distance from points [P, 2] to a polygon [N, 2], 0 inside: [P] float64."""
    edge = np.roll(corners, -1, axis=0) - corners
    to = points[:, None] - corners  # [P, N, 2], from the start of each edge
    length = (edge * edge).sum(axis=-1)
    share = np.clip((to * edge).sum(axis=-1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
    gap = to - share[..., None] * edge
    # A ray from a point inside, along +x, crosses an odd number of edges.
    below = corners[:, 1] <= points[:, None, 1]
    crossed = below != np.roll(below, -1, axis=1)
    left = (edge[:, 0] * to[..., 1] - edge[:, 1] * to[..., 0] > 0) == (edge[:, 1] > 0)
    inside = (crossed & left).sum(axis=1) % 2 == 1
    return np.where(inside, 0.0, (gap * gap).sum(axis=-1).min(axis=1))
