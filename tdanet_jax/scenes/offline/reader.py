"""One scene's folder in the original layout, as arrays."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax import poses
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.poses import GRID_SIZE, HORIZONS, ROTATIONS, STEPS, VIEWS
from tdanet_jax.scenes.errors import SceneError
from tdanet_jax.scenes.metadata import FARTHEST, check_points
from tdanet_jax.scenes.offline.layout import (
    BOX_FILE,
    GRAPH_FILE,
    GRID_FILE,
    OBJECT_FILE,
    VISIBILITY_FILES,
    Grid,
    first_file,
)
from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.scenes.visibility.build import SUBPIXEL, Sight
from tdanet_jax.scenes.visibility.geometry import transitions
from tdanet_jax.vocabulary import IMAGE_SIZE

#: The box of an object that is known to be visible, but not where.
NO_BOX = (-1, -1, -1, -1)
#: Pixels by which a box may leave the image; it is clipped.
OVERHANG = 1.0
MOST_OBJECTS, MOST_POINTS = 20_000, 20_000


@dataclasses.dataclass(frozen=True, eq=False)
class SceneData:
    """What a folder holds."""

    scene: Scene
    next_position: np.ndarray  # [P, 8] int32
    sight: Sight
    found: tuple[str, ...]  # what was there
    noted: tuple[str, ...]  # what was not, or is odd


@dataclasses.dataclass
class _Visibility:
    """Objects of a scene, and the states that they are visible from."""

    kinds: dict[str, str]  # id -> class
    places: dict[str, np.ndarray]  # id -> [2, 3] box in metres, or NaN
    states: dict[str, set[int]]  # id -> states


def read_scene(folder: Path, name: str, room_type: int) -> SceneData:
    """Reads a scene's folder, one file after the other.

    Raises:
      FileError: a file is missing, broken, or contradicts another; names file and reason.
    """
    grid = read_grid(folder / GRID_FILE)
    next_position, odd = read_graph(folder / GRAPH_FILE, grid)
    source = first_file(folder, VISIBILITY_FILES)
    if source is None:
        raise FileError(folder, f"none of {', '.join(VISIBILITY_FILES)}")
    known = read_visibility(source, grid)
    found = [f"{len(grid.points)} points", f"{source.name} ({len(known.kinds)} objects)"]
    noted = list(odd)
    owners: dict[int, list[str]] | None = None
    if (folder / OBJECT_FILE).is_file():
        owners = read_objects(folder / OBJECT_FILE, grid, known)
        found.append(OBJECT_FILE)
    boxes: Iterator[tuple[int, dict[str, np.ndarray]]] = iter(())
    if (folder / BOX_FILE).is_file():
        boxes = read_boxes(folder / BOX_FILE, grid)
    else:
        noted.append(f"no {BOX_FILE}, so no detections")
    rows = _Rows(folder / BOX_FILE, known, owners)
    rows.add(boxes)
    scene, sight = rows.finish(name, room_type, grid.points)
    boxed = int((sight.box[:, 0] >= 0).sum())
    if boxed:
        found.append(f"{BOX_FILE} ({boxed} boxes)")
    if boxed and len(sight.box) > boxed:
        noted.append(f"{len(sight.box) - boxed} times an object is visible and has no box")
    return SceneData(scene, next_position, sight, tuple(found), tuple(noted))


def read_grid(path: Path) -> Grid:
    """The reachable points of `grid.json`.

    Raises:
      FileError: they are not x, y, z in metres on a grid of 0.25 m.
    """
    content = jsons.load(path)
    if not isinstance(content, list) or len(content) > MOST_POINTS:
        raise FileError(path, "not a list of points")
    points = np.empty((len(content), 3))
    for i, point in enumerate(content):
        if not isinstance(point, Mapping):
            raise FileError(path, f"point {i} is not x, y, z")
        for axis, letter in enumerate("xyz"):
            what = f"{letter} of point {i}"
            points[i, axis] = jsons.number(path, point.get(letter), what, FARTHEST)
    try:
        return Grid(check_points("points", points))
    except SceneError as error:
        raise FileError(path, error) from None


def read_graph(path: Path, grid: Grid) -> tuple[np.ndarray, list[str]]:
    """Where MoveAhead leads from each point along each heading: [P, 8] int32; and oddities.

    The reference controller takes a step if a link leads to the state that the step would reach,
    so links that are no step of the five moving actions have no effect, there as here.

    Raises:
      FileError: it is no node-link graph, or a link leads to a missing node.
    """
    content = jsons.load(path)
    if not isinstance(content, Mapping):
        raise FileError(path, "not a node-link graph")
    nodes, links = content.get("nodes"), content.get("links", content.get("edges"))
    if not isinstance(nodes, list) or not isinstance(links, list):
        raise FileError(path, "not a node-link graph (no nodes and links)")
    names = [node.get("id") if isinstance(node, Mapping) else None for node in nodes]
    states = {str(name): grid.state(path, name) for name in names}
    order = [states[str(name)] for name in names]

    def end(link: Any, side: str) -> int:
        value = link.get(side) if isinstance(link, Mapping) else None
        if isinstance(value, str) and value in states:
            return states[value]
        # Before networkx 2 a link's ends were places in the list of nodes.
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(order):
            return order[value]
        raise FileError(path, f"a link's {side} {value!r} is not among the nodes")

    pairs = np.array([(end(link, "source"), end(link, "target")) for link in links], np.int64)
    pairs = pairs.reshape(-1, 2)
    if content.get("directed") is False:
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
    return _steps(grid, pairs, set(order))


def _steps(grid: Grid, pairs: np.ndarray, nodes: set[int]) -> tuple[np.ndarray, list[str]]:
    count = len(grid.points)
    source, target = pairs.T
    (place, heading, horizon), end = poses.split(source), poses.split(target)
    moved = (grid.points[end.position] - grid.points[place])[:, [0, 2]] / GRID_SIZE
    straight = (heading == end.rotation) & (horizon == end.horizon) & (source != target)
    step = straight & (np.abs(moved - STEPS[heading]).max(axis=1, initial=0) < 0.5)
    result = np.repeat(np.arange(count, dtype=np.int32)[:, None], ROTATIONS, axis=1)
    result[place[step], heading[step]] = end.position[step]
    opened = np.zeros((count, ROTATIONS, HORIZONS), bool)
    opened[place[step], heading[step], horizon[step]] = True
    turns = transitions(result)[:, 1:]  # [S, 4]
    size = count * VIEWS
    tail = np.repeat(np.array(sorted(nodes), np.int64), turns.shape[1])
    head = turns[sorted(nodes)].reshape(-1)
    expected = np.unique((tail * size + head)[tail != head])
    linked = source * size + target
    counts = {
        "states not in the graph": size - len(nodes),
        "steps at one horizon alone, taken as open at both": (
            opened[..., 0] ^ opened[..., 1]
        ).sum(),
        "turns without a link, taken as possible": (~np.isin(expected, linked)).sum(),
        "links that no action takes, left out": (~step & ~np.isin(linked, expected)).sum(),
    }
    return result, [f"{number} {what}" for what, number in counts.items() if number]


def read_visibility(path: Path, grid: Grid) -> _Visibility:
    """Objects and where they are visible from, of a visibility map or of raw metadata.

    Which of the two a file is shows in its first member, as in the reference: a list of states
    under an object's id, or an event under a state's key.

    Raises:
      FileError: it is neither.
    """
    known = _Visibility({}, {}, defaultdict(set))
    for name, value in jsons.members(path):
        if isinstance(value, list):
            _add_object(path, known, name, class_of(name), place_in(name))
            known.states[name] |= {grid.state(path, key) for key in value}
        elif isinstance(value, Mapping) and isinstance(value.get("objects"), list):
            state = grid.state(path, name)
            for record in value["objects"]:
                _add_record(path, known, record, state)
        else:
            raise FileError(path, f"{name}: neither a list of states nor an event's metadata")
    if not known.kinds:
        raise FileError(path, "no objects")
    return known


def _add_record(path: Path, known: _Visibility, record: Any, state: int) -> None:
    if not isinstance(record, Mapping) or not isinstance(record.get("visible"), bool):
        raise FileError(path, "an object without objectId, objectType or visible")
    name, kind = record.get("objectId"), record.get("objectType")
    if not isinstance(name, str) or not isinstance(kind, str) or not name or not kind:
        raise FileError(path, "an object without objectId, objectType or visible")
    if name not in known.kinds:
        _add_object(path, known, name, kind, place_in(name))
    if record["visible"]:
        known.states[name].add(state)


def _add_object(path: Path, known: _Visibility, name: str, kind: str, place: np.ndarray) -> None:
    if not name or not kind or len(known.kinds) >= MOST_OBJECTS:
        raise FileError(path, "an object without a name, or too many objects")
    known.kinds[name] = kind
    known.places[name] = place


def class_of(name: str) -> str:
    """The class in an object's id: the first part, or the last if that is a name.

    "Mug|+00.10|+00.93|-01.20" is a Mug, "Sink|+00.10|+00.93|-01.20|SinkBasin" a SinkBasin,
    "Apple|+00.10|+00.93|-01.20|AppleSliced_3" an AppleSliced.
    """
    parts = name.split("|")
    last = parts[-1].rpartition("_")[0] or parts[-1]
    return last if len(parts) > 4 and last.isalpha() else parts[0]


def place_in(name: str) -> np.ndarray:
    """The place in an object's id, as a box [2, 3] without extent in metres; NaN without one."""
    try:
        place = np.array([float(part) for part in name.split("|")[1:4]])
    except ValueError:
        place = np.empty(0)
    if place.shape != (3,) or not (np.abs(place) <= FARTHEST).all():
        place = np.full(3, np.nan)
    return np.stack([place, place])


