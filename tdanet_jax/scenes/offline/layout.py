"""Folders, files and state keys of the original offline data; docs/data.md describes them all."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tdanet_jax import poses
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes.metadata import ALIGNED
from tdanet_jax.scenes.room_names import Kinds, check_name, kind_of, sort_key, type_names
from tdanet_jax.scenes.scene import SceneError

GRID_FILE, GRAPH_FILE, BOX_FILE = "grid.json", "graph.json", "objects_bb.json"
METADATA_FILE, IMAGE_FILE = "metadata.json", "images.hdf5"
#: In order of preference: both names of the visibility map, then the raw metadata.
VISIBILITY_FILES = ("visible_object_map_1.5.json", "visible_object_map.json", METADATA_FILE)
#: Our addition: what the original layout lacks of our tables.
OBJECT_FILE = "objects.json"
FEATURE_FILE = "resnet18_featuremap.hdf5"
FEATURE_SHAPE = (512, 7, 7)
PARENT_FILE = "c2p_prob.json"
#: Names of `ROOM_TYPES` in `c2p_prob.json`, in the same order.
ROOM_NAMES = ("Kitchen", "Living_Room", "Bedroom", "Bathroom")

#: Called with the share that is done and a line of text.
Report = Callable[[float, str], None]

_NUMBER = r"(-?\d{1,4}(?:\.\d{1,9})?)"
_KEY = re.compile(rf"{_NUMBER}\|{_NUMBER}\|(\d{{1,3}})(?:\.0)?\|(\d{{1,2}})(?:\.0)?")


class SceneFolder(NamedTuple):
    """A folder with the files of a scene."""

    name: str
    room_type: str
    part: str | None
    path: Path


def scene_name(folder: str) -> str:
    """The scene in a folder called `folder`: FloorPlan1 for FloorPlan1_physics as well."""
    plain = folder.removesuffix("_physics")
    return plain if kind_of(plain) is not None else folder


def _is_scene(place: Path) -> bool:
    """Whether a folder holds a scene: it has the name of an iTHOR room, or a file of points."""
    kind = kind_of(scene_name(place.name))
    is_ithor = kind is not None and kind.part is None
    return place.is_dir() and (is_ithor or (place / GRID_FILE).is_file())


def find_root(folder: Path) -> Path:
    """The folder whose children are the scenes: `folder`, or one up to two levels inside it.

    Raises:
      FileError: there is none, or there are several at the same level.
    """
    for pattern in ("*", "*/*", "*/*/*"):
        found = sorted({place.parent for place in folder.glob(pattern) if _is_scene(place)})
        roots = [*{root.resolve(): root for root in found}.values()]  # a link is no other folder
        if len(roots) > 1:
            listed = ", ".join(str(root.relative_to(folder)) for root in roots)
            raise FileError(folder, f"rooms in several folders; import one of them: {listed}")
        if roots:
            return roots[0]
    raise FileError(folder, f"no folder, or no folders of rooms (with a {GRID_FILE}) in it")


def find_scenes(root: Path, kinds: Kinds | None = None) -> tuple[list[SceneFolder], list[str]]:
    """The scenes of a folder, by room type, name and number; and lines on what is left out.

    Raises:
      FileError: two folders belong to one scene, or no scene is left.
    """
    kinds = kinds or Kinds()
    found: dict[str, SceneFolder] = {}
    left_out = []
    for place in sorted(root.iterdir()):
        name = scene_name(place.name)
        if not _is_scene(place):
            if place.is_dir() and name.startswith("FloorPlan"):
                left_out.append(f"{name}: left out, has no {GRID_FILE}")
            continue
        try:
            check_name(name)
        except SceneError as error:
            left_out.append(f"left out: {error}")
            continue
        kind = kinds.of(name)
        if kind.room_type is None:
            left_out.append(f"{name}: left out, --room-type or --rooms must say its type")
        elif name in found:
            raise FileError(place, f"{name} is there twice")
        else:
            found[name] = SceneFolder(name, kind.room_type, kind.part, place)
    if rest := sorted(kinds.table.keys() - found.keys(), key=sort_key):
        listed = ", ".join(rest[:3]) + (", ..." if len(rest) > 3 else "")
        left_out.append(f"{len(rest)} rooms of the table of rooms are not in the folder: {listed}")
    if not found:
        raise FileError(root, f"no room to import; {left_out[0] if left_out else 'it is empty'}")

    types = type_names(scene.room_type for scene in found.values())
    return sorted(
        found.values(), key=lambda s: (types.index(s.room_type), sort_key(s.name))
    ), left_out


def state_key(x: float, z: float, rotation: int, horizon: int) -> str:
    """A state's key as the reference controller writes it: "-0.00|1.25|45|30".

    Metres are rounded before they are formatted, so that -0.001 and -0.0 give "-0.00".
    """
    return f"{round(x, 2):0.2f}|{round(z, 2):0.2f}|{rotation:d}|{horizon:d}"


def state_keys(points: np.ndarray) -> list[str]:
    """Keys of all P * 16 states at points [P, 3], in the order of the tables."""
    return [
        state_key(float(x), float(z), *poses.ITHOR.degrees(poses.split(view)))
        for x, _, z in points
        for view in range(poses.VIEWS)
    ]


def is_view(rotation: int, horizon: int) -> bool:
    """Whether rotation and horizon, in degrees, are among those of the task."""
    return rotation in range(0, 360, 45) and horizon in (0, 30)


class Grid:
    """The reachable points of a scene, and the states that keys name."""

    def __init__(self, points: np.ndarray) -> None:
        self.points = points  # [P, 3] metres
        self._origin = points[0, [0, 2]]
        cells = np.rint((points[:, [0, 2]] - self._origin) / GRID_SIZE).astype(np.int64)
        self._index = {(int(x), int(z)): i for i, (x, z) in enumerate(cells)}
        self._known: dict[str, int] = {}

    def state(self, path: Path | str, key: object) -> int:
        """The state with a key; "-0.00" and "0.00" are equal.

        Raises:
          FileError: it is not a key, or its point is not on the grid.
        """
        if not isinstance(key, str):
            raise FileError(path, f"a state key that is not text: {key!r}")
        if key not in self._known:
            self._known[key] = self._parse(path, key)
        return self._known[key]

    def _parse(self, path: Path | str, key: str) -> int:
        match = _KEY.fullmatch(key)
        if match is None:
            raise FileError(path, f"state key {key!r} is not x|z|rotation|horizon")
        return self.state_at(path, float(match[1]), float(match[2]), int(match[3]), int(match[4]))

    def state_at(self, path: Path | str, x: float, z: float, rotation: int, horizon: int) -> int:
        """The state at a point in metres, with rotation and horizon in degrees.

        Raises:
          FileError: there is none.
        """
        key = state_key(x, z, rotation, horizon)
        if not is_view(rotation, horizon):
            raise FileError(path, f"state {key}: rotation or horizon is not one of the task's")
        point = self.point_at(x, z)
        if point is None:
            raise FileError(path, f"state {key} is not on the grid of grid.json")
        return poses.from_degrees(point, rotation, horizon)

    def point_at(self, x: float, z: float) -> int | None:
        """The reachable point at (x, z) metres, or None."""
        steps = (np.array([x, z]) - self._origin) / GRID_SIZE
        cell = np.rint(steps)
        if np.abs(steps - cell).max() * GRID_SIZE > ALIGNED:
            return None
        return self._index.get((int(cell[0]), int(cell[1])))
