"""The interface of a sensor: what an agent perceives in addition to its detections.

A sensor is one file with a function `make() -> Sensor`, here or anywhere that Python finds it.
`tdanet_jax.registry.SENSORS` gives the built-in ones short names; `--sensors` takes the dotted name
of any other. The environment and an agent on a robot run the same functions, so a sensor is told
only what a robot knows: how it faces at the start, its own actions, whether it was blocked, and its
detections. All methods work on one episode, and under `jit` and `vmap`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, NamedTuple

import jax
import numpy as np

from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.sensors.shared import MeasuredPose as MeasuredPose


class Slip(NamedTuple):
    """How an agent misjudges its motion; of a perfect one factors are 1 and angles 0."""

    distance: jax.Array  # float32, believed length of a MoveAhead, as a share of the step
    turn: jax.Array  # float32, believed angle of a turn, as a share of it
    drift: jax.Array  # float32, radians by which the believed heading turns before a MoveAhead
    error: jax.Array  # float32, radians by which the heading is wrong in this pose alone


#: What the `slip` of a `Start` is where motion is measured, not believed.
NO_SLIP = Slip(*np.array([1, 1, 0, 0], np.float32))


class Start(NamedTuple):
    """How the agent faces at the start of an episode."""

    rotation: jax.Array  # int32, turns clockwise from the grid's z axis, see PoseGrid
    horizon: jax.Array  # int32, index of the horizon; in iTHOR 1 looks 30 degrees down, 0 level
    slip: Slip | None = None  # of the first pose; None if all motion is as the agent believes


class Motion(NamedTuple):
    """The last action, and whether it failed."""

    action: jax.Array  # int32; 6 before the first action, which changes nothing
    blocked: jax.Array  # bool, the agent did not move; only meaningful after a MoveAhead
    slip: Slip | None = None  # as in `Start`: None in all of an episode, or never
    measured: MeasuredPose | None = None  # where it led, in place of `slip`


class Frame(NamedTuple):
    """The detections in view."""

    classes: jax.Array  # [K] int32, 0 in padding
    boxes: jax.Array  # [K, 3] float32, x, y, S: box centre and area as shares of the image; or
    # [K, 4] with the detector's score, if the agent is shown scores
    mask: jax.Array  # [K] bool, False in padding
    target: jax.Array  # int32, class of the target


class Sensor:
    """Base class of the sensors.

    A state and a reading are arrays, or trees of arrays. `others` holds the states of the sensors
    that come before this one, by name, as they are at the same moment; in `read`, of all sensors.

    Attributes:
      REQUIRES: names of sensors that must come before it.
      width: length of `features`.
      grid: the turns, horizons and steps of the agent, set after `make`; `width` must not depend on
        it, so that a network can go to other rooms.
    """

    REQUIRES: ClassVar[tuple[str, ...]] = ()
    width: int
    grid: PoseGrid = ITHOR

    def init(self, start: Start) -> Any:
        """The state at the start of an episode, before the first frame."""
        raise NotImplementedError

    def update(self, state: Any, motion: Motion, others: Mapping[str, Any]) -> Any:
        """The state after an action."""
        return state

    def observe(self, state: Any, frame: Frame, others: Mapping[str, Any]) -> Any:
        """The state after a frame has been seen."""
        return state

    def clear(self, state: Any, changed: jax.Array) -> Any:
        """The state once the agent may have been given another target; `changed` is a bool."""
        return state

    def read(self, state: Any, others: Mapping[str, Any]) -> Any:
        """What the sensor says now; the observation holds it."""
        return state

    def features(self, reading: Any) -> jax.Array:
        """Readings with leading axes [...] as the network's input, [..., width] float32."""
        return reading
