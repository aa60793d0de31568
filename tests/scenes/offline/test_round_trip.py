"""Round trips through the original layout: the exported folder contains what the tables do."""

from __future__ import annotations

import dataclasses
import json
import os
import re
import warnings
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax import words
from tdanet_jax.env.reward import find_parents, named_parents, published_parents
from tdanet_jax.io.untrusted import FileError, hdf5
from tdanet_jax.scenes import SceneTables, dataset, tabulation
from tdanet_jax.scenes.offline import exporter, features, importer, layout, reader
from tdanet_jax.scenes.offline.frames import Frame
from tdanet_jax.scenes.offline.layout import OBJECT_FILE, SceneFolder, state_keys
from tdanet_jax.scenes.room_names import Kinds, RoomKind
from tdanet_jax.scenes.scene import SceneError
from tdanet_jax.splits import make_split
from tdanet_jax.vocabulary import ALL_TARGETS, TARGETS
from tests.support import original, toy


def silent(share: float, line: str) -> None:
    """Reports nothing."""


@pytest.fixture(autouse=True)
def cache_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TDANET_CACHE", str(tmp_path / "cache"))


def assert_equal(ours: SceneTables, theirs: SceneTables) -> None:
    """Equal but for classes that do not occur and targets that are none."""
    whole = ours.with_known_targets()
    for field in dataclasses.fields(SceneTables):
        a, b = getattr(whole, field.name), getattr(theirs, field.name)
        if field.name == "object_class":
            a, b = np.array(ours.classes)[a], np.array(theirs.classes)[b]
        elif field.name == "raster":
            a, b = (np.array([*t.classes, ""])[r] for t, r in ((ours, a), (theirs, b)))
        elif field.name in ("classes", "targets", "distance"):
            continue
        np.testing.assert_array_equal(a, b, err_msg=field.name)
    for target in theirs.targets:
        a, b = (t.distance[:, t.targets.index(target)] for t in (ours, theirs))
        np.testing.assert_array_equal(a, b)


def test_export_and_import_are_the_identity(some_rooms: SceneTables, tmp_path: Path) -> None:
    rooms = some_rooms.subset(["FloorPlan29", "FloorPlan321", "FloorPlan428"])
    rooms = exporter.write_folder(rooms, tmp_path / "out", silent).tables
    back = importer.read_folder(tmp_path / "out", silent).tables
    assert_equal(rooms, back)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(rooms.scenes)
    assert sorted(path.name for path in (tmp_path / "cache").glob("import-*/*")) == [
        "FloorPlan29.npz", "FloorPlan321.npz", "FloorPlan428.npz"
    ]  # fmt: skip
    importer.clear_cache(tmp_path / "out")
    assert list((tmp_path / "cache").iterdir()) == []


def detections(t: SceneTables, exact: bool) -> tuple[Counter, set]:
    """Class and box of every row with a box, and what is visible from where."""
    boxes = [tuple(box) for box in t.row_box.tolist()]
    kinds = [t.classes[c] for c in t.row_class]
    states = t.row_state.tolist()
    seen = {
        (states[i], t.object_id[t.row_object[i]] if exact else kinds[i])
        for i in np.flatnonzero(t.row_visible)
    }
    return Counter(zip(states, kinds, boxes, strict=True)), seen


def test_the_layout_alone_holds_transitions_visibility_and_boxes(
    some_rooms: SceneTables, tmp_path: Path
) -> None:
    """Without our own file, whose a box is may be lost, but nothing else is."""
    room = some_rooms.subset(["FloorPlan303"])
    exporter.write_folder(room, tmp_path / "out", silent)
    (tmp_path / "out" / "FloorPlan303" / OBJECT_FILE).unlink()
    back = importer.read_folder(tmp_path / "out", silent).tables
    np.testing.assert_array_equal(back.next_position, room.next_position)
    np.testing.assert_array_equal(back.position, room.position)
    assert detections(back, exact=True) == detections(room, exact=True)
    shared = [t for t in back.targets if t in room.targets]
    for target in shared:
        a, b = (t.distance[:, t.targets.index(target)] for t in (room, back))
        np.testing.assert_array_equal(a, b)


