"""Furniture shifted a little where a room allows, and the reachable points that follow from it.

Walls are not published. What is known to be floor is where an agent can stand, what is under the
furniture that moves, and what is between these, straight ahead or beside: nothing is put anywhere
else.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tdanet_jax.poses import GRID_SIZE, ITHOR
from tdanet_jax.scenes import reachable
from tdanet_jax.scenes.placement import LEVEL, SAME, chain, holds, shifted, supports
from tdanet_jax.scenes.reachable import RADIUS
from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.scenes.visibility.geometry import next_positions

#: Furniture that is not built in.
MOVABLE = frozenset([
    "ArmChair", "Bed", "Chair", "CoffeeTable", "Desk", "DiningTable", "DogBed", "Dresser",
    "FloorLamp", "GarbageCan", "HousePlant", "LaundryHamper", "Ottoman", "ShelvingUnit",
    "SideTable", "Sofa", "Stool", "TVStand",
])  # fmt: skip
FARTHEST = 0.3  # metres of a shift, along one axis
WAYS = np.array([(1, 0, 0), (-1, 0, 0), (0, 0, 1), (0, 0, -1)])
STEP = 0.05  # metres: shifts are multiples of it
TRIES = 12  # for a piece of furniture
KEPT = 0.95  # share of a room's reachable points that must be left
STANDING = 0.9  # metres of an agent's y above the floor
SAMPLES = 0.05  # metres between the places at which the floor is looked at
SLACK = 0.02  # metres that reachable floor extends beyond the agent's radius
#: Places [8, 2] on the edge of the agent's circle.
RIM = RADIUS * np.array([(1, 0), (0.7, 0.7), (0, 1), (-0.7, 0.7), (-1, 0), (-0.7, -0.7), (0, -1),
                         (0.7, -0.7)])  # fmt: skip
#: Metres from a reachable point to furniture or a wall, at most, if the next point is blocked.
NEXT = RADIUS + GRID_SIZE


def shift(scene: Scene, draw: np.random.Generator, share: float) -> Scene:
    """The room with some of its furniture shifted, along with what stands on it or is a part of it.

    Nothing gets into other objects or off the known floor, no part of the reachable points is cut
    off, and nearly as many are left.

    Args:
      share: of the furniture, the part that is tried.
    """
    like_ithor = (scene.grid.grid_size, scene.grid.rotations) == (ITHOR.grid_size, ITHOR.rotations)
    if not like_ithor or not isinstance(scene.room_type, str):
        return scene  # the rule of reachable points is for this grid; houses have rooms
    floor = float(np.median(scene.points[:, 1])) - STANDING
    names = [
        item.object_id
        for item in scene.objects
        if item.object_class in MOVABLE
        and np.isfinite(item.box).all()
        and abs(item.box[0, 1] - floor) < 0.1
    ]
    least = KEPT * len(scene.points)
    for name in names:
        tried, steps = draw.random(), round(FARTHEST / STEP)
        lengths, ways = draw.integers(1, steps + 1, TRIES) * STEP, draw.integers(4, size=TRIES)
        if tried < share:
            unit = _unit(scene, name)
            there = (
                _moved(scene, unit, name, length * WAYS[way], least)
                for length, way in zip(lengths, ways, strict=True)
            )
            scene = next((room for room in there if room is not None), scene)
    return scene


def _moved(
    scene: Scene, unit: Sequence[SceneObject], name: str, way: np.ndarray, least: float
) -> Scene | None:
    """The room with furniture moved by `way` [3] metres; None if it cannot be there.

    Args:
      unit: what moves.
      name: the id of the piece of furniture, of which all others are parts or stand on it.
      least: the number of points that must be reachable.
    """
    new = {item.object_id: shifted(item, way) for item in unit}
    [area] = [item.box[:, LEVEL] for item in unit if item.object_id == name]
    rest = [o for o in scene.objects if o.object_id not in new and np.isfinite(o.box).all()]
    lattice = _lattice(new[name].box[:, LEVEL])
    if not _is_floor(lattice, area, scene.points).all() or _meets(unit, [*new.values()], rest):
        return None
    objects = tuple(new.get(item.object_id, item) for item in scene.objects)
    points = _reachable(scene.points, unit, [*new.values()], objects, area)
    if len(points) < least or _parts(points) > _parts(scene.points):
        return None
    return dataclasses.replace(scene, points=points, objects=objects)


def _unit(scene: Scene, name: str) -> list[SceneObject]:
    """A piece of furniture, its parts, such as drawers, and all that stands on any of these."""
    support = supports(scene)
    [piece] = [item for item in scene.objects if item.object_id == name]

    def belongs(item: SceneObject) -> bool:
        return bool(np.isfinite(item.box).all()) and (
            holds(piece.box, item.box) or _is_on(item, piece)
        )

    base = {item.object_id for item in scene.objects if item is piece or belongs(item)}
    return [item for item in scene.objects if _rests_on(item, base, support)]


def _is_on(item: SceneObject, piece: SceneObject) -> bool:
    middle = item.box.mean(axis=0)
    over = ((piece.box[0] <= middle) & (middle <= piece.box[1]))[LEVEL].all()
    return bool(over and abs(item.box[0, 1] - piece.box[1, 1]) < SAME)


def _rests_on(item: SceneObject, base: set[str], support: Mapping[str, SceneObject]) -> bool:
    return item.object_id in base or any(o.object_id in base for o in chain(item, support))


def _meets(
    old: Sequence[SceneObject], new: Sequence[SceneObject], rest: Sequence[SceneObject]
) -> bool:
    """Whether objects in new places get into others, or further into them than they were."""
    if not rest:
        return False
    other = np.array([item.box for item in rest])

    def common(items: Sequence[SceneObject]) -> np.ndarray:
        boxes = np.array([item.box for item in items])[:, None]
        span = np.minimum(boxes[:, :, 1], other[:, 1]) - np.maximum(boxes[:, :, 0], other[:, 0])
        return np.maximum(span, 0).prod(axis=-1)

    return bool((common(new) > common(old) + 1e-9).any())


def _lattice(area: np.ndarray) -> np.ndarray:
    """Places [N, 2] on and within the border of `area` [2, 2], close to each other."""
    axes = [
        np.linspace(low, high, int(np.ceil((high - low) / SAMPLES)) + 1) for low, high in area.T
    ]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)


def _is_floor(places: np.ndarray, area: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether each of `places` [N, 2] is on known floor: [N] bool.

    Args:
      area: [2, 2] under the furniture. What is beyond one of its sides is floor up to points on the
        same side: if it stands at a wall, the wall goes on along it.
      points: [P, 3] reachable.
    """
    at = points[:, LEVEL]
    offset = places[:, None] - at
    squared = (offset * offset).sum(axis=2)
    found = ((area[0] - SLACK <= places) & (places <= area[1] + SLACK)).all(axis=1)
    found |= squared.min(axis=1) <= (RADIUS + SLACK) ** 2
    for axis in (0, 1):
        across = places[:, 1 - axis]
        level = (area[0, 1 - axis] - SLACK <= across) & (across <= area[1, 1 - axis] + SLACK)
        for side, beyond in ((0, at[:, axis] < area[0, axis]), (1, at[:, axis] > area[1, axis])):
            outside = (places[:, axis] - area[side, axis]) * (2 * side - 1) > 0
            near = (squared[:, beyond] <= NEXT**2).any(axis=1)
            found |= level & outside & near
    result: np.ndarray = found
    return result


