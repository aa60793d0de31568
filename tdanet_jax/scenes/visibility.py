"""What a camera sees from each reachable point: patches, rays, and boxes in the image.

Every object is a box, its faces divided into patches. A patch is seen if the ray from the
camera to its centre meets no occluder, and in view if its centre projects into the image. An
object's 2-D box is the extent of the patches that are both, clipped to the image.

All tests of rays against boxes are made in whole millimetres in 32-bit integers, by
cross-multiplication: no product reaches 2^31, so every machine and compiler gives the same
answer. Projections are element-wise float64 operations that IEEE 754 defines to the last bit.
"""

from dataclasses import dataclass
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.scenes.geometry import HEADINGS, HORIZONS, VIEWS
from tdanet_jax.scenes.rules import Rules
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT, Scene, SceneObject

IMAGE = 300  # pixels, width and height of the frame
SUBPIXEL = 16  # boxes are stored in sixteenths of a pixel
RAYS = 1 << 16  # rays cast at once; one shape, one compilation
MOST_OCCLUDERS = 256  # of one room
TURN_BITS = 14  # rotations of oriented occluders are whole numbers of 2^-14


@dataclass(frozen=True, eq=False)
class Solids:
    """Boxes that hide things: those along the world's axes, then those that are turned.

    Millimetres, as int32. A turned box lives in a frame of its own, around `origin`.
    """

    lo: np.ndarray  # [K, 3]
    hi: np.ndarray  # [K, 3]
    closed: np.ndarray  # [K] int32, 1 where it hides what is inside it
    origin: np.ndarray  # [K, 3]
    turn: np.ndarray  # [K, 3, 3], rows are the box's axes times 2^14
    aligned: int  # how many of the K lie along the world's axes


@dataclass(frozen=True, eq=False)
class Patches:
    """The pieces that a room's object surfaces are divided into; Q of them, sorted by object."""

    owner: np.ndarray  # [Q] index of the object
    center: np.ndarray  # [Q, 3] float64 millimetres
    corner: np.ndarray  # [Q, 4, 3] float64 millimetres
    normal: np.ndarray  # [Q, 3] float64, outward, length of no meaning


def millimetres(lengths: np.ndarray) -> np.ndarray:
    """Lengths in metres as whole millimetres, int32."""
    return np.rint(np.asarray(lengths) * 1000).astype(np.int32)


def frame_of(item: SceneObject) -> tuple[np.ndarray, np.ndarray]:
    """An object's tightest known box as origin corner [3] and edge vectors [3, 3], metres."""
    if item.corners is not None:
        origin = item.corners[0]
        return origin, item.corners[[1, 4, 3]] - origin
    return item.box[0], np.diag(item.box[1] - item.box[0])


def patches_of(objects: tuple[SceneObject, ...], rules: Rules) -> Patches:
    """Divide the faces of every object into patches of at most `rules.patch`."""
    parts: list[tuple[np.ndarray, ...]] = []
    for index, item in enumerate(objects):
        origin, edges = frame_of(item)
        lengths = np.sqrt((edges * edges).sum(axis=1))
        counts = np.clip(np.ceil(lengths / rules.patch), 2, rules.patches).astype(int)
        middle = origin + edges.sum(axis=0) / 2
        for axis in range(3):
            u, v = (axis + 1) % 3, (axis + 2) % 3
            grid = _face_grid(counts[u], counts[v])
            for side in (0.0, 1.0):
                base = origin + side * edges[axis]
                corner = base + grid[..., :1] * edges[u] + grid[..., 1:] * edges[v]
                face_middle = base + (edges[u] + edges[v]) / 2
                normal = np.broadcast_to(face_middle - middle, (len(grid), 3))
                parts.append((np.full(len(grid), index), corner.mean(axis=1), corner, normal))
    owner, center, corner, normal = (np.concatenate(column) for column in zip(*parts, strict=True))
    return Patches(owner, center * 1000, corner * 1000, normal)


def _face_grid(m: int, n: int) -> np.ndarray:
    """Corners of an m x n division of the unit square: [m * n, 4, 2]."""
    i, j = np.meshgrid(np.arange(m), np.arange(n), indexing="ij")
    low = np.stack([i, j], axis=-1).reshape(-1, 1, 2)
    return (low + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])) / np.array([m, n])


