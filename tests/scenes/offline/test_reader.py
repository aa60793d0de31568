"""A scene's folder: every variant of its files, by hand, and everything that is refused."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax.io.untrusted import FileError
from tdanet_jax.scenes.offline import layout, matching, reader
from tdanet_jax.scenes.offline.frames import Frame
from tdanet_jax.scenes.offline.reader import SceneData
from tests.support import original
from tests.support.original import APPLE, KEYS, MUG, TABLE

AHEAD = [0, 1, 2]  # places in KEYS: 16 a point


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    original.write_room(tmp_path / "FloorPlan1")
    return tmp_path / "FloorPlan1"


def read(folder: Path) -> SceneData:
    return reader.read_scene(folder, "FloorPlan1", "kitchen")


def change(folder: Path, name: str, edit: Any) -> None:
    """Rewrites a file: `edit` gets its content and changes or replaces it."""
    content = json.loads((folder / name).read_text())
    (folder / name).write_text(json.dumps(edit(content) or content))


def rows(data: SceneData) -> set[tuple[int, str, tuple[float, ...], bool]]:
    """State, object, box in pixels, and whether it is visible, of every row."""
    return {
        (int(s), data.scene.objects[o].object_id, tuple((b / 16).tolist()), bool(v))
        for s, o, b, v in zip(*data.detections, strict=True)
    }


def test_the_miniature_by_hand(folder: Path) -> None:
    data = read(folder)
    assert data.scene.points.tolist() == [[-0.001, 0.9, 0.25 * i] for i in range(3)]
    nowhere = tuple(value / 16 for value in matching.NO_BOX)
    assert rows(data) == {
        (16, MUG, (140, 150, 160, 170), False),
        (16, TABLE, (100, 160, 200, 300), True),
        (32, MUG, (130, 140, 170, 180), True),  # the larger box is that of the visible mug
        (32, "Mug|unnamed|0", (5, 150, 15, 160), False),
        (32, APPLE, (0, 0, 10, 20), False),
        (32, TABLE, nowhere, True),
    }
    steps = [[point] * 8 for point in range(3)]
    steps[0][0], steps[1][0], steps[1][4], steps[2][4] = 1, 2, 0, 1
    assert data.next_position.tolist() == steps
    places = {item.object_id: item.box[0].tolist() for item in data.scene.objects}
    assert places[MUG] == [0.0, 1.0, 1.5]
    assert np.isnan(places[APPLE]).all()
    assert "3 points, visible_object_map.json (3 objects)" in data.describe()
    assert "1 times an object is visible and has no box" in data.describe()


def test_links_by_name_and_links_called_edges_are_the_same(folder: Path) -> None:
    before = read(folder).next_position

    def new_style(graph: dict) -> None:
        graph["links"] = [{k: KEYS[i] for k, i in link.items()} for link in graph["links"]]

    change(folder, "graph.json", new_style)
    np.testing.assert_array_equal(read(folder).next_position, before)
    change(folder, "graph.json", lambda graph: graph.update(edges=graph["links"]))
    np.testing.assert_array_equal(read(folder).next_position, before)
    change(folder, "graph.json", lambda graph: graph.pop("links") and None)
    np.testing.assert_array_equal(read(folder).next_position, before)


def test_an_undirected_graph_has_every_link_both_ways(folder: Path) -> None:
    def undirect(graph: dict) -> None:
        links = graph["links"]
        graph["directed"] = False
        graph["links"] = [link for link in links if link["source"] < link["target"]]

    before = read(folder)
    change(folder, "graph.json", undirect)
    # A step back along heading 180 is another state's link, so a step ahead gives none back.
    after = read(folder)
    assert after.next_position[:, 0].tolist() == before.next_position[:, 0].tolist()


def test_oddities_of_a_graph_are_counted(folder: Path) -> None:
    def edit(graph: dict) -> None:
        links = graph["links"]
        links.remove({"source": 0, "target": 16})  # a step at horizon 0 alone
        links.remove({"source": 2, "target": 4})  # a turn
        links.append({"source": 0, "target": 32})  # two steps at once
        graph["nodes"][40:40] = [{"id": KEYS[5].replace("-0.00", "0.00")}]
        for link in links:
            for end in link:
                link[end] += link[end] >= 40

    change(folder, "graph.json", edit)
    data = read(folder)
    assert data.next_position[0, 0] == 1
    assert set(data.noted) >= {
        "1 steps at one horizon alone, taken as open at both",
        "1 turns without a link, taken as possible",
        "1 links that no action takes, left out",
    }


def test_states_without_a_node(folder: Path) -> None:
    def cut(graph: dict) -> None:
        graph["nodes"] = graph["nodes"][:32]
        graph["links"] = [link for link in graph["links"] if max(link.values()) < 32]

    change(folder, "graph.json", cut)
    data = read(folder)
    assert "16 states not in the graph" in data.noted
    assert data.next_position[1, 0] == 1


def test_raw_metadata_in_place_of_the_map(folder: Path) -> None:
    before = read(folder)
    (folder / "visible_object_map.json").unlink()
    kinds = {MUG: "Mug", TABLE: "TableTop", APPLE: "Apple"}
    metadata = {
        key: {
            "objects": [
                {"objectId": name, "objectType": kind, "visible": key in original.VISIBLE[name]}
                for name, kind in kinds.items()
            ],
            "agent": {"cameraHorizon": 0.0},
        }
        for key in KEYS
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    after = read(folder)
    assert rows(after) == rows(before)
    assert "metadata.json (3 objects)" in after.found


def test_boxes_of_events_say_where_objects_are(folder: Path) -> None:
    (folder / "visible_object_map.json").unlink()
    box = {"center": {"x": 1.0, "y": 0.5, "z": 2.0}, "size": {"x": 0.5, "y": 1.0, "z": 2.0}}
    for given, expected in (
        (box, [[0.75, 0.0, 1.0], [1.25, 1.0, 3.0]]),
        (None, [[0.0, 1.0, 1.5]] * 2),
        ([], "has no center and size"),
        ({"center": box["center"]}, "has no center and size"),
        ({**box, "size": {"x": 0.5}}, "y is not a number"),
    ):
        record = {"objectId": MUG, "objectType": "Mug", "visible": True}
        event = {"objects": [{**record, "axisAlignedBoundingBox": given}]}
        (folder / "metadata.json").write_text(json.dumps({KEYS[0]: event}))
        if isinstance(expected, str):
            with pytest.raises(FileError, match=rf"metadata\.json: .*{expected}"):
                read(folder)
        else:
            [mug] = [item for item in read(folder).scene.objects if item.object_id == MUG]
            assert mug.box.tolist() == expected


@pytest.mark.parametrize("part", ["Floor", "Wall", "Doorway"])
def test_parts_of_the_building_are_left_out_of_every_file(folder: Path, part: str) -> None:
    before = read(folder)
    floor = f"{part}|+00.00|+00.00|+00.00"
    change(folder, "visible_object_map.json", lambda seen: seen.update({floor: KEYS}))
    change(
        folder, "objects_bb.json", lambda boxes: boxes[KEYS[0]].update({part: [0, 200, 300, 300]})
    )
    assert rows(read(folder)) == rows(before)
    named = {KEYS[0]: {floor: [0, 200, 300, 300], MUG: [1, 1, 2, 2]}}
    change(folder, "objects_bb.json", lambda _: named)
    assert [item for _, item, _, _ in rows(read(folder)) if part in item] == []
    change(folder, "objects_bb.json", lambda _: {KEYS[0]: {part: [0] * 4, "Mug": [1, 1, 2, 2]}})
    records = {
        floor: {"objectType": part, "box": None}, MUG: {"objectType": "Mug", "box": None}
    }  # fmt: skip
    ours = {"objects": records, "instances": {KEYS[0]: [0, 1]}}
    (folder / "objects.json").write_text(json.dumps(ours))
    assert (0, MUG, (1, 1, 2, 2), False) in rows(read(folder))
    (folder / "objects.json").unlink()
    (folder / "visible_object_map.json").unlink()
    things = [
        {"objectId": name, "objectType": name.split("|")[0], "visible": True}
        for name in (floor, MUG)
    ]
    (folder / "metadata.json").write_text(json.dumps({KEYS[0]: {"objects": things}}))
    assert [item for _, item, _, _ in rows(read(folder)) if part in item] == []


def test_the_file_named_with_the_distance_is_preferred(folder: Path) -> None:
    (folder / "visible_object_map_1.5.json").write_text(json.dumps({MUG: []}))
    assert "visible_object_map_1.5.json (1 objects)" in read(folder).found


def test_without_boxes_there_is_visibility_alone(folder: Path) -> None:
    (folder / "objects_bb.json").unlink()
    data = read(folder)
    assert (data.detections.box == matching.NO_BOX).all()
    assert data.detections.visible.tolist() == [True] * 3
    assert "no objects_bb.json, so no detections" in data.noted


def test_keys_with_and_without_a_sign_are_equal(folder: Path) -> None:
    change(folder, "objects_bb.json", lambda boxes: boxes.update({"0.00|0.50|0|0": {}}))
    before = read(folder)
    change(folder, "visible_object_map.json", lambda seen: seen.update({MUG: ["0.00|0.50|0|0"]}))
    assert rows(read(folder)) == rows(before)


def by_id(boxes: dict) -> dict:
    """The miniature's boxes under the ids of their objects; the second mug is nowhere visible."""
    names = {"TableTop": [TABLE], "Apple": [APPLE]}
    return {
        key: {
            name: group[4 * i : 4 * i + 4]
            for kind, group in groups.items()
            for i, name in enumerate(names.get(kind, [FAR_MUG, MUG] if len(group) > 4 else [MUG]))
        }
        for key, groups in boxes.items()
    }


