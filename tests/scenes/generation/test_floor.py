"""Walls, free places and points of a room that is being furnished, by hand."""

from __future__ import annotations

import numpy as np
import pytest

from tdanet_jax.scenes.generation.floor import AHEAD, RIGHT, Floor
from tests.support import toy

CORNERS = [(x, z) for x in (-2.0, 1.0) for z in (-1.5, 0.0)]
NOTCHES = [None, *(np.array([(x, z), (x + 1.0, z + 1.5)]) for x, z in CORNERS)]


@pytest.mark.parametrize("notch", NOTCHES)
def test_walls_lead_around_the_room_with_the_inside_to_their_left(notch: np.ndarray | None) -> None:
    floor = Floor(np.array([4.0, 3.0]), notch)
    ends = np.array([wall.start + wall.along * wall.length for wall in floor.walls])
    starts = np.array([wall.start for wall in floor.walls])
    np.testing.assert_allclose(ends, np.roll(starts, -1, axis=0), atol=1e-9)
    for wall in floor.walls:
        middle, across = wall.start + wall.along * wall.length / 2, wall.inward * 0.3
        assert _inside(middle + across, notch)
        assert not _inside(middle - across, notch)
        np.testing.assert_array_equal(AHEAD[wall.turns], wall.inward)
        np.testing.assert_array_equal(RIGHT[wall.turns], wall.along)
    assert floor.area[1].tolist() == [2.0, 1.5]


def _inside(place: np.ndarray, notch: np.ndarray | None) -> bool:
    cut = notch is not None and ((notch[0] < place) & (place < notch[1])).all()
    return bool((np.abs(place) < (2.0, 1.5)).all() and not cut)


def test_an_agent_stands_a_radius_off_walls_and_things() -> None:
    floor = Floor(np.array([1.5, 1.5]), None)
    assert len(floor.points) == 25  # 0.25 m apart, up to 0.5 m from the middle
    assert set(floor.points[:, 1]) == {0.9}
    box = toy.thing("Safe", (0.0, 0.25, 0.0), (0.2, 0.5, 0.2))
    assert floor.put([box], [(0, np.zeros(3))]) is not None
    # 0.25 m from the middle is 0.15 m from the box; at a diagonal, it is 0.21 m.
    assert len(floor.points) == 20
    assert np.abs(floor.points[:, [0, 2]]).sum(axis=1).min() == 0.5


def test_what_is_put_meets_nothing_and_cuts_nothing_off() -> None:
    floor = Floor(np.array([3.0, 1.5]), None)
    safe = toy.thing("Safe", (0.0, 0.25, 0.0), (0.4, 0.5, 0.4))
    here = np.array([1.2, 0.0, 0.5])
    assert floor.put([safe], [(0, here)]) is not None
    assert floor.put([safe], [(0, here + 0.3)]) is None  # it would be outside
    assert floor.put([safe], [(0, here - (0.3, 0, 0))]) is None  # in the first
    assert floor.put([safe], [(0, here), (0, here - (0.41, 0, 0))]) is not None
    wall = toy.thing("Sofa", (0.0, 0.4, 0.0), (0.5, 0.8, 1.4))
    assert floor.put([wall], [(0, np.zeros(3))]) is None
    empty = Floor(np.array([3.0, 1.5]), None)
    assert empty.put([wall], [(0, np.zeros(3))]) is None  # half of the room would be lost
    assert floor.put([wall], [(1, np.array([-0.7, 0.0, 0.5]))]) is not None  # turned, at a wall
    assert len(floor.items) == 3


def test_zones_stay_free_and_solid_boxes_are_no_floor() -> None:
    floor = Floor(np.array([3.0, 3.0]), None)
    safe = toy.thing("Safe", (0.0, 0.25, 0.0), (0.4, 0.5, 0.4))
    zone = np.array([(-0.2, 0.0, 0.21), (0.2, 0.3, 0.9)])
    assert floor.put([safe], [(2, np.zeros(3))], [zone]) is not None  # it faces -z
    before = len(floor.points)
    assert floor.put([safe], [(0, np.array([0.0, 0.0, -0.6]))]) is None
    assert floor.put([safe], [(0, np.array([0.0, 0.0, 0.6]))]) is not None
    shelf = toy.thing("Shelf", (0.0, 1.9, 0.0), (0.2, 0.1, 0.2))
    solid = np.array([(-0.5, 0.0, -0.5), (0.5, 0.85, 0.5)])
    there = floor.put([shelf], [(0, np.array([-1.0, 0.0, 1.0]))], solid=[solid])
    assert there is not None
    assert len(floor.points) < before
    gap = np.abs(floor.points[:, [0, 2]] - (-1.0, 1.0)).max(axis=1)
    assert gap.min() >= 0.7
    copy = floor.copy()
    assert copy.put([safe], [(0, np.array([1.2, 0.0, 1.2]))]) is not None
    assert len(copy.items) == len(floor.items) + 1
    assert len(copy.points) < len(floor.points)
