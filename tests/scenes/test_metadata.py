"""Scene files: what they mean, and that broken ones are refused in one line."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneError, dataset, metadata
from tdanet_jax.scenes.room_names import Kinds

BOX = {"center": {"x": 0.0, "y": 1.5, "z": 1.0}, "size": {"x": 0.2, "y": 0.2, "z": 0.2}}
DOCUMENT: dict[str, Any] = {
    "name": "Lab",
    "room_type": "bedroom",
    "reachable_positions": [{"x": 0.1, "y": 0.9, "z": 0.25 * i} for i in (2, 0, 1)],
    "objects": [
        {
            "objectId": "Mug|1",
            "objectType": "Mug",
            "axisAlignedBoundingBox": BOX,
            "parentReceptacles": ["Floor|0", "Desk|0"],
            "visible": True,
        },
        {"objectId": "Floor|0", "objectType": "Floor", "axisAlignedBoundingBox": None},
        {
            "objectId": "Desk|0",
            "objectType": "Desk",
            "axisAlignedBoundingBox": BOX,
            "isOpen": True,
            "rotation": {"x": 0, "y": 45, "z": 0},
        },
        {"objectId": "room|0", "objectType": "Room", "axisAlignedBoundingBox": None},
        {"objectId": "Ceiling|0", "objectType": "Ceiling", "axisAlignedBoundingBox": None},
    ],
}


@pytest.mark.filterwarnings("error")
def test_classes_go_by_ai2thors_names(tmp_path: Path) -> None:
    """Or else a split would not hide a Laptop that is called otherwise."""
    document = copy.deepcopy(DOCUMENT)
    document["objects"][0]["objectType"] = "laptop_computer"
    document["objects"][2]["objectType"] = "Oven"
    with pytest.warns(UserWarning, match=r"scenes\.json: .*: laptop_computer as Laptop$"):
        [scene] = read(tmp_path, document)
    assert [item.object_class for item in scene.objects] == ["Laptop", "Oven"]
    assert scene.objects[0].parents == ("Desk|0",)
    document["objects"][0]["objectType"] = "AppleSliced"  # another class of AI2-THOR
    [scene] = read(tmp_path, document)
    assert [item.object_class for item in scene.objects] == ["AppleSliced", "Oven"]


def read(tmp_path: Path, document: Any) -> Any:
    path = tmp_path / "scenes.json"
    path.write_text(document if isinstance(document, str) else json.dumps(document))
    return metadata.read_scenes(path)


def test_a_scene_file(tmp_path: Path) -> None:
    [scene] = read(tmp_path, DOCUMENT)
    assert (scene.name, scene.room_type) == ("Lab", "bedroom")
    assert scene.points[:, 2].tolist() == [0.0, 0.25, 0.5]
    assert [item.object_id for item in scene.objects] == ["Desk|0", "Mug|1"]
    desk, mug = scene.objects
    assert np.allclose(mug.box, [(-0.1, 1.4, 0.9), (0.1, 1.6, 1.1)])
    assert mug.parents == ("Desk|0",)
    assert mug.visible is True
    assert desk.visible is None
    assert desk.is_open
    assert desk.rotation == (0.0, 45.0, 0.0)


def test_a_list_of_scenes(tmp_path: Path) -> None:
    other = {**DOCUMENT, "name": "Den"}
    first, second = read(tmp_path, [DOCUMENT, other])
    assert (first.name, second.name) == ("Lab", "Den")


def test_a_room_may_say_what_it_is_for(tmp_path: Path) -> None:
    assert [scene.part for scene in read(tmp_path, DOCUMENT)] == [None]
    assert [scene.part for scene in read(tmp_path, {**DOCUMENT, "split": "test"})] == ["test"]


def test_rooms_may_name_their_targets(tmp_path: Path) -> None:
    other = {**DOCUMENT, "name": "Den", "targets": ["desks", "mug"]}
    assert [s.targets for s in read(tmp_path, [DOCUMENT, other])] == [(), ("Mug", "Desk")]
    found = dataset.build_rooms(tmp_path / "scenes.json").extras
    assert found is not None
    assert found.targets == {"bedroom": ("Mug", "Desk")}
    other["targets"] = ["Kettle"]
    (tmp_path / "scenes.json").write_text(json.dumps([DOCUMENT, other]))
    with pytest.raises(SceneError, match=r"scenes\.json: Den: targets: no room holds a Kettle"):
        dataset.build_rooms(tmp_path / "scenes.json")


def test_a_room_may_have_a_grid_of_its_own(tmp_path: Path) -> None:
    assert read(tmp_path, DOCUMENT)[0].grid == PoseGrid()
    fields = {"gridSize": 0.125, "rotateStepDegrees": 30.0, "horizons": [-30, 0, 30]}
    document = {**DOCUMENT, **fields}
    [scene] = read(tmp_path, document)
    assert scene.grid == PoseGrid(0.125, 12, (-30, 0, 30))
    assert len(scene.points) == 3
    other = {**DOCUMENT, **fields, "name": "Den"}
    with pytest.raises(SceneError, match=r"scenes.json: Den: another gridSize, .* than Lab;"):
        read(tmp_path, [DOCUMENT, other])
    assert len(read(tmp_path, [document, other])) == 2


def square(room_type: str, low: float, high: float, **other: Any) -> dict[str, Any]:
    """A room of 2 m from `low` to `high` metres along z."""
    corners = [(-1.0, low), (1.0, low), (1.0, high), (-1.0, high)]
    polygon = [{"x": x, "y": 0.0, "z": z} for x, z in corners]
    return {"roomType": room_type, "floorPolygon": polygon, "id": "room|2", "children": []}


def test_the_rooms_of_a_house(tmp_path: Path) -> None:
    """A doorway, at 0.25 m, is of the nearer room; a room without a point has no type."""
    house = {key: value for key, value in DOCUMENT.items() if key != "room_type"}
    for door, found in ((0.2, "Attic"), (0.3, "living_room")):
        rooms = [
            square("Attic", door + 0.08, 1.0), square("LivingRoom", -1.0, door - 0.08),
            square("Garage", 5.0, 6.0),
        ]  # fmt: skip
        [scene] = read(tmp_path, {**house, "rooms": rooms})
        assert scene.room_type == ("living_room", found, "Attic")
    with pytest.raises(SceneError, match="Lab: both room_type and rooms"):
        read(tmp_path, {**DOCUMENT, "rooms": rooms})
    assert read(tmp_path, {**DOCUMENT, "rooms": None})[0].room_type == "bedroom"


def broken(path: list[Any], value: Any) -> Any:
    document = copy.deepcopy(DOCUMENT)
    place = document
    for step in path[:-1]:
        place = place[step]
    place[path[-1]] = value
    return document


def corners(
    degrees: float = 0, low: float = 1.4, order: Any = range(8), skew: float = 0, away: float = 0
) -> dict[str, Any]:
    """The oriented box of the mug, or one with something wrong."""
    turn = np.exp(1j * np.radians(degrees))
    flat = [turn * (0.1 * x + 0.1j * z) for x, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    points = [[p.real + away + skew * (y > 1.5), y, p.imag + 1.0] for y in (low, 1.6) for p in flat]
    return {"cornerPoints": [points[i] for i in order]}


NAN = float("nan")
CASES = [
    (["reachable_positions"], [], "Lab: no reachable position"),
    (["reachable_positions"], None, "Lab: reachable_positions is not a list"),
    (["reachable_positions", 1, "x"], NAN, r"Lab: reachable_positions\[1\]"),
    (["reachable_positions", 0, "x"], 0.2, "Lab: reachable position x .*: off the 0.25 m grid"),
    (["objects"], [], "Lab: no objects"),
    (["objects"], {}, "Lab: objects is not a list"),
    (["objects", 0], 3, "Lab: an object without objectType"),
    (["objects", 0, "objectId"], "", "Lab: an object without objectId"),
    (["objects", 0, "objectType"], None, "Lab: an object without objectType"),
    (["objects", 0, "objectId"], "Desk|0", r"Lab: Desk\|0: id occurs 2 times"),
    (["objects", 0, "axisAlignedBoundingBox"], None, r"Lab: Mug\|1: no axisAligned"),
    (["objects", 0, "axisAlignedBoundingBox", "center", "y"], NAN, r"Lab: Mug\|1: center is not"),
    (["objects", 0, "axisAlignedBoundingBox", "size", "y"], -1, r"Lab: Mug\|1: .*negative size"),
    (["objects", 0, "axisAlignedBoundingBox", "size"], [1, 1, 1], r"Lab: Mug\|1: size is not"),
    (["objects", 0, "objectOrientedBoundingBox"], {}, None),
    (["objects", 0, "objectOrientedBoundingBox"], {"cornerPoints": [[0, 0, 0]]}, "8 finite"),
    (["objects", 0, "objectOrientedBoundingBox"], {"cornerPoints": []}, None),
    (["objects", 0, "objectOrientedBoundingBox"], {"cornerPoints": None}, None),
    (["objects", 0, "objectOrientedBoundingBox"], corners(), None),
    (["objects", 0, "objectOrientedBoundingBox"], corners(degrees=30), None),
    (["objects", 0, "objectOrientedBoundingBox"], corners(low=1.6), None),  # flat
    (["objects", 0, "objectOrientedBoundingBox"], corners(order=(4, 5, 6, 7, 0, 1, 2, 3)), None),
    (["objects", 0, "objectOrientedBoundingBox"], corners(order=(0, 1, 3, 2, 4, 5, 7, 6)), "order"),
    (["objects", 0, "objectOrientedBoundingBox"], corners(order=(0, 4, 1, 5, 3, 7, 2, 6)), "order"),
    (["objects", 0, "objectOrientedBoundingBox"], corners(skew=0.1), "no box in AI2-THOR's order"),
    (["objects", 0, "objectOrientedBoundingBox"], corners(away=0.5), None),
    (["objects", 0, "objectOrientedBoundingBox"], corners(away=0.7), r"Mug\|1: .* over 0.5 m from"),
    (["objects", 0, "parentReceptacles"], 3, r"Lab: Mug\|1: parentReceptacles"),
    (["room_type"], None, "Lab: no room type; give it in the file .*--room-type or --rooms"),
    (["room_type"], 3, "Lab: room_type 3: not a name"),
    (["room_type"], "", "Lab: room_type '': empty"),
    (["room_type"], "Living Room", "Lab: room_type 'Living Room': did you mean living_room?"),
    (["rooms"], [], "Lab: rooms is not a list of rooms"),
    (["rooms"], {}, "Lab: rooms is not a list of rooms"),
    (["rooms"], [3], r"Lab: rooms\[0\]: floorPolygon is not a list of 3 or more corners"),
    (["rooms"], [{"roomType": "Kitchen"}], r"Lab: rooms\[0\]: floorPolygon is not a list"),
    (
        ["rooms"],
        [square("A", 0, 1) | {"floorPolygon": [{"x": 0, "y": 0, "z": 0}] * 2}],
        r"Lab: rooms\[0\]: floorPolygon is not a list of 3 or more corners",
    ),
    (
        ["rooms"],
        [square("A", 0, 1), square("B", 1, NAN)],
        r"Lab: rooms\[1\]: floorPolygon\[2\]: corner is not x, y, z, finite",
    ),
    (["rooms"], [square("A", 0, 1) | {"roomType": None}], r"Lab: rooms\[0\]: no roomType"),
    (["rooms"], [square("a/b", 0, 1)], r"Lab: rooms\[0\]: roomType 'a/b': is a path"),
    (["name"], " ", "room name ' ': empty, longer than"),
    (["name"], "x" * 201, "longer than 200 bytes"),
    (["name"], "../Lab", "room name '../Lab': is a path"),
    (["name"], "a\\b", "is a path"),
    (["name"], "..", "is a path"),
    (["name"], "a\nb", "has a control character"),
    (["name"], None, "a scene without a name"),
    (["split"], "half", "Lab: part 'half', not train or test"),
    (["split"], ["test"], "Lab: part "),
    (["gridSize"], 0.4, "Lab: reachable position x .*: off the 0.4 m grid"),
    (
        ["reachable_positions"],
        [{"x": 0.5 * i, "y": 0.9, "z": 0.0} for i in range(3)],
        "Lab: no two positions are 0.25 m apart; is gridSize missing?",
    ),
    (["reachable_positions"], [{"x": 0.0, "y": 0.9, "z": 0.0}], None),
    (["gridSize"], "wide", "Lab: gridSize 'wide': must be from 0.05 to 0.5 metres"),
    (["rotateStepDegrees"], 40, r"Lab: rotateStepDegrees 40, not one of \[15, 30, 45, 60, 90\]"),
    (["rotateStepDegrees"], "90", "Lab: rotateStepDegrees '90', not one of"),
    (["horizons"], 30, "Lab: horizons is not a list"),
    (["targets"], "Mug", "Lab: targets is not a list of names of classes"),
    (["targets"], ["a;b"], "Lab: targets is not a list of names of classes"),
    (
        ["targets"],
        ["mug", "Doorway"],
        "Lab: targets: parts of the building are never targets: Doorway",
    ),
    (["horizons"], [], r"Lab: horizons \[\]: must be whole degrees"),
    (["horizons"], [0, [30]], "Lab: horizons .*: must be whole degrees"),
    (["agent"], 3, None),  # as every field that is not listed
]


@pytest.mark.parametrize(("path", "value", "message"), CASES)
def test_rules(tmp_path: Path, path: list[Any], value: Any, message: str | None) -> None:
    if message is None:
        assert read(tmp_path, broken(path, value))
        return
    with pytest.raises(SceneError, match=message) as error:
        read(tmp_path, broken(path, value))
    assert "\n" not in str(error.value)
    assert str(error.value).startswith(f"{tmp_path / 'scenes.json'}: ")


@pytest.mark.parametrize("content", ["", "{", "[]", "[1]", "3", "null", "[" * 100_000])
def test_files_without_a_scene(tmp_path: Path, content: str) -> None:
    with pytest.raises(SceneError, match=r"scenes\.json") as error:
        read(tmp_path, content)
    assert "\n" not in str(error.value)


def test_a_name_taken_twice(tmp_path: Path) -> None:
    with pytest.raises(SceneError, match="Lab: name occurs 2 times"):
        read(tmp_path, [DOCUMENT, DOCUMENT])


anything = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=8,
)
places = st.sampled_from(
    [
        ["objects", 0, "axisAlignedBoundingBox"],
        ["objects", 0, "axisAlignedBoundingBox", "size", "x"],
        ["objects", 0, "objectOrientedBoundingBox"],
        ["objects", 0, "rotation"],
        ["objects", 0, "parentReceptacles"],
        ["objects", 2],
        ["reachable_positions"],
        ["reachable_positions", 0],
        ["name"],
        ["room_type"],
        ["rooms"],
        ["split"],
        ["gridSize"],
        ["rotateStepDegrees"],
        ["horizons"],
    ]
)


@given(places, anything)
def test_whatever_is_wrong_is_a_scene_error(path: list[Any], value: Any) -> None:
    message = ""
    try:
        metadata._read_scene(broken(path, value), Kinds())
    except SceneError as error:
        message = str(error)
    assert "\n" not in message


def test_a_byte_order_mark_is_no_matter(tmp_path: Path) -> None:
    [scene] = read(tmp_path, "\ufeff" + json.dumps(DOCUMENT))
    assert scene.name == "Lab"
