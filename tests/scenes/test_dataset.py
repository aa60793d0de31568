"""Files of rooms: what goes in comes out, and broken ones are refused in one line."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax.scenes import SceneTables, archive, dataset, tables, toy
from tdanet_jax.scenes.dataset import Extras, PublishedEpisode, Rooms
from tdanet_jax.untrusted import FileError


@pytest.fixture(scope="module")
def rooms() -> SceneTables:
    draw = np.random.default_rng(1)
    return tables.build([toy.random_room(draw, name=f"Room{i}") for i in range(3)])


def test_rooms_come_back_with_their_extras(rooms: SceneTables, tmp_path: Path) -> None:
    episode = PublishedEpisode("test", "Room1", 0.25, -0.5, 45, 30, "Mug")
    extras = Extras({"kitchen": {"Mug": {"Sofa": 0.5}}}, (episode,), ("A", "B"),
                    np.eye(2, dtype=np.float32))  # fmt: skip
    path = tmp_path / "rooms.npz"
    dataset.save(Rooms(rooms, extras), path)
    back = dataset.load(path)
    assert back.extras is not None
    assert (back.extras.parents, list(back.extras.episodes)) == (extras.parents, [episode])
    assert back.extras.graph_classes == ("A", "B")
    np.testing.assert_array_equal(back.extras.adjacency, np.eye(2))
    assert back.tables.scenes == rooms.scenes
    assert set(back.tables.targets) == set(rooms.targets) & set(rooms.classes)
    assert SceneTables.load(path).data_version == rooms.data_version
    assert [p.name for p in tmp_path.iterdir()] == ["rooms.npz"]


def test_tables_alone_are_a_file_of_rooms(rooms: SceneTables, tmp_path: Path) -> None:
    rooms.save(tmp_path / "rooms.npz")
    extras = dataset.load(tmp_path / "rooms.npz").extras
    assert extras is not None
    assert extras.class_graph(rooms.classes) is None
    assert not extras.parents
    assert dataset.load_rooms(None).extras is None


BREAKS: list[tuple[str, Any]] = [
    ("room_type", lambda a: a + 9),
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
]


@pytest.mark.parametrize("case", range(len(BREAKS)))
def test_numbers_that_contradict_each_other(rooms: SceneTables, tmp_path: Path, case: int) -> None:
    name, change = BREAKS[case]
    broken = dataclasses.replace(rooms, **{name: change(getattr(rooms, name))})
    broken.save(tmp_path / "rooms.npz")
    with pytest.raises(FileError, match=r"rooms\.npz: not a file of rooms \(") as error:
        dataset.load(tmp_path / "rooms.npz")
    assert str(error.value).isprintable()


def test_other_archives(rooms: SceneTables, tmp_path: Path) -> None:
    path = tmp_path / "rooms.npz"
    arrays = rooms.to_arrays()
    for change in (
        {"rest": np.frombuffer(b"{", np.uint8)},
        {"extras/notes": np.frombuffer(b"[]", np.uint8)},
        {"unknown": np.zeros(3)},
    ):
        archive.write(path, {**arrays, **change})
        with pytest.raises(FileError, match=r"rooms\.npz: not a file of rooms"):
            dataset.load(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(FileError, match=r"rooms\.npz: not a file of rooms"):
        dataset.load_rooms(str(path))
    path.write_text("{}")
    with pytest.raises(FileError, match=r"rooms\.npz: not an npz archive"):
        dataset.load(path)


def test_a_room_as_a_scene(rooms: SceneTables) -> None:
    scene = dataset.as_scene(rooms.subset(["Room1"]))
    assert scene.name == "Room1"
    assert {item.object_class for item in scene.objects} <= set(rooms.classes)
    assert scene.objects[0].box.shape == (2, 3)