def read_objects(path: Path, grid: Grid, known: _Visibility) -> dict[int, list[str]]:
    """Adds the objects of our own `objects.json`; the ids behind each state's boxes, in order.

    Raises:
      FileError: it does not fit the other files.
    """
    content = jsons.load(path)
    objects = content.get("objects") if isinstance(content, Mapping) else None
    instances = content.get("instances") if isinstance(content, Mapping) else None
    if not isinstance(objects, Mapping) or not isinstance(instances, Mapping):
        raise FileError(path, "no objects and instances")
    names = list(objects)
    for name, record in objects.items():
        if not isinstance(record, Mapping) or not isinstance(record.get("objectType"), str):
            raise FileError(path, f"{name}: no objectType")
        _add_object(path, known, name, record["objectType"], _extent(path, name, record))
    owners = {}
    for key, places in instances.items():
        if not isinstance(places, list) or not all(
            type(i) is int and 0 <= i < len(names) for i in places
        ):
            raise FileError(path, f"{key}: not places in the list of objects")
        owners[grid.state(path, key)] = [names[i] for i in places]
    return owners


def _extent(path: Path, name: str, record: Mapping[str, Any]) -> np.ndarray:
    """An object's box [2, 3] in metres, NaN if it is not known."""
    box = record.get("box")
    if box is None:
        return np.full((2, 3), np.nan)
    if not isinstance(box, list) or len(box) != 6:
        raise FileError(path, f"{name}: a box is six numbers")
    numbers = [jsons.number(path, value, f"{name}: a box's number", FARTHEST) for value in box]
    return np.array(numbers).reshape(2, 3)