def solids_of(scene: Scene, rules: Rules) -> Solids:
    """The occluding boxes of a room under `rules`."""
    aligned: list[tuple[Any, ...]] = []
    turned: list[tuple[Any, ...]] = []
    for item in scene.objects:
        name = item.object_class
        if name in rules.open_frames:
            continue
        closed = name in rules.containers and not item.is_open
        if name in rules.plates:
            box = item.box.copy()
            box[0, 1] = max(box[0, 1], box[1, 1] - rules.plate)
            aligned.append((*millimetres(box), closed, np.zeros(3), np.eye(3)))
            continue
        origin, edges = frame_of(item)
        if np.count_nonzero(np.abs(edges) > 1e-3) == 3:
            aligned.append((*millimetres(item.box), closed, np.zeros(3), np.eye(3)))
            continue
        lengths = np.sqrt((edges * edges).sum(axis=1))
        half = lengths / 2
        middle = origin + edges.sum(axis=0) / 2
        turned.append(
            (*millimetres(np.stack([-half, half])), closed, middle, edges / lengths[:, None])
        )
    lo, hi, closed, origin, turn = zip(*(aligned + turned), strict=True)
    return Solids(
        np.array(lo, np.int32),
        np.array(hi, np.int32),
        np.array(closed, np.int32),
        millimetres(np.array(origin)),
        np.rint(np.array(turn) * (1 << TURN_BITS)).astype(np.int32),
        len(aligned),
    )


def blocked_by_box(
    camera: jax.Array, ray: jax.Array, lo: jax.Array, hi: jax.Array, closed: jax.Array
) -> jax.Array:
    """Whether a box cuts the segments from `camera` [3, N] along `ray` [3, N] before its end.

    All int32, coordinates below 2^15. The segment meets the open box where, for every pair of
    axes, it enters along one before it leaves along the other: fractions a/d compared by
    cross-multiplication. It counts if it enters before the end of the segment and, unless the
    box is `closed`, leaves before it too (an open one does not hide what is inside it).
    """
    sign = jnp.where(ray < 0, -1, 1)
    step = ray * sign
    enter = jnp.minimum((lo[:, None] - camera) * sign, (hi[:, None] - camera) * sign)
    leave = jnp.maximum((lo[:, None] - camera) * sign, (hi[:, None] - camera) * sign)
    hit = (leave > 0).all(axis=0) & (enter < step).all(axis=0)
    for i in range(3):
        j = (i + 1) % 3
        hit &= (enter[i] * step[j] < leave[j] * step[i]) & (enter[j] * step[i] < leave[i] * step[j])
    return hit & ((closed > 0) | (leave < step).any(axis=0))


@cache
def _caster() -> Any:
    def turn_into(matrix: jax.Array, point: jax.Array) -> jax.Array:
        total = (matrix[:, :, None] * point[None]).sum(axis=1)
        return (total + (1 << (TURN_BITS - 1))) >> TURN_BITS

    def cast(
        camera: jax.Array,
        point: jax.Array,
        lo: jax.Array,
        hi: jax.Array,
        closed: jax.Array,
        origin: jax.Array,
        turn: jax.Array,
        aligned: jax.Array,
        count: jax.Array,
    ) -> jax.Array:
        ray = point - camera

        def straight(k: jax.Array, blocked: jax.Array) -> jax.Array:
            return blocked | blocked_by_box(camera, ray, lo[k], hi[k], closed[k])

        def turned(k: jax.Array, blocked: jax.Array) -> jax.Array:
            start = turn_into(turn[k], camera - origin[k][:, None])
            end = turn_into(turn[k], point - origin[k][:, None])
            return blocked | blocked_by_box(start, end - start, lo[k], hi[k], closed[k])

        none = jnp.zeros(camera.shape[1], bool)
        return jax.lax.fori_loop(
            aligned, count, turned, jax.lax.fori_loop(0, aligned, straight, none)
        )

    return jax.jit(cast)


def cast_rays(camera: np.ndarray, point: np.ndarray, solids: Solids) -> np.ndarray:
    """Whether anything hides each `point` from its `camera` (both [N, 3] int32 millimetres)."""
    count = len(solids.lo)
    assert count <= MOST_OCCLUDERS

    def padded(array: np.ndarray) -> np.ndarray:
        return np.concatenate(
            [array, np.zeros((MOST_OCCLUDERS - count, *array.shape[1:]), np.int32)]
        )

    shapes = [padded(a) for a in (solids.lo, solids.hi, solids.closed, solids.origin, solids.turn)]
    blocked = np.empty(len(point), bool)
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        for start in range(0, len(point), RAYS):
            stop = min(start + RAYS, len(point))
            block = np.zeros((2, 3, RAYS), np.int32)
            block[0, :, : stop - start] = camera[start:stop].T
            block[1, :, : stop - start] = point[start:stop].T
            result = _caster()(block[0], block[1], *shapes, solids.aligned, count)
            blocked[start:stop] = np.asarray(result)[: stop - start]
    return blocked


