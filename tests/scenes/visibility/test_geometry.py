"""Steps, transitions and action distances against counting by hand and against scipy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes.visibility import geometry
from tests.support import toy

AHEAD, LEFT, RIGHT, UP, DOWN = range(5)


def state(position: int, heading: int, horizon: int = 0) -> int:
    return (position * 8 + heading) * 2 + horizon


def test_steps_follow_the_compass() -> None:
    # A full 3 x 3 grid; the middle point is number 4 (x = 0.25, z = 0.25).
    spots = toy.points(*((x * 0.25, z * 0.25) for x in range(3) for z in range(3)))
    ends = spots[geometry.next_positions(spots)[4]][:, [0, 2]] - (0.25, 0.25)
    compass = [(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)]
    assert np.allclose(ends, np.array(compass) * 0.25)


def test_blocked_steps_stay() -> None:
    ends = geometry.next_positions(toy.line(3))
    assert ends[:, 0].tolist() == [1, 2, 2]  # along +z
    assert ends[:, 4].tolist() == [0, 0, 1]  # along -z
    for heading in (1, 2, 3, 5, 6, 7):
        assert ends[:, heading].tolist() == [0, 1, 2]


@pytest.mark.parametrize("offset", [0.0, 0.03125, 0.1, -0.13])
def test_grids_need_not_start_at_zero(offset: float) -> None:
    noise = np.random.default_rng(0).uniform(-1e-3, 1e-3, (5, 1))
    moved = toy.line(5) + np.array([offset, 0, offset]) + noise
    expected = geometry.next_positions(toy.line(5))
    assert (geometry.next_positions(moved) == expected).all()


def test_transitions_by_hand() -> None:
    table = geometry.transitions(geometry.next_positions(toy.line(2)))
    assert table[state(0, 0, 1), AHEAD] == state(1, 0, 1)
    assert table[state(1, 0), AHEAD] == state(1, 0)
    assert table[state(0, 0), LEFT] == state(0, 7)
    assert table[state(0, 7), RIGHT] == state(0, 0)
    assert table[state(1, 3, 0), DOWN] == state(1, 3, 1)
    assert table[state(1, 3, 1), DOWN] == state(1, 3, 1)
    assert table[state(1, 3, 1), UP] == state(1, 3, 0)
    assert table[state(1, 3, 0), UP] == state(1, 3, 0)


def test_steps_of_another_grid() -> None:
    grid = PoseGrid(grid_size=0.5, rotations=12, horizons=(-30, 0, 30))
    spots = toy.points(*((x * 0.5, z * 0.5) for x in range(3) for z in range(3)))
    ends = spots[geometry.next_positions(spots, grid)[4]][:, [0, 2]] / 0.5 - (1, 1)
    assert ends[:4].tolist() == [[0, 1], [1, 1], [1, 1], [1, 0]]  # 0, 30, 60 and 90 degrees
    table = geometry.transitions(geometry.next_positions(spots, grid), grid)
    here, turned = grid.from_degrees(4, 60, -30), grid.from_degrees(4, 90, -30)
    diagonal, level = grid.from_degrees(8, 60, -30), grid.from_degrees(4, 60, 0)
    back = grid.from_degrees(4, 30, -30)
    assert table[here].tolist() == [diagonal, back, turned, here, level]
    assert table[level, [UP, DOWN]].tolist() == [here, grid.from_degrees(4, 60, 30)]
    one = PoseGrid(horizons=(0,))
    table = geometry.transitions(geometry.next_positions(toy.line(2), one), one)
    assert (table[:, [UP, DOWN]] == np.arange(16)[:, None]).all()


def test_distances_by_hand() -> None:
    table = geometry.transitions(geometry.next_positions(toy.line(3)))
    goals = np.zeros((len(table), 2), bool)
    goals[state(2, 0, 1), 0] = True
    distance = geometry.action_distances(table, goals)
    assert distance[state(2, 0, 1), 0] == 0
    assert distance[state(0, 0), 0] == 3  # two steps and a look down
    assert distance[state(0, 4), 0] == 7  # half a turn besides
    assert (distance[:, 1] == -1).all()


@given(st.integers(0, 2**32 - 1))
def test_distances_agree_with_scipy(seed: int) -> None:
    draw = np.random.default_rng(seed)
    table = geometry.transitions(geometry.next_positions(toy.random_room(draw).points))
    goals = draw.random((len(table), 3)) < (0.0, 0.002, 0.05)
    found = geometry.action_distances(table, goals)
    count, actions = table.shape
    tail = np.repeat(np.arange(count), actions)
    backwards = coo_array((np.ones(tail.size), (table.reshape(-1), tail)), (count, count)).tocsr()
    for goal in range(3):
        sources = np.flatnonzero(goals[:, goal])
        expected = np.full(count, np.inf)
        if len(sources):
            steps = dijkstra(backwards, unweighted=True, indices=sources, min_only=True)
            expected = np.asarray(steps)
        assert (found[:, goal] == np.where(np.isinf(expected), -1, expected)).all()


def test_rotation_is_found_from_what_is_flagged() -> None:
    camera = np.array([0.0, 1.5, 0.0])
    corners = np.array([(-0.1, 1.4, 0.9), (0.9, 1.4, -0.1), (-0.1, 1.4, -1.1), (-1.1, 1.4, -0.1)])
    points = geometry.lattice(corners, np.broadcast_to(np.eye(3) * 0.2, (4, 3, 3)))
    for quarter in range(4):
        flags = np.arange(4) == quarter
        assert geometry.frustum_rotation(points, flags, camera) == 90 * quarter
    assert geometry.frustum_rotation(points[:0], np.zeros(0, bool), camera) == 0


def test_tight_box_follows_the_order_of_corners() -> None:
    low = [(0, 0), (2, 0), (2, 1), (0, 1)]  # x and z around the bottom face
    corners = np.array([(x, y, z) for y in (0, 3) for x, z in low], float)
    origin, edges = geometry.box_frame(np.zeros((2, 3)), corners)
    assert origin.tolist() == [0, 0, 0]
    assert edges.tolist() == [[2, 0, 0], [0, 3, 0], [0, 0, 1]]
