"""Collecting rooms from AI2-THOR."""

from __future__ import annotations

import dataclasses
import importlib
from pathlib import Path
from typing import Any

import tyro

from tdanet_jax.commands.console import check_new_file, console, fail
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.vocabulary import FIELD_OF_VIEW, IMAGE_SIZE, ROOM_TYPES


@dataclasses.dataclass(frozen=True)
class Collect:
    """Writes a scene file from a running AI2-THOR (requires `pip install ai2thor` and Unity)."""

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """Rooms as NAME=TYPE, such as FloorPlan1=kitchen."""
    grid_size: float = ITHOR.grid_size
    """Metres between neighbouring reachable positions, from 0.05 to 0.5."""
    out: Path = Path("scenes.json")
    """Scene file to write; it must not exist."""

    def run(self) -> None:
        """Starts AI2-THOR, visits the rooms, writes the file."""
        from tdanet_jax.scenes import collect
        from tdanet_jax.scenes.room_names import RoomKind, check_kind

        check_new_file(self.out)
        if not self.scenes:
            fail("collect: name a room, say FloorPlan1=kitchen")
        rooms = []
        for word in self.scenes:
            name, _, kind = word.rpartition("=")
            if not name or not kind:
                fail(f"{word}: not NAME=TYPE, with a type such as {', '.join(ROOM_TYPES)}")
            check_kind(RoomKind(kind))
            rooms.append((name, kind))
        grid = PoseGrid(self.grid_size)
        controller = _start_ai2thor()
        try:
            found = collect.collect(controller, rooms, grid.grid_size)
            collect.write_scenes(found, self.out)
        finally:
            controller.stop()
        console.print(f"{self.out}")


def _start_ai2thor() -> Any:
    try:
        controller = importlib.import_module("ai2thor.controller")
    except ImportError:
        fail("collect needs AI2-THOR: pip install ai2thor")
    return controller.Controller(
        gridSize=ITHOR.grid_size, width=IMAGE_SIZE, height=IMAGE_SIZE, fieldOfView=FIELD_OF_VIEW
    )
