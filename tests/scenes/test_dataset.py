"""Files of rooms: saved and loaded again, and broken ones refused in one line."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax.evaluation import room_statistics
from tdanet_jax.io import archive
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneTables, dataset, tabulation
from tdanet_jax.scenes.dataset import Extras, PublishedEpisode, Rooms
from tdanet_jax.scenes.offline import exporter
from tdanet_jax.scenes.visibility.rules import RULES
from tdanet_jax.splits import Split, make_split
from tdanet_jax.targets import PAPER
from tdanet_jax.vocabulary import ROOM_TYPES, TARGETS
from tests.support import toy


@pytest.fixture(scope="module")
def rooms() -> SceneTables:
    return tabulation.build(toy.random_rooms(1))


def test_rooms_come_back_with_their_extras(rooms: SceneTables, tmp_path: Path) -> None:
    episode = PublishedEpisode("test", "Room1", 0.25, -0.5, 45, 30, "Mug")
    extras = Extras({"kitchen": {"Mug": {"Sofa": 0.5}}}, (episode,), ("A", "B"),
                    np.eye(2, dtype=np.float32), {"Room2": "test"})  # fmt: skip
    path = tmp_path / "rooms.npz"
    dataset.save_rooms(Rooms(rooms, extras), path)
    back = dataset.load_rooms(path)
    assert back.extras is not None
    assert (back.extras.parents, list(back.extras.episodes)) == (extras.parents, [episode])
    assert back.extras.graph_classes == ("A", "B")
    np.testing.assert_array_equal(back.extras.adjacency, np.eye(2))
    assert back.extras.parts == {"Room2": "test"}
    assert back.path == path
    assert back.tables.scenes == rooms.scenes
    assert set(back.tables.targets) == set(rooms.targets) & set(rooms.classes)
    assert SceneTables.load(path).data_version == rooms.data_version
    assert [p.name for p in tmp_path.iterdir()] == ["rooms.npz"]


def test_tables_alone_are_a_file_of_rooms(rooms: SceneTables, tmp_path: Path) -> None:
    rooms.save(tmp_path / "rooms.npz")
    extras = dataset.load_rooms(tmp_path / "rooms.npz").extras
    assert extras is not None
    assert extras.class_graph(rooms.classes) is None
    assert not extras.parents
    assert dataset.load_rooms(None).extras is None


BREAKS: list[tuple[str, Any]] = [
    ("room_type", lambda a: a + 9),
    ("room_type", lambda a: a.astype(np.int16)),
    ("position", lambda a: a * np.nan),
    ("position", lambda a: a[:-1]),
    ("position_scene", lambda a: a[::-1]),
    ("next_position", lambda a: a + 10_000),
    ("next_position", lambda a: -a - 1),
    ("next_position", lambda a: a.astype(np.float64)),
    ("row_start", lambda a: a[::-1]),
    ("row_start", lambda a: a + 1),
    ("row_object", lambda a: a + 10_000),
    ("row_box", lambda a: a + 10_000),
    ("row_visible", lambda a: a.astype(np.int8)),
    ("object_class", lambda a: a + 1000),
    ("object_scene", lambda a: a - 1),
    ("object_box", lambda a: a[:, :5]),
    ("distance", lambda a: a[1:]),
    ("raster", lambda a: a + 100),
    ("scenes", lambda a: ()),
    ("classes", lambda a: (3,) * len(a)),
    ("classes", lambda a: a[:1]),
    ("object_id", lambda a: a[:-1]),
    # Names that would become paths, or write to the terminal.
    ("scenes", lambda a: ("../../escaped", *a[1:])),
    ("scenes", lambda a: ("/escaped", *a[1:])),
    ("targets", lambda a: ("../../escaped", *a[1:])),
    ("classes", lambda a: ("a\x1b[2J", *a[1:])),
    ("object_id", lambda a: ("a\x1b[2J", *a[1:])),
    ("scenes", lambda a: (*a[:-1], a[0])),
    ("classes", lambda a: (*a[:-1], a[0])),
    ("position", lambda a: a + 1e9),
    ("object_box", lambda a: a * np.inf),
    ("distance", lambda a: a - 9),
    ("field_of_view", lambda a: "wide"),
    ("camera_height", lambda a: -1.0),
    ("image", lambda a: 10**9),
    ("subpixel", lambda a: "16"),
]


@pytest.mark.parametrize(
    "values",
    [{"parents": {"attic": {}}}, {"parents": {"kitchen": {"Mug": {"Sink": "1"}}}},
     {"parents": {"kitchen": {"Mug": {"Sink": 10**400}}}}, {"parts": {"Room1": "both"}},
     {"episodes": [["test", "Room1", "0", 0, 0, 0, "Mug"]]}, {"episodes": [["test", "Room1"]]},
     {"episodes": [["test", 1, 0, 0, 0, 0, "Mug"]]}, {"graph_classes": ["a"]}, {"parents": [1]}],
)  # fmt: skip
def test_odd_extras_are_refused(rooms: SceneTables, tmp_path: Path, values: Any) -> None:
    path, empty = tmp_path / "rooms.npz", np.zeros((0, 0), np.float32)
    arrays = {**rooms.to_arrays(), "extras/notes": notes(**values), "extras/adjacency": empty}
    archive.write(path, arrays)
    with pytest.raises(FileError, match=r"rooms\.npz: not a file of rooms \("):
        dataset.load_rooms(path)


@pytest.mark.parametrize("case", range(len(BREAKS)))
def test_inconsistent_arrays_are_refused(rooms: SceneTables, tmp_path: Path, case: int) -> None:
    name, change = BREAKS[case]
    arrays = rooms.to_arrays()
    rest = json.loads(arrays["rest"].tobytes())
    fields: dict[str, Any] = arrays if name in arrays else rest
    fields[name] = change(fields[name])
    arrays["rest"] = np.frombuffer(json.dumps(rest).encode(), np.uint8)
    archive.write(tmp_path / "rooms.npz", arrays)
    with pytest.raises(FileError, match=r"rooms\.npz: not a file of rooms \(") as error:
        dataset.load_rooms(tmp_path / "rooms.npz")
    assert str(error.value).isprintable()


def notes(**values: Any) -> np.ndarray:
    whole = {"parents": {}, "episodes": [], "graph_classes": [], **values}
    return np.frombuffer(json.dumps(whole).encode(), np.uint8)


def test_older_files_without_parts_are_read(rooms: SceneTables, tmp_path: Path) -> None:
    path, empty = tmp_path / "rooms.npz", np.zeros((0, 0), np.float32)
    archive.write(path, {**rooms.to_arrays(), "extras/notes": notes(), "extras/adjacency": empty})
    extras = dataset.load_rooms(path).extras
    assert extras is not None
    assert extras.parts == {}


def test_rooms_with_a_part_of_their_own() -> None:
    """Own names and iTHOR's, what is said before what the name says; validation takes a fifth."""
    corridor = toy.corridor()
    kinds = {"FloorPlan1": 0, "FloorPlan2": 0, "FloorPlan30": 0, "Attic": 2, "Den": 0, "Hall": 0}
    kinds |= {f"Own{i}": 1 for i in range(5)}
    scenes = [
        dataclasses.replace(corridor, name=name, room_type=ROOM_TYPES[kind])
        for name, kind in kinds.items()
    ]
    parts = {"FloorPlan2": "test", "Den": "train", "Hall": "test"}
    parts |= {f"Own{i}": "train" for i in range(5)}
    rooms = Rooms(tabulation.build(scenes), Extras(parts=parts))
    found = {}
    for validation in (False, True):
        split = dataset.assign_rooms(make_split("18/4", validation), rooms, validation)
        split = split.within(kinds, ("Apple",))
        found[validation] = set(split.train_scenes), set(split.eval_scenes)
    own = {f"Own{i}" for i in range(5)}
    assert found[False] == ({"FloorPlan1", "Den"} | own, {"FloorPlan2", "FloorPlan30", "Hall"})
    assert found[True] == ({"FloorPlan1"} | own - {"Own4"}, {"Den", "Own4"})
    split = make_split("18/4")
    assert dataset.assign_rooms(split, Rooms(rooms.tables, None)) == split


