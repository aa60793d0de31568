"""What lies on what, how objects are turned and what opens: kept in files of rooms."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.io import archive
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.scenes import dataset, records, tabulation
from tdanet_jax.scenes.dataset import Extras, Rooms
from tdanet_jax.scenes.scene import Scene, SceneError
from tests.support import toy

CORNERS = np.arange(24.0).reshape(8, 3)


def scenes() -> list[Scene]:
    mug = dataclasses.replace(
        toy.thing("Mug", (0, 1, 1)), corners=CORNERS, rotation=(1.0, 2.0, 3.0), pickupable=True,
        parents=("Sofa|0", "elsewhere"), visible=None,
    )  # fmt: skip
    fridge = dataclasses.replace(toy.thing("Fridge", (1, 1, 1)), openable=True, is_open=True)
    house = dataclasses.replace(
        toy.room(toy.line(2), mug, name="House"), room_type=("kitchen", "bedroom")
    )
    return [
        toy.room(toy.line(2), toy.thing("Sofa", (0, 0, 1)), mug, fridge, name="One", room_type=2),
        dataclasses.replace(house, part="test"),
    ]


def rooms() -> Rooms:
    tables = tabulation.build(scenes())
    return Rooms(tables, Extras(parts={"House": "test"}), records=records.of_scenes(scenes()))


def test_rooms_come_back_from_a_file_as_they_were(tmp_path: Path) -> None:
    dataset.save_rooms(rooms(), tmp_path / "rooms.npz")
    back = dataset.load_rooms(tmp_path / "rooms.npz")
    for ours, theirs in zip(back.scenes(("One", "House")), scenes(), strict=True):
        assert (ours.name, ours.room_type, ours.part) == (
            theirs.name, theirs.room_type, theirs.part
        )  # fmt: skip
        np.testing.assert_array_equal(ours.points, theirs.points)
        for one, other in zip(ours.objects, theirs.objects, strict=True):
            known = tuple(name for name in other.parents if name == "Sofa|0" and ours.name == "One")
            assert one.parents == known
            np.testing.assert_array_equal(one.box, other.box)
            assert (one.corners is None) == (other.corners is None)
            assert one.corners is None or (one.corners == CORNERS).all()
            for field in ("object_id", "object_class", "rotation", *records.FLAGS):
                assert getattr(one, field) == getattr(other, field)
    [house] = back.scenes(("House",))
    assert house.name == "House"


def test_files_without_records_are_read_and_say_so(tmp_path: Path) -> None:
    dataset.save_rooms(dataclasses.replace(rooms(), records=None), tmp_path / "rooms.npz")
    back = dataset.load_rooms(tmp_path / "rooms.npz")
    assert back.records is None
    with pytest.raises(SceneError, match="do not say what lies on what: import them from a scene"):
        back.scenes(("One",))


@pytest.mark.parametrize(
    ("name", "damage", "message"),
    [
        ("flags", lambda a: a[1:], "flags is not bool"),
        ("flags", lambda a: a.astype(np.int8), "flags is not bool"),
        ("rotation", lambda a: a * np.nan, "rotation is not finite"),
        ("corners", lambda a: a + np.inf, "corners is not finite"),
        ("corners", lambda a: a[:, :4], "corners is not float64"),
        ("turned", lambda a: a + 100, "turned points outside the tables"),
        ("parent", lambda a: a - 5, "parent points outside the tables"),
        ("parent", lambda a: a[:, :1], "parent is not int32"),
        ("parent", lambda a: np.array([[0, 3]], np.int32), "parent leads from one room to another"),
        ("parent", None, "parent is not int32"),
    ],
)
def test_broken_records(
    tmp_path: Path, name: str, damage: Callable[[np.ndarray], np.ndarray] | None, message: str
) -> None:
    path = tmp_path / "rooms.npz"
    dataset.save_rooms(rooms(), path)
    with np.load(path) as data:
        arrays = dict(data)
    value = arrays.pop(f"objects/{name}")
    if damage is not None:
        arrays[f"objects/{name}"] = damage(value)
    archive.write(path, arrays)
    with pytest.raises(FileError, match=f"rooms.npz: not a file of rooms .objects/{message}"):
        dataset.load_rooms(path)
