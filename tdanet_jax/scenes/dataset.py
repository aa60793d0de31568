"""A file of rooms: tables, and what else came with the data that they were imported from."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import archive, files
from tdanet_jax.io.untrusted import FileError, npz
from tdanet_jax.scenes import cache
from tdanet_jax.scenes.scene import MOST_CLASSES, Scene, SceneObject
from tdanet_jax.scenes.tables import Progress, SceneTables
from tdanet_jax.splits import PARTS, TRAIN_SCENES_PER_TYPE, VALIDATION_TRAIN_SCENES_PER_TYPE, Split
from tdanet_jax.vocabulary import ROOM_TYPES


@dataclasses.dataclass(frozen=True)
class PublishedEpisode:
    """One entry of the published lists of test episodes."""

    part: str  # "test" or "val"
    scene: str
    x: float  # metres
    z: float
    rotation: int  # degrees clockwise from +z, a multiple of 45
    horizon: int  # 0 or 30 degrees down
    target: str


@dataclasses.dataclass(frozen=True, eq=False)
class Extras:
    """What may come beside the rooms.

    Attributes:
      parents: room type -> target -> parent -> R_p, the partial reward itself.
      episodes: published test episodes.
      graph_classes: n class names, one for each row of `adjacency`.
      adjacency: [n, n] float32, the published class graph; [0, 0] if there is none.
      parts: room -> "train" or "test", for rooms that say it themselves.
    """

    parents: Mapping[str, Mapping[str, Mapping[str, float]]] = dataclasses.field(
        default_factory=dict
    )
    episodes: Sequence[PublishedEpisode] = ()
    graph_classes: tuple[str, ...] = ()
    adjacency: np.ndarray = dataclasses.field(default_factory=lambda: np.zeros((0, 0), np.float32))
    parts: Mapping[str, str] = dataclasses.field(default_factory=dict)

    def class_graph(self, classes: Sequence[str]) -> np.ndarray | None:
        """The class graph between `classes`: [C, C] float32, or None if there is none.

        Classes that the graph does not know have zero rows and columns.
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
    """Tables and what came beside them; nothing does beside the bundled ones.

    Attributes:
      path: the file that they were read from, beside which their feature maps lie; None if there
      is none.
    """

    tables: SceneTables
    extras: Extras | None
    path: Path | None = None


def load_rooms(path: str | Path | None, progress: Progress | None = None) -> Rooms:
    """The rooms of a file, or the bundled ones.

    Raises:
      FileError: it is no file of rooms.
    """
    if path is None:
        return Rooms(cache.load_tables(progress), None)
    return load(Path(path))


def save(rooms: Rooms, path: Path) -> None:
    """Writes a file of rooms; it appears whole or not at all."""
    extras = rooms.extras or Extras()
    notes = {
        "parents": extras.parents,
        "episodes": [dataclasses.astuple(episode) for episode in extras.episodes],
        "graph_classes": extras.graph_classes,
        "parts": extras.parts,
    }
    arrays = rooms.tables.to_arrays()
    arrays["extras/notes"] = np.frombuffer(json.dumps(notes).encode(), np.uint8)
    arrays["extras/adjacency"] = extras.adjacency
    with files.replacing(path) as fresh:
        archive.write(fresh, arrays, compress=True)


def load(path: Path) -> Rooms:
    """Reads a file of rooms, as `save` or `SceneTables.save` wrote it.

    Raises:
      FileError: it is no such file, or its numbers contradict each other.
    """
    arrays = npz.read(path)
    try:
        tables = SceneTables.from_arrays(arrays)
        problem = find_problem(tables)
        if problem is not None:
            raise FileError(path, f"not a file of rooms ({problem})")
        return Rooms(with_known_targets(tables), _read_extras(arrays), path)
    except FileError:
        raise
    except Exception as error:  # a missing array, a field of another kind, broken JSON
        raise FileError(path, f"not a file of rooms ({error})") from None


def _read_extras(arrays: Mapping[str, np.ndarray]) -> Extras:
    if "extras/notes" not in arrays:
        return Extras()
    notes = json.loads(arrays["extras/notes"].tobytes())
    names, adjacency = tuple(notes["graph_classes"]), arrays["extras/adjacency"]
    if adjacency.shape != (len(names), len(names)) or adjacency.dtype != np.float32:
        raise ValueError("the class graph does not match its names")
    parts = notes.get("parts", {})  # older files have none
    if not set(parts.values()) <= set(PARTS):
        raise ValueError(f"a room that is for neither of {', '.join(PARTS)}")
    return Extras(
        parents={
            str(room): {
                str(target): {str(name): float(reward) for name, reward in parents.items()}
                for target, parents in targets.items()
            }
            for room, targets in notes["parents"].items()
        },
        episodes=[PublishedEpisode(*values) for values in notes["episodes"]],
        graph_classes=names,
        adjacency=adjacency,
        parts=parts,
    )