def tables_of(data: reader.SceneData) -> SceneTables:
    return tabulation.tabulate(data.scene, data.next_position, data.detections, ALL_TARGETS)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=8)
def test_random_rooms(tmp_path_factory: pytest.TempPathFactory, seed: int) -> None:
    draw = np.random.default_rng(seed)
    room = tabulation.build([toy.random_room(draw, name="FloorPlan5")])
    room = dataclasses.replace(room, position_room_type=np.zeros(len(room.position), np.int8))
    folder = tmp_path_factory.mktemp("random") / "FloorPlan5"
    folder.mkdir()
    exporter.write_scene(room, folder)
    data = reader.read_scene(folder, "FloorPlan5", "kitchen")
    assert_equal(room, tables_of(data))
    (folder / OBJECT_FILE).unlink()
    data = reader.read_scene(folder, "FloorPlan5", "kitchen")
    back = tables_of(data)
    assert detections(back, exact=False) == detections(room, exact=False)


def test_imported_rooms_survive_export_and_import(tmp_path: Path) -> None:
    """Nameless objects and those without a box or a place included."""
    first = importer.read_folder(original.write_all(tmp_path / "original"), silent).tables
    exporter.write_folder(first, tmp_path / "out", silent)
    again = importer.read_folder(tmp_path / "out", silent).tables
    assert_equal(first, again)
    keys = (tmp_path / "out" / "FloorPlan1" / "graph.json").read_text()
    assert '"-0.00|0.25|0|0"' in keys


