"""The 120 iTHOR rooms: built from published metadata into one compact file, and read from it.

Two packages on PyPI describe the rooms: `procthor` contains AI2-THOR's object metadata of one
default frame per room, `alfworld` most of the reachable points on the 0.25 m grid; `reachable` adds
the others. `build_asset` combines them into `ithor.npz`, which `load_scenes` reads. The metadata do
not say where the agent is in a default frame: that follows from its distances to all objects.
"""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import archive, assets
from tdanet_jax.io.untrusted import npz
from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes import reachable
from tdanet_jax.scenes.metadata import parse_scene
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT, Scene, SceneError, SceneObject
from tdanet_jax.scenes.visibility.geometry import box_frame, frustum_rotation, lattice
from tdanet_jax.splits import SCENE_NUMBERS
from tdanet_jax.vocabulary import ROOM_TYPES, VISIBILITY_DISTANCE

ASSET = "ithor.npz"
UNIT = 1e-4  # metres; lengths in the file are whole numbers of this unit
FLAGS = ("openable", "is_open", "pickupable", "visible")
METADATA = "procthor/databases/ai2thor-object-metadata.json"
LAYOUT = "alfworld/gen/layouts/{name}-layout.npy"


def locate_agent(records: list[dict[str, Any]]) -> np.ndarray:
    """The agent's position [3] in metres, from its `distance` to every object of a frame.

    Differences of squared distances are linear in the position; a few Newton steps on the
    distances themselves then remove the error of rounding.
    """
    places = np.array([[r["position"][axis] for axis in "xyz"] for r in records])
    distances = np.array([r["distance"] for r in records])
    squares = (places**2).sum(axis=1) - distances**2
    matrix = 2 * (places - places.mean(axis=0))
    agent = np.linalg.lstsq(matrix, squares - squares.mean(), rcond=None)[0]
    for _ in range(10):
        offset = agent - places
        lengths = np.linalg.norm(offset, axis=1)
        agent = (
            agent - np.linalg.lstsq(offset / lengths[:, None], lengths - distances, rcond=None)[0]
        )
    worst = np.abs(np.linalg.norm(agent - places, axis=1) - distances).max()
    if worst > 1e-3:
        raise SceneError(f"distances of a default frame contradict each other by {worst:.4f} m")
    return agent


def build_asset(procthor_wheel: Path, alfworld_wheel: Path, out_dir: Path) -> Path:
    """Writes `ithor.npz` into `out_dir` from the two wheels; equal wheels give equal bytes."""
    with zipfile.ZipFile(procthor_wheel) as wheel:
        metadata = json.loads(wheel.read(METADATA))
    rooms: list[dict[str, Any]] = []
    with zipfile.ZipFile(alfworld_wheel) as wheel:
        for room in ROOM_TYPES:
            for offset, number in enumerate(SCENE_NUMBERS[room]):
                name = f"FloorPlan{number}"
                layout = np.load(
                    io.BytesIO(wheel.read(LAYOUT.format(name=name))), allow_pickle=False
                )
                scene = _room(name, room, metadata[f"{room}s"][offset], layout)
                added = reachable.complete(scene.points, scene.objects)
                rooms.append(_room_arrays(scene, added))
    scene_keys = ("name", "room_type", "default_position", "default_rotation")
    arrays = {f"scene_{key}": np.array([room[key] for room in rooms]) for key in scene_keys}
    for key in rooms[0]:
        if key not in scene_keys:
            arrays[key] = np.concatenate([room[key] for room in rooms])
    names, arrays["object_class"] = np.unique(arrays["object_class"], return_inverse=True)
    arrays["object_class"] = arrays["object_class"].astype(np.int16)
    arrays["class_name"] = names
    has_corners = arrays["object_corners"] >= 0
    arrays["object_corners"][has_corners] = np.arange(has_corners.sum())
    arrays["scene_points"] = np.array([len(room["point"]) for room in rooms], np.int32)
    arrays["scene_objects"] = np.array([len(room["object_id"]) for room in rooms], np.int32)
    path = out_dir / ASSET
    archive.write(path, arrays)
    return path


def _whole(lengths: Any) -> np.ndarray:
    return np.rint(np.asarray(lengths, np.float64) / UNIT).astype(np.int32)


def _room(name: str, room_type: str, records: list[dict[str, Any]], layout: np.ndarray) -> Scene:
    """A room from its metadata and its published points (x, z)."""
    agent = locate_agent(records)
    grid = np.rint(layout / GRID_SIZE) * GRID_SIZE
    if len(grid) == 0 or np.abs(grid - layout).max() > 1e-3:
        raise SceneError(f"{name}: reachable points are not on a {GRID_SIZE} m grid")
    points = np.stack([grid[:, 0], np.full(len(grid), agent[1]), grid[:, 1]], axis=1)
    scene = parse_scene(name, room_type, records, points, agent)
    return dataclasses.replace(scene, default_rotation=_default_rotation(scene))


