"""A robot's camera: maps boxes in its image onto the image that agents were trained with.

That image is 90 degrees wide and high. Boxes in the image of another camera, given as shares of
it, look nearer to the centre or farther from it than they are: the agent and its triangulation
would take every direction wrong. Imports no JAX.

camera = Camera(hfov=69, vfov=55)
seen = camera.to_agent([Detection("mug", 0.2, 0.3, 0.25, 0.4)])
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Sequence
from dataclasses import InitVar
from typing import Any

from tdanet_jax.agent.detection import Detection
from tdanet_jax.vocabulary import FIELD_OF_VIEW, VISIBILITY_DISTANCE

#: Metres above the floor of the camera with which agents are trained in iTHOR's rooms.
TRAINED_HEIGHT = 1.58

#: Least and greatest field of view, in degrees; less would be radians.
ANGLES = (5, 180)

#: A direction: how far to the right, down and ahead.
Ray = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Camera:
    """A pinhole camera, whose images are rectified.

    Attributes:
      hfov: horizontal field of view, in degrees.
      vfov: vertical field of view, in degrees; or give `aspect`.
      aspect: width of the image over its height, instead of `vfov`.
      height: metres above the floor; only for `limits`.
      horizon: degrees that the camera looks down where the robot does not tilt it.
      centre: where the optical axis meets the image, as shares of its width and height.

    Raises:
      ValueError: a value is out of range, or not exactly one of `vfov` and `aspect` is given.
    """

    hfov: float
    vfov: float | None = None
    aspect: InitVar[float | None] = None
    height: float | None = None
    horizon: float = 0.0
    centre: tuple[float, float] = (0.5, 0.5)

    def __post_init__(self, aspect: float | None) -> None:
        _check("hfov", self.hfov, *ANGLES)
        if (self.vfov is None) == (aspect is None):
            raise ValueError("camera: give either vfov, in degrees, or aspect, width over height")
        if aspect is not None:
            _check("aspect", aspect, 0, 100)
            tangent = math.tan(math.radians(self.hfov / 2)) / aspect
            object.__setattr__(self, "vfov", 2 * math.degrees(math.atan(tangent)))
        assert self.vfov is not None
        _check("vfov", self.vfov, *ANGLES)
        if self.height is not None:
            _check("height", self.height, 0, 100)
        _check("horizon", self.horizon, -90, 90)
        for share in self.centre:
            _check("centre", share, 0, 1)

    @classmethod
    def from_camera_info(
        cls, info: Any, height: float | None = None, horizon: float = 0.0
    ) -> Camera:
        """The camera of a `sensor_msgs/CameraInfo`, of ROS 1 or 2; nothing is imported.

        It is that of rectified images (`p`), or else of raw ones (`k`), if the message has no `p`.

        Raises:
          ValueError: the message holds no calibration.
        """
        old = hasattr(info, "K")  # ROS 1
        raw = info.K if old else info.k
        rectified: Sequence[float] = getattr(info, "P" if old else "p", ())
        focal, axis, size = (raw[0], raw[4]), (raw[2], raw[5]), (info.width, info.height)
        if len(rectified) == 12 and rectified[0] > 0 and rectified[5] > 0:
            focal, axis = (rectified[0], rectified[5]), (rectified[2], rectified[6])
        if not all(value > 0 for value in (*focal, *size)):
            raise ValueError("CameraInfo: not calibrated, k or the size of the image is zero")
        hfov, vfov = (
            2 * math.degrees(math.atan(pixels / (2 * f)))
            for pixels, f in zip(size, focal, strict=True)
        )
        centre = axis[0] / info.width, axis[1] / info.height
        return cls(hfov, vfov, height=height, horizon=horizon, centre=centre)

    def to_agent(
        self, detections: Iterable[Detection], horizon: float | None = None
    ) -> list[Detection]:
        """Detections in this camera's image as an agent's camera would see them.

        Args:
          detections: boxes as shares of this camera's image.
          horizon: degrees down that the agent takes itself to look; by default as the camera does.
            Boxes are then those around the corners in the tilted image.

        Returns:
          The detections in the agent's image, clipped to it, without those that are outside of it.
        """
        down = 0.0 if horizon is None else self.horizon - horizon
        mapped = (_seen(found, self._rays(found), down) for found in detections)
        return [found for found in mapped if found is not None]

    def seen_share(self, horizon: float | None = None) -> float:
        """How much of the agent's image this camera sees, from 0 to 1; `horizon` as above."""
        down = 0.0 if horizon is None else self.horizon - horizon
        corners = _inside([_tilted(ray, down) for ray in self._rays(_WHOLE)])
        points = [(right / ahead, low / ahead) for right, low, ahead in corners]
        pairs = zip(points, points[1:] + points[:1], strict=True)
        return abs(sum(a[0] * b[1] - b[0] * a[1] for a, b in pairs)) / 2 / 4

    def limits(self, distance: float = VISIBILITY_DISTANCE) -> tuple[str, ...]:
        """What the camera cannot see of what an agent is used to seeing: a sentence each.

        Args:
          distance: metres ahead at which heights are given; by default where targets count.
        """
        assert self.vfov is not None
        lines = [
            f"sees {self.hfov:.0f} degrees across and {self.vfov:.0f} down, where agents are used "
            f"to {FIELD_OF_VIEW:.0f}: {100 * self.seen_share():.0f} % of their image"
        ]
        if self.height is not None:
            up, down = (
                math.degrees(math.atan(2 * share * math.tan(math.radians(self.vfov / 2))))
                for share in (self.centre[1], 1 - self.centre[1])
            )
            lowest, highest = (
                max(self.height - distance * math.tan(math.radians(angle)), 0.0)
                for angle in (
                    min(self.horizon + down, 89.9),
                    max(self.horizon - up, -89.9),
                )
            )
            lines.append(
                f"{distance:g} m ahead, sees what is between {lowest:.2f} and {highest:.2f} m high"
            )
            if abs(self.height - TRAINED_HEIGHT) > 0.3:
                lines.append(
                    f"is {self.height:g} m above the floor, where agents are used to "
                    f"{TRAINED_HEIGHT:g} m: they see other sides of tables and shelves"
                )
        return tuple(lines)

    def _rays(self, box: Detection) -> list[Ray]:
        """The directions of a box's corners, around it."""
        return _rays(box, self.hfov, self.vfov or self.hfov, self.centre)


