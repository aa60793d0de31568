"""Reachable points that a published grid lacks: by hand, against a slow flood fill, in rooms."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.scenes import ithor, reachable
from tdanet_jax.scenes.checks import grid
from tdanet_jax.scenes.scene import Scene, SceneObject
from tests.support import toy

LEVEL = 0.9  # of an agent on a flat floor


def added(spots: set[tuple[int, int]], *objects: SceneObject) -> set[tuple[int, int]]:
    """Cells of the grid that are added to those of `spots`."""
    points = toy.points(*sorted((0.25 * x, 0.25 * z) for x, z in spots))
    found = reachable.complete(points, objects)
    assert (found[:, 1] == points[0, 1]).all()
    return {(int(x), int(z)) for x, z in np.rint(found[:, [0, 2]] / 0.25)}


def pillar(x: float, z: float, side: float = 0.01, kind: str = "Sofa") -> SceneObject:
    return toy.thing(kind, (x, LEVEL, z), (side, 1.8, side))


BLOCK = {(x, z) for x in range(3) for z in range(3)}
RING = {(x, z) for x in range(3) for z in (-1, 3)} | {(x, z) for x in (-1, 3) for z in range(3)}


def test_one_ring_is_added_around_a_block_and_it_stops_at_the_walls() -> None:
    # Its corners, too, lie no farther out than the ring. Nothing else does.
    assert added(BLOCK) == RING | {(-1, -1), (-1, 3), (3, -1), (3, 3)}


def test_the_agents_capsule_must_stand_free() -> None:
    for distance, free in ((0.199, False), (0.201, True)):
        near = pillar(0.75 + distance + 0.005, 0.25)
        assert ((3, 1) in added(BLOCK, near)) == free


@pytest.mark.parametrize(
    ("low", "high", "blocks"),
    [(0.0, 1.8, True), (1.9, 2.4, False), (0.0, 0.01, False), (0.0, 0.1, True), (1.7, 2.0, True)],
)
def test_only_what_is_at_the_agents_height_blocks(low: float, high: float, blocks: bool) -> None:
    # At 0.15 m aside, the round lower end of the capsule is 0.068 m above the floor.
    edge = toy.thing("Sofa", (0.75 + 0.15 + 0.5, (low + high) / 2, 0.25), (1.0, high - low, 1.0))
    assert ((3, 1) not in added(BLOCK, edge)) == blocks


def test_flat_things_on_walls_and_unknown_boxes_block_nothing() -> None:
    for kind in reachable.FLAT:
        assert (3, 1) in added(BLOCK, pillar(0.75, 0.25, 0.1, kind))
    unknown = dataclasses.replace(pillar(0.75, 0.25), box=np.full((2, 3), np.nan))
    assert (3, 1) in added(BLOCK, unknown)


def test_a_turned_box_blocks_where_it_is_and_not_where_its_axis_aligned_box_is() -> None:
    half = 0.5
    corners = [(0.75 + x, y, 0.25 + z) for y in (0.0, 1.8)
               for x, z in ((half, 0), (0, half), (-half, 0), (0, -half))]  # fmt: skip
    box = np.array([(0.25, 0.0, -0.25), (1.25, 1.8, 0.75)])
    diamond = SceneObject("Sofa|1", "Sofa", box, np.array(corners))
    found = added(BLOCK, diamond)
    assert not {(3, 0), (3, 1), (3, 2)} & found
    far = {(x, z) for x in range(5, 8) for z in range(-4, -1)}
    assert (4, -2) in added(far | BLOCK, diamond)  # 0.53 m from its nearest edge


def test_an_alley_between_furniture_is_found_by_what_lies_farther_out() -> None:
    # A bench with an agent's width behind it, which the published grid lacks as a whole.
    spots = {(x, z) for x in range(9) for z in range(3)} | {(0, z) for z in range(3, 7)}
    bench = toy.thing("Sofa", (1.25, LEVEL, 1.05), (1.4, 1.8, 0.1))
    found = added(spots, bench)
    assert {(x, 6) for x in range(1, 2)} <= found
    assert not {cell for cell in found if cell[1] > 7 or cell[0] > 9}


def slow(spots: set[tuple[int, int]], objects: list[SceneObject]) -> set[tuple[int, int]]:
    """The same flood fill, cell by cell."""

    def free(cell: tuple[int, int]) -> bool:
        for item in objects:
            gaps = []
            for axis, at in ((0, cell[0] * 0.25), (2, cell[1] * 0.25)):
                gaps.append(max(item.box[0, axis] - at, at - item.box[1, axis], 0))
            gaps.append(max(item.box[0, 1] - (LEVEL + 0.7), (LEVEL - 0.7) - item.box[1, 1], 0))
            if sum(gap**2 for gap in gaps) < 0.2**2:
                return False
        return True

    def inside(cell: tuple[int, int], outline: set[tuple[int, int]]) -> bool:
        x, z = cell
        column = [b for a, b in outline if abs(a - x) <= 1]
        row = [a for a, b in outline if abs(b - z) <= 1]
        return (
            bool(column and row) and min(column) <= z <= max(column) and min(row) <= x <= max(row)
        )

    known, outline = set(spots), None
    while True:
        new = {
            (x + dx, z + dz) for x, z in known for dx, dz in ((1, 0), (-1, 0), (0, 1), (0, -1))
        } - known
        new = {c for c in new if free(c) and (outline is None or inside(c, outline))}
        if not new:
            return known - spots
        known |= new
        outline = outline or set(known)


@given(
    st.sets(st.tuples(st.integers(-3, 3), st.integers(-3, 3)), min_size=1),
    st.lists(
        st.tuples(*[st.integers(-40, 40)] * 2, *[st.integers(1, 40)] * 2, st.integers(0, 20)),
        max_size=5,
    ),
)
def test_it_is_the_slow_flood_fill(
    spots: set[tuple[int, int]], boxes: list[tuple[int, int, int, int, int]]
) -> None:
    # Boxes whose distances to the grid are never 0.2 m to within rounding.
    objects = [
        toy.thing("Sofa", (x / 37, y / 7, z / 37), (w / 41, 0.5, d / 41)) for x, z, w, d, y in boxes
    ]
    assert added(spots, *objects) == slow(spots, objects)


@pytest.fixture(scope="module")
def rooms() -> dict[str, Scene]:
    return {scene.name: scene for scene in ithor.load_scenes()}


def parts(points: np.ndarray) -> list[int]:
    """Sizes of the connected parts, largest first."""
    left = {(int(x), int(z)) for x, z in np.rint(points[:, [0, 2]] / 0.25)}
    sizes = []
    while left:
        edge, size = [left.pop()], 0
        while edge:
            x, z = edge.pop()
            size += 1
            near = {(x + i, z + j) for i in (-1, 0, 1) for j in (-1, 0, 1)} & left
            left -= near
            edge += near
        sizes.append(size)
    return sorted(sizes, reverse=True)


def test_known_places_in_the_bundled_rooms(rooms: dict[str, Scene]) -> None:
    kitchen = rooms["FloorPlan28"].points
    assert grid.on_grid(np.array([(-1, -0.5), (-1, -1.25)]), kitchen).all()
    assert 100 < len(kitchen) < 125  # AI2-THOR's own test of this room
    unconnected = {name for name, room in rooms.items() if len(parts(room.points)) > 1}
    assert unconnected == {"FloorPlan204"}


def test_the_summary_counts_places_on_points(rooms: dict[str, Scene]) -> None:
    published = ithor.published_points()
    chosen = [rooms[name] for name in ("FloorPlan1", "FloorPlan28", "FloorPlan29")]
    lines = list(grid.summary(chosen, published, {"FloorPlan1"}))
    counts = {line[:27].strip(): line[27:].split() for line in lines[2:]}
    stood = grid.places()
    assert counts["places in test episodes"] == [
        "0", str(len(stood["FloorPlan28"]) + len(stood["FloorPlan29"]))
    ]  # fmt: skip
    assert counts["agents in default frames"] == ["1", "2"]
    assert counts["at a published point"] == ["1", "1"]  # the agent of FloorPlan29 is at none
    assert counts["at any point"] == ["1", "2"]
    before = sum(
        int(grid.on_grid(stood[r.name], r.points[published[r.name]]).sum()) for r in chosen[1:]
    )
    after = sum(int(grid.on_grid(stood[r.name], r.points).sum()) for r in chosen[1:])
    assert counts["on a published point"] == ["0", str(before)]
    assert counts["on any point"] == ["0", str(after)]
    assert before < after
    assert counts["published points"][1] == str(101 + published["FloorPlan29"].sum())


def test_places_are_those_of_21_rooms() -> None:
    found = grid.places()
    assert len(found) == 21
    assert sum(map(len, found.values())) == 524
