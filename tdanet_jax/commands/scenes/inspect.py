"""Drawing a room."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

from tdanet_jax.commands.console import (
    check_at_most,
    check_picture,
    check_positive,
    console,
    fail,
    load_rooms,
)
from tdanet_jax.config import MOST_VARIANTS
from tdanet_jax.splits import make_split

if TYPE_CHECKING:
    from tdanet_jax.scenes import SceneTables
    from tdanet_jax.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Draws a room: floor plan, reachable points, objects, and a view of the camera."""

    scene: tyro.conf.Positional[str]
    """Name of the room, such as FloorPlan228."""
    position: tuple[float, float] | None = None
    """x and z in metres, at the nearest reachable point. By default, a view of many objects."""
    rotation: int = 0
    """Degrees clockwise from +z, in iTHOR a multiple of 45; requires --position."""
    horizon: int = 0
    """Degrees down, in iTHOR 0 or 30; requires --position."""
    scenes: Path | None = None
    """Scene file (JSON) with the room; by default the bundled rooms."""
    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote, instead of the bundled ones."""
    variants: int = 0
    """Draws instead the floor plans of the room and of its first variants, those of --seed 0."""
    out: Path = Path("scene.png")
    """Picture to write; an existing one is replaced."""

    def run(self) -> None:
        """Writes the picture."""
        from tdanet_jax.analysis import pictures

        check_picture(self.out)
        if self.variants:
            self._draw_variants()
            return
        if self.position is None and (self.rotation or self.horizon):
            fail("--rotation and --horizon need --position")
        if self.position is not None and not all(map(math.isfinite, self.position)):
            fail(f"--position {self.position[0]} {self.position[1]}: must be finite")
        room, tables = self._room()
        if self.position is None:
            state = pictures.most_telling_state(tables)
        else:
            state = tables.nearest_state(0, *self.position, self.rotation, self.horizon)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        pictures.room(room, tables, state, self.out)
        console.print(f"{self.out}")

    def _draw_variants(self) -> None:
        from tdanet_jax.analysis import pictures
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.placement import statistics
        from tdanet_jax.scenes.vary import vary

        check_positive(variants=self.variants)
        check_at_most("variants", self.variants, MOST_VARIANTS)
        if self.position is not None or self.rotation or self.horizon or self.scenes is not None:
            fail("--variants takes no --position, --rotation, --horizon or --scenes")
        rooms = load_rooms(self.data)
        self._check(rooms.tables.scenes)
        train = dataset.assign_rooms(make_split("22/0"), rooms).train_scenes
        known, [room] = statistics(rooms.scenes(train)), rooms.scenes([self.scene])
        varied = [vary(room, known, 0, copy) for copy in range(1, self.variants + 1)]
        self.out.parent.mkdir(parents=True, exist_ok=True)
        pictures.plans([room, *varied], self.out)
        console.print(f"{self.out}")

    def _room(self) -> tuple[Scene, SceneTables]:
        """The room and its tables."""
        from tdanet_jax.scenes import dataset, ithor, metadata, tabulation

        if self.data is not None:
            if self.scenes is not None:
                fail("--scenes and --data: choose one")
            given = dataset.load_rooms(self.data)
            self._check(given.tables.scenes)
            tables = given.tables.subset([self.scene])
            known = given.records is not None
            return given.scenes([self.scene])[0] if known else tables.as_scene(), tables
        rooms = ithor.load_scenes() if self.scenes is None else metadata.read_scenes(self.scenes)
        names = [room.name for room in rooms]
        self._check(names)
        room = rooms[names.index(self.scene)]
        return room, tabulation.build([room])

    def _check(self, names: Sequence[str]) -> None:
        from tdanet_jax.analysis.episode_lookup import name_ranges

        if self.scene not in names:
            fail(f"{self.scene}: no such room; there are {name_ranges(names)}")
