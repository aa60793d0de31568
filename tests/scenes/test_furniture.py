"""Shifted furniture: by hand, and what must hold in real rooms."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import furniture, ithor, placement
from tdanet_jax.scenes.scene import Scene, SceneObject
from tests.scenes.test_reachable import parts
from tests.support import toy

ROOMS = ("FloorPlan7", "FloorPlan203", "FloorPlan210", "FloorPlan301", "FloorPlan318",
         "FloorPlan409")  # fmt: skip


def grid(columns: range, rows: range, *but: SceneObject) -> np.ndarray:
    """Points 0.25 m apart where an agent's circle is clear of the boxes."""
    spots = [
        (0.25 * i, 0.25 * j)
        for i in columns
        for j in rows
        if all(gap(item.box, (0.25 * i, 0.25 * j)) >= 0.2 for item in but)
    ]
    return toy.points(*spots)


def gap(box: np.ndarray, at: tuple[float, float]) -> float:
    low, high, place = box[0, [0, 2]], box[1, [0, 2]], np.array(at)
    return float(np.linalg.norm(np.maximum(np.maximum(low - place, place - high), 0)))


def cells(points: np.ndarray) -> set[tuple[int, int]]:
    return {(int(x), int(z)) for x, z in np.rint(points[:, [0, 2]] / 0.25)}


TABLE = toy.thing("CoffeeTable", (1.5, 0.25, 1.5), (0.7, 0.5, 0.7))
VASE = toy.thing("Vase", (1.4, 0.6, 1.6), (0.1, 0.2, 0.1))
DRAWER = toy.thing("Drawer", (1.5, 0.3, 1.2), (0.5, 0.2, 0.1))


def test_a_table_amid_a_room_moves_with_all_that_belongs_to_it_and_the_points_follow() -> None:
    vase = dataclasses.replace(VASE, parents=("CoffeeTable|0",), pickupable=True)
    scene = toy.room(grid(range(13), range(13), TABLE), TABLE, vase, DRAWER)
    found = set()
    for seed in range(8):
        after = furniture.shift(scene, np.random.default_rng(seed), 1.0)
        ways = [
            (new.box - old.box)[0].round(3)
            for old, new in zip(scene.objects, after.objects, strict=True)
        ]
        assert ways[0].any()
        assert 0.05 <= np.abs(ways[0]).max() <= 0.3
        assert np.count_nonzero(ways[0]) == 1
        np.testing.assert_array_equal(ways, [ways[0]] * 3)
        [table] = [o for o in after.objects if o.object_class == "CoffeeTable"]
        # All are reachable where the table is not.
        assert cells(after.points) == cells(grid(range(13), range(13), table))
        found.add(tuple(ways[0]))
    assert len(found) > 4


def test_at_a_wall_it_moves_along_it_or_away_and_frees_nothing_behind_it() -> None:
    sofa = toy.thing("Sofa", (1.5, 0.4, -0.25), (1.0, 0.8, 0.5))  # its back at z = -0.5
    spots = grid(range(13), range(-1, 9), sofa)  # walls 0.25 m beyond the points
    scene = toy.room(spots, sofa)
    ways = set()
    for seed in range(30):
        after = furniture.shift(scene, np.random.default_rng(seed), 1.0)
        way = (after.objects[0].box - sofa.box)[0]
        ways.add(tuple(np.sign(way.round(3))))
        assert way[2] > -1e-9  # never into the wall
        assert cells(after.points) <= cells(grid(range(13), range(-1, 9)))
        assert all(gap(after.objects[0].box, (p[0], p[2])) >= 0.2 for p in after.points)
    assert ways >= {(1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)}


def test_it_meets_nothing_and_cuts_nothing_off() -> None:
    # A corridor between a wall and a counter, one agent wide at the table.
    counter = toy.thing("CounterTop", (2.3, 0.45, 1.5), (0.5, 0.9, 3.0))
    scene = toy.room(grid(range(8), range(13), TABLE, counter), TABLE, counter)
    assert len(parts(scene.points)) == 1
    for seed in range(30):
        after = furniture.shift(scene, np.random.default_rng(seed), 1.0)
        assert len(parts(after.points)) == 1
        table = next(o for o in after.objects if o.object_class == "CoffeeTable")
        assert table.box[1, 0] <= counter.box[0, 0]


def test_no_part_of_the_points_is_cut_off() -> None:
    """A passage of one point, next to a bin; on the far side is a tenth of the points."""
    can = toy.thing("GarbageCan", (1.5, 0.3, 0.0), (0.2, 0.6, 0.2))
    spots = toy.points(
        *((0.25 * x, 0.25 * z) for x in range(5) for z in range(-2, 3)), (1.25, 0.5), (1.5, 0.5),
        (1.75, 0.5), (1.75, 0.0), (1.75, 0.25),
    )  # fmt: skip
    scene = toy.room(spots, can)
    unit, way = list(scene.objects), np.array([0.0, 0.0, 0.25])
    assert len(parts(spots)) == 1
    without = toy.points(*((p[0], p[2]) for p in spots if p[0] < 1.6))  # none on the far side
    assert furniture._moved(scene, unit, can.object_id, way, 0.0) is None
    alone = dataclasses.replace(scene, points=without)
    assert furniture._moved(alone, unit, can.object_id, way, 0.0) is not None


