"""A set of rooms, as commands take it with --data: tables, and extras of imported data."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax import targets
from tdanet_jax.io import archive, files
from tdanet_jax.io.escaping import in_line
from tdanet_jax.io.untrusted import FileError, jsons, npz
from tdanet_jax.scenes import cache, ithor, metadata, records, tabulation
from tdanet_jax.scenes.metadata import FARTHEST
from tdanet_jax.scenes.records import Records
from tdanet_jax.scenes.room_names import Kinds, check_name
from tdanet_jax.scenes.scene import MOST_CLASSES, MOST_ROOM_TYPES, Scene, SceneError
from tdanet_jax.scenes.tables import FIELDS, SceneTables
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.scenes.target_distances import with_targets
from tdanet_jax.splits import (
    OPEN,
    PARTS,
    TRAIN_SCENES_PER_TYPE,
    VALIDATION_TRAIN_SCENES_PER_TYPE,
    Split,
    in_order,
    is_plain,
    make_split,
    open_classes,
)
from tdanet_jax.vocabulary import ALL_TARGETS, ROOM_TYPES, TARGETS


@dataclasses.dataclass(frozen=True)
class PublishedEpisode:
    """An entry of the published lists of test episodes."""

    part: str  # "test" or "val"
    scene: str
    x: float  # metres
    z: float
    rotation: int  # degrees clockwise from +z
    horizon: int  # degrees down
    target: str


@dataclasses.dataclass(frozen=True, eq=False)
class Extras:
    """What imported data may contain in addition to the rooms.

    Attributes:
      parents: room type -> target -> parent -> R_p, the partial reward itself.
      episodes: published test episodes.
      graph_classes: n class names, one for each row of `adjacency`.
      adjacency: [n, n] float32, the published class graph; [0, 0] without one.
      parts: room -> "train" or "test", for rooms whose scene file says it.
      targets: room type -> target classes, if the data say which they are.
      made: how the rooms were made, if they are variants or generated: names -> numbers and
        versions.
    """

    parents: Mapping[str, Mapping[str, Mapping[str, float]]] = dataclasses.field(
        default_factory=dict
    )
    episodes: Sequence[PublishedEpisode] = ()
    graph_classes: tuple[str, ...] = ()
    adjacency: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0), np.float32))
    parts: Mapping[str, str] = dataclasses.field(default_factory=dict)
    targets: Mapping[str, tuple[str, ...]] = dataclasses.field(default_factory=dict)
    made: Mapping[str, str | int] = dataclasses.field(default_factory=dict)

    @property
    def has_parents(self) -> bool:
        """Whether any target has a parent."""
        return any(names for targets in self.parents.values() for names in targets.values())

    def class_graph(self, classes: Sequence[str]) -> np.ndarray | None:
        """The class graph between `classes`: [C, C] float32, or None without one.

        Rows and columns of classes that are not in the graph are zero.
        """
        if not self.graph_classes:
            return None
        known = {name: i for i, name in enumerate(self.graph_classes)}
        here = np.array([i for i, name in enumerate(classes) if name in known], np.int64)
        there = np.array([known[classes[i]] for i in here], np.int64)
        graph = np.zeros((len(classes), len(classes)), np.float32)
        graph[np.ix_(here, here)] = self.adjacency[np.ix_(there, there)]
        return graph


@dataclasses.dataclass(frozen=True, eq=False)
class Rooms:
    """Scene tables, with the extras of imported data; the bundled rooms have none.

    Attributes:
      path: the file that they were read from, next to which their feature maps are; None if they
        are not from a file.
      records: what the tables do not say of the objects; None if it is not known. The bundled rooms
        have them in their own file.
    """

    tables: SceneTables
    extras: Extras | None
    path: Path | None = None
    records: Records | None = None

    def scenes(self, names: Collection[str]) -> list[Scene]:
        """Some of the rooms, in the order of the tables, with all that is known of their objects.

        Raises:
          SceneError: what lies on what is not known.
        """
        if self.extras is None:
            return [scene for scene in ithor.load_scenes() if scene.name in names]
        if self.records is None:
            raise SceneError(
                "these rooms do not say what lies on what: import them from a scene file"
            )
        return records.restore(self.records, self.tables, names, self.extras.parts)


def load_rooms(path: str | Path | None, progress: Progress | None = None) -> Rooms:
    """The rooms of a file that `save_rooms` or `SceneTables.save` wrote; None: the bundled rooms.

    Raises:
      FileError: the file is missing or broken, or its arrays are inconsistent.
    """
    if path is None:
        return Rooms(cache.load_tables(progress), None)
    path = Path(path)
    if path.suffix == ".json" and path.is_file():
        raise FileError(
            path, "a scene file: first run tdanet scenes import, which writes its rooms"
        )
    arrays = npz.read(path)
    try:
        tables = SceneTables.from_arrays(arrays)
        if problem := _find_problem(tables):
            raise ValueError(problem)
        known = records.from_arrays(arrays, tables)
        return Rooms(tables.with_known_targets(), _read_extras(arrays, tables), path, known)
    except Exception as error:  # a missing array, a field of another type, broken JSON
        raise FileError(path, f"not a file of rooms ({error})") from None


load = load_rooms  # its former name


def build_rooms(
    scene_file: Path | str, progress: Progress | None = None, kinds: Kinds | None = None
) -> Rooms:
    """The rooms of a scene file (JSON), see `metadata`.

    Args:
      progress: called with (rooms done, rooms in all).
      kinds: room types and parts of the rooms for which the file does not say them.

    Raises:
      SceneError: the file is broken, or its rooms break a rule.
    """
    scene_file = Path(scene_file)
    scenes = metadata.read_scenes(scene_file, kinds)
    try:
        tables = tabulation.build(scenes, progress=progress)
    except SceneError as error:
        raise SceneError(f"{scene_file}: {error}") from None
    for scene in scenes:
        if lacking := sorted({*scene.targets} - {*tables.classes}):
            raise SceneError(f"{scene_file}: {scene.name}: targets: no room holds a {lacking[0]}")
    parts = {s.name: s.part for s in scenes if s.part is not None}
    extras = Extras(parts=parts, targets=_own_targets(scenes))
    return Rooms(tables, extras, records=records.of_scenes(scenes))


def _own_targets(scenes: Sequence[Scene]) -> dict[str, tuple[str, ...]]:
    """Room type -> the targets that scenes with such rooms name; empty if none does."""
    named = {
        room: in_order(c for s in scenes if room in s.point_types for c in s.targets)
        for room in sorted({room for scene in scenes for room in scene.point_types})
    }
    return {room: names for room, names in named.items() if names}


def save_rooms(rooms: Rooms, path: Path | str) -> None:
    """Writes a file of rooms, atomically."""
    path = Path(path)
    extras = rooms.extras or Extras()
    notes = {
        "parents": extras.parents,
        "episodes": [dataclasses.astuple(episode) for episode in extras.episodes],
        "graph_classes": extras.graph_classes,
        "parts": extras.parts,
        "targets": extras.targets,
        **({"made": extras.made} if extras.made else {}),
    }
    arrays = rooms.tables.to_arrays()
    arrays["extras/notes"] = np.frombuffer(json.dumps(notes).encode(), np.uint8)
    arrays["extras/adjacency"] = extras.adjacency
    arrays |= records.to_arrays(rooms.records or {})
    with files.replacing(path) as temporary:
        archive.write(temporary, arrays, compress=True)


def _find_problem(tables: SceneTables) -> str | None:
    """What is inconsistent in the tables, in a few words, or None."""
    sizes = {
        "R": len(tables.scenes), "P": len(tables.position), "O": len(tables.object_id),
        "N": len(tables.row_object), "S": tables.num_states, "S + 1": tables.num_states + 1,
        "A": tables.grid.rotations, "G": len(tables.targets), "C": len(tables.classes),
        "T": len(tables.room_types), "F": tables.image * tables.subpixel + 1,
    }  # fmt: skip
    lists = (tables.scenes, tables.classes, tables.targets, tables.object_id, tables.room_types)
    for names in lists:
        if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
            return "names that are not text"
        if not all(name.isprintable() for name in names):
            return "names with control characters"
    for names in lists[:3]:
        if len(set(names)) < len(names):
            return "a room, class or target that is listed twice"
    for name in (*tables.scenes, *tables.targets, *tables.room_types):
        check_name(name)  # they become names of files
    angle, height = tables.field_of_view, tables.camera_height
    if not all(type(value) in (int, float) and 0 < value < 180 for value in (angle, height)):
        return "field_of_view or camera_height is not a number, or out of range"
    if not all(type(v) is int and 0 < v <= 10_000 for v in (tables.image, tables.subpixel)):
        return "image or subpixel is not a whole number, or out of range"
    if tables.room_types[: len(ROOM_TYPES)] != ROOM_TYPES or sizes["T"] > MOST_ROOM_TYPES:
        return f"other room types than iTHOR's come first, or there are over {MOST_ROOM_TYPES}"
    if len(set(tables.room_types)) != sizes["T"]:
        return "a room type that occurs twice"
    if min(sizes[letter] for letter in "RPOC") == 0 or sizes["C"] > MOST_CLASSES:
        return f"no rooms, positions, objects or classes, or over {MOST_CLASSES} classes"
    for field, (dtype, shape, low, high) in FIELDS.items():
        value: Any = getattr(tables, field)
        wanted = tuple(sizes.get(size, size) for size in shape)
        if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != wanted:
            return f"{field} is not {dtype} {wanted}"
        if high and value.size and not low <= value.min() <= value.max() < sizes[high]:
            return f"{field} points outside the tables"
    starts = tables.row_start
    if starts[0] != 0 or starts[-1] != sizes["N"] or (np.diff(starts) < 0).any():
        return "row_start does not divide the rows"
    if (np.diff(tables.position_scene) < 0).any() or (np.diff(tables.object_scene) < 0).any():
        return "positions or objects are not in the order of the rooms"
    if not (np.abs(tables.position) <= FARTHEST).all() or (np.abs(tables.object_box) > 2e3).any():
        return "a position or an object that is not finite or too far away"  # a box may be unknown
    if (tables.distance < -1).any():
        return "distance below -1"
    if len(np.unique(tables.position_scene)) != sizes["R"]:
        return "a room without positions"
    return None


def _read_extras(arrays: Mapping[str, np.ndarray], tables: SceneTables) -> Extras:
    if "extras/notes" not in arrays:
        return Extras()
    notes = jsons.parse("extras/notes", arrays["extras/notes"].tobytes().decode())
    names, adjacency = tuple(notes["graph_classes"]), arrays["extras/adjacency"]
    if adjacency.shape != (len(names), len(names)) or adjacency.dtype != np.float32:
        raise ValueError("the class graph does not match its names")
    if not (np.isfinite(adjacency) & (adjacency >= 0)).all():
        raise ValueError("the class graph has a weight that is not finite or below 0")
    if not all(isinstance(name, str) and name.isprintable() for name in names):
        raise ValueError("the class graph has names that are not text")
    parts = notes.get("parts", {})  # older files have none
    if not set(parts.values()) <= set(PARTS):
        raise ValueError(f"a room whose part is neither of {', '.join(PARTS)}")
    own = {room: tuple(names) for room, names in notes.get("targets", {}).items()}
    if not {*own} <= {*tables.room_types} or not {*sum(own.values(), ())} <= {*tables.classes}:
        raise ValueError("targets of a room type or of a class that it does not hold")
    made = notes.get("made", {})
    if not all(
        isinstance(v, str | int) and in_line(f"{k} {v}") == f"{k} {v}" for k, v in made.items()
    ):
        raise ValueError("how it was made is not in plain words and numbers")
    return Extras(
        parents={
            ROOM_TYPES[ROOM_TYPES.index(room)]: {
                target: {
                    name: jsons.number("parents", reward, name, 100)
                    for name, reward in parents.items()
                }
                for target, parents in targets.items()
            }
            for room, targets in notes["parents"].items()
        },
        episodes=[_read_episode(values) for values in notes["episodes"]],
        graph_classes=names,
        adjacency=adjacency,
        parts=parts,
        targets=own,
        made=made,
    )


def _read_episode(values: Sequence[Any]) -> PublishedEpisode:
    part, scene, x, z, rotation, horizon, target = values
    if not all(isinstance(text, str) for text in (part, scene, target)):
        raise ValueError("an episode whose part, scene or target is not text")
    x, z, *turns = (jsons.number("episodes", n, "a pose", 1000) for n in (x, z, rotation, horizon))
    return PublishedEpisode(part, scene, x, z, round(turns[0]), round(turns[1]), target)


def assign_rooms(split: Split, rooms: Rooms, validation: bool = False) -> Split:
    """The split, with the rooms for which the data say "train" or "test" in that part.

    All other rooms stay where the split has them by name. With `validation`, rooms for which the
    data say "test" are left out, and of those of a room type that say "train" the last fifth is for
    evaluation, as with iTHOR's rooms. Houses with rooms of several types are divided in the same
    way.
    """
    tables, parts = rooms.tables, {} if rooms.extras is None else rooms.extras.parts
    train = [name for name in split.train_scenes if name not in parts]
    evaluated = [name for name in split.eval_scenes if name not in parts]
    for kind in (*range(len(tables.room_types)), -1):
        own = [n for n, k in zip(tables.scenes, tables.room_type, strict=True) if k == kind]
        mine = [name for name in own if parts.get(name) == "train"]
        rest = [name for name in own if parts.get(name) == "test"]
        if validation:
            first = len(mine) * VALIDATION_TRAIN_SCENES_PER_TYPE // TRAIN_SCENES_PER_TYPE
            mine, rest = mine[:first], mine[first:]
        train += mine
        evaluated += rest
    return dataclasses.replace(split, train_scenes=tuple(train), eval_scenes=tuple(evaluated))


def find_targets(
    text: str, rooms: Rooms, validation: bool = False
) -> tuple[SceneTables, dict[str, tuple[str, ...]]]:
    """The tables with the targets that `--targets` asks for, and these targets by room type.

    Those of the paper are as it has them; in a room type of the data's own, they are those that its
    rooms hold, or houses with such a room. All others are those classes among the given ones that
    can be found in a training room of the type.

    Args:
      text: `TrainConfig.sought`. "paper" is what the data say themselves, if they say it.
      validation: as for `assign_rooms`.

    Raises:
      ValueError: a name means no class, or one that can be found in no training room (of the room
        type, if one is given).
    """
    tables, named = rooms.tables, text != targets.PAPER
    asked = {} if rooms.extras is None else dict(rooms.extras.targets)
    if not named and not asked:
        others = enumerate(tables.room_types[len(ROOM_TYPES) :], len(ROOM_TYPES))
        held = {room: _classes_in(tables, kind) for kind, room in others}
        return tables, TARGETS | {
            room: tuple(c for c in ALL_TARGETS if c in names) for room, names in held.items()
        }
    if text == OPEN:
        asked, named = open_classes()["targets"], False
        asked = {
            room: tuple(c for c in names if c in tables.classes) for room, names in asked.items()
        }
    elif named:
        asked = targets.parse(text)
    if unknown := [room for room in asked if room and room not in tables.room_types]:
        where = "--targets" if named else "the rooms' own targets:"
        raise ValueError(
            f"{where} {unknown[0]}: no room type of these rooms; there are "
            f"{', '.join(tables.room_types)}"
        )
    every = {name for name in tables.classes if is_plain(name)}
    meant = {
        label: targets.find(label, tables.classes) for names in asked.values() for label in names
    }
    wanted = {label: every if name is None else {name} for label, name in meant.items()}
    tables = with_targets(tables, in_order(name for names in wanted.values() for name in names))
    found = _found(tables, assign_rooms(make_split("22/0", validation), rooms, validation))
    chosen: dict[str, set[str]] = {room: set() for room in tables.room_types}
    for where, label in ((where, label) for where, names in asked.items() for label in names):
        there = {room: wanted[label] & found[room] for room in ([where] if where else found)}
        if named and not any(there.values()):
            of = f" of type {where}" if where else ""
            raise ValueError(f"--targets {label}: can be found in no training room{of}")
        for room, names in there.items():
            chosen[room] |= names
    return tables, {room: in_order(names) for room, names in chosen.items()}


def _found(tables: SceneTables, split: Split) -> dict[str, set[str]]:
    """Room type -> the tables' targets that can be found in a training room of the type."""
    trains = np.isin(np.array(tables.scenes), split.train_scenes)[tables.position_scene]  # [P]
    reachable, names = tables.reachable, np.array(tables.targets, object)
    return {
        room: {*names[reachable[trains & (tables.position_room_type == kind)].any(axis=0)]}
        for kind, room in enumerate(tables.room_types)
    }


def idle_rooms(tables: SceneTables, split: Split) -> list[str]:
    """The rooms of a split in which none of its targets can be found: no episode is there."""
    idle = set()
    for scenes, sought in (
        (split.train_scenes, [split.seen]),
        (split.eval_scenes, [split.seen, split.unseen]),
    ):
        for name in scenes:
            scene = tables.scenes.index(name)
            if not any(
                tables.reachable[tables.positions_in(scene, kind)][:, tables.targets.index(c)].any()
                for kind, room in enumerate(tables.room_types)
                for names in sought
                for c in names.get(room, ())
            ):
                idle.add(name)
    return [name for name in tables.scenes if name in idle]


def _classes_in(tables: SceneTables, room_type: int) -> set[str]:
    """The classes of the objects in the rooms of a type, and in houses with such a room."""
    scenes = tables.position_scene[tables.position_room_type == room_type]
    objects = np.isin(tables.object_scene, scenes)
    return {tables.classes[c] for c in np.unique(tables.object_class[objects])}
