"""How well the rebuilt rooms agree: with AI2-THOR's own flags, and with dense ray casting.

AI2-THOR's `visible` flags of the default frames judge the rules. The dense ray casting, pixel
by pixel and in plain NumPy, judges the sampling by patches on the same solids: it says nothing
of how faithful the solids are.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tdanet_jax import poses
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT, Scene
from tdanet_jax.scenes.visibility.build import SUBPIXEL, look_around
from tdanet_jax.scenes.visibility.geometry import box_frame
from tdanet_jax.scenes.visibility.rays import CLOSED, TURN_BITS
from tdanet_jax.scenes.visibility.rules import Rules
from tdanet_jax.scenes.visibility.solids import fronts_of, solids_of, stood_on
from tdanet_jax.vocabulary import IMAGE_SIZE


@dataclass(frozen=True)
class Count:
    """Agreement of two yes-or-no answers over many cases."""

    hits: int = 0  # both yes
    extras: int = 0  # ours alone
    misses: int = 0  # theirs alone

    def __add__(self, other: Count) -> Count:
        return Count(
            self.hits + other.hits,
            self.extras + other.extras,
            self.misses + other.misses,
        )

    @property
    def precision(self) -> float:
        """Share of our yeses that are theirs."""
        return self.hits / max(self.hits + self.extras, 1)

    @property
    def recall(self) -> float:
        """Share of their yeses that are ours."""
        return self.hits / max(self.hits + self.misses, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.hits / max(2 * self.hits + self.extras + self.misses, 1)


def count(ours: np.ndarray, theirs: np.ndarray) -> Count:
    """Agreement of two boolean arrays."""
    return Count(
        int((ours & theirs).sum()),
        int((ours & ~theirs).sum()),
        int((~ours & theirs).sum()),
    )


def default_frame(scene: Scene, rules: Rules) -> np.ndarray:
    """Which objects the rules call visible in the scene's default frame: [O] bool."""
    assert scene.default_position is not None
    assert scene.default_rotation is not None
    sight = look_around(scene, rules, scene.default_position[None])
    view = poses.from_degrees(0, scene.default_rotation, 0)
    result = np.zeros(len(scene.objects), bool)
    result[sight.owner[(sight.state == view) & sight.visible]] = True
    return result


def by_class(scenes: Iterable[Scene], rules: Rules) -> dict[str, Count]:
    """Agreement with AI2-THOR's flags in the default frames, per object class."""
    result: dict[str, Count] = {}
    for scene in scenes:
        ours = default_frame(scene, rules)
        for item, mine in zip(scene.objects, ours, strict=True):
            case = count(np.array([mine]), np.array([bool(item.visible)]))
            result[item.object_class] = result.get(item.object_class, Count()) + case
    return result


@dataclass(frozen=True, eq=False)
class DenseView:
    """What one camera sees, by a ray for each pixel."""

    box: np.ndarray  # [O, 4] float64 x1, y1, x2, y2 in pixels; zeros where nothing is seen
    share: np.ndarray  # [O] share of the image that each object's seen part covers


def dense_view(scene: Scene, rules: Rules, state: int, pixels: int = 150) -> DenseView:
    """The view of `state` of a room with pixels x pixels rays, in float64."""
    pose = poses.split(state)
    camera = scene.points[pose.position] + np.array([0, CAMERA_ABOVE_AGENT, 0])
    turn, tilt = np.radians(pose.degrees)
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
    """Directions [pixels^2, 3] through the pixels' middles, rows from the top; depth 1.

    Args:
      turn, tilt: of the camera, in radians clockwise from +z and down.
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
    """Ray parameter [N] at which each ray meets object k's visible surface, else infinity."""
    item = scene.objects[k]
    origin, edges = box_frame(item.box, item.corners)
    enter, leave = _interval(origin, edges, camera, rays)
    first, axis = enter.max(axis=1), enter.argmax(axis=1)
    hit = (first < leave.min(axis=1)) & (first > 0)
    if item.object_class in rules.fronts:
        hit &= np.isin(axis, [a for a, _ in fronts_of(item, scene.points, rules.nearly)])
        for front, side in fronts_of(item, scene.points, rules.nearly):
            before = (camera[front] - item.box[side, front]) * (2 * side - 1) > 0
            hit &= (axis != front) | before
    if item.object_class in rules.carved:
        rows = np.flatnonzero(hit)
        places = camera + first[rows, None] * rays[rows]
        hit[rows] = ~stood_on(places, scene.points, rules.standing)
    return np.where(hit, first, np.inf)


def _float_solids(scene: Scene, rules: Rules) -> list[tuple[np.ndarray, np.ndarray, bool]]:
    """Origin, edges and closedness of each occluder, metres."""
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
    slack = 2e-3 / np.linalg.norm(rays, axis=1)  # the tables count in whole millimetres
    met = (first < last) & (last > 0) & (first < reach - slack)
    return met & (closed | (last < reach - slack))


def compare_boxes(
    scene: Scene, rules: Rules, states: Iterable[int], least: float = 0.005
) -> tuple[list[float], Count]:
    """Overlaps of the boxes of objects covering over `least` of the image; classes in view."""
    sight = look_around(scene, rules)
    labels = np.array([item.object_class for item in scene.objects])
    overlaps: list[float] = []
    classes = Count()
    for state in states:
        dense = dense_view(scene, rules, state)
        rows = np.flatnonzero(sight.state == state)
        boxes = {int(sight.owner[r]): sight.box[r] / SUBPIXEL for r in rows}
        for k in map(int, np.flatnonzero(dense.share > least)):
            overlaps.append(_overlap(boxes[k], dense.box[k]) if k in boxes else 0.0)
        ours, theirs = set(labels[list(boxes)]), set(labels[dense.share > 0])
        classes += Count(len(ours & theirs), len(ours - theirs), len(theirs - ours))
    return overlaps, classes


def _overlap(a: np.ndarray, b: np.ndarray) -> float:
    """Intersection over union of two boxes."""
    sides = np.maximum(np.minimum(a[2:], b[2:]) - np.maximum(a[:2], b[:2]), 0)
    both = sides.prod()
    return float(both / max((a[2:] - a[:2]).prod() + (b[2:] - b[:2]).prod() - both, 1e-9))
