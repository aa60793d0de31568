"""Exact ray casting: does a box lie between a camera and a point?

Everything is in whole millimetres in 32-bit integers and fractions are compared by
cross-multiplication, where no product reaches 2^31. No rounding means that every machine,
compiler and version gives the same answer.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

RAYS = 1 << 16  # rays cast at once: one shape, one compilation
MOST_SOLIDS = 256  # of one room
TURN_BITS = 14  # rotations of oriented boxes are whole numbers of 2^-14
FARTHEST = 15_000  # millimetres; farther coordinate differences could overflow

OPEN, CLOSED = 0, 1


@dataclass(frozen=True, eq=False)
class Solids:
    """K boxes that hide things: those along the world's axes first, then those that are turned.

    Millimetres, int32. A turned box is given in a frame of its own, around `origin`.
    """

    lo: np.ndarray  # [K, 3]
    hi: np.ndarray  # [K, 3]
    kind: np.ndarray  # [K] OPEN or CLOSED: whether it hides points inside it
    origin: np.ndarray  # [K, 3]
    turn: np.ndarray  # [K, 3, 3], rows are the box's axes times 2^14
    aligned: int  # how many of the K lie along the world's axes


def blocked_by_box(
    camera: jax.Array, ray: jax.Array, lo: jax.Array, hi: jax.Array, kind: jax.Array
) -> jax.Array:
    """Whether a box hides the ends of the segments from `camera` [3, N] along `ray` [3, N]: [N].

    A segment meets the open box where, for every pair of axes, it enters along one before it
    leaves along the other. It is blocked if it passes through or ends inside a closed box.
    Touching is not meeting.

    Args:
        lo, hi: [3] corners of the box. kind: scalar. All int32, below 2^15 in size.
    """
    sign = jnp.where(ray < 0, -1, 1)
    step = ray * sign
    one, other = (lo[:, None] - camera) * sign, (hi[:, None] - camera) * sign
    enter, leave = jnp.minimum(one, other), jnp.maximum(one, other)
    hit = (leave > 0).all(axis=0) & (enter < step).all(axis=0)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        overlap = enter[i] * step[j] < leave[j] * step[i]
        overlap &= enter[j] * step[i] < leave[i] * step[j]
        hit &= overlap | ((step[i] | step[j]) == 0)  # along the third axis: nothing to compare
    through = (leave < step).any(axis=0)
    return hit & (through | (kind == CLOSED))


def _turned(matrix: jax.Array, point: jax.Array) -> jax.Array:
    """`point` [3, N] in the frame of `matrix` [3, 3] (times 2^14), rounded to millimetres."""
    total = (matrix[:, :, None] * point[None]).sum(axis=1)
    return (total + (1 << (TURN_BITS - 1))) >> TURN_BITS


@cache
def _compiled() -> Any:
    def cast(camera, point, lo, hi, kind, origin, turn, aligned, count):  # type: ignore[no-untyped-def]
        ray = point - camera

        def straight(k: jax.Array, blocked: jax.Array) -> jax.Array:
            return blocked | blocked_by_box(camera, ray, lo[k], hi[k], kind[k])

        def turned(k: jax.Array, blocked: jax.Array) -> jax.Array:
            start = _turned(turn[k], camera - origin[k][:, None])
            end = _turned(turn[k], point - origin[k][:, None])
            return blocked | blocked_by_box(start, end - start, lo[k], hi[k], kind[k])

        blocked = jnp.zeros(camera.shape[1], bool)
        blocked = jax.lax.fori_loop(0, aligned, straight, blocked)
        return jax.lax.fori_loop(aligned, count, turned, blocked)

    return jax.jit(cast)


def cast(camera: np.ndarray, point: np.ndarray, solids: Solids) -> np.ndarray:
    """Whether anything hides each `point` from its `camera` (both [N, 3] int32 mm): [N] bool."""
    count = len(solids.lo)

    def padded(array: np.ndarray) -> np.ndarray:
        rest = np.zeros((MOST_SOLIDS - count, *array.shape[1:]), np.int32)
        return np.concatenate([array, rest])

    boxes = [padded(a) for a in (solids.lo, solids.hi, solids.kind, solids.origin, solids.turn)]
    blocked = np.empty(len(point), bool)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        for start in range(0, len(point), RAYS):
            stop = min(start + RAYS, len(point))
            block = np.zeros((2, 3, RAYS), np.int32)
            block[0, :, : stop - start] = camera[start:stop].T
            block[1, :, : stop - start] = point[start:stop].T
            result = _compiled()(block[0], block[1], *boxes, solids.aligned, count)
            blocked[start:stop] = np.asarray(result)[: stop - start]
    return blocked
