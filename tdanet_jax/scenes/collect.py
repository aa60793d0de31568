"""Scene files from a running AI2-THOR.

The controller is an argument: this module itself needs neither Unity nor the `ai2thor` package.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tdanet_jax.io import files
from tdanet_jax.poses import ITHOR
from tdanet_jax.scenes.scene import SceneError

FIELDS = (
    "objectId", "objectType", "axisAlignedBoundingBox", "objectOrientedBoundingBox", "rotation",
    "openable", "isOpen", "pickupable", "parentReceptacles", "visible",
)  # fmt: skip


def collect(
    controller: Any, rooms: Iterable[tuple[str, str]], grid_size: float = ITHOR.grid_size
) -> list[dict[str, Any]]:
    """The documents of a scene file, one per scene of AI2-THOR.

    A room in which an action fails is left out with a warning.

    Args:
      controller: an `ai2thor.controller.Controller`, or an object with its `reset` and `step`.
      rooms: (AI2-THOR scene name, room type) pairs.
      grid_size: metres between neighbouring reachable positions.

    Raises:
      SceneError: no room is left.
    """
    documents: list[dict[str, Any]] = []
    reason = "no rooms"
    for name, room_type in rooms:
        start = controller.reset(scene=name, gridSize=grid_size).metadata
        event = controller.step(action="GetReachablePositions")
        if not event.metadata["lastActionSuccess"]:
            reason = f"{name}: GetReachablePositions: {event.metadata['errorMessage']}"
            warnings.warn(f"{reason}; left out", stacklevel=2)
            continue
        documents.append(
            {
                "name": name,
                "room_type": room_type,
                "gridSize": grid_size,
                "reachable_positions": event.metadata["actionReturn"],
                "objects": [
                    {field: record.get(field) for field in FIELDS} for record in start["objects"]
                ],
            }
        )
    if not documents:
        raise SceneError(reason)
    return documents


def write_scenes(documents: list[dict[str, Any]], path: Path | str) -> None:
    """Writes a scene file, atomically; an existing file is replaced."""
    path = Path(path)
    files.write_text(path, json.dumps(documents))
