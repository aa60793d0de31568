"""Where the names of objects go in a picture, so that none covers another."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from tdanet_jax.scenes import floor_plan
from tdanet_jax.scenes.camera_view import CameraView
from tdanet_jax.scenes.floor_plan import FloorPlan
from tdanet_jax.vocabulary import IGNORED

#: Height of a line and advance of a letter as multiples of the font size; generous, since the
#: reader's font is not known.
LINE, LETTER = 1.15, 0.7
#: Free margin at the sides of a picture, in the same units.
MARGIN = 0.3
_ADVANCE = {
    **dict.fromkeys("ijlI .,:'", 0.35),
    **dict.fromkeys("frt-()", 0.45),
    **dict.fromkeys("mwMW%", 1.0),
}

Rectangle = tuple[float, float, float, float]  # x1, y1, x2, y2, y down


class Label(NamedTuple):
    """A placed name; x and y are its upper left corner."""

    text: str
    x: float
    y: float
    of: int  # index of the object it names


def place(
    things: Sequence[tuple[str, Rectangle]], size: float, bounds: Rectangle,
    centred: bool = False, most: int | None = None,
) -> list[Label]:  # fmt: skip
    """Places names at their rectangles, in order; those without room are left out.

    Args:
      things: (name, rectangle), most important first.
      size: of the font, in the unit of the rectangles.
      bounds: the picture; no name touches its sides.
      centred: tries the middle of a rectangle first instead of its corners.
      most: the greatest number of names.
    """
    placed: dict[Rectangle, Label] = {}
    margin, spots = MARGIN * size, _centred if centred else _cornered
    for number, (text, thing) in enumerate(things):
        width, height = extent(text, size)
        for left, y in spots(thing, width, height):
            x = max(min(left, bounds[2] - margin - width), bounds[0] + margin)
            spot = (x, y, x + width, y + height)
            inside = bounds[1] <= y and spot[2] <= bounds[2] and spot[3] <= bounds[3]
            if inside and not any(_overlap(spot, other) for other in placed):
                placed[spot] = Label(text, x, y, number)
                break
        if len(placed) == most:
            break
    return [*placed.values()]


def extent(text: str, size: float) -> tuple[float, float]:
    """Width and height of a name in a font of this size."""
    return size * sum(_ADVANCE.get(letter, LETTER) for letter in text), LINE * size


def _cornered(thing: Rectangle, width: float, height: float) -> Iterable[tuple[float, float]]:
    x1, y1, x2, y2 = thing
    above, below = (x1, y1 - height), (x1, y2)
    if width > x2 - x1 and height > 0.5 * (y2 - y1):  # a name inside would hide the thing
        yield from (above, below)
    yield x1, y1
    yield above
    yield x1, y2 - height
    yield below
    yield x2 - width, y1
    yield x2 - width, y2 - height
    yield (x1 + x2 - width) / 2, (y1 + y2 - height) / 2
    yield x2 - width, y1 - height
    yield x2 - width, y2


def _centred(thing: Rectangle, width: float, height: float) -> Iterable[tuple[float, float]]:
    x, y = (thing[0] + thing[2] - width) / 2, (thing[1] + thing[3] - height) / 2
    if width <= thing[2] - thing[0]:
        for shift in (0, 1, -1, 2, -2):
            yield x, y + shift * height / 2
    yield x, thing[3]
    yield x, thing[1] - height
    yield x, y


def _overlap(a: Rectangle, b: Rectangle) -> bool:
    return a[0] < b[2] and b[0] < a[2] and a[1] < b[3] and b[1] < a[3]


#: Font size as a share of the picture's greater side.
VIEW_FONT, PLAN_FONT = 0.034, 0.027
#: The greatest number of names in a view, and the least attention that is written after a name.
MOST_NAMES, LEAST_ATTENTION = 12, 0.005
#: The least area of an object that is named on a plan, in square metres.
LEAST_AREA = 0.15


def of_view(
    view: CameraView, attention: np.ndarray | None, target: str | None, scale: float = 1.0
) -> list[Label]:
    """Names of the target, the most attended and the largest objects; in shares of the image.

    Args:
      attention: [n] weight of each object in view, or None.
      scale: of the font; with a smaller font there are more names.
    """
    weights = np.zeros(len(view.boxes)) if attention is None else attention
    rank = weights + LEAST_ATTENTION * view.areas
    order = sorted(range(len(rank)), key=lambda i: (view.classes[i] != target, -rank[i]))
    things = []
    for i in order:
        share = f" {100 * weights[i]:.0f}%" if weights[i] >= LEAST_ATTENTION else ""
        x1, y1, x2, y2 = map(float, view.boxes[i])
        things.append((view.classes[i] + share, (x1, y1, x2, y2)))
    placed = place(things, scale * VIEW_FONT, (0, 0, 1, 1), most=round(MOST_NAMES / scale**2))
    return [label._replace(of=order[label.of]) for label in placed]


def of_plan(plan: FloorPlan, first: Collection[int], scale: float = 1.0) -> list[Label]:
    """Names of the given objects and of the largest of each other class; metres, y is minus z.

    Args:
      first: indices of the outlines that are named first, whatever their size.
      scale: of the font.
    """
    x1, z1, x2, z2 = plan.extent
    large = [i for i, outline in enumerate(plan.outlines) if floor_plan.area(outline) >= LEAST_AREA]
    named = {*IGNORED, *(plan.classes[i] for i in first)}
    others = {name: i for i in large[::-1] if (name := plan.classes[i]) not in named}
    chosen, things = [*first, *sorted(others.values())], []
    for i in chosen:
        (left, low), (right, high) = plan.outlines[i].min(axis=0), plan.outlines[i].max(axis=0)
        things.append((plan.classes[i], (float(left), float(-high), float(right), float(-low))))
    placed = place(things, scale * plan_font(plan), (x1, -z2, x2, -z1), centred=True)
    return [label._replace(of=chosen[label.of]) for label in placed]


def plan_font(plan: FloorPlan) -> float:
    """Font size of the names on a plan, in metres."""
    x1, z1, x2, z2 = plan.extent
    return PLAN_FONT * max(x2 - x1, z2 - z1)
