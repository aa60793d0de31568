"""Import of a folder of scenes in the original layout."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import shutil
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import archive, files
from tdanet_jax.io.untrusted import FileError, npz
from tdanet_jax.scenes import cache
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.scenes.offline import frames, layout
from tdanet_jax.scenes.offline.extras import ImportedRoom, read_extras
from tdanet_jax.scenes.offline.features import load_features as load_features  # its former place
from tdanet_jax.scenes.offline.frames import Frame
from tdanet_jax.scenes.offline.layout import Grid, Report, SceneFolder, find_root, find_scenes
from tdanet_jax.scenes.offline.reader import read_scene
from tdanet_jax.scenes.room_names import Kinds
from tdanet_jax.scenes.scene import MOST_CLASSES
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.tabulation import join, tabulate
from tdanet_jax.vocabulary import ALL_TARGETS

SOURCES = (layout.GRID_FILE, layout.GRAPH_FILE, layout.BOX_FILE, layout.OBJECT_FILE,
           layout.IMAGE_FILE, *layout.VISIBILITY_FILES)  # fmt: skip
#: Modules that make the cached scenes.
MODULES = (
    *cache.MODULES,
    *(f"scenes.{name}" for name in ("house", "metadata")),
    *(f"scenes.offline.{name}" for name in ("layout", "object_ids", "frames", "matching",
                                            "reader", "importer")),
)  # fmt: skip
#: Share of the frame's width or height from which a box comes near its border.
NEAR = 0.9


def read_folder(
    folder: Path, report: Report, kinds: Kinds | None = None, frame: Frame | None = None
) -> Rooms:
    """The rooms of a folder of scenes, with the extras that are next to it.

    One scene's files are in memory at a time. Every scene is kept in the user's cache folder until
    `clear_cache` is called, so that an interrupted import continues where it stopped.

    Args:
      folder: contains folders of scenes, at most two levels down.
      report: called for every scene and every further file.
      kinds: room type and part of rooms whose names do not say them.
      frame: the frame in whose pixels the boxes are; None: as the folders say, or the usual one.

    Raises:
      FileError: there are no scenes, or a file is broken.
    """
    root = find_root(folder)
    chosen, left_out = find_scenes(root, kinds)
    cached = _cache_folder(root)
    cache.touch(cached)
    rooms: list[SceneTables] = []
    for scene in chosen:
        room, line = _read_cached(cached, scene, frame)
        rooms.append(room)
        report(len(rooms) / len(chosen), line)
    _warn_of_borders(rooms)
    known = {
        scene.name: ImportedRoom(Grid(room.position), frozenset(room.classes), scene.room_type)
        for scene, room in zip(chosen, rooms, strict=True)
    }
    # The reference keeps its test episodes two folders above the scenes.
    places = [root, folder, folder / "data", *root.resolve().parents[:2]]
    extras, lines = read_extras(places, known, (root, folder))
    parts = {scene.name: scene.part for scene in chosen if scene.part is not None}
    extras = dataclasses.replace(extras, parts=parts)
    for line in (*left_out, *lines):
        report(1.0, line)
    classes = sorted({name for room in rooms for name in room.classes})
    if len(classes) > MOST_CLASSES:
        raise FileError(root, f"{len(classes)} classes, more than {MOST_CLASSES}")
    named = {p for targets in extras.parents.values() for names in targets.values() for p in names}
    if unknown := ", ".join(sorted(named - set(classes))):
        report(1.0, f"parents that are no class of these rooms, left out: {unknown}")
    return Rooms(join(rooms, classes).with_known_targets(), extras)


def _warn_of_borders(rooms: Sequence[SceneTables]) -> None:
    """Warns of rooms in which no box comes near the right or the lower border.

    In a real room some objects always leave the view; so the frames were probably smaller.
    """
    far = [
        room.scenes[0]
        for room in rooms
        if 0
        <= room.row_box[:, 2:].max(axis=0, initial=-1).min()
        < NEAR * room.image * room.subpixel
    ]
    if far:
        more = f" and in {len(far) - 3} more rooms" if len(far) > 3 else ""
        warnings.warn(
            f"no box comes near the right or the lower border of the frame in {', '.join(far[:3])}"
            f"{more}; if the frames were smaller, import with {frames.FLAG}",
            stacklevel=2,
        )


def _cache_folder(root: Path) -> Path:
    return cache.folder() / f"{cache.IMPORTS}{cache.source_hash(MODULES, str(root.resolve()))}"


def _read_cached(cached: Path, scene: SceneFolder, frame: Frame | None) -> tuple[SceneTables, str]:
    """A scene and a line on it, cached if it was read from files of equal sizes and dates."""
    path = cached / f"{scene.name}.npz"
    stamp = [scene.room_type, str(frame), *_stamp(scene.path)]
    with contextlib.suppress(OSError, ValueError, KeyError, TypeError):
        arrays = npz.read(path)
        note = json.loads(arrays["import/note"].tobytes())
        if note["stamp"] == stamp:
            return SceneTables.from_arrays(arrays), note["line"]
    data = read_scene(scene.path, scene.name, scene.room_type, frame)
    room = tabulate(data.scene, data.next_position, data.detections, ALL_TARGETS)
    note = json.dumps({"stamp": stamp, "line": data.describe()}).encode()
    with contextlib.suppress(OSError):  # without a cache, an import starts again
        cached.mkdir(parents=True, exist_ok=True)
        with files.replacing(path) as temporary:
            arrays = {**room.to_arrays(), "import/note": np.frombuffer(note, np.uint8)}
            archive.write(temporary, arrays, compress=True)
    return room, data.describe()


def _stamp(place: Path) -> list[list[Any]]:
    found = [place / name for name in SOURCES if (place / name).is_file()]
    return [[f.name, f.stat().st_size, f.stat().st_mtime_ns] for f in found]


def clear_cache(folder: Path) -> None:
    """Removes the cached scenes of a folder, once they are written elsewhere."""
    shutil.rmtree(_cache_folder(find_root(folder)), ignore_errors=True)
