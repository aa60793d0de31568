"""Rooms from AI2-THOR's object metadata, and scene files, which contain such metadata.

A scene file is JSON: a scene or a list of scenes, each an object with

    name                 unique in the file
    room_type            kitchen, living_room, bedroom, bathroom, or a custom type; the flags
                         of `import` may say it instead, or the name, if it is that of an iTHOR room
    rooms                instead of room_type, the rooms of a house, as ProcTHOR has them: roomType
                         and floorPolygon, its corners
    objects              controller.last_event.metadata["objects"]
    reachable_positions  the actionReturn of GetReachablePositions
    gridSize             optional, metres between neighbouring positions, 0.25 by default
    rotateStepDegrees    optional, degrees that a turn measures, 45 by default
    horizons             optional, degrees that the camera can look down, [0, 30] by default
    split                optional, train or test: the part of every split that the room belongs to;
                         without it the flags of `import` decide, or the name
    targets              optional, names of classes: the targets in all rooms of the scene's type,
                         with those of the file's other scenes of the type, in place of the paper's

The grid, that is gridSize, rotateStepDegrees and horizons, is the same for all scenes of a file.

The fields objectId, objectType and axisAlignedBoundingBox of an object are required;
objectOrientedBoundingBox, rotation, openable, isOpen, pickupable, parentReceptacles and visible are
read if present. An objectType that means a class of AI2-THOR, such as "tv" or "Arm_Chair", is read
as that class; any other is a class of its own.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io.escaping import in_line
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.labels import ai2thor_class
from tdanet_jax.poses import ITHOR, TURNS, PoseGrid
from tdanet_jax.scenes import house
from tdanet_jax.scenes.room_names import Kinds, RoomKind, check_kind, check_name
from tdanet_jax.scenes.scene import MOST_OBJECTS, MOST_POINTS, Scene, SceneError, SceneObject
from tdanet_jax.scenes.visibility.geometry import next_positions
from tdanet_jax.splits import in_order, is_plain, known_type
from tdanet_jax.vocabulary import IGNORED, STRUCTURE

ALIGNED = 0.02  # metres by which a point may miss the grid
SKEW = 0.02  # metres by which corners may miss those of a box
APART = 0.5  # metres by which the middle of an oriented box may be outside of the aligned one
#: Corners of an oriented box in AI2-THOR's order, as multiples of its edges.
CORNERS = np.array([(x, y, z) for y in (0, 1) for x, z in ((0, 0), (1, 0), (1, 1), (0, 1))])
FARTHEST = 1000.0  # metres from the origin; a coordinate beyond this is an error


def parse_scene(
    name: str,
    room_type: str,
    records: Sequence[Mapping[str, Any]],
    points: np.ndarray,
    default_position: np.ndarray | None = None,
    grid: PoseGrid = ITHOR,
) -> Scene:
    """A room from AI2-THOR's object records and reachable points [P, 3], which get sorted.

    Raises:
      SceneError: a record or the points break a rule; it names scene, object and rule.
    """
    objects = [
        parse_object(name, r) for r in records if _text(name, r, "objectType") not in IGNORED
    ]
    objects.sort(key=lambda item: (item.object_class, item.object_id))
    if not objects:
        raise SceneError(f"{name}: no objects")
    if len(objects) > MOST_OBJECTS:
        raise SceneError(f"{name}: {len(objects)} objects, more than {MOST_OBJECTS}")
    identity, times = Counter(item.object_id for item in objects).most_common(1)[0]
    if times > 1:
        raise SceneError(f"{name}: {identity}: id occurs {times} times")
    points = check_points(name, points, grid.grid_size)
    return Scene(name, room_type, points, tuple(objects), default_position, grid=grid)


def check_points(name: str, points: np.ndarray, size: float = ITHOR.grid_size) -> np.ndarray:
    """Reachable points [P, 3], sorted by (x, z) and without duplicates.

    Raises:
      SceneError: there are none, or they are not on a grid of `size` metres.
    """
    if len(points) == 0:
        raise SceneError(f"{name}: no reachable position")
    if len(points) > MOST_POINTS:
        raise SceneError(f"{name}: {len(points)} reachable positions, more than {MOST_POINTS}")
    if not np.isfinite(points).all() or np.abs(points).max() > FARTHEST:
        raise SceneError(f"{name}: a reachable position is not finite or over {FARTHEST:.0f} m")
    steps = (points - points[0])[:, [0, 2]] / size
    off = np.abs(steps - np.rint(steps)).max(axis=1) * size
    if off.max() > ALIGNED:
        x, _, z = points[off.argmax()]
        raise SceneError(
            f"{name}: reachable position x {x:.3f}, z {z:.3f}: off the {size:g} m grid"
        )
    _, first = np.unique(np.rint(steps), axis=0, return_index=True)
    return points[first]


def parse_object(scene: str, record: Mapping[str, Any]) -> SceneObject:
    """An object from its metadata record.

    Raises:
      SceneError: a field is missing, of the wrong kind, or not finite.
    """
    name = _text(scene, record, "objectId")
    box = record.get("axisAlignedBoundingBox")
    if not isinstance(box, Mapping):
        raise SceneError(f"{scene}: {name}: no axisAlignedBoundingBox")
    center = _vector(scene, name, box, "center")
    half = _vector(scene, name, box, "size") / 2
    if (half < 0).any():
        raise SceneError(f"{scene}: {name}: box has a negative size")
    aligned = np.stack([center - half, center + half])
    rotation = np.zeros(3)
    if record.get("rotation") is not None:
        rotation = _vector(scene, name, record, "rotation")
    parents = record.get("parentReceptacles") or []
    if not isinstance(parents, list) or not all(isinstance(p, str) for p in parents):
        raise SceneError(f"{scene}: {name}: parentReceptacles is not a list of ids")
    return SceneObject(
        object_id=name,
        object_class=_text(scene, record, "objectType"),
        box=aligned,
        corners=_corners(scene, name, record.get("objectOrientedBoundingBox"), aligned),
        rotation=(float(rotation[0]), float(rotation[1]), float(rotation[2])),
        openable=bool(record.get("openable")),
        is_open=bool(record.get("isOpen")),
        pickupable=bool(record.get("pickupable")),
        parents=tuple(sorted(p for p in parents if p.split("|")[0] not in IGNORED)),
        visible=None if record.get("visible") is None else bool(record["visible"]),
    )


def _text(scene: str, record: Mapping[str, Any], key: str) -> str:
    value = record.get(key) if isinstance(record, Mapping) else None
    if not isinstance(value, str) or not value:
        raise SceneError(f"{scene}: an object without {key}")
    if not value.isprintable():
        raise SceneError(f"{scene}: {key} {value[:40]}: has a control character")
    return value


def _vector(scene: str, name: str, record: Mapping[str, Any], key: str) -> np.ndarray:
    value = record.get(key)
    if not isinstance(value, Mapping) or not all(_is_number(value.get(a)) for a in "xyz"):
        raise SceneError(f"{scene}: {name}: {key} is not x, y, z, finite and within {FARTHEST:.0f}")
    return np.array([float(value[axis]) for axis in "xyz"])


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= FARTHEST


def _corners(scene: str, name: str, oriented: Any, aligned: np.ndarray) -> np.ndarray | None:
    """Corners [8, 3] of an oriented box, in AI2-THOR's order; None if it is not known."""
    points = oriented.get("cornerPoints") if isinstance(oriented, Mapping) else oriented
    if points is None or points == []:
        return None
    if (
        not isinstance(points, Sequence)
        or len(points) != 8
        or not all(isinstance(p, Sequence) and len(p) == 3 for p in points)
        or not all(_is_number(value) for point in points for value in point)
    ):
        raise SceneError(f"{scene}: {name}: objectOrientedBoundingBox needs 8 finite cornerPoints")
    corners = np.array(points, np.float64)
    edges = corners[[1, 4, 3]] - corners[0]
    lengths = np.maximum(np.sqrt((edges * edges).sum(axis=1)), SKEW)
    off = np.abs(corners - corners[0] - CORNERS @ edges).max()
    slip = np.abs(np.triu(edges @ edges.T, 1) / np.maximum(lengths[:, None], lengths)).max()
    if max(off, slip) > SKEW:
        raise SceneError(
            f"{scene}: {name}: cornerPoints are no box in AI2-THOR's order: around the bottom "
            "face, then above each of these"
        )
    middle = corners.mean(axis=0)
    if np.maximum(aligned[0] - middle, middle - aligned[1]).max() > APART:
        raise SceneError(f"{scene}: {name}: cornerPoints are over {APART} m from its aligned box")
    return corners


