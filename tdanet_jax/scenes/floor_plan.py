"""A room from above: where one can stand, and the outlines of its objects."""

from __future__ import annotations

import dataclasses

import numpy as np

from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes import ithor
from tdanet_jax.scenes.errors import SceneError
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility.geometry import box_frame


@dataclasses.dataclass(frozen=True)
class FloorPlan:
    """A room from above, in metres.

    Attributes:
      name: of the room.
      points: [P, 2] reachable (x, z).
      classes: n names of the objects' classes.
      outlines: [n, 4, 2] corners (x, z) of the objects, largest first.
      extent: least x and z, greatest x and z of all that.
    """

    name: str
    points: np.ndarray
    classes: tuple[str, ...]
    outlines: np.ndarray
    extent: tuple[float, float, float, float]


def load(tables: SceneTables, name: str) -> FloorPlan:
    """The floor plan of a room of these tables.

    Bundled rooms have oriented outlines, others those of their axis-aligned boxes; objects of which
    no box is known are left out.

    Raises:
      SceneError: there is no such room.
    """
    if name not in tables.scenes:
        raise SceneError(f"{name}: no such room in these tables")
    scene = tables.scenes.index(name)
    points = tables.position[tables.position_scene == scene][:, [0, 2]]
    own = np.flatnonzero(tables.object_scene == scene)
    room = _bundled(name, [tables.object_id[i] for i in own])
    if room is not None:
        outlines = np.array([footprint(room, k) for k in range(len(own))]).reshape(-1, 4, 2)
    else:
        x1, z1, x2, z2 = tables.object_box[own][:, [0, 2, 3, 5]].T
        outlines = np.stack([x1, z1, x2, z1, x2, z2, x1, z2], axis=-1).reshape(-1, 4, 2)
    known = np.isfinite(outlines).all(axis=(1, 2))
    outlines, own = outlines[known], own[known]
    order = np.argsort([-area(outline) for outline in outlines], kind="stable")
    everything = np.concatenate([points, outlines.reshape(-1, 2)])
    low, high = everything.min(axis=0) - GRID_SIZE / 2, everything.max(axis=0) + GRID_SIZE / 2
    return FloorPlan(
        name=name,
        points=points,
        classes=tuple(tables.classes[tables.object_class[own[i]]] for i in order),
        outlines=outlines[order],
        extent=(float(low[0]), float(low[1]), float(high[0]), float(high[1])),
    )


def _bundled(name: str, object_ids: list[str]) -> Scene | None:
    """The bundled room of this name, if it holds these very objects."""
    for room in ithor.load_scenes():
        if room.name == name and [item.object_id for item in room.objects] == object_ids:
            return room
    return None


def footprint(scene: Scene, k: int) -> np.ndarray:
    """Corners [4, 2] (x, z) of an object's box, of its oriented one where that stands upright."""
    item = scene.objects[k]
    origin, edges = box_frame(item.box, item.corners)
    level = edges[np.abs(edges[:, 1]) < 1e-2]
    if len(level) != 2:
        origin, edges = box_frame(item.box, None)
        level = edges[[0, 2]]
    a, b = level
    return np.array([origin, origin + a, origin + a + b, origin + b])[:, [0, 2]]


def area(outline: np.ndarray) -> float:
    """Of a parallelogram [4, 2], in square metres."""
    a, b, _, d = outline
    (x1, z1), (x2, z2) = b - a, d - a
    return float(abs(x1 * z2 - z1 * x2))
