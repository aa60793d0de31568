"""What the sensors in JAX and those in NumPy (`numpy_sensors`) share: sizes, units and axes."""

from __future__ import annotations

import functools
import math
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.poses import STEPS, Integers, PoseGrid, modulo

# Odometry.

#: Cells of the grid along each side of the map, which wraps around like a torus. The largest iTHOR
#: room has 35.
MAP_SIZE = 64
#: Cells along each side of the part of the map that is read, the agent in its middle.
WINDOW = 9
#: A heading counts as that of the eight directions that is nearest to it.
DIRECTIONS = len(STEPS)
#: Bits of a cell: one for each direction in which the agent stood there, then "blocked".
BLOCKED = 1 << DIRECTIONS

# Triangulation.

#: Weight of the prior, where a ray has weight 1.
PRIOR_WEIGHT = 1e-3
#: A box belongs to the tracked object if the position re-estimated with it lies within 12 degrees
#: of the box's direction.
SAME_OBJECT_COSINE = float(np.cos(np.radians(12)))
#: Weight along the line of sight at which the certainty is one half.
HALF_CERTAIN = 0.03
#: Upper bound of a radius, in metres.
MAX_RADIUS = 1.0
#: Cells by which an agent must have moved to see its target from a new point: measured poses waver
#: by some millimetres where it stands still.
MOVED = 0.25
#: Distances to the border of reach are divided by this many metres, and clipped there.
BORDER = 0.25
#: The square of an error over that of what is left of it once the estimate has followed the ray
#: (robust triangulation).
FOLLOWED = 2.0

# Both.

#: Positions are divided by this many metres; triangulation clips them at twice as many.
POSITION_SCALE = 4.0


class MeasuredPose(NamedTuple):
    """Where an agent stands and faces, measured on a robot; see `measured_pose`."""

    place: Any  # [2] float32, of NumPy or JAX, x and z in cells, in the axes of odometry
    angle: Any  # float32, radians clockwise from z


def measured_pose(
    grid: PoseGrid, rotation: int, ahead: float, right: float, turned: float
) -> MeasuredPose:
    """A pose that was measured relative to an episode's start, in the axes of odometry.

    Args:
      grid: the agent's.
      rotation: at the start, in turns, as in `sensor.Start`.
      ahead: metres from the start, in the direction in which the agent faced there.
      right: metres to the right of it.
      turned: degrees clockwise from that direction.
    """
    angle = math.radians(grid.turn * first_heading(grid, rotation))
    sine, cosine = math.sin(angle), math.cos(angle)
    x, z = ahead * sine + right * cosine, ahead * cosine - right * sine
    place = np.array([x / grid.grid_size, z / grid.grid_size], np.float32)
    return MeasuredPose(place, np.array(angle + math.radians(turned), np.float32))


def first_heading(grid: PoseGrid, rotation: Integers) -> Integers:
    """How the agent faces at the start in the axes of odometry, in turns."""
    return modulo(rotation, math.lcm(grid.turn, 90) // grid.turn)


@functools.cache
def window_offsets(rotations: int) -> np.ndarray:
    """The cells of the window, [rotations, WINDOW, WINDOW, 2]: the first row is far ahead.

    Off the axes these are the cells nearest to a square that is rotated: some cells occur twice,
    and some not at all.
    """
    middle = WINDOW // 2
    row, column = np.mgrid[:WINDOW, :WINDOW]
    right, ahead = column - middle, middle - row
    angle = np.arange(rotations)[:, None, None] * (2 * np.pi / rotations)
    x = right * np.cos(angle) + ahead * np.sin(angle)
    z = ahead * np.cos(angle) - right * np.sin(angle)
    return np.rint(np.stack([x, z], axis=-1)).astype(np.int32)
