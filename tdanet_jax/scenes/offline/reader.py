"""The files of one scene in the original layout, as arrays."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax import poses
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.poses import GRID_SIZE, HORIZONS, ROTATIONS, STEPS, VIEWS
from tdanet_jax.scenes.metadata import FARTHEST, check_points
from tdanet_jax.scenes.offline import frames, layout
from tdanet_jax.scenes.offline.frames import Frame
from tdanet_jax.scenes.offline.layout import Grid
from tdanet_jax.scenes.offline.matching import BoxMatcher, Objects
from tdanet_jax.scenes.offline.object_ids import UNKNOWN, class_of, is_id, place_in
from tdanet_jax.scenes.scene import MOST_OBJECTS, MOST_POINTS, SUBPIXEL, Scene, SceneError
from tdanet_jax.scenes.visibility.build import Detections
from tdanet_jax.scenes.visibility.geometry import transitions
from tdanet_jax.vocabulary import IMAGE_SIZE, STRUCTURE

#: Pixels by which a box may leave the frame, to which it is then clipped.
OVERHANG = 1.0
_CLASS = re.compile(r"[A-Za-z][A-Za-z0-9]*")


@dataclasses.dataclass(frozen=True, eq=False)
class SceneData:
    """The content of a scene's folder."""

    scene: Scene
    next_position: np.ndarray  # [P, 8] int32
    detections: Detections
    found: tuple[str, ...]  # what there was
    noted: tuple[str, ...]  # what was missing or unusual

    def describe(self) -> str:
        """One line on what the folder contains, and on what is missing or unusual."""
        line = f"{self.scene.name}: {', '.join(self.found)}"
        return f"{line}; noted: {', '.join(self.noted)}" if self.noted else line


def read_scene(folder: Path, name: str, room_type: str, frame: Frame | None = None) -> SceneData:
    """Reads the files of a scene, one after the other.

    Args:
      frame: the frame in whose pixels the boxes are; None: as the folder says, or the usual one.

    Raises:
      FileError: a file is missing or broken, or contradicts another.
    """
    grid = read_grid(folder / layout.GRID_FILE)
    next_position, odd = read_graph(folder / layout.GRAPH_FILE, grid)
    sources = [folder / n for n in layout.VISIBILITY_FILES if (folder / n).is_file()]
    if not sources:
        raise FileError(folder, f"none of {', '.join(layout.VISIBILITY_FILES)}")
    objects = read_visibility(sources[0], grid)
    found = [f"{len(grid.points)} points", f"{sources[0].name} ({len(objects.classes)} objects)"]
    noted = list(odd)
    owners: dict[int, list[str]] | None = None
    if (folder / layout.OBJECT_FILE).is_file():
        owners = read_objects(folder / layout.OBJECT_FILE, grid, objects)
        found.append(layout.OBJECT_FILE)
    boxes: Iterator[tuple[int, dict[str, np.ndarray]]] = iter(())
    if (folder / layout.BOX_FILE).is_file():
        frame, remarks = _frame(folder, frame)
        noted += remarks
        boxes = read_boxes(folder / layout.BOX_FILE, grid, frame)
    else:
        noted.append(f"no {layout.BOX_FILE}, so no detections")
    matcher = BoxMatcher(folder / layout.BOX_FILE, objects, owners, layout.state_keys(grid.points))
    matcher.add(boxes)
    if odd_names := sorted(n for n in matcher.names if not is_id(n) and not _CLASS.fullmatch(n)):
        noted.append(
            f"{len(odd_names)} names of boxes that look like neither a class nor an object's id, "
            f"taken as classes: {', '.join(odd_names[:3])}"
        )
    scene, detections = matcher.finish(name, room_type, grid.points)
    boxed = int((detections.box[:, 0] >= 0).sum())
    if boxed:
        found.append(f"{layout.BOX_FILE} ({boxed} boxes)")
    if boxed and len(detections.box) > boxed:
        noted.append(f"{len(detections.box) - boxed} times an object is visible and has no box")
    return SceneData(scene, next_position, detections, tuple(found), tuple(noted))


