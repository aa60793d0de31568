"""Agreement of the tables with dense ray casting, a ray per pixel, in plain NumPy.

Both use the same solids, so this measures the error of sampling by patches, and says nothing about
how faithful the solids are to AI2-THOR.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from tdanet_jax.scenes.checks.agreement import Confusion
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT, SUBPIXEL, Scene
from tdanet_jax.scenes.visibility.build import detect
from tdanet_jax.scenes.visibility.geometry import box_frame
from tdanet_jax.scenes.visibility.rays import CLOSED, TURN_BITS
from tdanet_jax.scenes.visibility.rules import Rules
from tdanet_jax.scenes.visibility.solids import fronts_of, near_any, solids_of
from tdanet_jax.vocabulary import IMAGE_SIZE


@dataclass(frozen=True, eq=False)
class DenseView:
    """What one camera sees, by a ray per pixel."""

    box: np.ndarray  # [O, 4] float64 x1, y1, x2, y2 in pixels; zero for what is not seen
    share: np.ndarray  # [O] share of the image that each object covers


def dense_view(scene: Scene, rules: Rules, state: int, pixels: int = 150) -> DenseView:
    """The view of `state` of a room with pixels x pixels rays, in float64."""
    pose = scene.grid.split(state)
    camera = scene.points[pose.position] + np.array([0, CAMERA_ABOVE_AGENT, 0])
    turn, tilt = np.radians(scene.grid.degrees(pose))
    rays = _pixel_rays(turn, tilt, pixels)
    occluders = _float_solids(scene, rules)
    share = np.zeros(len(scene.objects))
    box = np.zeros((len(scene.objects), 4))
    for k in range(len(scene.objects)):
        reach = _first_hit(scene, k, rules, camera, rays)
        rows = np.flatnonzero(np.isfinite(reach))
        for solid in occluders:
            rows = rows[~_blocks(solid, camera, rays[rows], reach[rows])]
        share[k] = len(rows) / len(rays)
        if len(rows):
            y, x = np.divmod(rows, pixels)
            step = IMAGE_SIZE / pixels
            box[k] = np.array([x.min(), y.min(), x.max() + 1, y.max() + 1]) * step
    return DenseView(box, share)


def _pixel_rays(turn: float, tilt: float, pixels: int) -> np.ndarray:
    """Directions [pixels^2, 3], of depth 1, through the centres of the pixels, rows from the top.

    Args:
      turn, tilt: of the camera, in radians, clockwise from +z and downwards.
    """
    right = np.array([np.cos(turn), 0, -np.sin(turn)])
    level = np.array([np.sin(turn), 0, np.cos(turn)])
    up = np.array([0, np.cos(tilt), 0]) + np.sin(tilt) * level
    forward = np.cos(tilt) * level - np.array([0, np.sin(tilt), 0])
    middle = (np.arange(pixels) + 0.5) / pixels * 2 - 1
    down, across = np.meshgrid(middle, middle, indexing="ij")
    return (forward + across[..., None] * right - down[..., None] * up).reshape(-1, 3)


def _interval(
    origin: np.ndarray, edges: np.ndarray, camera: np.ndarray, rays: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Ray parameters [N, 3] at which rays enter and leave each slab of an oriented box."""
    lengths = np.maximum(np.linalg.norm(edges, axis=1), 1e-9)
    axes = edges / lengths[:, None]
    start = axes @ (camera - origin)
    step = rays @ axes.T
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = -start / step, (lengths - start) / step
    return np.fmin(low, high), np.fmax(low, high)


