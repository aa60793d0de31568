"""The tables that the agent's world consists of: all rooms, one after the other.

Axes: R scenes, P positions, S = P * 16 states, C classes, G targets, N detection rows,
O objects. A state's index is that of its pose, see poses.py.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax import poses
from tdanet_jax.io import archive
from tdanet_jax.io.untrusted import npz
from tdanet_jax.poses import VIEWS
from tdanet_jax.scenes.errors import SceneError
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT, MOST_CLASSES, Scene
from tdanet_jax.scenes.visibility.build import SUBPIXEL, Sight, look_around
from tdanet_jax.scenes.visibility.geometry import action_distances, next_positions, transitions
from tdanet_jax.scenes.visibility.raster import paint
from tdanet_jax.scenes.visibility.rules import RULES, Rules
from tdanet_jax.vocabulary import ALL_TARGETS, FIELD_OF_VIEW, IMAGE_SIZE

#: Rooms that are computed at once, where there are as many cores: 2 GB of memory.
MOST_WORKERS = 8

Progress = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True, eq=False)
class SceneTables:
    """Transitions, detections, visibility and distances of every state of every room."""

    scenes: tuple[str, ...]  # R names
    classes: tuple[str, ...]  # C names, sorted
    targets: tuple[str, ...]  # G names
    object_id: tuple[str, ...]  # O names, unique within a scene
    room_type: np.ndarray  # [R] int8, index into vocabulary.ROOM_TYPES
    position: np.ndarray  # [P, 3] float64, agent's x, y, z in metres
    position_scene: np.ndarray  # [P] int16, nondecreasing
    next_position: np.ndarray  # [P, 8] int32, where MoveAhead leads; itself when blocked
    row_start: np.ndarray  # [S + 1] int32, rows of state s are row_start[s]:row_start[s + 1]
    row_object: np.ndarray  # [N] int32, index of the object; by (class, object) in a state
    row_box: np.ndarray  # [N, 4] int16, x1, y1, x2, y2 in sixteenths of a pixel, y down;
    # all -1 where an object is known to be visible, but not where (imported data alone)
    row_visible: np.ndarray  # [N] bool, visible as AI2-THOR says it: within 1.5 m horizontally
    object_class: np.ndarray  # [O] int16
    object_scene: np.ndarray  # [O] int16
    object_box: np.ndarray  # [O, 6] float64, least then greatest corner in metres
    distance: np.ndarray  # [S, G] int16, fewest actions to see the target; 0 here, -1 no way
    raster: np.ndarray  # [S, 7, 7] int8, class of the image cell (row, column), -1 none
    field_of_view: float = FIELD_OF_VIEW  # degrees, horizontal and vertical
    camera_height: float = CAMERA_ABOVE_AGENT  # metres above the agent's y
    image: int = IMAGE_SIZE  # pixels, width and height of the frame
    subpixel: int = SUBPIXEL  # units of row_box in a pixel

    @property
    def num_states(self) -> int:
        """S, the number of states."""
        return len(self.position) * VIEWS

    @cached_property
    def row_class(self) -> np.ndarray:
        """Class of each detection row: [N] int16."""
        return self.object_class[self.row_object]

    @cached_property
    def row_state(self) -> np.ndarray:
        """State of each detection row: [N] int32."""
        counts = np.diff(self.row_start)
        return np.repeat(np.arange(self.num_states, dtype=np.int32), counts)

    @property
    def state_scene(self) -> np.ndarray:
        """Scene of each state: [S] int16."""
        return np.repeat(self.position_scene, VIEWS)

    @property
    def reachable(self) -> np.ndarray:
        """Whether the way from a position leads to where a target is seen: [P, G] bool."""
        return self.distance[poses.join(np.arange(len(self.position)))] >= 0

    def visible_bits(self) -> np.ndarray:
        """Classes visible in each state: [S, ceil(C / 32)] uint32, class c is bit c % 32."""
        visible = np.zeros((self.num_states, -(-len(self.classes) // 32) * 32), bool)
        visible[self.row_state[self.row_visible], self.row_class[self.row_visible]] = True
        octets = np.packbits(visible, axis=1, bitorder="little")
        return octets.view("<u4").astype(np.uint32)

    def nearest_state(self, scene: int, x: float, z: float, rotation: int, horizon: int = 0) -> int:
        """The state at a scene's reachable point nearest to (x, z) metres.

        Raises:
          SceneError: rotation is not a multiple of 45, or horizon neither 0 nor 30.
        """
        if rotation % 45:
            raise SceneError(f"rotation {rotation}: not a multiple of 45 degrees")
        if horizon not in (0, 30):
            raise SceneError(f"horizon {horizon}: neither 0 nor 30 degrees")
        here = np.flatnonzero(self.position_scene == scene)
        offset = self.position[here][:, [0, 2]] - (x, z)
        position = int(here[(offset**2).sum(axis=1).argmin()])
        return poses.from_degrees(position, rotation, horizon)

    @cached_property
    def data_version(self) -> str:
        """First 12 hex digits of the sha256 over the content of all fields."""
        digest = hashlib.sha256()
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                plain = np.ascontiguousarray(value.astype(value.dtype.newbyteorder("<")))
                digest.update(f"{field.name}{plain.dtype}{plain.shape}".encode())
                digest.update(plain.data)
            else:
                digest.update(f"{field.name}{json.dumps(value)}".encode())
        return digest.hexdigest()[:12]

    def subset(self, names: Iterable[str]) -> SceneTables:
        """The tables of the named scenes alone, in the order of this table.

        Raises:
          SceneError: a name is not among `scenes`.
        """
        wanted = set(names)
        for name in sorted(wanted - set(self.scenes)):
            raise SceneError(f"{name}: no such scene in these tables")
        scene_kept = np.array([name in wanted for name in self.scenes])
        kept_p = scene_kept[self.position_scene]
        kept_s = np.repeat(kept_p, VIEWS)
        kept_o = scene_kept[self.object_scene]
        kept_n = kept_o[self.row_object]
        new_scene = (np.cumsum(scene_kept) - 1).astype(np.int16)
        new_position = (np.cumsum(kept_p) - 1).astype(np.int32)
        new_object = (np.cumsum(kept_o) - 1).astype(np.int32)
        return dataclasses.replace(
            self,
            scenes=tuple(name for name in self.scenes if name in wanted),
            object_id=tuple(np.array(self.object_id, object)[kept_o]),
            room_type=self.room_type[scene_kept],
            position=self.position[kept_p],
            position_scene=new_scene[self.position_scene[kept_p]],
            next_position=new_position[self.next_position[kept_p]],
            row_start=_ends(np.diff(self.row_start)[kept_s]),
            row_object=new_object[self.row_object[kept_n]],
            row_box=self.row_box[kept_n],
            row_visible=self.row_visible[kept_n],
            object_class=self.object_class[kept_o],
            object_scene=new_scene[self.object_scene[kept_o]],
            object_box=self.object_box[kept_o],
            distance=self.distance[kept_s],
            raster=self.raster[kept_s],
        )

    def save(self, path: Path) -> None:
        """Write the tables as a compressed npz without pickles."""
        archive.write(path, self.to_arrays(), compress=True)

    @classmethod
    def load(cls, path: Path) -> SceneTables:
        """Read what `save` wrote."""
        return cls.from_arrays(npz.read(path))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All fields as named arrays; what is no array goes into `rest`, as JSON."""
        arrays: dict[str, np.ndarray] = {}
        rest: dict[str, object] = {}
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                arrays[field.name] = value
            else:
                rest[field.name] = value
        arrays["rest"] = np.frombuffer(json.dumps(rest).encode(), np.uint8)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> SceneTables:
        """What `to_arrays` gave; further arrays, under names with a slash, are left out."""
        own: dict[str, Any] = {name: a for name, a in arrays.items() if "/" not in name}
        rest = json.loads(own.pop("rest").tobytes())
        fields: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in rest.items()
        }
        return cls(**own, **fields)