FAR_MUG = "Mug|-01.00|+01.00|+09.00"


def test_boxes_by_object_id(folder: Path) -> None:
    """The ids say whose a box is, and several instances of a class stay several."""
    before = rows(read(folder))
    change(folder, "objects_bb.json", by_id)
    data = read(folder)
    assert {item.object_class for item in data.scene.objects} == {"Apple", "Mug", "TableTop"}
    assert rows(data) == {
        (state, name.replace("Mug|unnamed|0", FAR_MUG), box, visible)
        for state, name, box, visible in before
    }
    assert not any("names of boxes" in note for note in data.noted)


def test_ids_outweigh_the_size_of_boxes(folder: Path) -> None:
    """By class, the larger box would be the visible mug's."""

    def swap(boxes: dict) -> dict:
        named = by_id(boxes)
        view = named["-0.00|0.50|0|0"]
        view[MUG], view[FAR_MUG] = view[FAR_MUG], view[MUG]
        return named

    change(folder, "objects_bb.json", swap)
    assert (32, MUG, (5, 150, 15, 160), True) in rows(read(folder))


def test_a_basin_is_not_its_sink(folder: Path) -> None:
    basin = "Sink|+00.10|+00.93|-01.20|SinkBasin"
    boxes = {KEYS[0]: {basin: [0, 0, 300, 300], "Sink|1|2": [0, 0, 10, 10]}}
    change(folder, "objects_bb.json", lambda _: boxes)
    kinds = {o.object_id: o.object_class for o in read(folder).scene.objects}
    assert (kinds[basin], kinds["Sink|1|2"]) == ("SinkBasin", "Sink")