def read_boxes(path: Path, grid: Grid) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """State and class -> boxes [n, 4] in table units (sixteenths of a pixel), state by state.

    Raises:
      FileError: a number is missing, not finite or outside the image.
    """
    for key, groups in jsons.members(path):
        state = grid.state(path, key)
        if not isinstance(groups, Mapping):
            raise FileError(path, f"{key}: not classes with boxes")
        yield state, {name: _boxes(path, key, name, flat) for name, flat in groups.items()}


def _boxes(path: Path, key: str, name: str, flat: Any) -> np.ndarray:
    where = f"{key}: {name}"
    if not name or not isinstance(flat, list) or len(flat) % 4 or len(flat) > 4 * MOST_OBJECTS:
        raise FileError(path, f"{where}: not four numbers a box")
    if not all(type(value) in (int, float) for value in flat):
        raise FileError(path, f"{where}: a pixel that is no number")
    pixels = np.array([min(max(value, -1e6), 1e6) for value in flat], np.float64).reshape(-1, 4)
    inside = (pixels >= -OVERHANG) & (pixels <= IMAGE_SIZE + OVERHANG)  # False for NaN
    if not inside.all():
        raise FileError(path, f"{where}: a pixel that is not finite or not in the image")
    pixels = np.clip(pixels, 0, IMAGE_SIZE)
    corners = np.hstack([np.minimum(pixels[:, :2], pixels[:, 2:]),
                         np.maximum(pixels[:, :2], pixels[:, 2:])])  # fmt: skip
    return np.rint(corners * SUBPIXEL).astype(np.int16)


