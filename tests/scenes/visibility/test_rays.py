"""Exact ray casting against fractions of whole numbers."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from tdanet_jax.scenes.visibility import rays
from tdanet_jax.scenes.visibility.rays import CLOSED, OPEN, Solids

UNTURNED = np.eye(3, dtype=np.int32) * (1 << rays.TURN_BITS)


def solids(*boxes: tuple[tuple[int, int, int], tuple[int, int, int], int]) -> Solids:
    lo, hi, kind = (np.array(column, np.int32) for column in zip(*boxes, strict=True))
    return Solids(
        lo,
        hi,
        kind,
        np.zeros_like(lo),
        np.tile(UNTURNED, (len(lo), 1, 1)),
        len(lo),
    )


def expected(
    camera: np.ndarray, point: np.ndarray, lo: np.ndarray, hi: np.ndarray, kind: int
) -> bool:
    """The share of the segment that lies inside the open box, in fractions."""
    first, last = Fraction(-(10**9)), Fraction(10**9)
    for c, p, a, b in zip(*(v.tolist() for v in (camera, point, lo, hi)), strict=True):
        if p == c:
            if not a < c < b:
                return False
            continue
        ends = sorted((Fraction(a - c, p - c), Fraction(b - c, p - c)))
        first, last = max(first, ends[0]), min(last, ends[1])
    met = first < last and last > 0 and first < 1
    return met and (kind == CLOSED or last < 1)


@pytest.mark.parametrize("seed", range(6))
def test_agrees_with_fractions(seed: int) -> None:
    # Small whole numbers make touching, grazing and parallel rays common.
    draw = np.random.default_rng(seed)
    corners = draw.integers(-3, 4, (2, 3), dtype=np.int32)
    lo, hi = corners.min(axis=0), corners.max(axis=0)
    camera, point = draw.integers(-4, 5, (2, 1000, 3), dtype=np.int32)
    moves = (camera != point).any(axis=1)
    camera, point = camera[moves], point[moves]
    for kind in (OPEN, CLOSED):
        got = rays.cast(camera, point, solids((tuple(lo), tuple(hi), kind)))
        want = [expected(c, p, lo, hi, kind) for c, p in zip(camera, point, strict=True)]
        assert got.tolist() == want


def test_agrees_with_fractions_at_full_size() -> None:
    draw = np.random.default_rng(0)
    size = rays.FARTHEST
    camera, point = draw.integers(-size // 2, size // 2, (2, 300, 3), dtype=np.int32)
    corners = draw.integers(-size // 2, size // 2, (40, 2, 3), dtype=np.int32)
    lo, hi = corners.min(axis=1), corners.max(axis=1)
    for kind in (OPEN, CLOSED):
        for k in range(len(lo)):
            got = rays.cast(camera, point, solids((tuple(lo[k]), tuple(hi[k]), kind)))
            want = [expected(c, p, lo[k], hi[k], kind) for c, p in zip(camera, point, strict=True)]
            assert got.tolist() == want


def test_any_solid_blocks() -> None:
    near, far = ((-1, -1, 10), (1, 1, 12), OPEN), ((-1, -1, 20), (1, 1, 22), OPEN)
    camera = np.zeros((4, 3), np.int32)
    point = np.array([(0, 0, 9), (0, 0, 15), (0, 0, 30), (5, 0, 30)], np.int32)
    assert rays.cast(camera, point, solids(near, far)).tolist() == [False, True, True, False]


def test_only_closed_boxes_hide_what_is_inside() -> None:
    camera, point = np.zeros((1, 3), np.int32), np.array([(0, 0, 11)], np.int32)
    for kind, hidden in ((OPEN, False), (CLOSED, True)):
        assert rays.cast(camera, point, solids(((-5, -5, 10), (5, 5, 20), kind)))[0] == hidden


def test_a_point_on_the_near_face_is_seen() -> None:
    camera, point = np.zeros((1, 3), np.int32), np.array([(2, 1, 10)], np.int32)
    assert not rays.cast(camera, point, solids(((-5, -5, 10), (5, 5, 20), CLOSED)))[0]


@pytest.mark.parametrize("degrees", [30, 45, 200])
def test_turned_boxes(degrees: int) -> None:
    # A wall 2 m wide and 2 cm thick, 1 m away, turned about the vertical axis through its middle.
    turn = np.radians(degrees)
    axes = np.array([(np.cos(turn), 0, -np.sin(turn)), (0, 1, 0), (np.sin(turn), 0, np.cos(turn))])
    wall = Solids(
        np.array([(-1000, -1000, -10)], np.int32),
        np.array([(1000, 1000, 10)], np.int32),
        np.array([OPEN], np.int32),
        np.array([(0, 0, 1000)], np.int32),
        np.rint(axes[None] * (1 << rays.TURN_BITS)).astype(np.int32),
        0,
    )
    offset = np.linspace(-1500, 1500, 61)
    beyond = np.array([0, 0, 1000]) + offset[:, None] * axes[0]
    point = np.rint(beyond * 1.1).astype(np.int32)
    got = rays.cast(np.zeros_like(point), point, wall)
    clear = np.abs(np.abs(offset) - 1000) > 30  # away from the wall's thick edges
    assert (got == (np.abs(offset) < 1000))[clear].all()


def test_more_rays_than_fit_at_once() -> None:
    count = rays.RAYS + 5
    point = np.zeros((count, 3), np.int32)
    point[:, 2] = np.arange(count) % 20
    got = rays.cast(np.zeros_like(point), point, solids(((-1, -1, 10), (1, 1, 12), OPEN)))
    assert (got == (point[:, 2] > 12)).all()
