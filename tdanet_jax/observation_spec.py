"""What an agent is shown: one value that the environment, the network and a robot's agent share.

Imports no JAX, so that a configuration can be checked before anything heavy is loaded.
"""

from __future__ import annotations

import dataclasses
from typing import Literal

from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.registry import SENSORS

#: What a detection is of.
Rows = Literal["object", "class"]
#: Sensors that track the target by its boxes.
TRACKING = ("triangulation", "robust-triangulation")


@dataclasses.dataclass(frozen=True)
class ObservationSpec:
    """What an agent is shown.

    Attributes:
      rows: one detection per "object", or per "class" (the extent over its instances).
      image: the "raster" of classes in 7 x 7 cells, the imported "features" of ResNet-18, or None.
      sensors: what it senses in addition to its detections, in the order of the network's inputs:
        names of `SENSORS`, or dotted names of modules of custom sensors.
      grid: the poses that it can take, which sensors must know; networks do not depend on it.
      scores: whether each box has the detector's confidence in addition, a share.
    """

    rows: Rows = "object"
    image: Literal["raster", "features"] | None = None
    sensors: tuple[str, ...] = ()
    grid: PoseGrid = ITHOR
    scores: bool = False

    @property
    def columns(self) -> int:
        """Numbers of each detection: x and y of the centre, the area S, and the score."""
        return 3 + self.scores

    @property
    def tracker(self) -> str:
        """The sensor that tracks the target; "" if there is none."""
        return next((name for name in self.sensors if name in TRACKING), "")

    def agent_name(self, model: str) -> str:
        """A model's name, and what it senses unlike the paper's agents: tdanet, --odometry."""
        flags = [f"--{name}" if name in SENSORS else f"--sensors {name}" for name in self.sensors]
        return ", ".join([model, *flags, *["--scores"] * self.scores])

    def check(self, model: str | None = None) -> None:
        """Raises ValueError, with one line that names the flag, if the parts do not go together.

        Args:
          model: the model that this is shown to, for the message.
        """
        for name in self.sensors:
            if name not in SENSORS and "." not in name:
                raise ValueError(
                    f"--sensors {name}: choose among {', '.join(SENSORS)}, or name a module"
                )
        tracker = self.tracker
        if {*TRACKING} <= {*self.sensors}:
            raise ValueError(f"--{tracker}: not with {', '.join({*TRACKING} - {tracker})}, too")
        # The robust one may have been asked for by --sensors, which has no --no-...
        instead = {name: f"use --no-{name}" for name in ("triangulation", "scores")}
        if tracker and "odometry" not in self.sensors[: self.sensors.index(tracker)]:
            raise ValueError(
                f"--{tracker}: needs --odometry (or {instead.get(tracker, 'leave it out')})"
            )
        for flag in filter(None, (tracker, "scores" * self.scores)):
            if self.rows != "object" or self.image is not None:
                what = model or (f"--image {self.image}" if self.image else f"--rows {self.rows}")
                raise ValueError(
                    f"--{flag}: needs a box of every object, which {what} does not show; "
                    f"{instead.get(flag, 'leave it out')}"
                )