def read_scenes(path: Path | str, kinds: Kinds | None = None) -> list[Scene]:
    """The rooms of a scene file.

    Args:
      kinds: room types and parts of the rooms for which the file does not say them.

    Raises:
      SceneError: it is not such a file, or a scene breaks a rule; the message begins with the path.
    """
    path = Path(path)
    try:
        return _read_scenes(path, kinds or Kinds())
    except SceneError as error:
        if str(error).startswith(in_line(path)):
            raise
        raise SceneError(f"{path}: {error}") from None


def _read_scenes(path: Path, kinds: Kinds) -> list[Scene]:
    try:
        content = jsons.load(path, nan=True)  # in fields that are not read
    except FileError as error:
        raise SceneError(str(error)) from None
    documents = content if isinstance(content, list) else [content]
    if not documents:
        raise SceneError(f"{path}: no scenes")
    names = [document.get("name") for document in documents if isinstance(document, Mapping)]
    if unknown := [name for name in kinds.table if name not in names]:
        raise SceneError(f"{path}: no room is called {unknown[0]}, which --rooms lists")
    try:
        scenes = [_read_scene(document, kinds) for document in documents]
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None
    given = {record["objectType"] for document in documents for record in document["objects"]}
    renamed = [f"{name} as {known}" for name in sorted(given) if (known := _known(name)) != name]
    if renamed:
        listed = ", ".join(renamed)
        warnings.warn(f"{path}: objectType read as AI2-THOR's class: {listed}", stacklevel=2)
    name, times = Counter(scene.name for scene in scenes).most_common(1)[0]
    if times > 1:
        raise SceneError(f"{path}: {name}: name occurs {times} times")
    for scene in scenes:
        if scene.grid != scenes[0].grid:
            raise SceneError(
                f"{path}: {scene.name}: another gridSize, rotateStepDegrees or horizons than "
                f"{scenes[0].name}; they must be the same for all scenes of a file"
            )
    return scenes


