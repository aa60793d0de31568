"""A detected object, as an agent is shown it. Imports no JAX."""

from __future__ import annotations

import dataclasses
import math

#: Share of the image by which a detection's box may reach beyond it: a pixel of any image of at
#: least 100 pixels, and more than what rounding adds in half precision or eight bits.
OVERHANG = 0.01


@dataclasses.dataclass(frozen=True)
class Detection:
    """One detected object: a label in English and its box as shares of the image, y down.

    A box that reaches up to 1% (`OVERHANG`) beyond the image, as detectors round, is clipped to the
    image; `clipped` does so with any box. The detector's confidence, from 0 to 1, is `score`; None
    if there is none.
    """

    label: str
    x1: float
    y1: float
    x2: float
    y2: float
    score: float | None = None

    def __post_init__(self) -> None:
        """Clips the box.

        Raises:
          ValueError: a corner is not finite or too far outside of the image, corners are in the
            wrong order, the whole box is outside, or the score is not from 0 to 1.
        """
        corners = (self.x1, self.y1, self.x2, self.y2)
        if not all(-OVERHANG <= corner <= 1 + OVERHANG for corner in corners):
            raise ValueError(
                f"{self}: corners must be shares of the image; for boxes that reach beyond it, "
                "Detection.clipped"
            )
        if self.score is not None and not 0 <= self.score <= 1:
            raise ValueError(f"{self.label}: score {self.score}: must be from 0 to 1")
        for side, corner in zip(("x1", "y1", "x2", "y2"), _clip(self.label, corners), strict=True):
            object.__setattr__(self, side, corner)

    @classmethod
    def clipped(
        cls, label: str, x1: float, y1: float, x2: float, y2: float, score: float | None = None
    ) -> Detection:
        """A detection whose box may reach beyond the image however far; it is clipped to it.

        Raises:
          ValueError: a corner is not finite, corners are in the wrong order, the whole box is
            outside of the image, or the score is not from 0 to 1.
        """
        return cls(label, *_clip(label, (x1, y1, x2, y2)), score)


def _clip(label: str, corners: tuple[float, ...]) -> tuple[float, float, float, float]:
    """The part of a box that is inside the image."""
    x1, y1, x2, y2 = whole = tuple(map(float, corners))
    if not (all(map(math.isfinite, whole)) and x1 <= x2 and y1 <= y2):
        raise ValueError(f"{label} at {whole}: corners must be finite, x1 <= x2 and y1 <= y2")
    left, top, right, bottom = (min(max(corner, 0.0), 1.0) for corner in whole)
    if (left == right and x1 != x2) or (top == bottom and y1 != y2):
        raise ValueError(f"{label} at {whole}: the box is outside of the image")
    return left, top, right, bottom