def _frame(folder: Path, given: Frame | None) -> tuple[Frame, list[str]]:
    """The frame of a scene's boxes, and remarks on where its size comes from."""
    found, source = frames.recorded(folder)
    if given is None and found is None:
        return frames.USUAL, [f"{source}; frames taken as {frames.USUAL}"] if source else []
    if given is None and found is not None:
        return found, [] if found == frames.USUAL else [f"frames of {found} by {source}"]
    assert given is not None
    differs = found is not None and found != given
    return given, [f"frames of {found} by {source}, read as {given}"] if differs else []


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
    """The position after MoveAhead at each point along each heading, [P, 8] int32; and remarks.

    The reference controller makes a step if there is a link to the state that the step would reach.
    So links that no moving action takes have no effect, there and here.

    Raises:
      FileError: it is not a node-link graph, or a link leads to a missing node.
    """
    content = jsons.load(path)
    if not isinstance(content, Mapping):
        raise FileError(path, "not a node-link graph")
    nodes, links = content.get("nodes"), content.get("links", content.get("edges"))
    if not isinstance(nodes, list) or not isinstance(links, list):
        raise FileError(path, "not a node-link graph (no nodes and links)")
    if content.get("edges", links) != links:
        raise FileError(path, "links and edges, two names for one list, differ")
    names = [node.get("id") if isinstance(node, Mapping) else None for node in nodes]
    states = {str(name): grid.state(path, name) for name in names}
    order = [states[str(name)] for name in names]

    def end(link: Any, side: str) -> int:
        value = link.get(side) if isinstance(link, Mapping) else None
        if isinstance(value, str) and value in states:
            return states[value]
        # Before networkx 2, the ends of a link were indices in the list of nodes.
        if isinstance(value, int) and not isinstance(value, bool) and 0 <= value < len(order):
            return order[value]
        raise FileError(path, f"a link's {side} {value!r} is not among the nodes")

    pairs = np.array([(end(link, "source"), end(link, "target")) for link in links], np.int64)
    pairs = pairs.reshape(-1, 2)
    if content.get("directed") is False:
        pairs = np.concatenate([pairs, pairs[:, ::-1]])
    return _next_positions(grid, pairs, set(order))


def _next_positions(grid: Grid, pairs: np.ndarray, nodes: set[int]) -> tuple[np.ndarray, list[str]]:
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


def read_visibility(path: Path, grid: Grid) -> Objects:
    """The objects of a visibility map or of raw metadata, and where they are visible.

    A map has a list of states under each object's id; metadata have an event for each state's key.

    Raises:
      FileError: it is neither.
    """
    objects = Objects()
    for name, value in jsons.members(path):
        if isinstance(value, list):
            if class_of(name) in STRUCTURE:
                continue
            objects.add(path, name, class_of(name), place_in(name))
            objects.states[name] |= {grid.state(path, key) for key in value}
        elif isinstance(value, Mapping) and isinstance(value.get("objects"), list):
            state = grid.state(path, name)
            for record in value["objects"]:
                _add_record(path, name, objects, record, state)
        else:
            raise FileError(path, f"{name}: neither a list of states nor an event's metadata")
    if not objects.classes:
        raise FileError(path, "no objects")
    return objects


def _add_record(path: Path, key: str, objects: Objects, record: Any, state: int) -> None:
    fields = record if isinstance(record, Mapping) else {}
    name, object_class, visible = (fields.get(k) for k in ("objectId", "objectType", "visible"))
    named = name and object_class and isinstance(visible, bool)
    if not named or not isinstance(name, str) or not isinstance(object_class, str):
        raise FileError(path, f"{key}: an object without objectId, objectType or visible")
    if object_class in STRUCTURE:
        return
    if name not in objects.classes:
        objects.add(path, name, object_class, _event_box(path, name, fields))
    if visible:
        objects.states[name].add(state)


def _event_box(path: Path, name: str, record: Mapping[str, Any]) -> np.ndarray:
    """An object's box [2, 3] in metres in an event, or else the place in its id."""
    box = record.get("axisAlignedBoundingBox")
    if box is None:
        return place_in(name)
    vectors = []
    for part in ("center", "size"):
        vector = box.get(part) if isinstance(box, Mapping) else None
        if not isinstance(vector, Mapping):
            raise FileError(path, f"{name}: axisAlignedBoundingBox has no center and size")
        numbers = [jsons.number(path, vector.get(a), f"{name}: {a}", FARTHEST) for a in "xyz"]
        vectors.append(np.array(numbers))
    center, half = vectors[0], vectors[1] / 2
    return np.stack([center - half, center + half])