def test_names_of_boxes_that_are_neither_classes_nor_ids_are_noted(folder: Path) -> None:
    boxes = {KEYS[0]: {"Mug_1a2b": [0, 0, 1, 1], "coffee machine": [], "Mug": []}}
    change(folder, "objects_bb.json", lambda _: boxes)
    assert (
        "2 names of boxes that look like neither a class nor an object's id, taken as classes: "
        "Mug_1a2b, coffee machine"
    ) in read(folder).noted


def test_boxes_of_another_frame(folder: Path) -> None:
    """They keep their shares of the frame."""
    wide = {
        key: {
            name: [[2, 1.5][i % 2] * value for i, value in enumerate(group)]
            for name, group in groups.items()
        }
        for key, groups in original.BOXES.items()
    }
    before = rows(read(folder))
    change(folder, "objects_bb.json", lambda _: wide)
    with pytest.raises(FileError, match=r"frame of 300x300; --frame-size WIDTHxHEIGHT"):
        read(folder)
    assert rows(reader.read_scene(folder, "FloorPlan1", "kitchen", Frame(600, 450))) == before
    (folder / "metadata.json").write_text('{"a": {"screenWidth": 600, "screenHeight": 450}}')
    data = read(folder)
    assert rows(data) == before
    assert "frames of 600x450 by metadata.json" in data.noted
    data = reader.read_scene(folder, "FloorPlan1", "kitchen", Frame(1200, 900))
    assert rows(data) != before
    assert "frames of 600x450 by metadata.json, read as 1200x900" in data.noted
    (folder / "images.hdf5").write_bytes(b"damaged")
    (folder / "metadata.json").unlink()
    change(folder, "objects_bb.json", lambda _: original.BOXES)
    [note] = [note for note in read(folder).noted if "images.hdf5" in note]
    assert note.endswith("frames taken as 300x300")


@pytest.mark.parametrize(
    ("x", "z", "key"),
    [(0.0, 1.25, "0.00|1.25|45|30"), (-0.0, -0.25, "-0.00|-0.25|45|30"),
     (-1.1e-7, 10.5, "-0.00|10.50|45|30"), (0.125, -0.005, "0.12|-0.01|45|30")],
)  # fmt: skip
def test_keys_are_the_reference_controllers(x: float, z: float, key: str) -> None:
    assert layout.state_key(x, z, 45, 30) == key


def test_points_off_whole_quarters_have_keys(tmp_path: Path) -> None:
    grid = layout.Grid(np.array([[0.125, 0.9, -0.875], [0.375, 0.9, -0.875]]))
    for point in grid.points:
        key = layout.state_key(point[0], point[2], 0, 0)
        assert grid.state(tmp_path, key) == 16 * (point[0] > 0.2)