class _Rows:
    """Joins boxes, which are known by class, to objects, which are known by id.

    Where the files do not say whose a box is, the largest boxes of a class go to its visible
    objects (they are near), the others to its other objects, and to nameless ones if there are
    more boxes than names. A visible object without a box gets a row with `NO_BOX`.
    """

    def __init__(self, path: Path, known: _Visibility, owners: dict[int, list[str]] | None) -> None:
        self._path = path
        self._known = known
        self._owners = owners
        self._by_kind: dict[str, list[str]] = defaultdict(list)
        for name in sorted(known.kinds):
            self._by_kind[known.kinds[name]].append(name)
        self._visible: dict[int, set[str]] = defaultdict(set)
        for name, states in known.states.items():
            for state in states:
                self._visible[state].add(name)
        self._rows: list[tuple[int, str, tuple[int, ...], bool]] = []

    def add(self, boxes: Iterator[tuple[int, dict[str, np.ndarray]]]) -> None:
        """Adds the rows of every state: those with boxes, then what is visible without one."""
        done = set()
        for state, groups in boxes:
            if state in done:  # under "0.00" and "-0.00"
                continue
            done.add(state)
            visible = self._visible.get(state, set())
            for name, box in self._assign(state, groups, visible):
                self._rows.append((state, name, box, name in visible))
        for state in self._visible.keys() - done:
            self._rows += [(state, name, NO_BOX, True) for name in self._visible[state]]

    def _assign(
        self, state: int, groups: dict[str, np.ndarray], visible: set[str]
    ) -> list[tuple[str, tuple[int, ...]]]:
        """Each box of a state with its object, and the visible objects that have none."""
        if self._owners is not None:
            pairs = self._named(state, groups)
        else:
            pairs = [pair for kind, boxes in groups.items() for pair in
                     self._guessed(kind, boxes, visible)]  # fmt: skip
        with_box = {name for name, _ in pairs}
        return pairs + [(name, NO_BOX) for name in sorted(visible - with_box)]

    def _named(self, state: int, groups: dict[str, np.ndarray]) -> list:
        owners = (self._owners or {}).get(state, [])
        kinds = [kind for kind, boxes in groups.items() for _ in boxes]
        flat = [tuple(box) for boxes in groups.values() for box in boxes.tolist()]
        if [self._known.kinds[name] for name in owners] != kinds or len(set(owners)) != len(owners):
            raise FileError(self._path, f"the boxes do not fit {OBJECT_FILE}")
        return list(zip(owners, flat, strict=True))

    def _guessed(self, kind: str, boxes: np.ndarray, visible: set[str]) -> list:
        names = self._by_kind[kind]
        number = 0
        while len(names) < len(boxes):
            nameless = f"{kind}|unnamed|{number}"
            number += 1
            if nameless in self._known.kinds:
                continue
            _add_object(self._path, self._known, nameless, kind, place_in(nameless))
            names.append(nameless)
        area = (boxes[:, 2] - boxes[:, 0]).astype(np.int64) * (boxes[:, 3] - boxes[:, 1])
        order = np.argsort(-area, kind="stable")
        first = [name for name in names if name in visible]
        rest = [name for name in names if name not in visible]
        return list(zip([*first, *rest], map(tuple, boxes[order].tolist()), strict=False))

    def finish(self, name: str, room_type: int, points: np.ndarray) -> tuple[Scene, Sight]:
        """The scene, its objects by class and id, and all rows by state and object."""
        known = self._known
        order = sorted(known.kinds, key=lambda name: (known.kinds[name], name))
        objects = tuple(SceneObject(n, known.kinds[n], known.places[n]) for n in order)
        index = {name: i for i, name in enumerate(order)}
        rows = sorted((state, index[n], box, seen) for state, n, box, seen in self._rows)
        sight = Sight(
            state=np.array([row[0] for row in rows], np.int32),
            owner=np.array([row[1] for row in rows], np.int32),
            box=np.array([row[2] for row in rows], np.int16).reshape(-1, 4),
            visible=np.array([row[3] for row in rows], bool),
        )
        return Scene(name, room_type, points, objects), sight


def describe(data: SceneData) -> str:
    """One line: what a folder held, what was missing and what is odd."""
    line = f"{data.scene.name}: {', '.join(data.found)}"
    return f"{line}; noted: {', '.join(data.noted)}" if data.noted else line