def _read_scene(document: Any, kinds: Kinds) -> Scene:
    if not isinstance(document, Mapping) or not isinstance(document.get("name"), str):
        raise SceneError("a scene without a name")
    name = document["name"]
    check_name(name)
    room_type, part = _kind(name, document, kinds)
    rooms = _rooms(name, document)
    if rooms and document.get("room_type") is not None:
        raise SceneError(f"{name}: both room_type and rooms, which have types of their own")
    for key in ("objects", "reachable_positions"):
        if not isinstance(document.get(key), list):
            raise SceneError(f"{name}: {key} is not a list")
    points = [
        _vector(name, f"reachable_positions[{i}]", {"position": point}, "position")
        for i, point in enumerate(document["reachable_positions"])
    ]
    grid = _grid(name, document)
    scene = parse_scene(
        name,
        room_type,
        [_with_known_class(record) for record in document["objects"]],
        np.reshape(points, (-1, 3)),
        grid=grid,
    )
    if document.get("gridSize") is None and len(scene.points) > 1 and _are_apart(scene.points):
        raise SceneError(
            f"{name}: no two positions are {grid.grid_size:g} m apart; is gridSize missing?"
        )
    if rooms:
        types = house.types_at(scene.points[:, [0, 2]], rooms)
        scene = dataclasses.replace(scene, room_type=types)
    return dataclasses.replace(scene, part=part, targets=_targets(name, document))


