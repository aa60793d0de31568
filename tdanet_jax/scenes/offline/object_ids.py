"""Ids of objects, as AI2-THOR writes them: class and place, "Mug|+00.10|+00.93|-01.20"."""

from __future__ import annotations

import re

import numpy as np

from tdanet_jax.scenes.metadata import FARTHEST

#: The box in metres of an object whose place is unknown.
UNKNOWN = np.full((2, 3), np.nan)

#: A coordinate in metres. Other numbers are part of a name, as in ProcTHOR's "Sofa|3|0|1".
_METRES = re.compile(r"[+-]\d+\.\d+")
_ID = re.compile(r"[^|\s]+(\|[^|]+)+")


def is_id(name: str) -> bool:
    """Whether a name is an object's id, and not a class: Class|x|y|z, with any number of parts."""
    return _ID.fullmatch(name) is not None


def class_of(name: str) -> str:
    """The class in an object's id: its first part, or its last if that is a name.

    "Mug|+00.10|+00.93|-01.20" is a Mug, "Sink|+00.10|+00.93|-01.20|SinkBasin" a SinkBasin,
    "Apple|+00.10|+00.93|-01.20|AppleSliced_3" an AppleSliced.
    """
    parts = name.split("|")
    last = parts[-1].rpartition("_")[0] or parts[-1]
    return last if len(parts) > 4 and last.isalpha() else parts[0]


def place_in(name: str) -> np.ndarray:
    """The place in an object's id, as a box [2, 3] without extent, in metres; NaN without one."""
    parts = name.split("|")[1:4]
    if len(parts) != 3 or not all(_METRES.fullmatch(part) for part in parts):
        return UNKNOWN
    place = np.array([*map(float, parts)])
    if not (np.abs(place) <= FARTHEST).all():
        return UNKNOWN
    return np.stack([place, place])
