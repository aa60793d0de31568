"""A pose as one number: (position * rotations + rotation) * horizons + horizon.

A position is the index of a reachable point in the tables. A rotation counts turns, clockwise from
+z; a horizon is an index, from the highest view to the lowest. In iTHOR's rooms there are eight
rotations, 45 degrees apart, and two horizons, level and 30 degrees down. Scene tables call a pose a
state.
"""

from __future__ import annotations

import dataclasses
import math
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

#: Grid cells (x, z) from a point to its eight neighbours, clockwise from +z, 45 degrees apart.
STEPS = np.array([(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)])
#: What the turns of an agent may measure, in degrees: each is nearest to one neighbour.
TURNS = (15, 30, 45, 60, 90)
#: The distances of neighbouring points, in metres. Farther apart, there would be walls between
#: them (`visibility.rules.Rules.void`).
SIZES = (0.05, 0.5)
#: Degrees by which a simulator may miss a rotation or a horizon.
TOLERANCE = 0.1

#: A whole number, or an array of them, of NumPy or of JAX.
Integers = Any


class Pose(NamedTuple):
    """The parts of a pose."""

    position: Integers
    rotation: Integers  # 0 up to the number of rotations
    horizon: Integers  # 0 up to the number of horizons


def modulo(value: Integers, count: int) -> Integers:
    """`value % count`; in JAX without looking after negative numbers, where that is possible."""
    return value & (count - 1) if _is_power_of_two(count) else value % count


def _is_power_of_two(count: int) -> bool:
    return count & (count - 1) == 0


@dataclasses.dataclass(frozen=True)
class PoseGrid:
    """The poses that an agent can take at each reachable point, and its steps between points.

    Attributes:
      grid_size: metres between neighbouring points along an axis, AI2-THOR's gridSize.
      rotations: number of rotations in a full turn.
      horizons: degrees that the camera looks down, ascending; negative is up.

    Raises:
      ValueError: one of them is not possible; the message names it as a scene file does.
    """

    grid_size: float = 0.25
    rotations: int = 8
    horizons: tuple[int, ...] = (0, 30)

    def __post_init__(self) -> None:
        size, looks = self.grid_size, self.horizons
        if type(size) not in (int, float) or not SIZES[0] <= size <= SIZES[1]:
            raise ValueError(f"gridSize {size!r}: must be from {SIZES[0]} to {SIZES[1]} metres")
        if type(self.rotations) is not int or self.rotations not in [360 // t for t in TURNS]:
            raise ValueError(
                f"{self.rotations} rotations: rotateStepDegrees must be one of {list(TURNS)}"
            )
        whole = all(type(degrees) is int and abs(degrees) <= 90 for degrees in looks)
        if not whole or 0 not in looks or list(looks) != sorted(set(looks)):
            raise ValueError(
                f"horizons {list(looks)}: must be whole degrees from -90 to 90, ascending, with 0"
            )
        object.__setattr__(self, "horizons", tuple(looks))  # a list would have no hash

    @property
    def turn(self) -> int:
        """Degrees of one rotation."""
        return 360 // self.rotations

    @property
    def views(self) -> int:
        """Number of poses at a position."""
        return self.rotations * len(self.horizons)

    @property
    def level(self) -> int:
        """Index of the horizon of 0 degrees."""
        return self.horizons.index(0)

    @cached_property
    def steps(self) -> np.ndarray:
        """Cells (x, z) that MoveAhead moves along each rotation: [rotations, 2]."""
        return STEPS[self.neighbour(np.arange(self.rotations))]

    def neighbour(self, rotation: Integers) -> Integers:
        """The neighbour, 0 to 7, whose direction is nearest to a rotation's."""
        if self.rotations == len(STEPS):
            return rotation
        return (2 * self.turn * rotation + 45) // 90 % len(STEPS)

    def split(self, pose: Integers) -> Pose:
        """The parts of poses."""
        looks = len(self.horizons)
        if not _is_power_of_two(self.views):
            return Pose(pose // self.views, pose // looks % self.rotations, pose % looks)
        # By shifts: // and % of JAX also look after negative numbers, in the environment's hot
        # loop.
        shift = looks.bit_length() - 1
        rotation = pose >> shift & (self.rotations - 1)
        return Pose(pose >> self.views.bit_length() - 1, rotation, pose & (looks - 1))

    def join(self, position: Integers, rotation: Integers = 0, horizon: Integers = 0) -> Integers:
        """Poses from their parts; with position 0, the number of a view at any of them."""
        return (position * self.rotations + rotation) * len(self.horizons) + horizon

    def look_level(self, position: Integers, rotation: Integers = 0) -> Integers:
        """Poses whose horizon is 0 degrees."""
        return self.join(position, rotation, self.level)

    def from_degrees(self, position: Integers, rotation: int, horizon: int) -> Integers:
        """Poses from a position, and degrees that are exactly those of a pose."""
        turns = rotation // self.turn % self.rotations
        return self.join(position, turns, self.horizons.index(horizon))

    def nearest_view(self, rotation: float, horizon: float) -> tuple[int, int]:
        """Rotation and horizon, as a pose has them, from a user's or a simulator's degrees.

        Raises:
          ValueError: there is none within a tenth of a degree.
        """
        turns = round(rotation / self.turn) if math.isfinite(rotation) else 0
        if not abs(rotation - self.turn * turns) <= TOLERANCE:  # so that NaN is refused, too
            raise ValueError(f"rotation {rotation}: not a multiple of {self.turn} degrees")
        look = min(self.horizons, key=lambda degrees: abs(degrees - horizon))
        if not abs(horizon - look) <= TOLERANCE:
            known = ", ".join(map(str, self.horizons))
            raise ValueError(f"horizon {horizon}: not among {known} degrees")
        return turns % self.rotations, self.horizons.index(look)

    def degrees(self, pose: Pose) -> tuple[Integers, Integers]:
        """Rotation and horizon of the parts of poses, in degrees."""
        return self.turn * pose.rotation, np.asarray(self.horizons)[pose.horizon]


#: The grid of iTHOR's rooms and of the original offline data.
ITHOR = PoseGrid()
#: Its sizes and functions, where there is no other.
GRID_SIZE, ROTATIONS, HORIZONS = ITHOR.grid_size, ITHOR.rotations, len(ITHOR.horizons)
VIEWS, split, join, from_degrees = ITHOR.views, ITHOR.split, ITHOR.join, ITHOR.from_degrees