def _reachable(
    points: np.ndarray,
    unit: Sequence[SceneObject],
    moved: Sequence[SceneObject],
    objects: Sequence[SceneObject],
    area: np.ndarray,
) -> np.ndarray:
    """The points [P, 3] once furniture, `unit`, has moved off its `area` [2, 2].

    Those that are now blocked are gone. Of those that it blocked, the neighbours of reachable
    points are reachable if the agent's capsule stands free there, as in the bundled rooms, and if
    its whole circle is on known floor.
    """
    level, size = float(np.median(points[:, 1])), GRID_SIZE
    phase = np.round(points[0, LEVEL] % size, 6) % size  # of the grid; 0 in iTHOR
    kept = points[reachable.clear(points[:, LEVEL], level, moved)]
    boxes = np.array([item.box[:, LEVEL] for item in unit])
    low, high = boxes[:, 0].min(axis=0) - RADIUS, boxes[:, 1].max(axis=0) + RADIUS
    near = [
        item
        for item in objects
        if (item.box[0, LEVEL] < high + RADIUS).all() and (item.box[1, LEVEL] > low - RADIUS).all()
    ]
    low, high = low - phase, high - phase
    axes = [np.arange(np.ceil(low[a] / size), np.floor(high[a] / size) + 1) * size for a in (0, 1)]
    axes = [axis + start for axis, start in zip(axes, phase, strict=True)]
    spots = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    spots = spots[_is_floor(spots, area, points) & ~reachable.clear(spots, level, unit)]
    spots = spots[reachable.clear(spots, level, near)]
    circle = (spots[:, None] + RIM).reshape(-1, 2)
    spots = spots[_is_floor(circle, area, points).reshape(-1, len(RIM)).all(axis=1)]
    found = kept[:, LEVEL]
    while len(spots):
        steps = np.abs(spots[:, None] - found).sum(axis=2).min(axis=1, initial=np.inf)
        beside = steps < 1.1 * size
        new = beside & (steps > 0.1 * size)
        found, spots = np.concatenate([found, spots[new]]), spots[~beside]
        if not new.any():
            break
    added = np.insert(found[len(kept) :], 1, level, axis=1)
    every = np.concatenate([kept, added])
    return every[np.lexsort((every[:, 2], every[:, 0]))]


def _parts(points: np.ndarray) -> int:
    """The number of connected parts of reachable points."""
    ahead = next_positions(points)
    tail = np.repeat(np.arange(len(points)), ahead.shape[1])
    links = coo_array((np.ones(len(tail)), (tail, ahead.reshape(-1))), (len(points),) * 2)
    return int(connected_components(links, directed=False)[0])