def _room_arrays(scene: Scene, added: np.ndarray) -> dict[str, Any]:
    """A room as arrays of whole numbers: its points, which are published, and those added."""
    items = scene.objects
    corners = [item.corners for item in items if item.corners is not None]
    row = {item.object_id: i for i, item in enumerate(items)}
    parents = [sorted(row[p] for p in item.parents if p in row) for item in items]
    points = np.concatenate([scene.points, added])
    order = np.lexsort((points[:, 2], points[:, 0]))
    return {
        "name": scene.name.encode(),
        "room_type": np.int8(ROOM_TYPES.index(scene.room_type)),
        "default_position": _whole(scene.default_position),
        "default_rotation": np.int16(scene.default_rotation or 0),
        "point": _whole(points[order]),
        "point_published": order < len(scene.points),
        "object_id": np.array([item.object_id.encode() for item in items]),
        "object_class": np.array([item.object_class.encode() for item in items]),
        "object_box": _whole([item.box for item in items]),
        "object_corners": np.array([0 if o.corners is not None else -1 for o in items], np.int16),
        "corners": _whole(corners).reshape(-1, 8, 3),
        "object_rotation": np.rint([[1000 * a for a in o.rotation] for o in items]).astype(
            np.int32
        ),  # thousandths of a degree
        **{f"object_{flag}": np.array([bool(getattr(o, flag)) for o in items]) for flag in FLAGS},
        "object_parents": np.array([len(rows) for rows in parents], np.int16),
        "parent": np.array([index for rows in parents for index in rows], np.int16),
    }


def _default_rotation(scene: Scene) -> int:
    """The rotation in the default frame, inferred from the flags of objects within reach."""
    agent = scene.default_position
    assert agent is not None
    origins, edges, visible = [], [], []
    for item in scene.objects:
        gap = np.maximum(np.maximum(item.box[0] - agent, agent - item.box[1]), 0)[[0, 2]]
        if np.hypot(*gap) <= VISIBILITY_DISTANCE or item.visible:
            origin, edge = box_frame(item.box, item.corners)
            origins.append(origin)
            edges.append(edge)
            visible.append(item.visible)
    points = lattice(np.reshape(origins, (-1, 3)), np.reshape(edges, (-1, 3, 3)))
    camera = agent + np.array([0, CAMERA_ABOVE_AGENT, 0])
    return frustum_rotation(points, np.array(visible, bool), camera)


def published_points() -> dict[str, np.ndarray]:
    """Which points of each bundled room are published, rather than added: name -> [P] bool."""
    data = npz.read(assets.path(ASSET))
    parts = np.split(data["point_published"], np.cumsum(data["scene_points"])[:-1])
    return {name.decode(): part for name, part in zip(data["scene_name"], parts, strict=True)}


def load_scenes(path: Path | None = None) -> list[Scene]:
    """The bundled rooms, in the order FloorPlan1-30, 201-230, 301-330, 401-430."""
    data = npz.read(path or assets.path(ASSET))
    points = np.split(data["point"] * UNIT, np.cumsum(data["scene_points"])[:-1])
    parents = np.split(data["parent"], np.cumsum(data["object_parents"])[:-1])
    ids = [value.decode() for value in data["object_id"]]
    scenes = []
    start = 0
    for i, name in enumerate(data["scene_name"]):
        stop = start + int(data["scene_objects"][i])
        scenes.append(
            Scene(
                name=name.decode(),
                room_type=ROOM_TYPES[int(data["scene_room_type"][i])],
                points=points[i],
                objects=tuple(
                    _object(data, row, ids[row], [ids[start + p] for p in parents[row]])
                    for row in range(start, stop)
                ),
                default_position=data["scene_default_position"][i] * UNIT,
                default_rotation=int(data["scene_default_rotation"][i]),
            )
        )
        start = stop
    return scenes


def _object(data: dict[str, np.ndarray], row: int, name: str, parents: list[str]) -> SceneObject:
    corner = int(data["object_corners"][row])
    rotation = data["object_rotation"][row] / 1000
    return SceneObject(
        object_id=name,
        object_class=data["class_name"][data["object_class"][row]].decode(),
        box=data["object_box"][row] * UNIT,
        corners=data["corners"][corner] * UNIT if corner >= 0 else None,
        rotation=(float(rotation[0]), float(rotation[1]), float(rotation[2])),
        parents=tuple(parents),
        **{flag: bool(data[f"object_{flag}"][row]) for flag in FLAGS},
    )