def turned(
    found: Detection, right: float, horizon: float, horizon_before: float
) -> Detection | None:
    """A detection in an agent's image after the agent has turned or tilted on the spot.

    Args:
      found: in the image before.
      right: degrees clockwise that the agent has turned.
      horizon: degrees down that it looks now.
      horizon_before: and before.

    Returns:
      The box around its corners in the image now; None if it has left the image.
    """
    angle = math.radians(right)
    sine, cosine = math.sin(angle), math.cos(angle)
    level = [_tilted(ray, horizon_before) for ray in _rays(found, FIELD_OF_VIEW, FIELD_OF_VIEW)]
    rays = [(x * cosine - z * sine, y, z * cosine + x * sine) for x, y, z in level]
    return _seen(found, rays, -horizon)


_WHOLE = Detection("", 0, 0, 1, 1)


def _check(name: str, value: float, least: float, most: float) -> None:
    if not least < value < most:  # NaN as well
        raise ValueError(f"camera: {name} {value}: must be between {least} and {most}")


def _rays(
    box: Detection, hfov: float, vfov: float, centre: tuple[float, float] = (0.5, 0.5)
) -> list[Ray]:
    wide, high = math.tan(math.radians(hfov / 2)), math.tan(math.radians(vfov / 2))
    x1, x2 = (2 * wide * (x - centre[0]) for x in (box.x1, box.x2))
    y1, y2 = (2 * high * (y - centre[1]) for y in (box.y1, box.y2))
    return [(x1, y1, 1.0), (x2, y1, 1.0), (x2, y2, 1.0), (x1, y2, 1.0)]


def _tilted(ray: Ray, down: float) -> Ray:
    """A direction as seen by a camera that looks `down` degrees higher."""
    angle = math.radians(down)
    x, y, z = ray
    return (
        x,
        y * math.cos(angle) + z * math.sin(angle),
        z * math.cos(angle) - y * math.sin(angle),
    )


def _seen(found: Detection, rays: Sequence[Ray], down: float) -> Detection | None:
    """A detection at these directions, seen by an agent that looks `down` degrees higher."""
    corners = _inside([_tilted(ray, down) for ray in rays])
    if not corners:
        return None
    x1, x2 = _span(x / z for x, _, z in corners)
    y1, y2 = _span(y / z for _, y, z in corners)
    if (x1 == x2 and found.x1 != found.x2) or (y1 == y2 and found.y1 != found.y2):
        return None  # only its border is inside
    return dataclasses.replace(found, x1=x1, y1=y1, x2=x2, y2=y2)


def _span(tangents: Iterable[float]) -> tuple[float, float]:
    """From least to greatest, as shares of an agent's image."""
    shares = [min(max(0.5 + tangent / 2, 0.0), 1.0) for tangent in tangents]
    return min(shares), max(shares)


def _inside(polygon: list[Ray]) -> list[Ray]:
    """The part of a polygon of directions that is in an agent's image (Sutherland and Hodgman)."""
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1)):
        left = [ray[2] + sign * ray[axis] for ray in polygon]  # below 0 outside
        clipped: list[Ray] = []
        for i, (ray, here) in enumerate(zip(polygon, left, strict=True)):
            before, there = polygon[i - 1], left[i - 1]
            if (here < 0) != (there < 0):
                share = there / (there - here)
                x, y, z = (a + share * (b - a) for a, b in zip(before, ray, strict=True))
                clipped.append((x, y, z))
            if here >= 0:
                clipped.append(ray)
        polygon = clipped
    return polygon