def test_the_graph_is_the_reference_controllers(some_rooms: SceneTables) -> None:
    """Walked as the reference walks: the key of the guessed state must be a neighbour's."""
    room = some_rooms.subset(["FloorPlan229"])
    keys = state_keys(room.position)
    graph = exporter.graph(room, keys)
    neighbours: dict[str, set[str]] = {node["id"]: set() for node in graph["nodes"]}
    for link in graph["links"]:
        neighbours[link["source"]].add(link["target"])
    ways = [(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)]
    for i, key in enumerate(keys):
        x, z, rotation, horizon = key.split("|")
        across, along = ways[int(rotation) // 45]
        guess = f"{float(x) + across * 0.25:0.2f}|{float(z) + along * 0.25:0.2f}"
        guess = guess.replace("-0.00", "0.00")
        moved = room.next_position[i // 16, int(rotation) // 45] != i // 16
        assert (f"{guess}|{rotation}|{horizon}" in neighbours[key]) == moved
        assert f"{x}|{z}|{(int(rotation) + 45) % 360}|{horizon}" in neighbours[key]
        assert f"{x}|{z}|{rotation}|{30 - int(horizon)}" in neighbours[key]
        assert len(neighbours[key]) == 3 + moved


@pytest.mark.slow
def test_what_older_code_reads(some_rooms: SceneTables, tmp_path: Path) -> None:
    pytest.importorskip("h5py")
    room = some_rooms.subset(["FloorPlan428"])
    glove = words.load_bundled()
    vectors = glove.table(room.classes, None)
    parents = {"bathroom": {"Mirror": {"Sink": 0.5}}}
    out = tmp_path / "out"
    exporter.write_folder(room, out, silent, parents, vectors, features=True)
    assert json.loads((out / "c2p_prob.json").read_text()) == {
        "Bathroom": {"Mirror": {"Sink": 0.5}}
    }
    seen = json.loads((out / "FloorPlan428" / "visible_object_map.json").read_text())
    assert seen == json.loads((out / "FloorPlan428" / "visible_object_map_1.5.json").read_text())
    assert all(seen.values()), "objects that are visible from nowhere are not listed"
    with hdf5.opened(out / "FloorPlan428" / "resnet18_featuremap.hdf5") as file:
        keys = state_keys(room.position)
        assert sorted(file.names()) == sorted(keys)
        for state in range(0, room.num_states, 97):
            values = file.read(keys[state], (512, 7, 7))
            shown = np.where(values.any(axis=0), values.argmax(axis=0), -1)
            np.testing.assert_array_equal(shown, room.raster[state])
            assert set(np.unique(values)) <= {0.0, 1.0}
    stored = words.load_word_vectors(out / "thor_glove" / "glove_map50d.hdf5")
    np.testing.assert_allclose(stored.table(room.classes), glove.table(room.classes), atol=1e-6)

    sources = features.find_features(out)
    features.save_with_maps(dataset.Rooms(room, None), tmp_path / "a.npz", sources, silent)
    loaded = features.load_features(tmp_path / "a.npz", room)
    assert loaded.shape == (room.num_states, 512, 7, 7)
    assert loaded.dtype == np.float16
    np.testing.assert_array_equal(np.where(loaded[5].any(0), loaded[5].argmax(0), -1),
                                  room.raster[5])  # fmt: skip
    with pytest.raises(FileError, match="not the maps of these rooms"):
        features.load_features(tmp_path / "a.npz", some_rooms)
    with pytest.raises(FileError, match=r"b\.features\.npy: no such file"):
        features.load_features(tmp_path / "b.npz", room)


def test_broken_features_leave_nothing_behind(some_rooms: SceneTables, tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    room = some_rooms.subset(["FloorPlan428"])
    exporter.write_folder(room, tmp_path / "out", silent)
    with pytest.raises(FileError, match=r"featuremap\.hdf5: no such file"):
        features.find_features(tmp_path / "out")
    for name, data, reason in (
        (state_keys(room.position)[0], np.full((512, 7, 7), np.nan), "NaN"),
        (state_keys(room.position)[0], np.full((512, 7, 7), 1e6), "half precision"),
        (state_keys(room.position)[0], np.zeros((512, 7)), "shape"),
        ("9.00|9.00|0|0", np.zeros((512, 7, 7)), "not on the grid"),
    ):
        with h5py.File(tmp_path / "out/FloorPlan428/resnet18_featuremap.hdf5", "w") as file:
            file[name] = data
        with pytest.raises(FileError, match=rf"featuremap\.hdf5: .*{reason}"):
            features.save_with_maps(
                dataset.Rooms(room, None),
                tmp_path / "a.npz",
                features.find_features(tmp_path / "out"),
                silent,
            )
    assert sorted(p.name for p in tmp_path.iterdir()) == ["out"]


def test_the_links_have_the_names_of_older_and_newer_networkx(some_rooms: SceneTables) -> None:
    room = some_rooms.subset(["FloorPlan428"])
    graph = exporter.graph(room, state_keys(room.position))
    assert len(graph["links"]) > room.num_states
    assert graph["links"] == graph["edges"]


@pytest.mark.parametrize("name", ["../../escaped", "/absolute", "a/b", "..", "a\nb"])
def test_nothing_is_written_outside_of_the_folder(
    some_rooms: SceneTables, tmp_path: Path, name: str
) -> None:
    room = dataclasses.replace(some_rooms.subset(["FloorPlan428"]), scenes=(name,))
    (tmp_path / "a" / "b").mkdir(parents=True)
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SceneError, match="room name"):
        exporter.write_folder(room, tmp_path / "a" / "b" / "out", silent)
    assert sorted(tmp_path.rglob("*")) == before


def test_rooms_that_the_layout_cannot_hold() -> None:
    def tables(name: str = "Mug", x: float = 0.0) -> SceneTables:
        spots = toy.points((x, 0.0), (x + 0.25, 0.0))
        return tabulation.build([toy.room(spots, toy.thing(name, (0.0, toy.CAMERA, 1.2)))])

    exporter.check_layout(tables())
    exporter.check_layout(tables(x=-0.001))
    for name in ("salt/pepper", "a|b"):
        with pytest.raises(ValueError, match=rf"class {re.escape(name)}: .* names with / or \|"):
            exporter.check_layout(tables(name))
    with pytest.raises(ValueError, match=r"Toy, whose points in whole centimetres are not 0\.25 m"):
        exporter.check_layout(tables(x=0.125))  # keys 0.12 and 0.38


def test_parents_survive_export_and_import(ithor: SceneTables) -> None:
    split = make_split("22/0")
    train = ithor.subset(split.train_scenes)
    ours, theirs = find_parents(train, TARGETS), named_parents(ithor, split)
    back = published_parents(train, TARGETS, theirs, ())
    np.testing.assert_array_equal(np.sort(ours.reward), np.sort(back.reward))
    for goal in range(len(ithor.targets)):
        assert set(ours.classes[goal]) == set(back.classes[goal])


def test_an_import_interrupted_while_reading_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source = original.write_all(tmp_path / "original")
    whole = importer.read_folder(source, silent).tables
    importer.clear_cache(source)
    read: list[str] = []
    plain = reader.read_scene

    def counted(folder: Path, name: str, *rest: Any) -> reader.SceneData:
        read.append(name)
        if len(read) == 2:
            raise KeyboardInterrupt
        return plain(folder, name, *rest)

    monkeypatch.setattr(importer, "read_scene", counted)
    with pytest.raises(KeyboardInterrupt):
        importer.read_folder(source, silent)
    back = importer.read_folder(source, silent).tables
    assert read == ["FloorPlan1", "FloorPlan21", "FloorPlan21"]
    assert_equal(whole, back)


def test_scenes_that_changed_are_read_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    place = original.write_all(tmp_path / "original") / "FloorPlan1"
    parts = tmp_path / "parts"
    read: list[str] = []
    plain = reader.read_scene
    monkeypatch.setattr(
        importer, "read_scene", lambda *given: (read.append(given[1]), plain(*given))[1]
    )
    scene = SceneFolder("FloorPlan1", "kitchen", None, place)
    bathroom = scene._replace(room_type="bathroom")
    for times, change, folder, frame in (
        (1, lambda: None, scene, None),
        (1, lambda: None, scene, None),
        (2, lambda: os.utime(place / "grid.json", (1, 1)), scene, None),
        (3, lambda: (parts / "FloorPlan1.npz").write_bytes(b"damaged"), scene, None),
        (4, lambda: None, scene, Frame(600, 600)),
        (5, lambda: None, bathroom, Frame(600, 600)),
        (6, lambda: (place / "images.hdf5").write_bytes(b"damaged"), bathroom, Frame(600, 600)),
    ):
        change()
        room, _ = importer._read_cached(parts, folder, frame)
        assert len(read) == times
        assert len(room.row_object) == 6
        assert room.as_scene().room_type == folder.room_type


def copies(tmp_path: Path, *names: str) -> Path:
    """A folder with the miniature's room under other names."""
    for name in names:
        original.write_room(tmp_path / "rooms" / name)
    return tmp_path / "rooms"


def test_rooms_of_any_name(tmp_path: Path) -> None:
    """Type and part by name, by table, or for all the rest."""
    names = ("FloorPlan2-10", "FloorPlan2-2", "FloorPlan30-1", "FloorPlan_Train1_1", "Lab [bold]",
             "FloorPlan430", "FloorPlan5_physics")  # fmt: skip
    source = copies(tmp_path, *names, "a\nb", "x" * 201)
    (source / "FloorPlan6-1").mkdir()
    (source / "thor_glove").mkdir()
    lines: list[str] = []
    back = importer.read_folder(source, lambda share, line: lines.append(line))
    assert back.tables.scenes == (
        "FloorPlan2-2", "FloorPlan2-10", "FloorPlan5", "FloorPlan30-1", "FloorPlan430"
    )  # fmt: skip
    assert back.extras is not None
    assert back.extras.parts == {
        "FloorPlan2-2": "train", "FloorPlan2-10": "train", "FloorPlan30-1": "test"
    }  # fmt: skip
    split = dataset.assign_rooms(make_split("22/0"), back)
    assert {"FloorPlan2-2", "FloorPlan2-10", "FloorPlan5"} <= set(split.train_scenes)
    assert {"FloorPlan30-1", "FloorPlan430"} <= set(split.eval_scenes)
    assert lines[5:] == [
        "FloorPlan6-1: left out, has no grid.json",
        "FloorPlan_Train1_1: left out, --room-type or --rooms must say its type",
        "Lab [bold]: left out, --room-type or --rooms must say its type",
        "left out: room name 'a?b': has a control character",
        f"left out: room name '{'x' * 40}': empty, longer than 200 bytes, or with a space at its "
        "start or end",
    ]

    table = {"Lab [bold]": RoomKind("bedroom", "test"),
             "FloorPlan30-1": RoomKind("living_room", None),
             "Nowhere": RoomKind("kitchen", None)}  # fmt: skip
    kinds = Kinds(table, RoomKind("living_room", "train"))
    back = importer.read_folder(source, lambda share, line: lines.append(line), kinds)
    assert dict(zip(back.tables.scenes, back.tables.room_type.tolist(), strict=True)) == {
        "FloorPlan2-2": 0, "FloorPlan2-10": 0, "FloorPlan5": 0, "FloorPlan_Train1_1": 1,
        "FloorPlan30-1": 1, "Lab [bold]": 2, "FloorPlan430": 3,
    }  # fmt: skip
    assert back.extras is not None
    assert back.extras.parts == {
        "FloorPlan2-2": "train", "FloorPlan2-10": "train", "FloorPlan_Train1_1": "train",
        "FloorPlan30-1": "test", "Lab [bold]": "test",
    }  # fmt: skip
    assert "1 rooms of the table of rooms are not in the folder: Nowhere" in lines
    dataset.save_rooms(back, tmp_path / "rooms.npz")
    again = dataset.load_rooms(tmp_path / "rooms.npz")
    exporter.write_folder(again.tables, tmp_path / "out", silent)
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == sorted(again.tables.scenes)


def test_boxes_that_never_come_near_the_border(tmp_path: Path) -> None:
    source = copies(tmp_path, "FloorPlan1", "FloorPlan2")
    with pytest.warns(UserWarning, match=r"in FloorPlan1, FloorPlan2; if the frames were smaller, "
                                         r"import with --frame-size WIDTHxHEIGHT$"):  # fmt: skip
        importer.read_folder(source, silent)
    for name in ("FloorPlan1", "FloorPlan2"):
        path = source / name / "objects_bb.json"
        content = json.loads(path.read_text())
        content[original.KEYS[0]] = {"Mug": [0, 0, 271, 271]}
        path.write_text(json.dumps(content))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        importer.read_folder(source, silent)
    with pytest.warns(UserWarning, match="no box comes near"):
        importer.read_folder(source, silent, None, Frame(600, 300))
    for name in ("FloorPlan1", "FloorPlan2"):
        (source / name / "objects_bb.json").unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        importer.read_folder(source, silent)


def test_folders_without_scenes(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no folders of rooms"):
        layout.find_root(tmp_path / "nowhere")
    (tmp_path / "FloorPlan501").mkdir()
    with pytest.raises(FileError, match="no folders of rooms"):
        layout.find_root(tmp_path)
    original.write_room(tmp_path / "a" / "test" / "FloorPlan21")
    original.write_room(tmp_path / "a" / "train" / "FloorPlan1")
    with pytest.raises(FileError, match=r"a: rooms in several .* one of them: test, train"):
        layout.find_root(tmp_path / "a")
    with pytest.raises(FileError, match="one of them: a/test, a/train"):
        layout.find_root(tmp_path)
    assert layout.find_root(tmp_path / "a" / "train") == tmp_path / "a" / "train"
    (tmp_path / "b").mkdir()
    for name in ("data", "offline_data"):
        (tmp_path / "b" / name).symlink_to(tmp_path / "a" / "train")
    assert layout.find_root(tmp_path / "b").resolve() == tmp_path / "a" / "train"
    original.write_room(tmp_path / "a" / "Lab")
    with pytest.raises(FileError, match="no room to import; Lab: left out, --room-type or --rooms"):
        layout.find_scenes(layout.find_root(tmp_path))
    (tmp_path / "FloorPlan1").mkdir()
    (tmp_path / "FloorPlan1_physics").mkdir()
    with pytest.raises(FileError, match="FloorPlan1 is there twice"):
        layout.find_scenes(layout.find_root(tmp_path))


@pytest.mark.slow
def test_all_rooms_survive_export_and_import(ithor: SceneTables, tmp_path: Path) -> None:
    """To the last bit: the hash over all fields is the same."""
    written = exporter.write_folder(ithor, tmp_path / "out", silent).tables
    back = importer.read_folder(tmp_path / "out", silent).tables
    assert back.data_version == written.data_version
