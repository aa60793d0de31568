"""From rooms to scene tables: visibility, transitions, distances and rasters of every state."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from tdanet_jax.poses import VIEWS
from tdanet_jax.scenes.errors import SceneError
from tdanet_jax.scenes.scene import MOST_CLASSES, SUBPIXEL, Scene
from tdanet_jax.scenes.tables import SceneTables, row_offsets
from tdanet_jax.scenes.visibility.build import Detections, detect
from tdanet_jax.scenes.visibility.geometry import action_distances, next_positions, transitions
from tdanet_jax.scenes.visibility.raster import paint
from tdanet_jax.scenes.visibility.rules import RULES, Rules
from tdanet_jax.vocabulary import ALL_TARGETS, IMAGE_SIZE

#: Rooms that are computed at once, given as many cores: 2 GB of memory.
MOST_WORKERS = 8

#: Called with the number of rooms that are done, and of all rooms.
Progress = Callable[[int, int], None]


@dataclasses.dataclass(frozen=True, eq=False)
class RoomTables:
    """One room's part of the tables, with indices that count from the room's own first entry."""

    scene: Scene
    next_position: np.ndarray  # [P, 8] int32
    detections: Detections
    object_class: np.ndarray  # [O] int16
    distance: np.ndarray  # [S, G] int16
    raster: np.ndarray  # [S, 7, 7] int8


def build(
    scenes: Sequence[Scene],
    classes: Sequence[str] | None = None,
    targets: Sequence[str] = ALL_TARGETS,
    rules: Rules = RULES,
    progress: Progress | None = None,
) -> SceneTables:
    """Computes the tables of `scenes`; equal scenes and rules give equal tables on any machine.

    Args:
      classes: the vocabulary; by default the classes that occur, sorted.

    Raises:
      SceneError: there are more classes than the raster can number, or `classes` lacks one.
    """
    if classes is None:
        classes = sorted({item.object_class for scene in scenes for item in scene.objects})
    names = tuple(classes)
    if len(names) > MOST_CLASSES:
        raise SceneError(f"{len(names)} classes, more than {MOST_CLASSES}")

    def build_room(scene: Scene) -> RoomTables:
        for item in scene.objects:
            if item.object_class not in names:
                raise SceneError(
                    f"{scene.name}: {item.object_id}: class {item.object_class} is not known"
                )
        return tabulate(scene, next_positions(scene.points), detect(scene, rules), names, targets)

    rooms = []
    with ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, MOST_WORKERS)) as pool:
        for room in pool.map(build_room, scenes):
            rooms.append(room)
            if progress is not None:
                progress(len(rooms), len(scenes))
    return join(rooms, names, targets)


def tabulate(
    scene: Scene,
    next_position: np.ndarray,
    detections: Detections,
    classes: Sequence[str],
    targets: Sequence[str],
) -> RoomTables:
    """One room's part of the tables.

    Args:
      next_position: [P, 8] int32, the position after MoveAhead along each heading.
      classes: the vocabulary, with all classes of the room; at most `MOST_CLASSES`.
    """
    index = {name: i for i, name in enumerate(classes)}
    object_class = np.array([index[item.object_class] for item in scene.objects], np.int16)
    row_class = object_class[detections.owner]
    states = len(scene.points) * VIEWS
    goals = np.zeros((states, len(targets)), bool)
    for g, target in enumerate(targets):
        seen = detections.visible & (row_class == index.get(target, -1))
        goals[detections.state[seen], g] = True
    return RoomTables(
        scene=scene,
        next_position=next_position,
        detections=detections,
        object_class=object_class,
        distance=action_distances(transitions(next_position), goals),
        raster=paint(detections.state, detections.box, row_class, states, IMAGE_SIZE * SUBPIXEL),
    )


def join(
    rooms: Sequence[RoomTables], classes: Sequence[str], targets: Sequence[str]
) -> SceneTables:
    """The tables of all rooms, one after the other."""
    scenes = [room.scene for room in rooms]
    points = [len(scene.points) for scene in scenes]
    objects = [len(scene.objects) for scene in scenes]
    first_point = np.concatenate([[0], np.cumsum(points)])
    first_object = np.concatenate([[0], np.cumsum(objects)])
    counts = [
        np.bincount(room.detections.state, minlength=p * VIEWS)
        for room, p in zip(rooms, points, strict=True)
    ]
    return SceneTables(
        scenes=tuple(scene.name for scene in scenes),
        classes=tuple(classes),
        targets=tuple(targets),
        object_id=tuple(item.object_id for scene in scenes for item in scene.objects),
        room_type=np.array([scene.room_type for scene in scenes], np.int8),
        position=np.concatenate([scene.points for scene in scenes]),
        position_scene=np.repeat(np.arange(len(scenes), dtype=np.int16), points),
        next_position=np.concatenate(
            [room.next_position + first_point[i] for i, room in enumerate(rooms)]
        ).astype(np.int32),
        row_start=row_offsets(np.concatenate(counts)),
        row_object=np.concatenate(
            [room.detections.owner + first_object[i] for i, room in enumerate(rooms)]
        ).astype(np.int32),
        row_box=np.concatenate([room.detections.box for room in rooms]),
        row_visible=np.concatenate([room.detections.visible for room in rooms]),
        object_class=np.concatenate([room.object_class for room in rooms]),
        object_scene=np.repeat(np.arange(len(scenes), dtype=np.int16), objects),
        object_box=np.array(
            [item.box.reshape(6) for scene in scenes for item in scene.objects], np.float64
        ),
        distance=np.concatenate([room.distance for room in rooms]),
        raster=np.concatenate([room.raster for room in rooms]),
    )