def _are_apart(points: np.ndarray) -> bool:
    """Whether no step leads from any of `points` [P, 3] to another."""
    return bool((np.arange(len(points)) == next_positions(points).T).all())


def _targets(scene: str, document: Mapping[str, Any]) -> tuple[str, ...]:
    """The classes that a scene names as targets."""
    names = document.get("targets", [])
    if not isinstance(names, list) or not all(isinstance(n, str) and is_plain(n) for n in names):
        raise SceneError(f"{scene}: targets is not a list of names of classes")
    found = in_order(map(_known, names))
    if parts := ", ".join(name for name in found if name in STRUCTURE):
        raise SceneError(f"{scene}: targets: parts of the building are never targets: {parts}")
    return found


def _rooms(scene: str, document: Mapping[str, Any]) -> list[house.Room]:
    """The rooms of a house; none if the scene is a room."""
    records = document.get("rooms")
    if records is not None and (not isinstance(records, list) or not records):
        raise SceneError(f"{scene}: rooms is not a list of rooms")
    rooms = []
    for i, record in enumerate(records or ()):
        name = f"rooms[{i}]"
        polygon = record.get("floorPolygon") if isinstance(record, Mapping) else None
        if not isinstance(polygon, list) or len(polygon) < 3:
            raise SceneError(f"{scene}: {name}: floorPolygon is not a list of 3 or more corners")
        corners = [
            _vector(scene, f"{name}: floorPolygon[{k}]", {"corner": corner}, "corner")
            for k, corner in enumerate(polygon)
        ]
        if not isinstance(record.get("roomType"), str):
            raise SceneError(f"{scene}: {name}: no roomType")
        check_name(record["roomType"], f"{scene}: {name}: roomType")
        rooms.append(house.Room(known_type(record["roomType"]), np.array(corners)[:, [0, 2]]))
    return rooms


def _with_known_class(record: Any) -> Any:
    """An object's record with AI2-THOR's name of its class, so that splits and agents know it."""
    if not isinstance(record, Mapping) or not isinstance(record.get("objectType"), str):
        return record
    return {**record, "objectType": _known(record["objectType"])}


def _known(name: str) -> str:
    """AI2-THOR's class, if a name means one; or else the name."""
    return ai2thor_class(name) or name


def _kind(name: str, document: Mapping[str, Any], kinds: Kinds) -> tuple[str, str | None]:
    """Room type and part of a scene; the type is empty if its rooms have their own."""
    said = RoomKind(document.get("room_type"), document.get("split"))
    try:
        check_kind(said)
    except SceneError as error:
        raise SceneError(f"{name}: {error}") from None
    room_type, part = kinds.of(name, said)
    if room_type is None and document.get("rooms") is None:
        raise SceneError(
            f'{name}: no room type; give it in the file ("room_type"), or import the file '
            "with --room-type or --rooms"
        )
    return room_type or "", part


def _grid(scene: str, document: Mapping[str, Any]) -> PoseGrid:
    """The grid that a scene's fields describe."""
    turn, horizons = document.get("rotateStepDegrees"), document.get("horizons")
    if turn is not None and turn not in TURNS:
        raise SceneError(f"{scene}: rotateStepDegrees {turn!r}, not one of {list(TURNS)}")
    if horizons is not None and not isinstance(horizons, list):
        raise SceneError(f"{scene}: horizons is not a list")
    given: dict[str, Any] = {
        "grid_size": document.get("gridSize"),
        "rotations": turn and 360 // int(turn),
        "horizons": horizons and tuple(horizons),
    }
    try:
        return PoseGrid(**{name: value for name, value in given.items() if value is not None})
    except ValueError as error:
        raise SceneError(f"{scene}: {error}") from None
