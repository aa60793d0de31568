"""Variants of rooms: the same again from the same numbers, and mirrored state by state."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.scenes import ithor, placement, tabulation, vary
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility import solids
from tdanet_jax.scenes.visibility.rules import RULES
from tests.support import toy


@pytest.fixture(scope="module")
def rooms() -> dict[str, Scene]:
    return {scene.name: scene for scene in ithor.load_scenes()}


def assert_mirrored(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tables of the mirrored room are those of the room, turns and image boxes mirrored.

    The cells in which voids are found begin at the lowest x, so voids are mirrored for the test.
    """
    mirrored = vary.mirrored(scene)
    ours = tabulation.build([scene])
    walls = [box * [-1, 1, 1] for box in solids.void_boxes(scene, RULES)]
    with monkeypatch.context() as patch:
        patch.setattr(solids, "void_boxes", lambda *_: [np.sort(box, axis=0) for box in walls])
        theirs = tabulation.build([mirrored])
    compare(scene, ours, theirs)


def compare(scene: Scene, ours: SceneTables, theirs: SceneTables) -> None:
    order = np.lexsort((scene.points[:, 2], -scene.points[:, 0]))
    np.testing.assert_array_equal(theirs.position * [-1, 1, 1], ours.position[order])
    grid = ours.grid
    position, rotation, horizon = grid.split(np.arange(ours.num_states))
    state = grid.join(order[position], -rotation % grid.rotations, horizon)
    turns = -np.arange(grid.rotations) % grid.rotations
    np.testing.assert_array_equal(order[theirs.next_position], ours.next_position[order][:, turns])
    np.testing.assert_array_equal(theirs.distance, ours.distance[state])
    counts = np.diff(ours.row_start)[state]
    np.testing.assert_array_equal(np.diff(theirs.row_start), counts)
    row = np.repeat(ours.row_start[state] - theirs.row_start[:-1], counts)
    row = row + np.arange(len(theirs.row_object))
    np.testing.assert_array_equal(theirs.row_object, ours.row_object[row])
    np.testing.assert_array_equal(theirs.row_visible, ours.row_visible[row])
    x1, y1, x2, y2 = ours.row_box[row].T
    size = ours.image * ours.subpixel
    flipped = np.stack([size - x2, y1, size - x1, y2], axis=1)
    assert np.abs(theirs.row_box - flipped).max(initial=0) <= 1  # a rounding of corners, if any
    # Boxes of one size that cover a cell's middle, and boxes that end there, may change places.
    assert (theirs.raster != ours.raster[state][..., ::-1]).mean() < 2e-3


@pytest.mark.parametrize(
    "name",
    [
        "FloorPlan430",
        *(pytest.param(f"FloorPlan{n}", marks=pytest.mark.slow) for n in (1, 203, 303, 402)),
    ],
)
def test_a_mirrored_room_is_the_room_with_turns_and_image_boxes_mirrored(
    rooms: dict[str, Scene], monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    assert_mirrored(rooms[name], monkeypatch)


@pytest.mark.parametrize("seed", range(3))
def test_so_is_any_room(monkeypatch: pytest.MonkeyPatch, seed: int) -> None:
    scene = toy.random_room(np.random.default_rng(seed))
    assert_mirrored(scene, monkeypatch)


@given(st.integers(0, 2**32 - 1))
def test_mirrored_twice_is_the_room(seed: int) -> None:
    scene = toy.random_room(np.random.default_rng(seed))
    types = tuple(str(i) for i in range(len(scene.points)))
    order = np.lexsort((scene.points[:, 2], scene.points[:, 0]))
    scene = dataclasses.replace(scene, points=scene.points[order], room_type=types)
    again = vary.mirrored(vary.mirrored(scene))
    np.testing.assert_array_equal(again.points, scene.points)
    assert again.room_type == types
    for one, other in zip(again.objects, scene.objects, strict=True):
        np.testing.assert_array_equal(one.box, other.box)
        assert one.rotation == other.rotation
    assert not (np.diff(vary.mirrored(scene).points[:, 0]) < 0).any()
    turned = dataclasses.replace(scene.objects[0], rotation=(10.0, 60.0, 20.0))
    scene = dataclasses.replace(scene, objects=(turned,), default_rotation=45)
    once = vary.mirrored(scene)
    assert (once.objects[0].rotation, once.default_rotation) == ((10.0, 300.0, 340.0), 315)


def test_variants_are_named_mirrored_and_drawn_by_their_numbers(rooms: dict[str, Scene]) -> None:
    scene = rooms["FloorPlan403"]
    known = placement.statistics([scene])
    made = {copy: vary.vary(scene, known, 0, copy) for copy in (1, 2, 3)}
    assert [room.name for room in made.values()] == [
        "FloorPlan403-v01", "FloorPlan403-v02", "FloorPlan403-v03"
    ]  # fmt: skip
    assert {room.part for room in made.values()} == {"train"}
    assert {vary.original_name(room.name) for room in made.values()} == {"FloorPlan403"}
    low = scene.points[:, 0].min()
    assert [room.points[:, 0].min() == low for room in made.values()] == [True, False, True]
    again = vary.vary(scene, known, 0, 1)
    for one, other in zip(again.objects, made[1].objects, strict=True):
        np.testing.assert_array_equal(one.box, other.box)
    places = {
        (room.name, seed): np.concatenate([o.box for o in room.objects if o.pickupable]).tobytes()
        for seed in (0, 1)
        for room in (vary.vary(scene, known, seed, copy) for copy in (1, 3))
    }
    assert len({*places.values()}) == 4


def test_a_room_that_says_its_part_keeps_it(rooms: dict[str, Scene]) -> None:
    room = dataclasses.replace(rooms["FloorPlan430"], name="Lab", part="test")
    varied = vary.vary(room, placement.statistics([room]), 0, 1)
    assert (varied.name, varied.part) == ("Lab-v01", "test")
    assert vary.vary(rooms["FloorPlan430"], placement.statistics([room]), 0, 1).part == "test"
    assert vary.original_name("Lab-v1") == "Lab-v1"
