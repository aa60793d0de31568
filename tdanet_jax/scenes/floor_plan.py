"""Floor plans: the reachable points of a room, and the outlines of its objects from above."""

from __future__ import annotations

import dataclasses

import numpy as np

from tdanet_jax.scenes import ithor
from tdanet_jax.scenes.scene import Scene, SceneError
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility.geometry import box_frame


@dataclasses.dataclass(frozen=True)
class FloorPlan:
    """A room seen from above, in metres.

    Attributes:
      points: [P, 2] reachable (x, z).
      classes: n names of the objects' classes.
      outlines: [n, 4, 2] corners (x, z) of the objects, largest first.
      objects: [n] int, their indices among the objects of the room.
      extent: lowest x and z and highest x and z of all points and corners, plus half a grid cell.
    """

    points: np.ndarray
    classes: tuple[str, ...]
    outlines: np.ndarray
    objects: np.ndarray
    extent: tuple[float, float, float, float]

    def of_class(self, name: str | None) -> list[int]:
        """Indices of the outlines of a class."""
        return [i for i, other in enumerate(self.classes) if other == name]


def of_scene(scene: Scene) -> FloorPlan:
    """The floor plan of a room, without objects whose boxes are unknown."""
    points = scene.points[:, [0, 2]]
    outlines = np.array([_outline(scene, k) for k in range(len(scene.objects))]).reshape(-1, 4, 2)
    known = np.flatnonzero(np.isfinite(outlines).all(axis=(1, 2)))
    largest_first = np.argsort([-area(outlines[k]) for k in known], kind="stable")
    objects = known[largest_first]
    corners = np.concatenate([points, outlines[known].reshape(-1, 2)])
    margin = scene.grid.grid_size / 2
    low, high = corners.min(axis=0) - margin, corners.max(axis=0) + margin
    return FloorPlan(
        points=points,
        classes=tuple(scene.objects[k].object_class for k in objects),
        outlines=outlines[objects],
        objects=objects,
        extent=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
    )


def of_room(tables: SceneTables, name: str) -> FloorPlan:
    """The floor plan of a room in these tables.

    The outlines are oriented in bundled rooms, and those of axis-aligned boxes in other rooms.

    Raises:
      SceneError: there is no such room.
    """
    if name not in tables.scenes:
        raise SceneError(f"{name}: no such room in these tables")
    room = tables.subset([name]).as_scene()
    ids = [item.object_id for item in room.objects]
    for bundled in ithor.load_scenes():
        if bundled.name == name and [item.object_id for item in bundled.objects] == ids:
            return of_scene(dataclasses.replace(bundled, points=room.points))
    return of_scene(room)


def area(outline: np.ndarray) -> float:
    """Area of a parallelogram [4, 2], in square metres."""
    a, b, _, d = outline
    (x1, z1), (x2, z2) = b - a, d - a
    return float(abs(x1 * z2 - z1 * x2))


def _outline(scene: Scene, k: int) -> np.ndarray:
    """Corners [4, 2] (x, z) of an object's box: of the oriented one if that is upright."""
    item = scene.objects[k]
    origin, edges = box_frame(item.box, item.corners)
    level = edges[np.abs(edges[:, 1]) < 1e-2]
    if len(level) != 2:
        origin, edges = box_frame(item.box, None)
        level = edges[[0, 2]]
    a, b = level
    return np.array([origin, origin + a, origin + a + b, origin + b])[:, [0, 2]]
