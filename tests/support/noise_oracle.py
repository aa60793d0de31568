"""Senses that err, one detection and one action at a time: plain Python, from the definitions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

Bits = Sequence[Sequence[int]]  # eight fields of 16 bits for each column


class Detected(NamedTuple):
    """A row of a frame."""

    cls: int
    x: float
    y: float
    area: float
    score: float


class Seen(NamedTuple):
    """A detection without noise, with its extent x1, y1, x2, y2."""

    cls: int
    box: tuple[float, float, float]
    extent: tuple[float, float, float, float]


def share(bits: int) -> float:
    """A number in [0, 1) from 16 bits."""
    return bits / 65536


def normal(bits: int) -> float:
    """A number of mean 0 and deviation 1 from four draws of 0 to 15."""
    digits = [bits >> shift & 15 for shift in (0, 4, 8, 12)]
    return (sum(digits) - 30) / math.sqrt(85)


def detect(
    seen: Sequence[Seen], longest: int, everything: Sequence[Seen], bits: Bits,
    level: Mapping[str, float], known: Sequence[int], similar: Sequence[Sequence[int]],
    one_per_class: bool = False,
) -> list[Detected | None]:  # fmt: skip
    """The rows of a frame: what is there, then up to four false ones and duplicates.

    Args:
      seen: what is in view.
      longest: number of rows.
      everything: all detections of all views.
      bits: [8][longest + 5].
      level: levels of noise by name.
      known: classes that are detected anywhere, ascending.
      similar: what each class is confused with.
      one_per_class: whether a centre is a mean over instances, and the first row of each class
        alone stays.
    """
    miss, change, pick, dx, dy, dw, dh, sure = bits
    rows: list[Detected | None] = [None] * longest
    shown = []
    for i, one in enumerate(seen):
        tiny = level["small_misses"] * math.exp(-math.sqrt(one.box[2]) / 0.1)
        shown.append(share(miss[i]) >= 1 - (1 - level["misses"]) * (1 - tiny))

    def perceived(one: Seen, i: int, is_false: bool) -> Detected | None:
        cls = one.cls
        swaps, chance = level["swaps"], share(change[i])
        if not is_false and chance < swaps:
            others = [c for c in known if c != one.cls]
            if others:
                cls = others[pick[i] * len(others) // 65536]
        elif not is_false and chance < swaps + (1 - swaps) * level["confusions"]:
            cls = similar[one.cls][pick[i] // 16384]
        x1, y1, x2, y2 = one.extent
        edges = []
        for low, high, move, grow in ((x1, x2, dx[i], dw[i]), (y1, y2, dy[i], dh[i])):
            middle = (low + high) / 2 + level["jitter"] * normal(move) * (high - low)
            half = (high - low) / 2 * math.exp(level["jitter"] * normal(grow))
            border = level["truncation"]
            ends = [min(max(end, border), 1 - border) for end in (middle - half, middle + half)]
            if ends[0] >= ends[1]:
                return None
            edges.append((low, high, *ends))
        shift = [(a + b - low - high) / 2 for low, high, a, b in edges]
        ratio = math.prod((b - a) / (high - low) for low, high, a, b in edges)
        right = cls == one.cls and not is_false
        drawn = (max if right else min)(sure[i] // 256, sure[i] % 256) / 256
        drawn *= 1 - math.exp(-math.sqrt(one.box[2]) / 0.1) / 2
        score = 1 - level["scores"] * (1 - drawn)
        x, y, area = one.box[0] + shift[0], one.box[1] + shift[1], one.box[2] * ratio
        if one_per_class:
            x, y = (min(max(at, e[2]), e[3]) for at, e in zip((x, y), edges, strict=True))
        return Detected(cls, x, y, min(area, 1.0), score)

    for i, one in enumerate(seen):
        if shown[i]:
            rows[i] = perceived(one, i, is_false=False)
    for k in range(min(4, longest - len(seen))):
        i = len(seen) + k
        false, again, copy, high, low, *_ = (field[longest + k] for field in bits)
        if share(false) < level["false_positives"] / 4:
            one = everything[int((high * 65536 + low) * len(everything) / 2**32)]
            x1, y1, x2, y2 = one.extent
            box = ((x1 + x2) / 2, (y1 + y2) / 2, (x2 - x1) * (y2 - y1))
            rows[i] = perceived(Seen(one.cls, box, one.extent), i, is_false=True)
        elif seen and share(again) < level["duplicates"] * len(seen) / 4:
            copied = copy * len(seen) // 65536
            if shown[copied]:
                rows[i] = perceived(seen[copied], i, is_false=False)
    if one_per_class:
        for i, row in enumerate(rows):
            if row and row.cls in [earlier.cls for earlier in rows[:i] if earlier]:
                rows[i] = None
    return rows


class Walker:
    """Where an agent believes to stand, in cells and degrees, from what its wheels tell it."""

    def __init__(self, heading: float) -> None:
        self.x = self.z = 0.0
        self.heading = self.nominal = heading
        self.error = 0.0

    def act(
        self, action: int, blocked: bool, bits: Sequence[int], level: Mapping[str, Any]
    ) -> None:
        """An action; `bits` are the eight fields of the step's last column."""
        step, turn, error, short, length, *_ = bits
        factor = 1 + level["distance_bias"] + level["distance_noise"] * normal(step)
        if share(short) < level["short_steps"]:
            factor *= 1 + share(length)
        if action == 0:
            self.heading += level["heading_drift"]
            if not blocked:
                far = math.sqrt(2) if self.nominal % 90 else 1.0
                self.x += factor * far * math.sin(math.radians(self.heading))
                self.z += factor * far * math.cos(math.radians(self.heading))
        if action in (1, 2):
            sign = -1 if action == 1 else 1
            angle = 1 + level["turn_bias"] + level["turn_noise"] * normal(turn)
            self.heading += sign * 45 * angle
            self.nominal += sign * 45
        self.error = level["heading_error"] * normal(error)
