"""The patches of a room that rays are cast at, and the solids that stop them, by the rules."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

from tdanet_jax.io.untrusted.budgets import excess
from tdanet_jax.scenes.scene import Scene, SceneError, SceneObject
from tdanet_jax.scenes.visibility.geometry import THIN, box_frame
from tdanet_jax.scenes.visibility.rays import CLOSED, FARTHEST, OPEN, TURN_BITS, Solids
from tdanet_jax.scenes.visibility.rules import Rules

MOST_PATCHES = 64  # along an edge
PAIRS = 1 << 21  # of a camera and a patch, in a batch
FACES = [(axis, side) for axis in range(3) for side in (0, 1)]  # of a box: lower and upper sides
BOTTOM = (1, 0)
CELL = 0.25  # metres, cell of the floor plan in which voids are found
BELOW, ABOVE = 1.0, 3.0  # metres that walls extend below and above the agent's y


@dataclass(frozen=True, eq=False)
class Patches:
    """The Q patches that the surfaces of a room's objects are divided into, sorted by object."""

    owner: np.ndarray  # [Q] index of the object
    center: np.ndarray  # [Q, 3] float64 millimetres
    corner: np.ndarray  # [Q, 4, 3] float64 millimetres
    normal: np.ndarray  # [Q, 3] float64, outward, not normalised
    place: np.ndarray  # [Q] ascending; neighbours along a row of a face differ by one
    area: np.ndarray  # [Q] int64 square millimetres that count for the visible flag


def millimetres(lengths: np.ndarray) -> np.ndarray:
    """Lengths in metres as whole millimetres, int32."""
    return np.rint(np.asarray(lengths) * 1000).astype(np.int32)


def fronts_of(item: SceneObject, points: np.ndarray, nearly: float) -> list[tuple[int, int]]:
    """Axis (0 or 2) and side (0 or 1) of the upright faces of an object's box towards the room.

    These are the face with the closest of `points` [P, 3] in front of it, and those whose closest
    is at most `nearly` farther. Distance to the side of a face counts double.
    """
    found = []
    for axis, across in ((0, 2), (2, 0)):
        sideways = np.maximum(item.box[0, across] - points[:, across], 0)
        sideways = np.maximum(sideways, points[:, across] - item.box[1, across])
        for side in (0, 1):
            ahead = (points[:, axis] - item.box[side, axis]) * (2 * side - 1)
            gaps = (ahead + 2 * sideways)[ahead > 0]
            if len(gaps):
                found.append((float(gaps.min()), axis, side))
    least = min(found, default=(0.0, 0, 0))[0]
    return [(axis, side) for gap, axis, side in found if gap <= least + nearly]


def patches_of(scene: Scene, rules: Rules) -> Patches:
    """Divides the faces of every object that can be seen into patches.

    Raises:
      SceneError: there are more than the budget allows.
    """
    # With an empty part: there are rooms without any patch.
    parts = [(0, np.zeros(3), 0, np.zeros(0, int), np.zeros((0, 4, 3)))]
    total = first = 0
    for index, item in enumerate(scene.objects):
        if item.object_class in rules.structure:
            continue
        origin, edges = box_frame(item.box, item.corners)
        lengths = np.sqrt((edges * edges).sum(axis=1))
        fine, coarse = np.minimum(lengths, 1.0), np.maximum(lengths - 1.0, 0.0)
        counts = np.clip(np.ceil((fine + coarse / 3) / rules.patch), 2, MOST_PATCHES).astype(int)
        faces = fronts = FACES
        if item.object_class in rules.fronts:
            faces = fronts = fronts_of(item, scene.points, rules.nearly)
        if item.object_class in rules.knobs:
            behind = {(axis, 1 - side) for axis, side in fronts}
            faces = [face for face in FACES if face in fronts or face not in {BOTTOM, *behind}]
        total += sum(int(counts[axis - 1] * counts[axis - 2]) for axis, _ in faces)
        if reason := excess("patches", total, f"{total} patches up to object {item.object_id}"):
            raise SceneError(f"{scene.name}: {reason}")
        for axis, side in faces:
            u, v = (axis + 1) % 3, (axis + 2) % 3
            grid = _unit_grid(counts[u], counts[v])
            corner = origin + side * edges[axis]
            corner = corner + grid[..., :1] * edges[u] + grid[..., 1:] * edges[v]
            area = max(np.rint(lengths[u] * lengths[v] / len(grid) * 1e6), 1)
            area *= (axis, side) in fronts
            place = first + np.arange(len(grid)) + np.arange(len(grid)) // counts[v]
            first = place[-1] + 2
            if item.object_class in rules.carved:
                free = ~near_any(corner.mean(axis=1), scene.points, rules.standing)
                corner, place = corner[free], place[free]
            parts.append((index, edges[axis] * (2 * side - 1), area, place, corner))
    owner, normal, area, place, corner = zip(*parts, strict=True)
    sizes = [len(places) for places in place]
    corners = np.concatenate(corner) * 1000
    return Patches(
        owner=np.repeat(owner, sizes),
        center=corners.mean(axis=1),
        corner=corners,
        normal=np.repeat(normal, sizes, axis=0),
        place=np.concatenate(place),
        area=np.repeat(area, sizes).astype(np.int64),
    )