BAD: list[tuple[str, Any, str]] = [
    ("grid.json", lambda c: {"x": 0}, "not a list of points"),
    ("grid.json", lambda c: [3], "point 0 is not x, y, z"),
    ("grid.json", lambda c: c[0].update(x="0"), "x of point 0 is not a number"),
    ("grid.json", lambda c: c[0].update(x=1e9), "x of point 0 is not finite"),
    ("grid.json", lambda c: c[0].update(x=0.1), "off the 0.25 m grid"),
    ("grid.json", lambda c: c[:2], None),
    ("graph.json", lambda c: [1], "not a node-link graph"),
    ("graph.json", lambda c: c.pop("links") and None, "not a node-link graph"),
    ("graph.json", lambda c: c.update(edges=c["links"][1:]), "links and edges"),
    ("graph.json", lambda c: c["links"].append({"source": 0, "target": 48}), "target 48 is not"),
    ("graph.json", lambda c: c["links"].append({"source": "9.00|0.00|0|0", "target": 0}),
     "source '9.00|0.00|0|0' is not among the nodes"),
    ("graph.json", lambda c: c["links"].append(3), "source None"),
    ("graph.json", lambda c: c["nodes"].append({"id": "9.00|0.00|0|0"}), "is not on the grid"),
    ("graph.json", lambda c: c["nodes"].append({"id": "-0.00|0.10|0|0"}), "is not on the grid"),
    ("graph.json", lambda c: c["nodes"].append({"id": "-0.00|0.00|50|0"}), "rotation or horizon"),
    ("graph.json", lambda c: c["nodes"].append({"id": "-0.00|0.00|0|60"}), "rotation or horizon"),
    ("graph.json", lambda c: c["nodes"].append({"id": "../../x"}), "is not x|z|rotation|horizon"),
    ("graph.json", lambda c: c["nodes"].append({"id": 7}), "a state key that is not text"),
    ("visible_object_map.json", lambda c: c.update({MUG: ["9.00|0.00|0|0"]}), "not on the grid"),
    ("visible_object_map.json", lambda c: c.update({MUG: 3}), "neither a list of states"),
    ("visible_object_map.json", lambda c: {KEYS[0]: {"objects": [3]}}, "an object without"),
    ("visible_object_map.json", lambda c: {"": []}, "an object without a name"),
    ("objects_bb.json", lambda c: c.update({"9.00|0.00|0|0": {}}), "is not on the grid"),
    ("objects_bb.json", lambda c: c.update({KEYS[0]: []}), "not classes with boxes"),
    ("objects_bb.json", lambda c: c.update({KEYS[0]: {"Mug": [1, 2, 3]}}), "four numbers per box"),
    ("objects_bb.json", lambda c: c.update({KEYS[0]: {"Mug": [0, 0, 1, None]}}), "is not a number"),
    ("objects_bb.json", lambda c: c.update({KEYS[0]: {"Mug": [0, 0, 1, 302]}}), "outside of a fr"),
    ("objects_bb.json", lambda c: c.update({KEYS[0]: {MUG: []}}), "both classes and ids of objec"),
    ("objects_bb.json", lambda c: c.update({KEYS[0]: {"Mug|": []}}), "neither a class nor an obj"),
    ("objects_bb.json", lambda c: {KEYS[0]: {MUG: [1] * 8}},
     "2 boxes of one object"),
]  # fmt: skip


@pytest.mark.parametrize("case", range(len(BAD)))
def test_what_contradicts_the_layout_names_file_and_reason(folder: Path, case: int) -> None:
    name, edit, reason = BAD[case]
    change(folder, name, edit)
    with pytest.raises(FileError) as error:
        read(folder)
    if reason is None:  # the other files then name a point that is gone
        name, reason = "graph.json", "is not on the grid"
    assert name in str(error.value)
    assert reason in str(error.value)
    assert str(error.value).isprintable()
    if name == "objects_bb.json" or reason == "an object without":
        assert re.search(r"\d\.\d\d\|-?\d+\.\d\d\|\d+\|\d+", str(error.value))  # the state


@pytest.mark.parametrize("value", ["NaN", "-Infinity", "1e999", "9" * 400])
def test_pixels_that_are_not_finite(folder: Path, value: str) -> None:
    text = (folder / "objects_bb.json").read_text().replace("[140", f"[{value}")
    (folder / "objects_bb.json").write_text(text)
    with pytest.raises(FileError, match=r"objects_bb\.json: "):
        read(folder)


@pytest.mark.parametrize("name", ["grid.json", "graph.json", "objects_bb.json",
                                  "visible_object_map.json"])  # fmt: skip
def test_missing_and_truncated_files(folder: Path, name: str) -> None:
    whole = (folder / name).read_text()
    (folder / name).write_text(whole[: len(whole) // 2])
    with pytest.raises(FileError, match=rf"{name}: not JSON"):
        read(folder)
    (folder / name).unlink()
    if name != "objects_bb.json":
        with pytest.raises(FileError, match=name):
            read(folder)