def _ends(counts: np.ndarray) -> np.ndarray:
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


@dataclasses.dataclass(frozen=True, eq=False)
class Room:
    """One room's share of the tables, indices counted from the room's own first entry."""

    next_position: np.ndarray
    sight: Sight
    object_class: np.ndarray
    distance: np.ndarray
    raster: np.ndarray


def build(
    scenes: Sequence[Scene],
    classes: Sequence[str] | None = None,
    targets: Sequence[str] = ALL_TARGETS,
    rules: Rules = RULES,
    progress: Progress | None = None,
) -> SceneTables:
    """Compute the tables of `scenes`; equal scenes and rules give equal tables anywhere.

    Args:
      classes: the vocabulary; by default the classes that occur, sorted.
      progress: called with (rooms done, rooms in all).

    Raises:
      SceneError: there are more classes than the tables can number, or fewer than occur.
    """
    names = tuple(
        sorted({item.object_class for scene in scenes for item in scene.objects})
        if classes is None
        else classes
    )

    if len(names) > MOST_CLASSES:
        raise SceneError(f"{len(names)} classes, more than {MOST_CLASSES}")

    def work(scene: Scene) -> Room:
        return _build_room(scene, names, targets, rules)

    rooms = []
    with ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, MOST_WORKERS)) as pool:
        for room in pool.map(work, scenes):
            rooms.append(room)
            if progress is not None:
                progress(len(rooms), len(scenes))
    return join(scenes, rooms, names, tuple(targets))