@pytest.mark.parametrize(("count", "expected"), [(1, None), (2, ["Own0"]), (3, ["Own0", "Own1"])])
def test_validation_needs_two_training_rooms_of_a_type(
    count: int, expected: list[str] | None
) -> None:
    names = [f"Own{i}" for i in range(count)]
    tables = tabulation.build([dataclasses.replace(toy.corridor(), name=name) for name in names])
    rooms = Rooms(tables, Extras(parts=dict.fromkeys(names, "train")))
    split = dataset.assign_rooms(make_split("22/0", True), rooms, True)
    if expected is None:
        with pytest.raises(ValueError, match="--validation: needs two training rooms of a type"):
            split.within(names, tables.classes)
    else:
        split = split.within(names, tables.classes)
        assert split.train_scenes == tuple(expected)
        assert split.eval_scenes == tuple(names[len(expected) :])


def split_in(rooms: Rooms, text: str, validation: bool = False, targets: str = "paper") -> Split:
    """The split of these rooms, before it is cut down to them."""
    _, chosen = dataset.find_targets(targets, rooms, validation)
    return dataset.assign_rooms(make_split(text, validation, chosen), rooms, validation)


@pytest.fixture(scope="module")
def shops() -> Rooms:
    """Two kitchens and two shops to train in, a shop to be tested in; the toaster is nowhere seen.

    The vase is in the test room alone.
    """
    middle, behind = (0.0, toy.CAMERA, 1.2), (0.0, toy.CAMERA, 90.0)
    things = {
        "K1": ("kitchen", ["Kettle", "Mug"]),
        "K2": ("kitchen", ["Bread"]),
        "S1": ("shop", ["Mug", "Lathe", "Toaster"]),
        "S2": ("shop", ["Book"]),
        "S3": ("shop", ["Vase", "Lathe"]),
    }
    scenes = [
        dataclasses.replace(
            toy.room(
                toy.line(3),
                *(toy.thing(c, behind if c == "Toaster" else (0.1 * i, *middle[1:]))
                  for i, c in enumerate(classes)),
                name=name,
            ),
            room_type=kind,
        )
        for name, (kind, classes) in things.items()
    ]  # fmt: skip
    parts = {name: "test" if name == "S3" else "train" for name in things}
    seen = dataclasses.replace(RULES, void=100.0)
    return Rooms(tabulation.build(scenes, rules=seen), Extras(parts=parts))


