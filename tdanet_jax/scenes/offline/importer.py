"""A folder of scenes in the original layout, as a file of rooms."""

from __future__ import annotations

import contextlib
import hashlib
import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax import poses
from tdanet_jax.io import archive, files
from tdanet_jax.io.untrusted import FileError, hdf5, npz
from tdanet_jax.poses import VIEWS
from tdanet_jax.scenes import cache, dataset
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.scenes.offline.extras import read_extras
from tdanet_jax.scenes.offline.layout import (
    BOX_FILE,
    FEATURE_FILE,
    FEATURE_SHAPE,
    GRAPH_FILE,
    GRID_FILE,
    OBJECT_FILE,
    VISIBILITY_FILES,
    Grid,
    scene_of,
)
from tdanet_jax.scenes.offline.reader import SceneData, describe, read_scene
from tdanet_jax.scenes.scene import MOST_CLASSES, Scene, SceneObject
from tdanet_jax.scenes.tables import SceneTables, join, tabulate
from tdanet_jax.scenes.visibility.build import Sight
from tdanet_jax.vocabulary import ALL_TARGETS

SOURCES = (GRID_FILE, GRAPH_FILE, BOX_FILE, OBJECT_FILE, *VISIBILITY_FILES)
#: Parts of an import that was stopped; part of their name, so that old ones are not read.
FORMAT = 1

Report = Callable[[float, str], None]


def read_folder(folder: Path, report: Report) -> Rooms:
    """The rooms of a folder of scenes, and what lies beside them.

    One scene's files are in memory at a time. Each scene is kept in the user's cache folder until
    `forget` is called, so that an import that was stopped goes on where it was.

    Args:
      folder: holds folders FloorPlan*, or holds one folder that does.
      report: called with the share done and a line for every scene and every further file.

    Raises:
      FileError: there are no scenes, or a file is broken; names file and reason.
    """
    root = find_root(folder)
    chosen = find_scenes(root)
    parts = _parts_folder(root)
    cache.touch(parts)
    rooms: list[SceneData] = []
    for name, room_type, place in chosen:
        data = _read_or_recall(parts, place, name, room_type)
        rooms.append(data)
        report(len(rooms) / len(chosen), describe(data))
    for other in sorted(root.glob("FloorPlan*")):
        if other.is_dir() and scene_of(other.name) is None:
            report(1.0, f"{other.name}: left out, not one of iTHOR's 120 rooms")
    grids = {data.scene.name: Grid(data.scene.points) for data in rooms}
    extras, lines = read_extras(_beside(folder, root), grids)
    for line in lines:
        report(1.0, line)
    result = Rooms(make_tables(root, rooms), extras)
    lost = {p for targets in extras.parents.values() for names in targets.values() for p in names}
    if lost := lost - set(result.tables.classes):
        report(
            1.0, f"parents that are no class of these rooms, left out: {', '.join(sorted(lost))}"
        )
    return result


def find_root(folder: Path) -> Path:
    """The folder whose children are the scenes: `folder`, or one folder or two inside it.

    Raises:
      FileError: there is none.
    """
    for pattern in ("FloorPlan*", "*/FloorPlan*", "*/*/FloorPlan*"):
        for place in sorted(folder.glob(pattern)):
            if place.is_dir() and scene_of(place.name) is not None:
                return place.parent
    raise FileError(folder, "no folder, or no folders FloorPlan1 to FloorPlan430 in it")


def find_scenes(root: Path) -> list[tuple[str, int, Path]]:
    """Name, room type and folder of each scene, by room type and number.

    Raises:
      FileError: a scene is there twice.
    """
    found: dict[str, tuple[str, int, Path]] = {}
    for place in sorted(root.glob("FloorPlan*")):
        known = scene_of(place.name)
        if known is None or not place.is_dir():
            continue
        if known[0] in found:
            raise FileError(place, f"{known[0]} is there twice")
        found[known[0]] = (*known, place)
    return sorted(found.values(), key=lambda scene: (scene[1], int(scene[0][9:])))


def _beside(folder: Path, root: Path) -> list[Path]:
    """Where the files beside the scenes are looked for, nearest first: the reference keeps the
    scenes two folders below its test episodes."""
    places = [root, folder, folder / "data", root.resolve().parent, root.resolve().parent.parent]
    return list(dict.fromkeys(places))


def make_tables(root: Path, rooms: Sequence[SceneData]) -> SceneTables:
    """The tables of all rooms; the vocabulary is theirs, the targets those of the 22 in it.

    Raises:
      FileError: there are more classes than the tables can number.
    """
    classes = tuple(sorted({o.object_class for data in rooms for o in data.scene.objects}))
    if len(classes) > MOST_CLASSES:
        raise FileError(root, f"{len(classes)} classes, more than {MOST_CLASSES}")
    targets = tuple(name for name in ALL_TARGETS if name in classes)
    shares = [tabulate(d.scene, d.next_position, d.sight, classes, targets) for d in rooms]
    return join([data.scene for data in rooms], shares, classes, targets)


def _parts_folder(root: Path) -> Path:
    name = hashlib.sha256(str(root.resolve()).encode()).hexdigest()[:16]
    return cache.folder() / f"{cache.IMPORTS}{FORMAT}-{name}"


