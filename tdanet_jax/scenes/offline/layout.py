"""Folders, files and state keys of the original offline data; docs/data.md describes them all."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tdanet_jax import poses
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes.metadata import ALIGNED
from tdanet_jax.splits import SCENE_NUMBERS
from tdanet_jax.vocabulary import ROOM_TYPES

GRID_FILE, GRAPH_FILE, BOX_FILE = "grid.json", "graph.json", "objects_bb.json"
#: In order of preference: both names of the visibility map, then the raw metadata.
VISIBILITY_FILES = ("visible_object_map_1.5.json", "visible_object_map.json", "metadata.json")
#: Our addition: what the original layout lacks of our tables.
OBJECT_FILE = "objects.json"
FEATURE_FILE = "resnet18_featuremap.hdf5"
FEATURE_SHAPE = (512, 7, 7)
PARENT_FILE = "c2p_prob.json"
#: Names of `ROOM_TYPES` in `c2p_prob.json`, in the same order.
ROOM_NAMES = ("Kitchen", "Living_Room", "Bedroom", "Bathroom")

#: Called with the share that is done and a line of text.
Report = Callable[[float, str], None]

_SCENE = re.compile(r"FloorPlan(\d{1,4})(_physics)?")
_NUMBER = r"(-?\d{1,4}(?:\.\d{1,9})?)"
_KEY = re.compile(rf"{_NUMBER}\|{_NUMBER}\|(\d{{1,3}})(?:\.0)?\|(\d{{1,2}})(?:\.0)?")


def scene_of(name: str) -> tuple[str, int] | None:
    """Name and room type of an iTHOR scene, with or without "_physics", or None."""
    match = _SCENE.fullmatch(name)
    if match is None:
        return None
    number = int(match[1])
    for room_type, room in enumerate(ROOM_TYPES):
        if number in SCENE_NUMBERS[room]:
            return f"FloorPlan{number}", room_type
    return None


def find_root(folder: Path) -> Path:
    """The folder whose children are the scenes: `folder`, or one up to two levels inside it.

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
      FileError: two folders belong to one scene.
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
            raise FileError(path, "a state key that is not text")
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
        if rotation % 45 or not 0 <= rotation < 360 or horizon not in (0, 30):
            raise FileError(path, f"state {key}: rotation or horizon is not one of the task's")
        steps = (np.array([x, z]) - self._origin) / GRID_SIZE
        cell = np.rint(steps)
        point = self._index.get((int(cell[0]), int(cell[1])))
        if point is None or np.abs(steps - cell).max() * GRID_SIZE > ALIGNED:
            raise FileError(path, f"state {key} is not on the grid of grid.json")
        return poses.from_degrees(point, rotation, horizon)