@pytest.mark.parametrize(
    ("text", "kitchen", "shop"),
    [
        ("all", ("Bread", "Mug", "Kettle"), ("Mug", "Book", "Lathe")),
        ("mugs, kettle", ("Mug", "Kettle"), ("Mug",)),
        ("lathe", (), ("Lathe",)),
        ("kitchen: kettle; shop: all", ("Kettle",), ("Mug", "Book", "Lathe")),
        ("Mug; kitchen: Bread", ("Bread", "Mug"), ("Mug",)),
    ],
)
def test_targets_are_the_classes_that_are_asked_for_where_they_can_be_found(
    shops: Rooms, text: str, kitchen: tuple[str, ...], shop: tuple[str, ...]
) -> None:
    tables, found = dataset.find_targets(text, shops)
    assert (found["kitchen"], found["shop"]) == (kitchen, shop)
    assert not any(found[room] for room in ROOM_TYPES[1:])
    assert {*kitchen, *shop} <= set(tables.targets)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("Ketle", "--targets Ketle: no class of these rooms; did you mean Kettle?"),
        ("Unicorn", "--targets Unicorn: no class of these rooms"),
        ("Toaster", "--targets Toaster: can be found in no training room"),
        ("Vase", "--targets Vase: can be found in no training room"),
        (
            "Mug; kitchen: Lathe",
            "--targets Lathe: can be found in no training room of type kitchen",
        ),
        ("attic: Mug", "--targets attic: no room type of these rooms; there are kitchen, "),
    ],
)
def test_targets_that_cannot_be_found_are_refused(shops: Rooms, text: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        dataset.find_targets(text, shops)
    assert "\n" not in str(error.value)


def test_the_papers_targets_are_as_they_were(shops: Rooms, ithor: SceneTables) -> None:
    for tables in (ithor, shops.tables):
        found, chosen = dataset.find_targets("paper", Rooms(tables, shops.extras))
        assert found is tables
        assert {room: chosen[room] for room in ROOM_TYPES} == TARGETS
    assert chosen["shop"] == ("Toaster", "Mug", "Vase")  # as long as a room holds them


def test_rooms_that_name_their_targets(shops: Rooms, tmp_path: Path) -> None:
    assert shops.extras is not None
    own = {"shop": ("Lathe", "Toaster")}
    extras = dataclasses.replace(shops.extras, targets=own)
    dataset.save_rooms(Rooms(shops.tables, extras), tmp_path / "rooms.npz")
    back = dataset.load_rooms(tmp_path / "rooms.npz")
    assert back.extras is not None
    assert back.extras.targets == own
    assert dataset.find_targets("paper", back)[1]["shop"] == ("Lathe",)  # the other is out of view
    assert dataset.find_targets("Mug", back)[1]["shop"] == ("Mug",)
    split = split_in(back, "Lathe", targets="Mug,Lathe,Book")
    assert split.unseen["shop"] == ("Lathe",)
    assert split.seen["shop"] == ("Mug", "Book")
    for wrong in ({"attic": ("Mug",)}, {"shop": ("Unicorn",)}):
        extras = dataclasses.replace(shops.extras, targets=wrong)
        dataset.save_rooms(Rooms(shops.tables, extras), tmp_path / "wrong.npz")
        with pytest.raises(FileError, match="targets of a room type or of a class"):
            dataset.load_rooms(tmp_path / "wrong.npz")


def test_rooms_without_a_target_are_named(shops: Rooms) -> None:
    tables, chosen = dataset.find_targets("Kettle,Lathe", shops)
    split = dataset.assign_rooms(make_split("22/0", targets=chosen), shops)
    assert dataset.idle_rooms(tables, split.within(tables.scenes, tables.classes)) == ["K2", "S2"]


def test_a_grid_of_its_own_is_kept(rooms: SceneTables, tmp_path: Path) -> None:
    """And tables without one are as before there were such grids, hash included."""
    assert b"grid" not in rooms.to_arrays()["rest"].tobytes()
    grid = PoseGrid(0.5, 4, (-30, 0))
    scene = dataclasses.replace(toy.corridor(), points=toy.line(5) * (1, 1, 2), grid=grid)
    tables = tabulation.build([scene])
    assert tables.num_states == 5 * 8
    path = tmp_path / "rooms.npz"
    dataset.save_rooms(Rooms(tables, None), path)
    found = dataset.load_rooms(path).tables
    assert found.grid == grid
    assert found.data_version == tables.with_known_targets().data_version
    assert found.as_scene().grid == grid
    assert dataclasses.replace(tables, grid=PoseGrid(0.4, 4, (-30, 0))).data_version != (
        tables.data_version
    )
    for broken in (PoseGrid(0.5, 8, (0,)), PoseGrid(0.5, 4, (-30, 0, 30))):
        dataset.save_rooms(Rooms(dataclasses.replace(tables, grid=broken), None), path)
        with pytest.raises(FileError, match="not a file of rooms"):
            dataset.load_rooms(path)
    arrays = tables.to_arrays()
    rest = json.loads(arrays["rest"].tobytes())
    rest["grid"]["rotations"] = 7
    arrays["rest"] = np.frombuffer(json.dumps(rest).encode(), np.uint8)
    archive.write(path, arrays)
    with pytest.raises(FileError, match=r"not a file of rooms \(7 rotations"):
        dataset.load_rooms(path)


def test_room_types_of_ones_own(tmp_path: Path) -> None:
    """Their targets are what their rooms hold, seen or unseen as elsewhere; iTHOR's stay."""
    shown = toy.thing("Laptop", (0.0, toy.CAMERA, 2.0)), toy.thing("Mug", (0.2, toy.CAMERA, 2.0))
    kinds = {"B1": "study", "A1": "office", "A2": "office", "K": "kitchen"}
    scenes = [
        dataclasses.replace(toy.room(toy.line(3), *shown[:count], name=name), room_type=kind)
        for (name, kind), count in zip(kinds.items(), (1, 1, 2, 2), strict=True)
    ]
    tables = tabulation.build(scenes)
    assert tables.room_types == (*ROOM_TYPES, "office", "study")
    assert tables.room_type.tolist() == [5, 4, 4, 0]
    path = tmp_path / "rooms.npz"
    parts = {"A1": "train", "A2": "test"}
    dataset.save_rooms(Rooms(tables, Extras(parts=parts)), path)
    rooms = dataset.load_rooms(path)
    assert rooms.tables.room_types == tables.room_types
    assert rooms.tables.subset(["A2"]).as_scene().room_type == "office"
    assert rooms.tables.data_version == tables.with_known_targets().data_version
    found = {
        text: split_in(rooms, text, validation)
        for text, validation in (("22/0", False), ("18/4", False), ("Vase", True))
    }
    assert found["22/0"].seen["office"] == ("Mug", "Laptop")
    assert found["22/0"].seen["study"] == ("Laptop",)
    assert found["18/4"].seen["office"] == ("Mug",)
    assert found["18/4"].unseen["office"] == ("Laptop",)
    assert found["18/4"].seen["kitchen"] == make_split("18/4").seen["kitchen"]
    assert "A1" in found["18/4"].train_scenes
    assert "A2" in found["18/4"].eval_scenes
    assert found["Vase"].seen["office"] == ("Mug", "Laptop")
    for broken in (("office", *ROOM_TYPES[1:], "a", "b"), (*ROOM_TYPES, "x", "x"), ROOM_TYPES,
                   (*ROOM_TYPES, "../up", "b")):  # fmt: skip
        dataset.save_rooms(Rooms(dataclasses.replace(tables, room_types=broken), None), path)
        with pytest.raises(FileError, match="not a file of rooms"):
            dataset.load_rooms(path)
    dataset.save_rooms(
        Rooms(dataclasses.replace(tables, scenes=("../B", "A", "C", "K")), None), path
    )
    with pytest.raises(FileError, match="is a path"):
        dataset.load_rooms(path)


def test_houses(tmp_path: Path) -> None:
    """Each position keeps the type of its room, and of the targets that a type of its own has."""
    shown = toy.thing("Laptop", (0.0, toy.CAMERA, 2.0)), toy.thing("Mug", (0.2, toy.CAMERA, 2.0))
    types = {"K": "kitchen", "H1": ("kitchen", "hall", "hall"), "H2": ("den", "den", "kitchen")}
    types |= {f"H{i}": ("bedroom", "bedroom", "kitchen") for i in range(3, 6)}
    scenes = [
        dataclasses.replace(toy.room(toy.line(3), *shown[: 2 - (name == "H2")], name=name),
                            room_type=kinds)
        for name, kinds in types.items()
    ]  # fmt: skip
    tables = tabulation.build(scenes)
    assert tables.room_types == (*ROOM_TYPES, "den", "hall")
    assert tables.position_room_type[:9].tolist() == [0, 0, 0, 0, 5, 5, 4, 4, 0]
    assert tables.room_type.tolist() == [0, *[-1] * 5]
    assert [tables.room_at(16 * position) for position in (3, 4, 6)] == ["kitchen", "hall", "den"]
    path = tmp_path / "rooms.npz"
    parts = {name: "train" for name in types if name != "K"}
    dataset.save_rooms(Rooms(tables, Extras(parts=parts)), path)
    rooms = dataset.load_rooms(path)
    assert rooms.tables.position_room_type.tolist() == tables.position_room_type.tolist()
    assert rooms.tables.subset(["H2"]).as_scene().room_type == types["H2"]
    others = tabulation.build([dataclasses.replace(scenes[1], room_type=("kitchen",) * 3)])
    plain = tabulation.build([dataclasses.replace(scenes[1], room_type="kitchen")])
    assert others.data_version == plain.data_version != tables.subset(["H1"]).data_version
    assert plain.to_arrays()["room_type"].tolist() == [0]  # as files were before there were houses
    split = split_in(rooms, "22/0")
    assert (split.seen["hall"], split.seen["den"]) == (("Mug", "Laptop"), ("Laptop",))
    split = split_in(rooms, "22/0", True).within(types, ("Mug",))
    assert split.train_scenes == ("H1", "H2", "H3", "H4")
    assert split.eval_scenes == ("H5",)
    with pytest.raises(ValueError, match="houses with rooms of several types: the original"):
        exporter.check_layout(tables.subset(["K", "H5"]))


def test_other_archives(rooms: SceneTables, tmp_path: Path) -> None:
    path = tmp_path / "rooms.npz"
    arrays = rooms.to_arrays()
    for change in (
        {"rest": np.frombuffer(b"{", np.uint8)},
        {"extras/notes": np.frombuffer(b"[]", np.uint8)},
        {"unknown": np.zeros(3)},
        {"extras/notes": notes(parts={"Room1": "train"}, episodes=3)},
        {"extras/notes": notes(parts={"Room1": "both"})},
        {"extras/notes": notes(parts={"Room1": ["train"]})},
        {"extras/notes": notes(parts=["Room1"])},
    ):
        change = {"extras/adjacency": np.zeros((0, 0), np.float32), **change}
        archive.write(path, {**arrays, **change})
        with pytest.raises(FileError, match=r"rooms\.npz: not a file of rooms"):
            dataset.load_rooms(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(FileError, match=r"rooms\.npz: not a file of rooms"):
        dataset.load_rooms(str(path))
    path.write_text("{}")
    with pytest.raises(FileError, match=r"rooms\.npz: not an npz archive"):
        dataset.load_rooms(path)


def test_rooms_of_a_type_of_ones_own_are_described() -> None:
    """Their episodes, too, which have the targets that they hold."""
    mug = toy.thing("Mug", (0.2, toy.CAMERA, 2.0))
    room = dataclasses.replace(toy.room(toy.line(8), mug, name="A1"), room_type="office")
    found = room_statistics.statistics(tabulation.build([room]).with_known_targets())
    assert float(found["L, mean"]) >= 1
    assert found["nearest target and furniture, median distance"] == "-"  # there is no furniture
    assert found["target classes that can be found in a room"] == "1.00"


def test_targets_of_a_type_that_the_rooms_lack_are_not_blamed_on_a_flag(
    some_rooms: SceneTables,
) -> None:
    """They come from a file, targets.json."""
    rooms = Rooms(some_rooms, Extras(targets={"lounge": ("Mug",)}))
    with pytest.raises(ValueError, match=r"^the rooms' own targets: lounge: no room"):
        dataset.find_targets(PAPER, rooms)
