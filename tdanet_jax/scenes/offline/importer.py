"""Import of a folder of scenes in the original layout."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import archive, files
from tdanet_jax.io.untrusted import FileError, npz
from tdanet_jax.scenes import cache
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.scenes.offline.extras import read_extras
from tdanet_jax.scenes.offline.features import load_features as load_features  # its former place
from tdanet_jax.scenes.offline.layout import (
    BOX_FILE,
    GRAPH_FILE,
    GRID_FILE,
    OBJECT_FILE,
    VISIBILITY_FILES,
    Grid,
    Report,
    find_root,
    find_scenes,
    scene_of,
)
from tdanet_jax.scenes.offline.reader import SceneData, read_scene
from tdanet_jax.scenes.scene import MOST_CLASSES, Scene, SceneObject
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.tabulation import join, tabulate
from tdanet_jax.scenes.visibility.build import Detections
from tdanet_jax.vocabulary import ALL_TARGETS

SOURCES = (GRID_FILE, GRAPH_FILE, BOX_FILE, OBJECT_FILE, *VISIBILITY_FILES)
#: Version of the cached scenes, and part of their name.
FORMAT = 1


def read_folder(folder: Path, report: Report) -> Rooms:
    """The rooms of a folder of scenes, with the extras that are next to it.

    One scene's files are in memory at a time. Every scene is kept in the user's cache folder until
    `clear_cache` is called, so that an interrupted import continues where it stopped.

    Args:
      folder: contains folders FloorPlan*, at most two levels down.
      report: called for every scene and every further file.

    Raises:
      FileError: there are no scenes, or a file is broken.
    """
    root = find_root(folder)
    chosen = find_scenes(root)
    cached = _cache_folder(root)
    cache.touch(cached)
    rooms: list[SceneData] = []
    for name, room_type, place in chosen:
        data = _read_cached(cached, place, name, room_type)
        rooms.append(data)
        report(len(rooms) / len(chosen), data.describe())
    for other in sorted(root.glob("FloorPlan*")):
        if other.is_dir() and scene_of(other.name) is None:
            report(1.0, f"{other.name}: left out, not one of iTHOR's 120 rooms")
    grids = {data.scene.name: Grid(data.scene.points) for data in rooms}
    extras, lines = read_extras(_near(folder, root), grids)
    for line in lines:
        report(1.0, line)
    result = Rooms(make_tables(root, rooms), extras)
    lost = {p for targets in extras.parents.values() for names in targets.values() for p in names}
    if lost := lost - set(result.tables.classes):
        report(
            1.0, f"parents that are no class of these rooms, left out: {', '.join(sorted(lost))}"
        )
    return result


def _near(folder: Path, root: Path) -> list[Path]:
    """Where extras are searched for, nearest first: the reference keeps its test episodes two
    folders above the scenes."""
    places = [root, folder, folder / "data", root.resolve().parent, root.resolve().parent.parent]
    return list(dict.fromkeys(places))


def make_tables(root: Path, rooms: Sequence[SceneData]) -> SceneTables:
    """The tables of all rooms, with their own classes, and the targets among these.

    Raises:
      FileError: there are more classes than the raster can number.
    """
    classes = tuple(sorted({o.object_class for data in rooms for o in data.scene.objects}))
    if len(classes) > MOST_CLASSES:
        raise FileError(root, f"{len(classes)} classes, more than {MOST_CLASSES}")
    targets = tuple(name for name in ALL_TARGETS if name in classes)
    parts = [tabulate(d.scene, d.next_position, d.detections, classes, targets) for d in rooms]
    return join(parts, classes, targets)


def _cache_folder(root: Path) -> Path:
    name = hashlib.sha256(str(root.resolve()).encode()).hexdigest()[:16]
    return cache.folder() / f"{cache.IMPORTS}{FORMAT}-{name}"


def _read_cached(cached: Path, place: Path, name: str, room_type: int) -> SceneData:
    """A scene from the cache, if it was read from files of equal sizes and dates, or its folder."""
    path = cached / f"{name}.npz"
    stamp = _stamp(place)
    with contextlib.suppress(OSError, ValueError, KeyError):
        if path.is_file():
            stored = npz.read(path)
            note = json.loads(stored["note"].tobytes())
            if note["stamp"] == stamp:
                return _unpack(stored, note)
    data = read_scene(place, name, room_type)
    with contextlib.suppress(OSError):  # without a cache, an import starts again
        cached.mkdir(parents=True, exist_ok=True)
        with files.replacing(path) as temporary:
            archive.write(temporary, _pack(data, stamp))
    return data


def _stamp(place: Path) -> list[list[Any]]:
    found = [place / name for name in SOURCES if (place / name).is_file()]
    return [[f.name, f.stat().st_size, f.stat().st_mtime_ns] for f in found]


def _pack(data: SceneData, stamp: list) -> dict[str, np.ndarray]:
    scene, found = data.scene, data.detections
    note = {
        "stamp": stamp, "name": scene.name, "room_type": scene.room_type, "found": data.found,
        "noted": data.noted, "objects": [[o.object_id, o.object_class] for o in scene.objects],
    }  # fmt: skip
    return {
        "note": np.frombuffer(json.dumps(note).encode(), np.uint8),
        "points": scene.points,
        "boxes": np.array([item.box for item in scene.objects]),
        "next_position": data.next_position,
        "state": found.state, "owner": found.owner, "box": found.box, "visible": found.visible,
    }  # fmt: skip


def _unpack(stored: dict[str, np.ndarray], note: dict) -> SceneData:
    objects = tuple(
        SceneObject(name, kind, box)
        for (name, kind), box in zip(note["objects"], stored["boxes"], strict=True)
    )
    return SceneData(
        Scene(note["name"], note["room_type"], stored["points"], objects),
        stored["next_position"],
        Detections(*(stored[name] for name in ("state", "owner", "box", "visible"))),
        tuple(note["found"]),
        tuple(note["noted"]),
    )


def clear_cache(folder: Path) -> None:
    """Removes the cached scenes of a folder, once they are written elsewhere."""
    shutil.rmtree(_cache_folder(find_root(folder)), ignore_errors=True)
