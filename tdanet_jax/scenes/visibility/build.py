"""The detections of a room: what a camera sees from each reachable point, as boxes in the image.

Object surfaces are divided into patches. A patch is seen if its centre projects into the image and
nothing lies between it and the camera. An object's box in the image is the extent of its seen
patches, clipped to the image. Projections are element-wise float32 operations, which IEEE 754
defines to the last bit, so that tables are equal on every machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tdanet_jax.io.untrusted.budgets import excess
from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT, SUBPIXEL, Scene, SceneError
from tdanet_jax.scenes.visibility import rays
from tdanet_jax.scenes.visibility.geometry import gap_to_box
from tdanet_jax.scenes.visibility.rules import Rules
from tdanet_jax.scenes.visibility.solids import PAIRS, Patches, millimetres, patches_of, solids_of
from tdanet_jax.vocabulary import IMAGE_SIZE


def cosine_and_sine(degrees: int) -> tuple[np.float32, np.float32]:
    """The float32 numbers nearest to those of whole degrees, on every machine.

    Machines differ in the last bits of a float64 cosine. That does not show: no cosine of whole
    degrees is so near to the middle between two float32 numbers.
    """
    angle = math.radians(degrees)
    return np.float32(round(math.cos(angle), 14)), np.float32(round(math.sin(angle), 14))


def turned(x: np.ndarray, z: np.ndarray, turn: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Coordinates to the right of and ahead of a level camera, every `turn` degrees all around."""
    headings = []
    for degrees in range(0, 360, turn):
        right, ahead = _turned_within_quarter(x, z, degrees % 90)
        for _ in range(degrees // 90):
            right, ahead = -ahead, right
        headings.append((right, ahead))
    return headings


def _turned_within_quarter(
    x: np.ndarray, z: np.ndarray, degrees: int
) -> tuple[np.ndarray, np.ndarray]:
    cosine, sine = cosine_and_sine(degrees)
    if degrees == 0:
        return x, z
    if degrees == 45:
        return (x - z) * cosine, (x + z) * cosine
    return x * cosine - z * sine, x * sine + z * cosine


def tilted(up: np.ndarray, ahead: np.ndarray, degrees: int) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates above and ahead of the camera once it looks down by `degrees`."""
    if degrees == 0:
        return up, ahead
    cosine, sine = cosine_and_sine(degrees)
    return cosine * up + sine * ahead, cosine * ahead - sine * up


def project(across: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Distance from the middle of the image, in sixteenths of a pixel, unclipped.

    Points behind the camera land far outside the image, on the side where they lie.
    """
    return across * (np.float32(IMAGE_SIZE * SUBPIXEL / 2) / np.maximum(depth, np.float32(1)))


class Detections(NamedTuple):
    """The detections of one room: one row per state and object in view, sorted by both."""

    state: np.ndarray  # [N] int32
    owner: np.ndarray  # [N] int32, index into the room's objects
    box: np.ndarray  # [N, 4] int16, x1, y1, x2, y2 in sixteenths of a pixel
    visible: np.ndarray  # [N] bool, within reach and more than a sliver in view


def within_reach(scene: Scene, points: np.ndarray, patches: Patches, rules: Rules) -> np.ndarray:
    """Whether each object is within `rules.reach` of each of `points`, horizontally: [P, O] bool.

    The distance is to the oriented box if that is known and upright, otherwise to the axis-aligned
    one; for a carved object, to its remaining patches.
    """
    result = np.empty((len(points), len(scene.objects)), bool)
    for k, item in enumerate(scene.objects):
        if item.object_class in rules.carved:
            offset = points[:, None] - patches.center[patches.owner == k] / 1000
            gap = (offset[..., 0] ** 2 + offset[..., 2] ** 2).min(axis=1, initial=np.inf)
        else:
            gap = gap_to_box(item, points)
        result[:, k] = gap <= rules.reach**2
    return result


def detect(
    scene: Scene,
    rules: Rules,
    points: np.ndarray | None = None,
    report: Callable[[float], None] | None = None,
) -> Detections:
    """The detections at `points` [P, 3] (by default the reachable ones) in all views.

    Memory is bounded: many points in a room of many patches are worked on in several batches.

    Args:
      report: called with the share of the points that is done.

    Raises:
      SceneError: the room has more patches, or lines of sight and boxes, than the budget allows.
    """
    points = scene.points if points is None else points
    patches, solids = patches_of(scene, rules), solids_of(scene, rules)
    tests = len(points) * len(patches.owner) * len(solids.lo)
    if reason := excess("tests", tests, f"{tests} pairs of a line of sight and a box"):
        raise SceneError(f"{scene.name}: {reason}")
    batch = max(1, PAIRS // max(len(patches.owner), 1))
    parts = []
    for first in range(0, len(points), batch):
        here = points[first : first + batch]
        near = within_reach(scene, here, patches, rules)
        found = _detect(scene.grid, here, near, patches, solids, rules)
        parts.append(found._replace(state=found.state + np.int32(first * scene.grid.views)))
        if report is not None:
            report(min(first + batch, len(points)) / len(points))
    return Detections(*map(np.concatenate, zip(*parts, strict=True)))


def _detect(
    grid: PoseGrid,
    points: np.ndarray,
    near: np.ndarray,
    patches: Patches,
    solids: rays.Solids,
    rules: Rules,
) -> Detections:
    """The detections at `points` [P, 3], from which the objects `near` [P, O] are within reach."""
    cameras = millimetres(points + np.array([0, CAMERA_ABOVE_AGENT, 0]))
    facing = np.zeros((len(points), len(patches.owner)))
    for axis in range(3):
        facing += patches.normal[:, axis] * (cameras[:, axis, None] - patches.center[:, axis])
    position, patch = np.nonzero(facing > 0)
    group = position * near.shape[1] + patches.owner[patch]
    whole = np.bincount(group, patches.area[patch], near.size)
    target = np.rint(patches.center).astype(np.int32)
    seen = ~rays.cast(cameras[position], target[patch], solids)
    least = np.where(near.reshape(-1) & (whole > 0), whole * rules.sliver, np.inf)
    unoccluded = position[seen], patch[seen], group[seen]
    return _boxes_in_view(grid, cameras, patches, *unoccluded, least)


def _boxes_in_view(
    grid: PoseGrid,
    cameras: np.ndarray,
    patches: Patches,
    position: np.ndarray,
    patch: np.ndarray,
    group: np.ndarray,
    least: np.ndarray,
) -> Detections:
    """Extents of the unoccluded patches in every view, per position and object.

    Args:
      position, patch, group: [V] index of camera, patch and (camera, object) of each patch that
        nothing hides, sorted.
      least: [P * O] area in view from which on an object counts as visible.
    """
    area, owners = patches.area[patch], patches.owner[patch]
    place = position * (patches.place.max(initial=0) + 2) + patches.place[patch]
    center, corner, eye = (a.astype(np.float32) for a in (patches.center, patches.corner, cameras))
    x, up, z = (center[patch, axis] - eye[position, axis] for axis in range(3))
    radius = np.abs(corner - center[:, None]).sum(axis=-1).max(initial=0) + 1
    # Of the four corners of each patch: the two where a run begins [Q, 2], and where it ends.
    corners_x, corners_up, corners_z = (
        np.stack([corner[:, ::2, axis], corner[:, 1::2, axis]]) for axis in range(3)
    )
    corners = turned(corners_x, corners_z, grid.turn)
    eyes, eyes_up = turned(eye[:, 0], eye[:, 2], grid.turn), np.ascontiguousarray(eye[:, 1])
    none = np.zeros(0, np.int32)
    parts = [(none, none, np.zeros((0, 4), np.int16), np.zeros(0, bool))]
    for heading, (right, ahead) in enumerate(turned(x, z, grid.turn)):
        for horizon, down in enumerate(grid.horizons):
            height, depth = tilted(up, ahead, down)
            rows = np.flatnonzero((np.abs(right) < depth) & (np.abs(height) < depth))
            if len(rows) == 0:
                continue
            start = np.flatnonzero(np.append(True, np.diff(group[rows])))
            found = rows[start]
            visible = np.add.reduceat(area[rows], start) >= least[group[found]]
            first, last = _runs(place[rows], depth[rows] < radius)
            start = np.searchsorted(first, start)
            first, last = rows[first], rows[last]
            begin, end, camera = patch[first], patch[last], position[first]
            across, over, along = (
                np.concatenate([table[0].take(begin, axis=0), table[1].take(end, axis=0)], axis=1)
                - at.take(camera)[:, None]
                for table, at in (
                    (corners[heading][0], eyes[heading][0]),
                    (corners_up, eyes_up),
                    (corners[heading][1], eyes[heading][1]),
                )
            )
            state = grid.join(position[found], heading, horizon)
            box = _extents(across, *tilted(over, along, down), start)
            parts.append((state, owners[found], box, visible))
    state, owner, box, visible = map(np.concatenate, zip(*parts, strict=True))
    order = np.lexsort((owner, state))
    return Detections(
        state[order].astype(np.int32), owner[order].astype(np.int32), box[order], visible[order]
    )


def _runs(place: np.ndarray, alone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where each run of patches that are next to one another begins and ends: two [R] indices.

    A patch in the middle of a run adds nothing to the run's extent in the image: its corners lie on
    lines between corners of the first and of the last. This does not hold for patches that reach
    behind the camera, which stay `alone` [V].
    """
    apart = (place[1:] != place[:-1] + 1) | alone[1:] | alone[:-1]
    breaks = np.flatnonzero(apart)
    return np.append(0, breaks + 1), np.append(breaks, len(place) - 1)


def _extents(
    across: np.ndarray, height: np.ndarray, depth: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """Image boxes [M, 4] around corners [V, 4] of patches; box m takes those from `start[m]` on."""
    x, y = project(across, depth), -project(height, depth)
    sides = [
        op.reduceat(op(op(a[:, 0], a[:, 1]), op(a[:, 2], a[:, 3])), start)
        for op, a in ((np.minimum, x), (np.minimum, y), (np.maximum, x), (np.maximum, y))
    ]
    middle = IMAGE_SIZE * SUBPIXEL // 2
    return np.rint(np.clip(np.stack(sides, axis=1), -middle, middle)).astype(np.int16) + middle