def with_own_rooms(split: Split, rooms: Rooms, validation: bool = False) -> Split:
    """A split, to which the rooms belong that say themselves which part they are for.

    Other rooms stay what the split says by their names. With `validation`, those that say "test"
    are left out, and of those of a room type that say "train" the last fifth, as of iTHOR's, are
    evaluated.
    """
    tables, parts = rooms.tables, {} if rooms.extras is None else rooms.extras.parts
    train = [name for name in split.train_scenes if name not in parts]
    evaluated = [name for name in split.eval_scenes if name not in parts]
    for kind in range(len(ROOM_TYPES)):
        own = [n for n, k in zip(tables.scenes, tables.room_type, strict=True) if k == kind]
        mine = [name for name in own if parts.get(name) == "train"]
        rest = [name for name in own if parts.get(name) == "test"]
        if validation:
            first = len(mine) * VALIDATION_TRAIN_SCENES_PER_TYPE // TRAIN_SCENES_PER_TYPE
            mine, rest = mine[:first], mine[first:]
        train += mine
        evaluated += rest
    return dataclasses.replace(split, train_scenes=tuple(train), eval_scenes=tuple(evaluated))


def as_scene(tables: SceneTables) -> Scene:
    """The one room of some tables: its points, and its objects with their boxes in metres."""
    objects = tuple(
        SceneObject(name, tables.classes[tables.object_class[i]], box.reshape(2, 3))
        for i, (name, box) in enumerate(zip(tables.object_id, tables.object_box, strict=True))
    )
    return Scene(tables.scenes[0], int(tables.room_type[0]), tables.position, objects)


def find_problem(tables: SceneTables) -> str | None:
    """What contradicts the tables' own description, in a few words, or None."""
    sizes = {
        "R": len(tables.scenes), "P": len(tables.position), "O": len(tables.object_id),
        "N": len(tables.row_object), "S": tables.num_states, "G": len(tables.targets),
        "C": len(tables.classes), "T": len(ROOM_TYPES), "F": tables.image * tables.subpixel + 1,
    }  # fmt: skip
    for names in (tables.scenes, tables.classes, tables.targets, tables.object_id):
        if not isinstance(names, tuple) or not all(isinstance(name, str) for name in names):
            return "names that are no text"
    if min(sizes[letter] for letter in "RPOC") == 0 or len(tables.classes) > MOST_CLASSES:
        return f"no rooms, positions, objects or classes, or over {MOST_CLASSES} classes"
    for field, (dtype, shape, low, high) in _FIELDS.items():
        value: Any = getattr(tables, field)
        wanted = tuple(sizes.get(size, size) for size in shape)
        if field == "row_start":
            wanted = (sizes["S"] + 1,)
        if not isinstance(value, np.ndarray) or value.dtype != dtype or value.shape != wanted:
            return f"{field} is not {dtype} {wanted}"
        if high and value.size and not low <= value.min() <= value.max() < sizes[high]:
            return f"{field} points outside the tables"
    starts = tables.row_start
    if starts[0] != 0 or starts[-1] != sizes["N"] or (np.diff(starts) < 0).any():
        return "row_start does not divide the rows"
    if (np.diff(tables.position_scene) < 0).any() or not np.isfinite(tables.position).all():
        return "positions are not finite or not in the order of the rooms"
    if len(np.unique(tables.position_scene)) != sizes["R"]:
        return "a room without positions"
    return None


def with_known_targets(tables: SceneTables) -> SceneTables:
    """The tables without the targets that none of their classes is."""
    known = np.array([name in tables.classes for name in tables.targets], bool)
    return dataclasses.replace(
        tables,
        targets=tuple(name for name in tables.targets if name in tables.classes),
        distance=tables.distance[:, known],
    )


#: Field -> dtype, shape, least value, and the axis that its values are indices of.
_FIELDS: dict[str, tuple[str, tuple[Any, ...], int, str]] = {
    "room_type": ("int8", ("R",), 0, "T"),
    "position": ("float64", ("P", 3), 0, ""),
    "position_scene": ("int16", ("P",), 0, "R"),
    "next_position": ("int32", ("P", 8), 0, "P"),
    "row_start": ("int32", ("S",), 0, ""),
    "row_object": ("int32", ("N",), 0, "O"),
    "row_box": ("int16", ("N", 4), -1, "F"),
    "row_visible": ("bool", ("N",), 0, ""),
    "object_class": ("int16", ("O",), 0, "C"),
    "object_scene": ("int16", ("O",), 0, "R"),
    "object_box": ("float64", ("O", 6), 0, ""),
    "distance": ("int16", ("S", "G"), 0, ""),
    "raster": ("int8", ("S", 7, 7), -1, "C"),
}