def camera_axes() -> np.ndarray:
    """Right, up and forward vectors of each view: [16, 3, 3] float64, view = heading * 2 + h.

    Built from square roots, which are exact to the last bit everywhere, not from sine and cosine.
    """
    half, root = np.sqrt(0.5), np.sqrt(0.75)
    compass = np.array(
        [
            (0, 1),
            (half, half),
            (1, 0),
            (half, -half),
            (0, -1),
            (-half, -half),
            (-1, 0),
            (-half, half),
        ]
    )
    axes = np.zeros((HEADINGS, HORIZONS, 3, 3))
    for horizon, (cosine, sine) in enumerate([(1.0, 0.0), (root, 0.5)]):
        x, z = compass.T
        zero, one = np.zeros(HEADINGS), np.ones(HEADINGS)
        axes[:, horizon, 0] = np.stack([z, zero, -x], axis=1)
        axes[:, horizon, 1] = np.stack([sine * x, cosine * one, sine * z], axis=1)
        axes[:, horizon, 2] = np.stack([cosine * x, -sine * one, cosine * z], axis=1)
    return axes.reshape(VIEWS, 3, 3)


def project(axes: np.ndarray, offset: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Image x, y in sixteenths of a pixel and depth in mm of points at `offset` [..., 3] mm.

    x and y of points behind the camera lie far outside the image, on their side of it.
    """
    x, y, z = offset[..., 0], offset[..., 1], offset[..., 2]
    right, up, forward = (a[0] * x + a[1] * y + a[2] * z for a in axes)
    half = IMAGE * SUBPIXEL / 2
    scale = half / np.maximum(forward, 1.0)
    return half + right * scale, half - up * scale, forward


@dataclass(frozen=True, eq=False)
class Sight:
    """What is seen from the cameras of one room: one row per state and object, sorted so."""

    state: np.ndarray  # [N] int32
    owner: np.ndarray  # [N] int32, index into the room's objects
    box: np.ndarray  # [N, 4] int16, x1, y1, x2, y2 in sixteenths of a pixel
    near: np.ndarray  # [N] bool, within reach


def nearness(objects: tuple[SceneObject, ...], points: np.ndarray, rules: Rules) -> np.ndarray:
    """Whether each object is within `rules.reach` of each agent position, horizontally: [P, O]."""
    boxes = np.array([item.box for item in objects])[None, :, :, [0, 2]]
    agent = points[:, None, [0, 2]]
    gap = np.maximum(np.maximum(boxes[:, :, 0] - agent, agent - boxes[:, :, 1]), 0)
    return (gap * gap).sum(axis=-1) <= rules.reach**2


def look_around(scene: Scene, rules: Rules, points: np.ndarray | None = None) -> Sight:
    """Everything seen from `points` [P, 3] (default: all reachable ones) in all 16 views."""
    points = scene.points if points is None else points
    patches = patches_of(scene.objects, rules)
    cameras = millimetres(points + np.array([0, CAMERA_ABOVE_AGENT, 0]))
    offset = cameras[:, None] - patches.center
    facing = (offset * patches.normal).sum(axis=-1) > 0
    position, patch = np.nonzero(facing)
    target = np.rint(patches.center).astype(np.int32)
    hidden = cast_rays(cameras[position], target[patch], solids_of(scene, rules))
    position, patch = position[~hidden], patch[~hidden]
    near = nearness(scene.objects, points, rules)
    return _boxes_in_view(cameras, patches, position, patch, near)


def _boxes_in_view(
    cameras: np.ndarray,
    patches: Patches,
    position: np.ndarray,
    patch: np.ndarray,
    near: np.ndarray,
) -> Sight:
    """Extents in every view of the unhidden patches, grouped by position and object."""
    offset = patches.center[patch] - cameras[position]
    group = position * len(near[0]) + patches.owner[patch]
    size = IMAGE * SUBPIXEL
    states, owners, boxes = [], [], []
    for view, axes in enumerate(camera_axes()):
        x, y, depth = project(axes, offset)
        inside = (depth > 1.0) & (x > 0) & (x < size) & (y > 0) & (y < size)
        rows = np.flatnonzero(inside)
        if len(rows) == 0:
            continue
        corner = patches.corner[patch[rows]] - cameras[position[rows], None]
        x, y, _ = project(axes, corner)
        start = np.flatnonzero(np.diff(group[rows], prepend=-1))
        box = np.stack(
            [
                np.minimum.reduceat(x.min(axis=1), start),
                np.minimum.reduceat(y.min(axis=1), start),
                np.maximum.reduceat(x.max(axis=1), start),
                np.maximum.reduceat(y.max(axis=1), start),
            ],
            axis=1,
        )
        first = rows[start]
        states.append(position[first] * VIEWS + view)
        owners.append(patches.owner[patch[first]])
        boxes.append(np.rint(np.clip(box, 0, size)).astype(np.int16))
    state, owner, box = (np.concatenate(part) for part in (states, owners, boxes))
    order = np.lexsort((owner, state))
    state, owner = state[order].astype(np.int32), owner[order].astype(np.int32)
    return Sight(state, owner, box[order], near[state // VIEWS, owner])