def read_objects(path: Path, grid: Grid, objects: Objects) -> dict[int, list[str]]:
    """Adds the objects of our `objects.json`.

    Returns:
      State -> ids of the objects to which its boxes belong, in order.

    Raises:
      FileError: it does not fit the other files.
    """
    content = jsons.load(path)
    records = content.get("objects") if isinstance(content, Mapping) else None
    instances = content.get("instances") if isinstance(content, Mapping) else None
    if not isinstance(records, Mapping) or not isinstance(instances, Mapping):
        raise FileError(path, "no objects and instances")
    names = list(records)
    kept = set()
    for name, record in records.items():
        if not isinstance(record, Mapping) or not isinstance(record.get("objectType"), str):
            raise FileError(path, f"{name}: no objectType")
        if record["objectType"] not in STRUCTURE:
            kept.add(name)
            objects.add(path, name, record["objectType"], _extent(path, name, record))
    owners = {}
    for key, indices in instances.items():
        if not isinstance(indices, list) or not all(
            type(i) is int and 0 <= i < len(names) for i in indices
        ):
            raise FileError(path, f"{key}: not indices in the list of objects")
        owners[grid.state(path, key)] = [names[i] for i in indices if names[i] in kept]
    return owners


def _extent(path: Path, name: str, record: Mapping[str, Any]) -> np.ndarray:
    """An object's box [2, 3] in metres, NaN if it is unknown."""
    box = record.get("box")
    if box is None:
        return UNKNOWN
    if not isinstance(box, list) or len(box) != 6:
        raise FileError(path, f"{name}: a box is six numbers")
    numbers = [jsons.number(path, value, f"{name}: a box's number", FARTHEST) for value in box]
    return np.array(numbers).reshape(2, 3)


def read_boxes(
    path: Path, grid: Grid, frame: Frame = frames.USUAL
) -> Iterator[tuple[int, dict[str, np.ndarray]]]:
    """Each state, with its boxes by class or by object id, [n, 4] in the units of the tables.

    Raises:
      FileError: some names are classes and some are ids, or a number is missing, not finite or
        outside of the frame.
    """
    first = None  # the first name: all are ids, or none is
    for key, groups in jsons.members(path):
        state = grid.state(path, key)
        if not isinstance(groups, Mapping):
            raise FileError(path, f"{key}: not classes with boxes")
        for name in groups:
            first = name if first is None else first
            if "|" in name and not is_id(name):
                raise FileError(path, f"{key}: {name!r} is neither a class nor an object's id")
            if is_id(name) != is_id(first):
                raise FileError(path, f"{key}: both classes and ids of objects: {first}, {name}")
        yield (
            state,
            {
                name: _boxes(path, key, name, flat, frame)
                for name, flat in groups.items()
                if (class_of(name) if is_id(name) else name) not in STRUCTURE
            },
        )


def _boxes(path: Path, key: str, name: str, flat: Any, frame: Frame) -> np.ndarray:
    where = f"{key}: {name}"
    if not name or not isinstance(flat, list) or len(flat) % 4 or len(flat) > 4 * MOST_OBJECTS:
        raise FileError(path, f"{where}: not four numbers per box")
    if not all(type(value) in (int, float) for value in flat):
        raise FileError(path, f"{where}: a pixel that is not a number")
    pixels = np.array([min(max(value, -1e6), 1e6) for value in flat], np.float64).reshape(-1, 4)
    size = np.array([*frame, *frame])
    inside = (pixels >= -OVERHANG) & (pixels <= size + OVERHANG)  # False for NaN
    if not inside.all():
        raise FileError(
            path, f"{where}: a pixel outside of a frame of {frame}; {frames.FLAG} says another size"
        )
    # The tables' frame is square: boxes keep their shares of width and height.
    pixels = np.clip(pixels, 0, size) * (IMAGE_SIZE / size)
    corners = np.hstack([np.minimum(pixels[:, :2], pixels[:, 2:]),
                         np.maximum(pixels[:, :2], pixels[:, 2:])])  # fmt: skip
    return np.rint(corners * SUBPIXEL).astype(np.int16)
