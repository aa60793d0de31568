"""Exact ray casting: does a box lie between a camera and a point?

Lengths are whole millimetres (in rooms over 30 m, a multiple of that) in 32-bit integers, and
fractions are compared by cross-multiplication without a product that reaches 2^31. Nothing is
rounded, so every machine, compiler and version gives the same answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

RAYS = 1 << 16  # rays in a batch: one shape, so one compilation
SOLIDS = 256  # solids in a batch of a room's
TURN_BITS = 14  # rotations of oriented boxes are multiples of 2^-14
FARTHEST = 30_000  # units of length; larger coordinate differences could overflow

OPEN, CLOSED = 0, 1


@dataclass(frozen=True, eq=False)
class Solids:
    """K occluding boxes: first those aligned with the world's axes, then the oriented ones.

    Units of length, int32. An oriented box is given in its own frame, around `origin`.
    """

    lo: np.ndarray  # [K, 3]
    hi: np.ndarray  # [K, 3]
    kind: np.ndarray  # [K] OPEN or CLOSED; a closed box also hides what is inside it
    origin: np.ndarray  # [K, 3]
    turn: np.ndarray  # [K, 3, 3], rows are the axes of the box times 2^14
    aligned: int  # how many of the K are aligned with the world's axes
    unit: int = 1  # millimetres in a unit of length


# One array [N] per axis: XLA does not vectorise these loops over an axis of length three.
Vectors = tuple[jax.Array, jax.Array, jax.Array]


def blocked_by_box(
    camera: Vectors, ray: Vectors, lo: jax.Array, hi: jax.Array, kind: jax.Array
) -> jax.Array:
    """Whether a box hides the ends of the segments from `camera` along `ray`: [N] bool.

    A segment meets the open box if, for every pair of axes, it enters along one before it leaves
    along the other. It is blocked if it passes through, or ends inside a closed box. A segment
    that only touches the box does not meet it.

    Args:
      lo, hi: [3] corners of the box.
      kind: OPEN or CLOSED. All are int32 with magnitudes below 2^15.
    """
    step = [jnp.abs(ray[a]) for a in range(3)]
    ahead = [ray[a] >= 0 for a in range(3)]
    enter = [jnp.where(ahead[a], lo[a] - camera[a], camera[a] - hi[a]) for a in range(3)]
    leave = [jnp.where(ahead[a], hi[a] - camera[a], camera[a] - lo[a]) for a in range(3)]
    hit, through = jnp.bool_(True), jnp.bool_(False)
    for a in range(3):
        hit &= (leave[a] > 0) & (enter[a] < step[a])
        through |= leave[a] < step[a]
    for i, j in ((0, 1), (1, 2), (2, 0)):
        overlap = enter[i] * step[j] < leave[j] * step[i]
        overlap &= enter[j] * step[i] < leave[i] * step[j]
        hit &= overlap | ((step[i] | step[j]) == 0)  # parallel to the third axis
    return hit & (through | (kind == CLOSED))


def _turned(matrix: jax.Array, point: Vectors, origin: jax.Array) -> Vectors:
    """`point` in the frame of `matrix` [3, 3] (times 2^14) around `origin`."""
    x, y, z = (point[a] - origin[a] for a in range(3))
    half = 1 << (TURN_BITS - 1)
    a, b, c = ((m[0] * x + m[1] * y + m[2] * z + half) >> TURN_BITS for m in matrix)
    return a, b, c


def _minus(end: Vectors, start: Vectors) -> Vectors:
    return end[0] - start[0], end[1] - start[1], end[2] - start[2]


@cache
def _compiled() -> Any:
    def cast(camera, point, lo, hi, kind, origin, turn, aligned, count):  # type: ignore[no-untyped-def]
        start, end = tuple(camera), tuple(point)

        def straight(k: jax.Array, blocked: jax.Array) -> jax.Array:
            return blocked | blocked_by_box(start, _minus(end, start), lo[k], hi[k], kind[k])

        def turned(k: jax.Array, blocked: jax.Array) -> jax.Array:
            near, far = (_turned(turn[k], at, origin[k]) for at in (start, end))
            return blocked | blocked_by_box(near, _minus(far, near), lo[k], hi[k], kind[k])

        blocked = jnp.zeros(camera.shape[1], bool)
        blocked = jax.lax.fori_loop(0, aligned, straight, blocked)
        return jax.lax.fori_loop(aligned, count, turned, blocked)

    return jax.jit(cast)


def cast(camera: np.ndarray, point: np.ndarray, solids: Solids) -> np.ndarray:
    """Whether anything hides each `point` from its `camera` (both [N, 3] int32 mm): [N] bool."""
    count = len(solids.lo)

    def padded(array: np.ndarray) -> np.ndarray:
        rest = np.zeros((SOLIDS - count % SOLIDS, *array.shape[1:]), np.int32)
        return np.concatenate([array, rest])

    def in_units(lengths: np.ndarray) -> np.ndarray:
        return lengths if solids.unit == 1 else np.rint(lengths / solids.unit).astype(np.int32)

    boxes = [padded(a) for a in (solids.lo, solids.hi, solids.kind, solids.origin, solids.turn)]
    blocked = np.empty(len(point), bool)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        for start in range(0, len(point), RAYS):
            stop = min(start + RAYS, len(point))
            block = np.zeros((2, 3, RAYS), np.int32)
            block[0, :, : stop - start] = in_units(camera[start:stop]).T
            block[1, :, : stop - start] = in_units(point[start:stop]).T
            result = _compiled()(block[0], block[1], *boxes, solids.aligned, count)
            blocked[start:stop] = np.asarray(result)[: stop - start]
    return blocked
