"""A pose as one number: (position * 8 + rotation) * 2 + horizon.

A position is the index of a reachable point in the tables. Rotations are 45 degrees apart,
clockwise from +z; horizon 0 is level, 1 looks 30 degrees down. Scene tables call a pose a state.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

GRID_SIZE = 0.25  # metres between neighbouring reachable points: AI2-THOR's gridSize
ROTATIONS = 8
HORIZONS = 2
#: Grid cells (x, z) that MoveAhead moves along each rotation; both axes along a diagonal.
STEPS = np.array([(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)])
#: Poses per position.
VIEWS = ROTATIONS * HORIZONS

#: A whole number, or an array of them, of NumPy or of JAX.
Integers = Any


class Pose(NamedTuple):
    """The parts of a pose."""

    position: Integers
    rotation: Integers  # 0 to 7
    horizon: Integers  # 0 or 1

    @property
    def degrees(self) -> tuple[Integers, Integers]:
        """Rotation and horizon in degrees."""
        return 45 * self.rotation, 30 * self.horizon


def split(pose: Integers) -> Pose:
    """The parts of poses."""
    # By shifts: // and % of JAX also look after negative numbers, in the environment's hot loop.
    return Pose(pose >> 4, (pose >> 1) & 7, pose & 1)


def join(position: Integers, rotation: Integers = 0, horizon: Integers = 0) -> Integers:
    """Poses from their parts; with position 0, the number of a view at any of them."""
    return (position * ROTATIONS + rotation) * HORIZONS + horizon


def from_degrees(position: Integers, rotation: Integers, horizon: Integers) -> Integers:
    """Poses from a position and degrees: a multiple of 45, and 0 or 30."""
    return join(position, rotation // 45 % ROTATIONS, horizon // 30)