def near_any(places: np.ndarray, points: np.ndarray, radius: float) -> np.ndarray:
    """Whether each of `places` [N, 3] is within `radius` of any of `points`, horizontally."""
    near = np.zeros(len(places), bool)
    batch = max(1, PAIRS // len(points))
    for first in range(0, len(places), batch):
        offset = (places[first : first + batch, None] - points)[:, :, [0, 2]]
        near[first : first + batch] = ((offset * offset).sum(axis=-1) < radius**2).any(axis=1)
    return near


@cache
def _unit_grid(m: int, n: int) -> np.ndarray:
    """Corners of the m x n cells of the unit square: [m * n, 4, 2]."""
    i, j = np.meshgrid(np.arange(m), np.arange(n), indexing="ij")
    low = np.stack([i, j], axis=-1).reshape(-1, 1, 2)
    return (low + np.array([(0, 0), (0, 1), (1, 0), (1, 1)])) / np.array([m, n])


def solids_of(scene: Scene, rules: Rules) -> Solids:
    """The occluding boxes of a room."""
    aligned = [(box, OPEN) for box in void_boxes(scene, rules)]
    turned = []
    passages = passages_of(scene, rules)
    for item in scene.objects:
        if item.object_class in rules.see_through or item in passages:
            continue
        closed = item.object_class in rules.closed and not item.is_open
        kind, inset = (CLOSED, 0.0) if closed else (OPEN, rules.inset)
        origin, edges = box_frame(item.box, item.corners)
        lengths = np.sqrt((edges * edges).sum(axis=1))
        is_structure = item.object_class in rules.structure
        if item.object_class in rules.plates:
            box = item.box.copy()
            box[0, 1] = max(box[0, 1], box[1, 1] - rules.thickness)
            aligned.append((box, kind))
        elif np.sort(np.abs(edges))[:, 1].max() <= THIN:  # along the world's axes
            rim = inset * (item.box[1] - item.box[0])
            if is_structure:
                rim *= np.arange(3) == _across(item.box)
            boxes = [item.box + np.stack([rim, -rim])]
            if item.object_class in rules.walls:
                boxes = wall_boxes(item, boxes[0], passages, scene, rules)
            aligned += [(box, kind) for box in boxes]
        else:
            insets = inset * (lengths == lengths.min()) if is_structure else inset
            turned.append((origin + edges.sum(axis=0) / 2, edges, lengths, insets, kind))
    boxes = [box for box, _ in aligned]
    boxes += [np.stack([-lengths, lengths]) * (0.5 - inset) for _, _, lengths, inset, _ in turned]
    unit = unit_of(scene)
    corners = millimetres(np.reshape(boxes, (-1, 2, 3)) / unit)
    plain = len(aligned)
    turns = [np.eye(3)] * plain + [edges / lengths[:, None] for _, edges, lengths, _, _ in turned]
    return Solids(
        lo=corners[:, 0],
        hi=corners[:, 1],
        kind=np.array([kind for _, kind in aligned] + [t[4] for t in turned], np.int32),
        origin=millimetres(
            np.reshape([np.zeros(3)] * plain + [t[0] for t in turned], (-1, 3)) / unit
        ),
        turn=np.rint(np.reshape(turns, (-1, 3, 3)) * (1 << TURN_BITS)).astype(np.int32),
        aligned=plain,
        unit=unit,
    )


def passages_of(scene: Scene, rules: Rules) -> list[SceneObject]:
    """The open doors of a room, and its doorways without a door: a closed one shuts its frame."""
    doors = [item for item in scene.objects if item.object_class in rules.doors]
    leaves = [item for item in doors if item.openable or item.object_class == "Door"]
    shut = [leaf.box for leaf in leaves if not leaf.is_open]
    frames = [item for item in doors if item not in leaves]
    return [leaf for leaf in leaves if leaf.is_open] + [
        frame for frame in frames if not any(_share_place(frame.box, box).all() for box in shut)
    ]


def _share_place(box: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Along each axis, whether the middle of the shorter of two boxes is within the longer: [3]."""
    apart = np.abs(box.mean(axis=0) - other.mean(axis=0))
    return apart <= np.maximum(np.ptp(box, axis=0), np.ptp(other, axis=0)) / 2 + THIN


def _across(box: np.ndarray) -> int:
    """The axis, 0 or 2, along which a part of the building is thin."""
    x, _, z = box[1] - box[0]
    return 0 if x <= z else 2


def wall_boxes(
    wall: SceneObject, inset: np.ndarray, passages: list[SceneObject], scene: Scene, rules: Rules
) -> list[np.ndarray]:
    """The parts [2, 3] of a wall's `inset` box [2, 3] that no passage through it opens.

    Nor is there a wall around the points in its box, as in a doorway that is not among the objects.
    """
    across = _across(wall.box)
    along = 2 - across
    holes = []
    for item in passages:
        size = item.box[1] - item.box[0]
        # The leaf of an open door that has swung out is no hole where it is.
        if _share_place(wall.box, item.box)[across] and size[across] <= 2 * size[along]:
            holes.append(item.box)
    at = scene.points
    inside = ((wall.box[0] <= at) & (at <= wall.box[1]))[:, [0, 2]].all(axis=1)
    radius = max(rules.standing, scene.grid.grid_size / 2)
    reach = np.array([radius, np.inf, radius])
    holes += [np.stack([point - reach, point + reach]) for point in at[inside]]
    boxes = [inset]
    for hole in holes:
        boxes = [piece for box in boxes for piece in _around_hole(box, hole, (along, 1))]
    return boxes


def _around_hole(box: np.ndarray, hole: np.ndarray, axes: tuple[int, int]) -> list[np.ndarray]:
    """The parts of a box that are before or beyond a hole along one axis, or else the other."""
    if not (np.maximum(box[0], hole[0]) + THIN < np.minimum(box[1], hole[1]))[[*axes]].all():
        return [box]
    pieces, middle = [], box.copy()
    for axis in axes:
        before, beyond = middle.copy(), middle.copy()
        middle[:, axis] = np.clip(hole[:, axis], *middle[:, axis])
        before[1, axis], beyond[0, axis] = middle[:, axis]
        pieces += [piece for piece in (before, beyond) if np.ptp(piece[:, axis]) > THIN]
    return pieces


def unit_of(scene: Scene) -> int:
    """The unit of length, in millimetres, in which rays through a room of this size are exact."""
    places = np.concatenate([scene.points, *(item.box for item in scene.objects)])
    places = places[np.isfinite(places).all(axis=1)]
    extent = 1000 * np.linalg.norm(places.max(axis=0) - places.min(axis=0))
    return max(1, int(np.ceil(extent / FARTHEST)))


def void_boxes(scene: Scene, rules: Rules) -> list[np.ndarray]:
    """Boxes [2, 3] over the parts of the floor plan far from all objects and points: walls, and
    what is behind them.

    The plan is divided into cells. A run of void cells along x becomes one box, and equal runs in
    successive rows are joined.
    """
    boxes = np.array([item.box for item in scene.objects])[:, :, [0, 2]]
    boxes = boxes[np.isfinite(boxes).all(axis=(1, 2))]  # NaN: an unknown place
    ground = scene.points[:, [0, 2]]
    low = np.minimum(boxes[:, 0].min(axis=0, initial=np.inf), ground.min(axis=0))
    high = np.maximum(boxes[:, 1].max(axis=0, initial=-np.inf), ground.max(axis=0))
    counts = np.maximum(np.ceil((high - low) / CELL), 1).astype(int)
    void = np.ones(counts, bool)
    for near in np.concatenate([boxes, np.stack([ground, ground], axis=1)]):
        first = np.maximum(((near[0] - rules.void - low) / CELL).astype(int), 0)
        stop = np.minimum(((near[1] + rules.void - low) / CELL).astype(int) + 1, counts)
        center = [low[a] + (np.arange(first[a], stop[a]) + 0.5) * CELL for a in (0, 1)]
        x, z = (np.maximum(np.maximum(near[0, a] - c, c - near[1, a]), 0)
                for a, c in enumerate(center))  # fmt: skip
        free = x[:, None] ** 2 + z**2 >= rules.void**2
        void[first[0] : stop[0], first[1] : stop[1]] &= free
    bottom, top = scene.points[:, 1].min() - BELOW, scene.points[:, 1].max() + ABOVE
    return [
        np.array(
            [
                (low[0] + i * CELL, bottom, low[1] + first * CELL),
                (low[0] + j * CELL, top, low[1] + last * CELL),
            ]
        )
        for i, j, first, last in _rectangles(void)
    ]


def _rectangles(mask: np.ndarray) -> list[tuple[int, int, int, int]]:
    """Rectangles [i, j) x [first, last) that together cover each true cell of `mask` once."""
    done: list[tuple[int, int, int, int]] = []
    growing: dict[tuple[int, int], int] = {}
    for column in range(mask.shape[1] + 1):
        line = mask[:, column] if column < mask.shape[1] else np.zeros(mask.shape[0], bool)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], line, [False]]).astype(int)))
        runs = {(int(i), int(j)) for i, j in edges.reshape(-1, 2)}
        for run in [run for run in growing if run not in runs]:
            done.append((*run, growing.pop(run), column))
        for run in sorted(runs):
            growing.setdefault(run, column)
    return done
