"""Exported rooms are connected: every state leads to every other, and so to all that is listed."""

from __future__ import annotations

import dataclasses
import json
from collections import deque
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.scenes import SceneTables, tabulation
from tdanet_jax.scenes.offline import exporter, layout
from tdanet_jax.scenes.offline.connected import largest_parts
from tests.support import toy


def from_start(links: Mapping[str, list[str]], start: str) -> set[str]:
    """The states to which the links of a graph lead."""
    found, waiting = {start}, deque([start])
    while waiting:
        for state in links[waiting.popleft()]:
            if state not in found:
                found.add(state)
                waiting.append(state)
    return found


def check(folder: Path) -> None:
    """The graph of a scene is strongly connected, and has all states that the map lists."""
    graph = json.loads((folder / layout.GRAPH_FILE).read_text())
    nodes = {node["id"] for node in graph["nodes"]}
    ahead: dict[str, list[str]] = {node: [] for node in nodes}
    back: dict[str, list[str]] = {node: [] for node in nodes}
    for link in graph["links"]:
        ahead[link["source"]].append(link["target"])
        back[link["target"]].append(link["source"])
    start = graph["nodes"][0]["id"]
    assert from_start(ahead, start) == from_start(back, start) == nodes
    seen = json.loads((folder / "visible_object_map.json").read_text())
    assert all(states and set(states) <= nodes for states in seen.values())
    assert set(json.loads((folder / layout.BOX_FILE).read_text())) == nodes
    assert len(json.loads((folder / layout.GRID_FILE).read_text())) * 16 == len(nodes)


def test_exported_rooms_are_connected(some_rooms: SceneTables, tmp_path: Path) -> None:
    rooms = some_rooms.subset(["FloorPlan29", "FloorPlan204", "FloorPlan428"])
    written = exporter.write_folder(rooms, tmp_path / "out", lambda share, line: None)
    for name in rooms.scenes:
        check(tmp_path / "out" / name)
    assert written.left_out == {"FloorPlan204": 17 * 16}
    lost = {name: int((~written.kept)[rooms.state_scene == i].sum())
            for i, name in enumerate(rooms.scenes)}  # fmt: skip
    assert written.left_out == {name: count for name, count in lost.items() if count}
    assert written.tables.num_states == written.kept.sum()


def two_parts() -> SceneTables:
    """Two points and, out of reach of them, three; an apple that only the two see nearby."""
    spots = toy.points((0, 0), (0, 0.25), (0, 2.0), (0, 2.25), (0, 2.5))
    apple = toy.thing("Apple", (0.0, toy.CAMERA, -1.0))
    mug = toy.thing("Mug", (0.0, toy.CAMERA, 3.5))
    return tabulation.build([toy.room(spots, apple, mug, name="Lab")])


def test_the_largest_part_is_kept_with_its_rows_and_distances() -> None:
    room = two_parts()
    tables, kept, left_out = largest_parts(room)
    assert left_out == {"Lab": 2 * 16}
    assert kept.tolist() == [False] * 32 + [True] * 48
    assert tables.position[:, 2].tolist() == [2.0, 2.25, 2.5]
    assert tables.next_position[:, 0].tolist() == [1, 2, 2]
    assert tables.next_position[:, 4].tolist() == [0, 0, 1]
    rows = kept[room.row_state]
    assert (tables.row_state == room.row_state[rows] - 32).all()
    np.testing.assert_array_equal(tables.row_box, room.row_box[rows])
    np.testing.assert_array_equal(tables.raster, room.raster[kept])
    apple, mug = tables.targets.index("Apple"), tables.targets.index("Mug")
    assert (room.distance[:32, apple] >= 0).all()
    assert (tables.distance[:, apple] == -1).all(), "it is nowhere visible in this part"
    np.testing.assert_array_equal(tables.distance[:, mug], room.distance[kept, mug])


def test_a_step_without_a_way_back_does_not_connect() -> None:
    room = two_parts()
    one_way = room.next_position.copy()
    one_way[1, 0] = 2  # from the two points to the three, and never back
    tables, _, left_out = largest_parts(dataclasses.replace(room, next_position=one_way))
    assert left_out == {"Lab": 32}
    one_way[1, 0], one_way[4, 0] = 1, 0  # from the three to the two: blocked, once these are gone
    tables, _, left_out = largest_parts(dataclasses.replace(room, next_position=one_way))
    assert left_out == {"Lab": 32}
    assert tables.next_position[2, 0] == 2


def test_of_equal_parts_the_first_is_kept() -> None:
    spots = toy.points((0, 0), (0, 2.0))
    room = tabulation.build([toy.room(spots, toy.thing("Apple", (0, 1, 1)))])
    assert largest_parts(room).tables.position[:, 2].tolist() == [0.0]


@pytest.mark.parametrize("seed", range(4))
def test_random_rooms_are_connected(tmp_path: Path, seed: int) -> None:
    rooms = tabulation.build(toy.random_rooms(seed))
    exporter.write_folder(rooms, tmp_path / "out", lambda share, line: None)
    for name in rooms.scenes:
        check(tmp_path / "out" / name)
