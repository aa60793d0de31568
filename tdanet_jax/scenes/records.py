"""What a file of rooms says of its objects besides their boxes, so that rooms can be varied.

Scene tables hold all that an agent's world consists of. They lack how objects are turned, what lies
on what, and what opens: that is kept next to them, as arrays with names that begin with `objects/`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.scenes.tables import SceneTables

PREFIX = "objects/"
FLAGS = ("openable", "is_open", "pickupable")

#: The arrays. Axes: O objects of all rooms, K of them with corners, N pairs of object and parent.
Records = Mapping[str, np.ndarray]


def of_scenes(scenes: Sequence[Scene]) -> Records:
    """The records of the objects of some rooms, in their order."""
    items = [item for scene in scenes for item in scene.objects]
    pairs, first = [], 0
    for scene in scenes:
        number = {item.object_id: first + i for i, item in enumerate(scene.objects)}
        for item in scene.objects:
            known = sorted(number[name] for name in item.parents if name in number)
            pairs += [(number[item.object_id], parent) for parent in known]
        first += len(scene.objects)
    turned = [i for i, item in enumerate(items) if item.corners is not None]
    return {
        "flags": np.array([[getattr(o, f) for f in FLAGS] for o in items], bool).reshape(-1, 3),
        "rotation": np.array([item.rotation for item in items], np.float64).reshape(-1, 3),
        "turned": np.array(turned, np.int32),
        "corners": np.array([items[i].corners for i in turned], np.float64).reshape(-1, 8, 3),
        "parent": np.array(pairs, np.int32).reshape(-1, 2),
    }


def to_arrays(records: Records) -> dict[str, np.ndarray]:
    """The arrays of a file."""
    return {f"{PREFIX}{name}": value for name, value in records.items()}


def from_arrays(arrays: Mapping[str, np.ndarray], tables: SceneTables) -> Records | None:
    """The records in the arrays of a file; None if it has none.

    Raises:
      ValueError: they do not fit the tables.
    """
    names = [field for field in of_scenes([]) if f"{PREFIX}{field}" in arrays]
    if not names:
        return None
    objects = len(tables.object_id)
    found = {name: arrays[f"{PREFIX}{name}"] for name in names}
    turned = len(found.get("turned", ()))
    for name, empty in of_scenes([]).items():
        length = {"flags": objects, "rotation": objects, "turned": turned, "corners": turned}
        value = found.get(name)
        count = length.get(name, -1 if value is None else len(value))
        shape = (count, *empty.shape[1:])
        if value is None or value.dtype != empty.dtype or value.shape != shape:
            raise ValueError(f"{PREFIX}{name} is not {empty.dtype} {shape}")
        if (
            name in ("turned", "parent")
            and value.size
            and not 0 <= value.min() <= value.max() < objects
        ):
            raise ValueError(f"{PREFIX}{name} points outside the tables")
    for name in ("rotation", "corners"):
        if not np.isfinite(found[name]).all():
            raise ValueError(f"{PREFIX}{name} is not finite")
    if (np.diff(tables.object_scene[found["parent"]], axis=1) != 0).any():
        raise ValueError(f"{PREFIX}parent leads from one room to another")
    return found


def restore(
    records: Records, tables: SceneTables, names: Collection[str], parts: Mapping[str, str]
) -> list[Scene]:
    """Some rooms of these tables, in their order, with these records of their objects.

    Args:
      names: the rooms.
      parts: room -> "train" or "test", where known.
    """
    corners = dict(zip(records["turned"].tolist(), records["corners"], strict=True))
    parents: dict[int, list[str]] = {}
    for item, parent in records["parent"].tolist():
        parents.setdefault(item, []).append(tables.object_id[parent])
    scenes = []
    for number, name in enumerate(tables.scenes):
        if name not in names:
            continue
        scene, first = tables.as_scene(number), int(np.searchsorted(tables.object_scene, number))
        objects: list[SceneObject] = []
        for i, item in enumerate(scene.objects, first):
            x, y, z = records["rotation"][i].tolist()
            flags = dict(zip(FLAGS, records["flags"][i].tolist(), strict=True))
            objects.append(
                dataclasses.replace(
                    item,
                    corners=corners.get(i),
                    rotation=(x, y, z),
                    parents=tuple(parents.get(i, ())),
                    **flags,
                )
            )
        scenes.append(dataclasses.replace(scene, objects=tuple(objects), part=parts.get(name)))
    return scenes
