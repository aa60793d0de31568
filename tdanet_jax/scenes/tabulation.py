"""From rooms to scene tables: visibility, transitions, distances and rasters of every state."""

from __future__ import annotations

import dataclasses
import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import numpy as np

from tdanet_jax.scenes.room_names import type_names
from tdanet_jax.scenes.scene import (
    MOST_CLASSES,
    MOST_ROOM_TYPES,
    MOST_ROOMS,
    SUBPIXEL,
    Scene,
    SceneError,
)
from tdanet_jax.scenes.tables import FIELDS, SceneTables, row_offsets
from tdanet_jax.scenes.visibility.build import Detections, detect
from tdanet_jax.scenes.visibility.geometry import action_distances, next_positions, transitions
from tdanet_jax.scenes.visibility.rules import RULES, Rules
from tdanet_jax.vocabulary import ALL_TARGETS, IMAGE_SIZE

#: Rooms that are computed at once, given as many cores: 2 GB of memory.
MOST_WORKERS = 8

CELLS = 7  # along each side of the raster

BOXES = 1 << 18  # that are painted at once
SECONDS_BETWEEN_REPORTS = 1.0  # while a room is computed

#: Called with the number of rooms that are done, parts of rooms included, and of all rooms.
Progress = Callable[[float, int], None]


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
      SceneError: there are more classes or room types than the tables can number, or `classes`
        lacks one.
    """
    if classes is None:
        classes = sorted({item.object_class for scene in scenes for item in scene.objects})
    names = tuple(classes)
    if len(names) > MOST_CLASSES:
        raise SceneError(f"{len(names)} classes, more than {MOST_CLASSES}")
    if len(type_names(name for scene in scenes for name in scene.point_types)) > MOST_ROOM_TYPES:
        raise SceneError(f"more than {MOST_ROOM_TYPES} room types")

    if len(scenes) > MOST_ROOMS:
        raise SceneError(f"{len(scenes)} rooms, more than {MOST_ROOMS}")
    shares = np.zeros(len(scenes))  # of each room, done

    def build_one(number: int) -> SceneTables:
        scene = scenes[number]
        for item in scene.objects:
            if item.object_class not in names:
                raise SceneError(
                    f"{scene.name}: {item.object_id}: class {item.object_class} is not known"
                )

        def note(share: float) -> None:
            shares[number] = share

        room = build_room(scene, targets, rules, note)
        note(1.0)
        return room

    def show() -> None:
        if progress is not None:
            progress(float(shares.sum()), len(scenes))

    rooms = []
    with ThreadPoolExecutor(max_workers=min(os.cpu_count() or 1, MOST_WORKERS)) as pool:
        futures = [pool.submit(build_one, number) for number in range(len(scenes))]
        try:
            for future in futures:
                while wait([future], SECONDS_BETWEEN_REPORTS).not_done:
                    show()
                rooms.append(future.result())
                show()
        finally:
            pool.shutdown(cancel_futures=True)
    return join(rooms, names)


def build_room(
    scene: Scene,
    targets: Sequence[str] = ALL_TARGETS,
    rules: Rules = RULES,
    report: Callable[[float], None] | None = None,
) -> SceneTables:
    """The tables of one room, with its own classes.

    Args:
      report: called with the share of the points that is done.
    """
    ahead = next_positions(scene.points, scene.grid)
    return tabulate(scene, ahead, detect(scene, rules, report=report), targets)


def tabulate(
    scene: Scene, next_position: np.ndarray, detections: Detections, targets: Sequence[str]
) -> SceneTables:
    """The tables of one room, with its own classes.

    Args:
      next_position: [P, rotations] int32, the position after MoveAhead along each heading.
    """
    classes = sorted({item.object_class for item in scene.objects})
    room_types = type_names(scene.point_types)
    object_class = np.array([classes.index(o.object_class) for o in scene.objects], np.int16)
    row_class = object_class[detections.owner]
    states = len(scene.points) * scene.grid.views
    goals = np.zeros((states, len(targets)), bool)
    for g, target in enumerate(targets):
        if target in classes:
            seen = detections.visible & (row_class == classes.index(target))
            goals[detections.state[seen], g] = True
    return SceneTables(
        scenes=(scene.name,),
        classes=tuple(classes),
        targets=tuple(targets),
        object_id=tuple(item.object_id for item in scene.objects),
        position_room_type=np.array([*map(room_types.index, scene.point_types)], np.int8),
        position=scene.points,
        position_scene=np.zeros(len(scene.points), np.int16),
        next_position=next_position,
        row_start=row_offsets(np.bincount(detections.state, minlength=states)),
        row_object=detections.owner,
        row_box=detections.box,
        row_visible=detections.visible,
        object_class=object_class,
        object_scene=np.zeros(len(scene.objects), np.int16),
        object_box=np.array([item.box.reshape(6) for item in scene.objects]),
        distance=action_distances(transitions(next_position, scene.grid), goals),
        raster=paint(detections.state, detections.box, row_class, states, IMAGE_SIZE * SUBPIXEL),
        grid=scene.grid,
        room_types=room_types,
    )


def paint(
    state: np.ndarray, box: np.ndarray, label: np.ndarray, states: int, size: int
) -> np.ndarray:
    """Class of the smallest box over the middle of each cell, or -1: [states, 7, 7] int8.

    This coarse image of a view replaces the convolutional feature maps that image-based models
    expect.
    Small objects stand on or in front of large ones, so boxes are painted from the largest down;
    among boxes of equal area, later rows cover earlier ones.

    Args:
      state: [N] state of each box.
      box: [N, 4] x1, y1, x2, y2.
      label: [N] class, below 128.
      states: number of states.
      size: width and height of the image in the units of `box`.
    """
    raster = np.full(states * CELLS * CELLS, -1, np.int8)
    by_state = np.argsort(state, kind="stable")
    for first, stop in itertools.pairwise(_batches(state[by_state])):
        rows = by_state[first:stop]
        _paint(raster, state[rows], box[rows].astype(np.int32), label[rows], size)
    return raster.reshape(states, CELLS, CELLS)


def _batches(state: np.ndarray) -> list[int]:
    """Where batches of about `BOXES` boxes begin and end, given the ascending state of each box.

    They end where a state ends: within a state, the order of painting matters.
    """
    starts = np.flatnonzero(np.diff(state, prepend=-1))
    ends = np.searchsorted(starts, range(BOXES, len(state), BOXES)).clip(max=len(starts) - 1)
    return sorted({0, *starts[ends].tolist(), len(state)})


def _paint(
    raster: np.ndarray, state: np.ndarray, box: np.ndarray, label: np.ndarray, size: int
) -> None:
    """Paints all boxes of some states into a raster [states * 49]."""
    # Cell c is covered if its middle, (c + 1/2) * size / 7, lies in [low, high).
    first = -((size - box[:, :2] * (2 * CELLS)) // (2 * size))
    stop = -((size - box[:, 2:] * (2 * CELLS)) // (2 * size))
    width, height = (stop - first).T
    area = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])
    order = np.argsort(-area, kind="stable")
    order = order[(width * height)[order] > 0]
    count = (width * height)[order]
    row = np.repeat(order, count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    across, down = step % width[row] + first[row, 0], step // width[row] + first[row, 1]
    raster[(state[row] * CELLS + down) * CELLS + across] = label[row].astype(np.int8)


def join(rooms: Sequence[SceneTables], classes: Sequence[str]) -> SceneTables:
    """The tables of all rooms, one after the other; `classes` includes those of every room."""
    room_types = type_names(name for room in rooms for name in room.room_types)
    parts: dict[str, list[np.ndarray]] = {field: [] for field in FIELDS}
    first = {"R": 0, "P": 0, "O": 0}
    for room in rooms:
        number = np.array([*map(classes.index, room.classes), -1])
        for field, (_, _, _, indexed) in FIELDS.items():
            value = getattr(room, field)
            if field == "row_start":
                value = np.diff(value)
            elif indexed == "C":
                value = number[value]  # -1 stays -1
            elif indexed == "T":
                value = np.array([*map(room_types.index, room.room_types)])[value]
            parts[field].append(value + first[indexed] if indexed in first else value)
        sizes = {"R": len(room.scenes), "P": len(room.position), "O": len(room.object_id)}
        first = {axis: first[axis] + sizes[axis] for axis in first}
    arrays: dict[str, Any] = {
        field: np.concatenate(values).astype(FIELDS[field][0]) for field, values in parts.items()
    }
    arrays["row_start"] = row_offsets(arrays["row_start"])
    return dataclasses.replace(
        rooms[0],
        scenes=tuple(name for room in rooms for name in room.scenes),
        classes=tuple(classes),
        room_types=room_types,
        object_id=tuple(name for room in rooms for name in room.object_id),
        **arrays,
    )
