"""Names of rooms: refused as paths, and read for type and part."""

from __future__ import annotations

from pathlib import Path

import pytest

from tdanet_jax.io.untrusted import FileError
from tdanet_jax.scenes import room_names
from tdanet_jax.scenes.room_names import Kinds, RoomKind
from tdanet_jax.scenes.scene import SceneError


@pytest.mark.parametrize(
    "name", ["FloorPlan1", "FloorPlan430-5", "FloorPlan_Train1_1", "Küche, 2. Stock", "x" * 200]
)
def test_plain_names_are_accepted(name: str) -> None:
    room_names.check_name(name)


@pytest.mark.parametrize(
    ("name", "reason"),
    [("../../escaped", "is a path"), ("/absolute", "is a path"), ("a\\b", "is a path"),
     ("C:room", "is a path"), (".", "is a path"), ("..", "is a path"),
     ("a\nb", "control character"), ("a\x00", "control character"), ("\x1b[2J", "control"),
     ("\ud800", "control character"), ("", "empty"), (" a", "space"), ("a ", "space"),
     ("x" * 201, "longer than 200 bytes"), ("ü" * 101, "longer than 200 bytes")],
)  # fmt: skip
def test_names_that_are_unsafe_as_files_are_refused(name: str, reason: str) -> None:
    with pytest.raises(SceneError, match=reason) as error:
        room_names.check_name(name)
    assert str(error.value).isprintable()


@pytest.mark.parametrize(
    ("name", "kind"),
    [("FloorPlan1", RoomKind("kitchen", None)), ("FloorPlan430", RoomKind("bathroom", None)),
     ("FloorPlan20-5", RoomKind("kitchen", "train")),
     ("FloorPlan21-1", RoomKind("kitchen", "test")),
     ("FloorPlan220_b", RoomKind("living_room", "train")),
     ("FloorPlan330 night", RoomKind("bedroom", "test"))],
)  # fmt: skip
def test_names_that_begin_with_an_ithor_room_have_its_kind(name: str, kind: RoomKind) -> None:
    assert room_names.kind_of(name) == kind


@pytest.mark.parametrize(
    "name", ["Lab", "FloorPlan", "FloorPlan_Train1_1", "FloorPlan0", "FloorPlan31", "FloorPlan123",
             "FloorPlan1234", "FloorPlan01", "MyFloorPlan1", "floorplan1"]
)  # fmt: skip
def test_other_names_have_no_kind(name: str) -> None:
    assert room_names.kind_of(name) is None


def test_a_table_says_more_than_a_name_and_a_name_more_than_the_rest() -> None:
    table = {"FloorPlan1-1": RoomKind("bedroom", "test"), "Lab": RoomKind("living_room", None)}
    kinds = Kinds(table, RoomKind("bathroom", "train"))
    assert kinds.of("FloorPlan1-1") == RoomKind("bedroom", "test")
    assert kinds.of("FloorPlan1-2") == RoomKind("kitchen", "train")
    assert kinds.of("Lab") == RoomKind("living_room", "train")
    assert kinds.of("Attic") == RoomKind("bathroom", "train")
    assert Kinds().of("Attic") == RoomKind(None, None)
    # What the room's own file says counts before all, and the rest is filled in.
    assert kinds.of("FloorPlan1-1", RoomKind("office")) == RoomKind("office", "test")
    assert kinds.of("Lab", RoomKind(None, "test")) == RoomKind("living_room", "test")
    assert kinds.of("FloorPlan1").part is None  # iTHOR's own: the split decides


def test_names_are_sorted_by_their_numbers() -> None:
    names = ["FloorPlan10", "FloorPlan2-10", "Attic", "FloorPlan2-1", "7", "FloorPlan2"]
    assert sorted(names, key=room_names.sort_key) == [
        "7", "Attic", "FloorPlan2", "FloorPlan2-1", "FloorPlan2-10", "FloorPlan10"
    ]  # fmt: skip


def test_a_table_of_rooms(tmp_path: Path) -> None:
    path = tmp_path / "rooms.csv"
    path.write_text('name,room_type,part\n"Lab, east",kitchen,train\n\n Office ,bedroom,\n')
    expected = {"Lab, east": RoomKind("kitchen", "train"), "Office": RoomKind("bedroom", None)}
    assert room_names.read_table(path) == expected
    path.write_bytes(b"\xef\xbb\xbfroom_type,name\r\nbathroom,Spa\r\n")  # as a spreadsheet writes
    assert room_names.read_table(path) == {"Spa": RoomKind("bathroom", None)}


@pytest.mark.parametrize(
    ("text", "reason"),
    [("", "line 1: the columns are not name, room_type, part"),
     ("room_type,part\nkitchen,train\n", "line 1: the columns"),
     ("name,room_type,name\nLab,kitchen,Lab\n", "line 1: the columns"),
     ("name,room_type,floor\nLab,kitchen,2\n", "line 1: the columns"),
     ("name,room_type\nLab,kitchen,train\n", "line 2: 3 columns, not 2"),
     ("name,room_type\nLab,Kitchen\n", "line 2: room_type 'Kitchen': did you mean kitchen"),
     ("name,room_type,part\nLab,kitchen,val\n", "line 2: part 'val', not train or test"),
     ("name,room_type\n../up,kitchen\n", r"line 2: room name '\.\./up': is a path"),
     ("name,room_type\nLab,kitchen\nLab,bedroom\n", "line 3: Lab is listed twice"),
     ('name,room_type\n"Lab,kitchen\n', "not a CSV table"),
     ("name,room_type\n\xff", "not UTF-8")],
)  # fmt: skip
def test_broken_tables(tmp_path: Path, text: str, reason: str) -> None:
    path = tmp_path / "rooms.csv"
    path.write_text(text, encoding="latin-1")
    with pytest.raises(FileError, match=rf"rooms\.csv: {reason}"):
        room_names.read_table(path)


def test_missing_tables(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"nowhere\.csv: No such file"):
        room_names.read_table(tmp_path / "nowhere.csv")
