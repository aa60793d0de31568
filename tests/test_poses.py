"""Poses and their parts, for whole numbers and for arrays of NumPy and JAX."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax import poses
from tests.support import oracle


def test_the_parts_of_a_pose_are_those_of_the_oracle() -> None:
    for pose in range(5 * poses.VIEWS):
        parts, expected = poses.split(pose), oracle.pose_of(pose)
        assert parts.position == expected.position
        assert parts.degrees == (expected.heading, expected.horizon)
        assert poses.join(*parts) == pose
        assert poses.from_degrees(parts.position, *parts.degrees) == pose


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
