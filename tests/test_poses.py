"""Poses and their parts, for whole numbers and for arrays of NumPy and JAX."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax import poses
from tdanet_jax.poses import PoseGrid
from tests.support import oracle


def test_the_parts_of_a_pose_are_those_of_the_oracle() -> None:
    for pose in range(5 * poses.VIEWS):
        parts, expected = poses.split(pose), oracle.pose_of(pose)
        assert parts.position == expected.position
        degrees = poses.ITHOR.degrees(parts)
        assert degrees == (expected.heading, expected.horizon)
        assert poses.join(*parts) == pose
        assert poses.from_degrees(parts.position, *degrees) == pose


@pytest.mark.parametrize("array", [np.asarray, jnp.asarray])
def test_arrays_are_taken_apart_as_numbers_are(array) -> None:
    every = np.arange(5 * poses.VIEWS, dtype=np.int32)
    parts = poses.split(array(every))
    assert [tuple(map(int, one)) for one in zip(*parts, strict=True)] == list(
        map(poses.split, range(len(every)))
    )
    joined = poses.join(*parts)
    assert joined.dtype == np.int32
    assert (joined == every).all()


def test_rotations_wrap_around() -> None:
    assert poses.from_degrees(3, -45, 30) == poses.from_degrees(3, 315, 30) == (3 * 8 + 7) * 2 + 1
    assert poses.from_degrees(3, 360, 0) == poses.join(3) == 3 * 16


GRIDS = [
    PoseGrid(rotations=rotations, horizons=horizons)
    for rotations in (24, 12, 8, 6, 4)
    for horizons in ((0,), (0, 30), (-30, 0, 30))
]


@pytest.mark.parametrize("grid", GRIDS, ids=str)
def test_other_grids_are_those_of_the_oracle_too(grid: PoseGrid) -> None:
    every = jnp.arange(3 * grid.views)
    parts = grid.split(every)
    for pose in map(int, every):
        expected = oracle.pose_of(pose, grid)
        one = grid.split(pose)
        degrees = grid.degrees(one)
        assert (one.position, *degrees) == expected
        assert tuple(int(part[pose]) for part in parts) == one
        assert grid.join(*one) == grid.from_degrees(one.position, *degrees) == pose
        assert (grid.look_level(one.position, one.rotation) == pose) == (expected.horizon == 0)


def test_steps_go_to_the_neighbour_in_the_nearest_direction() -> None:
    assert PoseGrid(rotations=4).steps.tolist() == [[0, 1], [1, 0], [0, -1], [-1, 0]]
    assert PoseGrid(rotations=6).steps.tolist() == [
        [0, 1], [1, 1], [1, -1], [0, -1], [-1, -1], [-1, 1]
    ]  # fmt: skip
    for grid in GRIDS:
        angle = np.radians(grid.turn * np.arange(grid.rotations))
        heading = np.stack([np.sin(angle), np.cos(angle)], axis=1)
        cosine = heading @ (poses.STEPS / np.linalg.norm(poses.STEPS, axis=1)[:, None]).T
        assert (grid.steps == poses.STEPS[cosine.argmax(axis=1)]).all()
        assert grid.neighbour(jnp.arange(grid.rotations)).tolist() == cosine.argmax(axis=1).tolist()


def test_a_list_of_horizons_makes_the_same_grid() -> None:
    grid = PoseGrid(horizons=[0, 30])  # type: ignore[arg-type]
    assert {grid} == {poses.ITHOR}


@pytest.mark.parametrize("degrees", [float("nan"), float("inf"), -float("inf")])
def test_a_view_that_is_no_number_is_refused_by_name(degrees: float) -> None:
    with pytest.raises(ValueError, match=f"^rotation {degrees}: not a multiple of 45 degrees$"):
        poses.ITHOR.nearest_view(degrees, 0)
    with pytest.raises(ValueError, match=f"^horizon {degrees}: not among 0, 30 degrees$"):
        poses.ITHOR.nearest_view(0, degrees)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"grid_size": 0.04}, "gridSize 0.04: must be from 0.05 to 0.5 metres"),
        ({"grid_size": float("nan")}, "gridSize nan"),
        ({"grid_size": True}, "gridSize True"),
        ({"grid_size": "0.25"}, "gridSize '0.25': must be from 0.05 to 0.5 metres"),
        ({"rotations": 16}, "16 rotations"),
        ({"rotations": 8.0}, "8.0 rotations"),
        ({"horizons": ()}, "horizons"),
        ({"horizons": (30,)}, "with 0"),
        ({"horizons": (30, 0)}, "ascending"),
        ({"horizons": (0, 0)}, "ascending"),
        ({"horizons": (0, 30.0)}, "whole degrees"),
        ({"horizons": (0, 91)}, "from -90 to 90"),
    ],
)
def test_impossible_grids_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PoseGrid(**fields)