def _build_room(
    scene: Scene, classes: tuple[str, ...], targets: Sequence[str], rules: Rules
) -> Room:
    known = set(classes)
    for item in scene.objects:
        if item.object_class not in known:
            raise SceneError(
                f"{scene.name}: {item.object_id}: class {item.object_class} is not known"
            )
    sight, steps = look_around(scene, rules), next_positions(scene.points)
    return tabulate(scene, steps, sight, classes, targets)


def tabulate(
    scene: Scene,
    next_position: np.ndarray,
    sight: Sight,
    classes: tuple[str, ...],
    targets: Sequence[str],
) -> Room:
    """One room's share of the tables.

    Args:
      next_position: [P, 8] where MoveAhead leads. sight: what is seen from each state.
      classes: the vocabulary, with all classes of the room; at most `MOST_CLASSES`.
    """
    index = {name: i for i, name in enumerate(classes)}
    object_class = np.array([index[item.object_class] for item in scene.objects], np.int16)
    states = len(scene.points) * VIEWS
    goals = np.zeros((states, len(targets)), bool)
    for g, target in enumerate(targets):
        seen = sight.visible & (object_class[sight.owner] == index.get(target, -1))
        goals[sight.state[seen], g] = True
    return Room(
        next_position=next_position,
        sight=sight,
        object_class=object_class,
        distance=action_distances(transitions(next_position), goals),
        raster=paint(
            sight.state, sight.box, object_class[sight.owner], states, IMAGE_SIZE * SUBPIXEL
        ),
    )


def join(
    scenes: Sequence[Scene],
    rooms: Sequence[Room],
    classes: tuple[str, ...],
    targets: tuple[str, ...],
) -> SceneTables:
    """The tables of all rooms, one after the other, from each room's share."""
    points = [len(scene.points) for scene in scenes]
    objects = [len(scene.objects) for scene in scenes]
    first_point = np.concatenate([[0], np.cumsum(points)])
    first_object = np.concatenate([[0], np.cumsum(objects)])
    counts = [
        np.bincount(room.sight.state, minlength=p * VIEWS)
        for room, p in zip(rooms, points, strict=True)
    ]
    return SceneTables(
        scenes=tuple(scene.name for scene in scenes),
        classes=classes,
        targets=targets,
        object_id=tuple(item.object_id for scene in scenes for item in scene.objects),
        room_type=np.array([scene.room_type for scene in scenes], np.int8),
        position=np.concatenate([scene.points for scene in scenes]),
        position_scene=np.repeat(np.arange(len(scenes), dtype=np.int16), points),
        next_position=np.concatenate(
            [room.next_position + first_point[i] for i, room in enumerate(rooms)]
        ).astype(np.int32),
        row_start=_ends(np.concatenate(counts)),
        row_object=np.concatenate(
            [room.sight.owner + first_object[i] for i, room in enumerate(rooms)]
        ).astype(np.int32),
        row_box=np.concatenate([room.sight.box for room in rooms]),
        row_visible=np.concatenate([room.sight.visible for room in rooms]),
        object_class=np.concatenate([room.object_class for room in rooms]),
        object_scene=np.repeat(np.arange(len(scenes), dtype=np.int16), objects),
        object_box=np.array(
            [item.box.reshape(6) for scene in scenes for item in scene.objects],
            np.float64,
        ),
        distance=np.concatenate([room.distance for room in rooms]),
        raster=np.concatenate([room.raster for room in rooms]),
    )
