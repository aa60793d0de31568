"""Consistency of scene tables from a file: shapes, dtypes, and indices within their range."""

from __future__ import annotations

from typing import Any

import numpy as np

from tdanet_jax.scenes.scene import MOST_CLASSES
from tdanet_jax.scenes.tables import FIELDS, SceneTables
from tdanet_jax.vocabulary import ROOM_TYPES


def find_problem(tables: SceneTables) -> str | None:
    """What is inconsistent in the tables, in a few words, or None."""
    sizes = {
        "R": len(tables.scenes), "P": len(tables.position), "O": len(tables.object_id),
        "N": len(tables.row_object), "S": tables.num_states, "S + 1": tables.num_states + 1,
        "G": len(tables.targets), "C": len(tables.classes), "T": len(ROOM_TYPES),
        "F": tables.image * tables.subpixel + 1,
    }  # fmt: skip
    for names in (tables.scenes, tables.classes, tables.targets, tables.object_id):
        if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
            return "names that are not text"
    if min(sizes[letter] for letter in "RPOC") == 0 or sizes["C"] > MOST_CLASSES:
        return f"no rooms, positions, objects or classes, or over {MOST_CLASSES} classes"
    for field, (dtype, shape, low, high) in FIELDS.items():
        value: Any = getattr(tables, field)
        wanted = tuple(sizes.get(size, size) for size in shape)
        if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != wanted:
            return f"{field} is not {dtype} {wanted}"
        if high and value.size and not low <= value.min() <= value.max() < sizes[high]:
            return f"{field} points outside the tables"
    starts = tables.row_start
    if starts[0] != 0 or starts[-1] != sizes["N"] or (np.diff(starts) < 0).any():
        return "row_start does not divide the rows"
    if (np.diff(tables.position_scene) < 0).any() or not np.isfinite(tables.position).all():
        return "positions are not finite or not in the order of the rooms"
    if len(np.unique(tables.position_scene)) != sizes["R"]:
        return "a room without positions"
    return None