def _first_hit(
    scene: Scene, k: int, rules: Rules, camera: np.ndarray, rays: np.ndarray
) -> np.ndarray:
    """Ray parameter [N] at which each ray meets object k's visible surface, or infinity."""
    item = scene.objects[k]
    origin, edges = box_frame(item.box, item.corners)
    enter, leave = _interval(origin, edges, camera, rays)
    first, axis = enter.max(axis=1), enter.argmax(axis=1)
    hit = (first < leave.min(axis=1)) & (first > 0)
    hit &= item.object_class not in rules.structure
    if item.object_class in rules.fronts:
        hit &= np.isin(axis, [a for a, _ in fronts_of(item, scene.points, rules.nearly)])
        for front, side in fronts_of(item, scene.points, rules.nearly):
            ahead = (camera[front] - item.box[side, front]) * (2 * side - 1) > 0
            hit &= (axis != front) | ahead
    if item.object_class in rules.carved:
        rows = np.flatnonzero(hit)
        places = camera + first[rows, None] * rays[rows]
        hit[rows] = ~near_any(places, scene.points, rules.standing)
    return np.where(hit, first, np.inf)


def _float_solids(scene: Scene, rules: Rules) -> list[tuple[np.ndarray, np.ndarray, bool]]:
    """Origin, edges and whether it is closed, of each occluder; metres."""
    solids = solids_of(scene, rules)
    result = []
    for k in range(len(solids.lo)):
        turn = solids.turn[k] / (1 << TURN_BITS)
        lo, hi = solids.lo[k] / 1000, solids.hi[k] / 1000
        edges = turn * (hi - lo)[:, None]
        result.append((solids.origin[k] / 1000 + lo @ turn, edges, bool(solids.kind[k] == CLOSED)))
    return result


def _blocks(
    solid: tuple[np.ndarray, np.ndarray, bool],
    camera: np.ndarray,
    rays: np.ndarray,
    reach: np.ndarray,
) -> np.ndarray:
    """Whether a solid hides the points at `reach` [N] along `rays` [N, 3]."""
    origin, edges, closed = solid
    enter, leave = _interval(origin, edges, camera, rays)
    first, last = enter.max(axis=1), leave.min(axis=1)
    slack = 2e-3 / np.linalg.norm(rays, axis=1)  # the tables use whole millimetres
    met = (first < last) & (last > 0) & (first < reach - slack)
    return met & (closed | (last < reach - slack))


def compare_boxes(
    scene: Scene, rules: Rules, states: Iterable[int], least: float = 0.005
) -> tuple[list[float], Confusion]:
    """Compares the detections of some states of a room with dense views.

    Returns:
      The IoU of the boxes of each object that covers more than `least` of the image, 0 if it has
      no box; and the classes in view.
    """
    found = detect(scene, rules)
    labels = np.array([item.object_class for item in scene.objects])
    overlaps: list[float] = []
    classes = Confusion()
    for state in states:
        dense = dense_view(scene, rules, state)
        rows = np.flatnonzero(found.state == state)
        boxes = {int(found.owner[r]): found.box[r] / SUBPIXEL for r in rows}
        for k in map(int, np.flatnonzero(dense.share > least)):
            overlaps.append(_iou(boxes[k], dense.box[k]) if k in boxes else 0.0)
        ours, theirs = set(labels[list(boxes)]), set(labels[dense.share > 0])
        classes += Confusion(len(ours & theirs), len(ours - theirs), len(theirs - ours))
    return overlaps, classes


def _iou(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boxes."""
    sides = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0)
    both = sides.prod()
    return float(both / max((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - both, 1e-9))


def summary(rooms: Sequence[Scene], rules: Rules, count: int, views: int) -> str:
    """One line on `count` of the rooms, evenly spaced, with `views` random views each."""
    rng = np.random.default_rng(0)
    overlaps: list[float] = []
    classes = Confusion()
    for i in np.linspace(0, len(rooms) - 1, count).astype(int):
        states = rng.choice(len(rooms[i].points) * rooms[i].grid.views, views, replace=False)
        more, case = compare_boxes(rooms[i], rules, states)
        overlaps += more
        classes += case
    return (
        f"Boxes against a ray for every 2 x 2 pixels on the same solids, {count * views} views: "
        f"mean IoU {np.mean(overlaps):.3f} over {len(overlaps)} objects above 0.5 % of the image; "
        f"classes in view: precision {classes.precision:.3f}, recall {classes.recall:.3f} "
        "(sampling error, not fidelity to AI2-THOR)"
    )