def _read_or_recall(parts: Path, place: Path, name: str, room_type: int) -> SceneData:
    """A scene from its folder, or as it was read before from files of this size and date."""
    part = parts / f"{name}.npz"
    stamp = _stamp(place)
    with contextlib.suppress(OSError, ValueError, KeyError):
        if part.is_file():
            stored = npz.read(part)
            note = json.loads(stored["note"].tobytes())
            if note["stamp"] == stamp:
                return _unpack(stored, note)
    data = read_scene(place, name, room_type)
    with contextlib.suppress(OSError):  # without a cache an import starts anew
        parts.mkdir(parents=True, exist_ok=True)
        with files.replacing(part) as fresh:
            archive.write(fresh, _pack(data, stamp))
    return data


def _stamp(place: Path) -> list[list[Any]]:
    found = [place / name for name in SOURCES if (place / name).is_file()]
    return [[f.name, f.stat().st_size, f.stat().st_mtime_ns] for f in found]


def _pack(data: SceneData, stamp: list) -> dict[str, np.ndarray]:
    scene, sight = data.scene, data.sight
    note = {
        "stamp": stamp, "name": scene.name, "room_type": scene.room_type, "found": data.found,
        "noted": data.noted, "objects": [[o.object_id, o.object_class] for o in scene.objects],
    }  # fmt: skip
    return {
        "note": np.frombuffer(json.dumps(note).encode(), np.uint8),
        "points": scene.points,
        "boxes": np.array([item.box for item in scene.objects]),
        "next_position": data.next_position,
        "state": sight.state, "owner": sight.owner, "box": sight.box, "visible": sight.visible,
    }  # fmt: skip


def _unpack(stored: dict[str, np.ndarray], note: dict) -> SceneData:
    objects = tuple(
        SceneObject(name, kind, box)
        for (name, kind), box in zip(note["objects"], stored["boxes"], strict=True)
    )
    return SceneData(
        Scene(note["name"], note["room_type"], stored["points"], objects),
        stored["next_position"],
        Sight(*(stored[name] for name in ("state", "owner", "box", "visible"))),
        tuple(note["found"]),
        tuple(note["noted"]),
    )


def forget(folder: Path) -> None:
    """Removes what is kept of the scenes of a folder; for when all of it is written elsewhere."""
    shutil.rmtree(_parts_folder(find_root(folder)), ignore_errors=True)


def find_features(folder: Path) -> dict[str, Path]:
    """The feature file of each scene of a folder.

    Raises:
      FileError: a scene has none, or h5py, which reads them, is not installed.
    """
    found = {name: place / FEATURE_FILE for name, _, place in find_scenes(find_root(folder))}
    for path in found.values():
        hdf5.need_h5py(path)
        if not path.is_file():
            raise FileError(path, "no such file")
    return found


def save(
    rooms: Rooms,
    out: Path,
    features: Mapping[str, Path] | None = None,
    report: Report | None = None,
) -> None:
    """Writes a file of rooms and, beside it, their feature maps: both whole, or neither.

    Args:
      features: from `find_features`; None writes no maps.
      report: called with the share done and a line for every scene's maps.

    Raises:
      FileError: a feature file is broken.
    """
    with contextlib.ExitStack() as stack:
        if features is not None:
            fresh = stack.enter_context(files.replacing(features_path(out)))
            write_features(features, rooms.tables, fresh, report)
        dataset.save(rooms, out)


def write_features(
    sources: Mapping[str, Path], tables: SceneTables, out: Path, report: Report | None = None
) -> None:
    """Writes every scene's feature maps into one memory-mapped file.

    Args:
      sources: the feature file of each scene.
      out: a .npy of [S, 512, 7, 7] float16, S states in the order of the tables; zero where a
        scene's file has no map of a state.

    Raises:
      FileError: a feature file is broken.
    """
    features = np.lib.format.open_memmap(out, "w+", np.float16, (tables.num_states, *FEATURE_SHAPE))
    for i, name in enumerate(tables.scenes):
        here = np.flatnonzero(tables.position_scene == i)
        count = _copy_features(
            sources[name], Grid(tables.position[here]), features, poses.join(here[0])
        )
        rest = len(here) * VIEWS - count
        note = f"; {rest} states without one are zero" if rest else ""
        if report is not None:
            report((i + 1) / len(tables.scenes), f"{name}: {count} feature maps{note}")
    features.flush()


def _copy_features(path: Path, grid: Grid, features: np.ndarray, first: int) -> int:
    done = set()
    with hdf5.opened(path) as reader:
        for key in reader.names():
            state = grid.state(path, key)
            with np.errstate(over="ignore"):  # what is beyond is infinite, and refused
                values = reader.read(key, FEATURE_SHAPE).astype(np.float16)
            if not np.isfinite(values).all():
                raise FileError(path, f"{key} holds numbers beyond half precision")
            features[first + state] = values
            done.add(state)
    return len(done)


def features_path(data: Path) -> Path:
    """Where the feature maps of a file of rooms lie: beside it."""
    return data.with_suffix(".features.npy")


def load_features(data: Path, tables: SceneTables) -> np.ndarray:
    """The imported feature maps of a file of rooms, memory-mapped: [S, 512, 7, 7] float16.

    Raises:
      FileError: there are none, or they are those of other rooms.
    """
    path = features_path(data)
    if not path.is_file():
        raise FileError(path, "no such file; import with --features")
    try:
        features = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError) as error:
        raise FileError(path, f"not an array ({error})") from None
    if features.shape != (tables.num_states, *FEATURE_SHAPE) or features.dtype != np.float16:
        raise FileError(path, f"{features.shape} {features.dtype}: the maps of other rooms")
    return features