def test_what_is_built_in_or_hangs_stays() -> None:
    counter = toy.thing("CounterTop", (1.5, 0.45, 1.5), (0.7, 0.9, 0.7))
    shelf = toy.thing("ShelvingUnit", (1.5, 1.5, 1.5), (0.3, 0.4, 0.3))
    scene = toy.room(grid(range(13), range(13), counter), counter, shelf)
    after = furniture.shift(scene, np.random.default_rng(0), 1.0)
    for old, new in zip(scene.objects, after.objects, strict=True):
        assert new is old


@pytest.mark.parametrize(
    "change",
    [{"room_type": ("kitchen",) * 200}, {"grid": PoseGrid(0.5)}, {"grid": PoseGrid(rotations=4)}],
)
def test_houses_and_other_grids_are_left_as_they_are(change: dict[str, object]) -> None:
    """A room with turns of 90 degrees has no diagonals: its parts are others than iTHOR's."""
    room = toy.room(grid(range(13), range(13), TABLE), TABLE)
    assert furniture.shift(room, np.random.default_rng(0), 1.0) is not room
    scene = dataclasses.replace(room, **change)  # type: ignore[arg-type]
    assert furniture.shift(scene, np.random.default_rng(0), 1.0) is scene


@pytest.mark.parametrize("offset", [(0.1, 0.05), (-0.2, 0.125), (1.0, -2.5)])
def test_a_room_somewhere_else_changes_in_the_same_way(offset: tuple[float, float]) -> None:
    """Points of rooms of one's own need not be multiples of 0.25 m from the world's origin."""
    way = np.array([offset[0], 0.0, offset[1]])
    room = toy.room(grid(range(13), range(13), TABLE), TABLE, DRAWER)
    moved = dataclasses.replace(
        room,
        points=room.points + way,
        objects=tuple(placement.shifted(item, way) for item in room.objects),
    )
    for seed in range(4):
        here, there = (furniture.shift(r, np.random.default_rng(seed), 1.0) for r in (room, moved))
        np.testing.assert_allclose(there.points, here.points + way, atol=1e-6)
        for old, new in zip(here.objects, there.objects, strict=True):
            np.testing.assert_allclose(new.box, old.box + way, atol=1e-6)


@pytest.fixture(scope="module")
def pairs() -> list[tuple[Scene, Scene]]:
    """Rooms, and the same with their furniture shifted."""
    known = {scene.name: scene for scene in ithor.load_scenes()}
    return [
        (known[name], furniture.shift(known[name], np.random.default_rng(k), 1.0))
        for k, name in enumerate(ROOMS)
    ]


def test_nothing_gets_into_anything_in_real_rooms(pairs: list[tuple[Scene, Scene]]) -> None:
    def common(one: SceneObject, other: SceneObject) -> float:
        span = np.minimum(one.box[1], other.box[1]) - np.maximum(one.box[0], other.box[0])
        return float(np.maximum(span, 0).prod())

    count = 0
    for before, after in pairs:
        old = {item.object_id: item for item in before.objects}
        for one, other in itertools.combinations(after.objects, 2):
            was = common(old[one.object_id], old[other.object_id])
            assert common(one, other) <= was + 1e-6, (before.name, one.object_id, other.object_id)
        count += sum(not np.array_equal(old[o.object_id].box, o.box) for o in after.objects)
    assert count > 40


def test_points_follow_in_real_rooms(pairs: list[tuple[Scene, Scene]]) -> None:
    freed = 0
    for before, after in pairs:
        old = {item.object_id: item.box for item in before.objects}
        new = {item.object_id: item.box for item in after.objects}
        moved = {name for name in old if not np.array_equal(old[name], new[name])}
        assert len(parts(after.points)) <= len(parts(before.points))
        assert 0.95 * len(before.points) <= len(after.points)
        freed += len(cells(after.points) - cells(before.points))
        order = np.lexsort((after.points[:, 2], after.points[:, 0]))
        np.testing.assert_array_equal(order, np.arange(len(order)))
        for x, z in cells(after.points) - cells(before.points):
            at = (0.25 * x, 0.25 * z)
            # Where something stood that has moved, and nothing stands in the agent's way now.
            assert min(gap(old[name], at) for name in moved) < 0.2
            for item in after.objects:
                if item.object_id in moved and item.box[0, 1] < 1.5:
                    assert gap(item.box, at) >= 0.2 - 1e-9 or item.corners is not None
    assert freed > 5
