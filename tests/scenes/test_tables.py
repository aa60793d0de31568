"""Invariants of scene tables, their subsets, and files of them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneError, SceneTables, tabulation
from tdanet_jax.scenes.visibility import geometry
from tdanet_jax.vocabulary import ALL_TARGETS
from tests.support import toy

# Of the bundled rooms. A change means that every published number has to be measured again.
DATA_VERSION = "6188ee7cb86d"


@pytest.fixture(scope="module")
def rooms() -> SceneTables:
    return tabulation.build(toy.random_rooms(0))


def test_the_bundled_rooms_are_the_same_everywhere(ithor: SceneTables) -> None:
    assert ithor.data_version == DATA_VERSION
    assert len(ithor.scenes) == 120
    assert len(ithor.position) == 18_344
    assert ithor.targets == ALL_TARGETS
    assert len(ithor.classes) == 117


def test_states_of_poses() -> None:
    t = tabulation.build([toy.corridor(), dataclasses.replace(toy.corridor(), name="Second")])
    assert t.nearest_state(0, 0.1, 0.55, 90, 30) == (2 * 8 + 2) * 2 + 1
    assert t.nearest_state(0, 9.0, 9.0, -45) == (4 * 8 + 7) * 2
    assert t.nearest_state(1, 9.0, 0.0, 360) == 5 * 16
    for rotation, horizon in ((20, 0), (0, 45)):
        with pytest.raises(ValueError, match=r"not a multiple of 45|not among 0, 30"):
            t.nearest_state(0, 0, 0, rotation, horizon)


def test_the_nearest_point_is_by_euclidean_distance() -> None:
    """And not by the longer of its two sides: 0.28 m along z, or 0.25 m across and 0.22 m along."""
    t = tabulation.build([toy.room(toy.points((0.0, 0.0), (0.25, 0.5)), toy.corridor().objects[0])])
    assert t.nearest_state(0, 0.0, 0.28, 0) == 0
    assert t.nearest_state(0, 0.1, 0.3, 0) == 16


@pytest.mark.parametrize("which", ["rooms", "some_rooms"])
def test_invariants(which: str, request: pytest.FixtureRequest) -> None:
    t: SceneTables = request.getfixturevalue(which)
    states = t.num_states
    assert t.row_start[0] == 0
    assert t.row_start[-1] == len(t.row_object) == len(t.row_box) == len(t.row_visible)
    assert (np.diff(t.row_start) >= 0).all()
    # Rows stay in their scene and are sorted by class and object within a state.
    assert (t.object_scene[t.row_object] == t.state_scene[t.row_state]).all()
    key = (t.row_state.astype(np.int64) * len(t.classes) + t.row_class) * len(t.object_id)
    assert (np.diff(key + t.row_object) > 0).all()
    x1, y1, x2, y2 = t.row_box.T
    assert ((x1 >= 0) & (y1 >= 0) & (x2 <= 4800) & (y2 <= 4800)).all()
    assert ((x1 <= x2) & (y1 <= y2)).all()
    # Steps stay in their scene and move a grid step, along both axes at odd headings.
    assert (t.position_scene[t.next_position] == t.position_scene[:, None]).all()
    moved = t.position[t.next_position] - t.position[:, None]
    stays = t.next_position == np.arange(len(t.position))[:, None]
    length = np.hypot(moved[..., 0], moved[..., 2])
    expected = np.where(np.arange(8) % 2, np.sqrt(0.125), 0.25)
    assert np.allclose(length, np.where(stays, 0, expected))
    assert t.raster.shape == (states, 7, 7)
    assert t.distance.shape == (states, len(t.targets))


@pytest.mark.parametrize("which", ["rooms", "some_rooms"])
def test_distance_is_zero_exactly_where_visible(which: str, request: pytest.FixtureRequest) -> None:
    t: SceneTables = request.getfixturevalue(which)
    bits = t.visible_bits()
    for goal, target in enumerate(t.targets):
        if target in t.classes:
            c = t.classes.index(target)
            visible = (bits[:, c // 32] >> np.uint32(c % 32)) & 1
            assert ((t.distance[:, goal] == 0) == visible).all()
        else:
            assert (t.distance[:, goal] == -1).all()


def test_distances_fall_by_one_along_some_action(some_rooms: SceneTables) -> None:
    t = some_rooms
    successor = geometry.transitions(t.next_position)
    after = t.distance[successor]  # [S, 5, G]
    least = np.where(after < 0, 30_000, after).min(axis=1)
    way = t.distance > 0
    assert (least[way] == t.distance[way] - 1).all()
    assert (after[np.broadcast_to((t.distance < 0)[:, None], after.shape)] == -1).all()


def test_visible_bits_by_hand(rooms: SceneTables) -> None:
    bits = rooms.visible_bits()
    for state in range(0, rooms.num_states, 7):
        rows = slice(rooms.row_start[state], rooms.row_start[state + 1])
        want = set(rooms.row_class[rows][rooms.row_visible[rows]].tolist())
        got = {c for c in range(len(rooms.classes)) if bits[state, c // 32] >> (c % 32) & 1}
        assert got == want


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=5)
def test_a_subset_is_what_its_rooms_alone_would_give(seed: int) -> None:
    scenes = toy.random_rooms(seed)
    whole = tabulation.build(scenes)
    alone = tabulation.build([scenes[0], scenes[2]], classes=whole.classes)
    assert whole.subset(["Room2", "Room0"]).data_version == alone.data_version


def test_subset_of_unknown_scene(rooms: SceneTables) -> None:
    with pytest.raises(SceneError, match="Room9"):
        rooms.subset(["Room0", "Room9"])


def test_saved_tables_come_back(rooms: SceneTables, tmp_path: Path) -> None:
    path = tmp_path / "tables.npz"
    rooms.save(path)
    back = SceneTables.load(path)
    for field in dataclasses.fields(rooms):
        ours, theirs = getattr(rooms, field.name), getattr(back, field.name)
        if isinstance(ours, np.ndarray):
            assert ours.dtype == theirs.dtype
            assert (ours == theirs).all()
        else:
            assert ours == theirs
    assert back.data_version == rooms.data_version


@pytest.mark.parametrize("field", [field.name for field in dataclasses.fields(SceneTables)])
def test_the_version_follows_every_field(rooms: SceneTables, field: str) -> None:
    value = getattr(rooms, field)
    if isinstance(value, np.ndarray):
        changed = value.copy()
        changed.flat[-1] = ~changed.flat[-1] if value.dtype == bool else changed.flat[-1] - 1
    elif isinstance(value, tuple):
        changed = (*value[:-1], value[-1] + "x")
    elif isinstance(value, PoseGrid):
        changed = PoseGrid(rotations=12)
    else:
        changed = value + 1
    other = dataclasses.replace(rooms, **{field: changed})
    assert other.data_version != rooms.data_version


def test_a_room_as_a_scene(rooms: SceneTables) -> None:
    scene = rooms.subset(["Room1"]).as_scene()
    assert scene.name == "Room1"
    assert {item.object_class for item in scene.objects} <= set(rooms.classes)
    assert scene.objects[0].box.shape == (2, 3)
