"""Scene tables: everything that an agent's world consists of, for all rooms one after the other.

Axes: R scenes, P positions, S states (P times the grid's views), C classes, G targets, N detection
rows, O objects. The index of a state is that of its pose, see poses.py.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import archive
from tdanet_jax.io.untrusted import jsons, npz
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT, SUBPIXEL, Scene, SceneError, SceneObject
from tdanet_jax.vocabulary import FIELD_OF_VIEW, IMAGE_SIZE, ROOM_TYPES

#: Field -> dtype, shape, least value, and the axis that its values are indices of. In addition to
#: the axes above, T are the room types, A the rotations and F the units of `row_box` along the
#: image.
FIELDS: dict[str, tuple[str, tuple[Any, ...], int, str]] = {
    "position_room_type": ("int8", ("P",), 0, "T"),
    "position": ("float64", ("P", 3), 0, ""),
    "position_scene": ("int16", ("P",), 0, "R"),
    "next_position": ("int32", ("P", "A"), 0, "P"),
    "row_start": ("int32", ("S + 1",), 0, ""),
    "row_object": ("int32", ("N",), 0, "O"),
    "row_box": ("int16", ("N", 4), -1, "F"),
    "row_visible": ("bool", ("N",), 0, ""),
    "object_class": ("int16", ("O",), 0, "C"),
    "object_scene": ("int16", ("O",), 0, "R"),
    "object_box": ("float64", ("O", 6), 0, ""),
    "distance": ("int16", ("S", "G"), 0, ""),
    "raster": ("int8", ("S", 7, 7), -1, "C"),
}
#: Fields that the first tables did not have.
_LATER = {"grid", "room_types"}


@dataclasses.dataclass(frozen=True, eq=False)
class SceneTables:
    """Transitions, detections, visibility and distances of every state of every room."""

    scenes: tuple[str, ...]  # R names
    classes: tuple[str, ...]  # C names, sorted
    targets: tuple[str, ...]  # G names
    object_id: tuple[str, ...]  # O names, unique within a scene
    position_room_type: np.ndarray  # [P] int8, index into `room_types`
    position: np.ndarray  # [P, 3] float64, agent's x, y, z in metres
    position_scene: np.ndarray  # [P] int16, nondecreasing
    next_position: np.ndarray  # [P, rotations] int32, where MoveAhead leads; itself when blocked
    row_start: np.ndarray  # [S + 1] int32, rows of state s are row_start[s]:row_start[s + 1]
    row_object: np.ndarray  # [N] int32, index of the object; by (class, object) in a state
    row_box: np.ndarray  # [N, 4] int16, x1, y1, x2, y2 in sixteenths of a pixel, y down;
    # all -1 where imported data say that an object is visible but have no box for it
    row_visible: np.ndarray  # [N] bool, visible in the sense of AI2-THOR: also within 1.5 m
    object_class: np.ndarray  # [O] int16
    object_scene: np.ndarray  # [O] int16
    object_box: np.ndarray  # [O, 6] float64, lower then upper corner in metres
    distance: np.ndarray  # [S, G] int16, fewest actions until the target is visible, -1 never
    raster: np.ndarray  # [S, 7, 7] int8, class in the image cell (row, column), -1 none
    field_of_view: float = FIELD_OF_VIEW  # degrees, horizontal and vertical
    camera_height: float = CAMERA_ABOVE_AGENT  # metres above the agent's y
    image: int = IMAGE_SIZE  # pixels, width and height of the frame
    subpixel: int = SUBPIXEL  # units of row_box in a pixel
    grid: PoseGrid = ITHOR  # the poses at a position, and the steps between positions
    room_types: tuple[str, ...] = ROOM_TYPES  # T names: iTHOR's four, then others, sorted

    @property
    def num_states(self) -> int:
        """S, the number of states."""
        return len(self.position) * self.grid.views

    @property
    def room_type(self) -> np.ndarray:
        """Room type of each scene: [R] int8; -1 for a house with rooms of several types."""
        kind = np.full(len(self.scenes), -1, np.int8)
        kind[self.position_scene] = self.position_room_type
        kind[self.position_scene[kind[self.position_scene] != self.position_room_type]] = -1
        return kind

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
        return np.repeat(self.position_scene, self.grid.views)

    @property
    def reachable(self) -> np.ndarray:
        """Whether a target can be reached from a position: [P, G] bool."""
        return self.distance[self.grid.look_level(np.arange(len(self.position)))] >= 0

    def room_at(self, state: int) -> str:
        """The room type of a state."""
        return self.room_types[self.position_room_type[self.grid.split(state).position]]

    def positions_in(self, scene: int, room_type: int) -> np.ndarray:
        """The positions in a scene's rooms of a type: [n] int."""
        return np.flatnonzero(
            (self.position_scene == scene) & (self.position_room_type == room_type)
        )

    def visible_bits(self) -> np.ndarray:
        """Classes visible in each state: [S, ceil(C / 32)] uint32, class c is bit c % 32."""
        visible = np.zeros((self.num_states, -(-len(self.classes) // 32) * 32), bool)
        visible[self.row_state[self.row_visible], self.row_class[self.row_visible]] = True
        octets = np.packbits(visible, axis=1, bitorder="little")
        return octets.view("<u4").astype(np.uint32)

    def nearest_state(self, scene: int, x: float, z: float, rotation: int, horizon: int = 0) -> int:
        """The state at a scene's reachable point nearest to (x, z) metres.

        Raises:
          ValueError: the grid has no such rotation or horizon.
        """
        view = self.grid.nearest_view(rotation, horizon)
        here = np.flatnonzero(self.position_scene == scene)
        offset = self.position[here][:, [0, 2]] - (x, z)
        position = int(here[(offset**2).sum(axis=1).argmin()])
        return self.grid.join(position, *view)

    @cached_property
    def data_version(self) -> str:
        """First 12 hex digits of the sha256 of all fields."""
        digest = hashlib.sha256()
        for name, value in self._stored():
            if isinstance(value, np.ndarray):
                plain = np.ascontiguousarray(value.astype(value.dtype.newbyteorder("<")))
                digest.update(f"{name}{plain.dtype}{plain.shape}".encode())
                digest.update(plain.data)
            else:
                digest.update(f"{name}{json.dumps(value)}".encode())
        return digest.hexdigest()[:12]

    def _stored(self) -> Iterator[tuple[str, Any]]:
        """The fields as arrays and as plain values for JSON.

        Without those of `_LATER` that have their defaults, and with the types of scenes in place of
        those of positions if they say the same, so that the tables of iTHOR's rooms are the same as
        before there were such fields.
        """
        for field in dataclasses.fields(self):
            name, value = field.name, getattr(self, field.name)
            if name == "position_room_type" and (self.room_type >= 0).all():
                name, value = "room_type", self.room_type
            if name not in _LATER or value != field.default:
                plain = dataclasses.is_dataclass(value) and not isinstance(value, type)
                yield name, dataclasses.asdict(value) if plain else value

    def subset(self, names: Iterable[str]) -> SceneTables:
        """The tables of the named scenes only, in the order of these tables.

        Raises:
          SceneError: a name is not among `scenes`.
        """
        wanted = set(names)
        for name in sorted(wanted - set(self.scenes)):
            raise SceneError(f"{name}: no such scene in these tables")
        scenes = np.array([name in wanted for name in self.scenes])
        positions, objects = scenes[self.position_scene], scenes[self.object_scene]
        kept = {
            "R": scenes, "P": positions, "S": np.repeat(positions, self.grid.views),
            "O": objects,
            "N": objects[self.row_object],
        }  # fmt: skip
        arrays: dict[str, Any] = {
            "row_start": row_offsets(np.diff(self.row_start)[kept["S"]]),
            "object_id": tuple(np.array(self.object_id, object)[objects]),
        }
        for field, (dtype, shape, _, indexed) in FIELDS.items():
            if field not in arrays:
                arrays[field] = getattr(self, field)[kept[shape[0]]]
            if indexed in kept:
                arrays[field] = (np.cumsum(kept[indexed]) - 1).astype(dtype)[arrays[field]]
        names = tuple(name for name in self.scenes if name in wanted)
        return dataclasses.replace(self, scenes=names, **arrays)

    def with_known_targets(self) -> SceneTables:
        """The tables without the targets that are not among the classes."""
        known = np.array([name in self.classes for name in self.targets], bool)
        return dataclasses.replace(
            self,
            targets=tuple(name for name in self.targets if name in self.classes),
            distance=self.distance[:, known],
        )

    def as_scene(self, number: int = 0) -> Scene:
        """One scene of these tables: its points, and its objects with their boxes."""
        here = self.position_scene == number
        types = [self.room_types[kind] for kind in self.position_room_type[here]]
        objects = tuple(
            SceneObject(
                self.object_id[i],
                self.classes[self.object_class[i]],
                self.object_box[i].reshape(2, 3),
            )
            for i in np.flatnonzero(self.object_scene == number)
        )
        return Scene(
            self.scenes[number],
            types[0] if len({*types}) == 1 else tuple(types),
            self.position[here],
            objects,
            grid=self.grid,
        )

    def save(self, path: Path | str) -> None:
        """Writes the tables as a compressed npz without pickles."""
        path = Path(path)
        archive.write(path, self.to_arrays(), compress=True)

    @classmethod
    def load(cls, path: Path | str) -> SceneTables:
        """Reads what `save` wrote."""
        path = Path(path)
        return cls.from_arrays(npz.read(path))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All fields as named arrays; fields that are not arrays go into `rest`, as JSON."""
        arrays: dict[str, np.ndarray] = {}
        rest: dict[str, object] = {}
        for name, value in self._stored():
            if isinstance(value, np.ndarray):
                arrays[name] = value
            else:
                rest[name] = value
        arrays["rest"] = np.frombuffer(json.dumps(rest).encode(), np.uint8)
        return arrays

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, np.ndarray]) -> SceneTables:
        """The tables from `to_arrays`; arrays with a slash in their names are ignored."""
        own: dict[str, Any] = {name: a for name, a in arrays.items() if "/" not in name}
        if "room_type" in own:
            own["position_room_type"] = own.pop("room_type")[own["position_scene"]]
        rest = jsons.parse("rest", own.pop("rest").tobytes().decode())
        fields: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in rest.items()
        }
        if "grid" in fields:
            values = fields["grid"]
            fields["grid"] = PoseGrid(**values | {"horizons": tuple(values["horizons"])})
        return cls(**own, **fields)


def row_offsets(counts: np.ndarray) -> np.ndarray:
    """`row_start` from the number of detections in each state [S]: [S + 1] int32."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
