"""What a user should know about a set of rooms before training in them."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tdanet_jax import words
from tdanet_jax.scenes.dataset import Rooms, assign_rooms, find_targets
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.target_distances import with_targets
from tdanet_jax.scenes.visibility.rules import RULES
from tdanet_jax.splits import Split, in_order, make_split
from tdanet_jax.targets import PAPER, find
from tdanet_jax.vocabulary import ROOM_TYPES


@dataclass(frozen=True)
class InvisibleTarget:
    """A target class that is in a room, but visible from none of its states."""

    scene: str
    target: str
    reason: str


def invisible_targets(tables: SceneTables) -> list[InvisibleTarget]:
    """The targets that are visible from no state of a room that holds them, with the reason."""
    found = []
    first = np.searchsorted(tables.state_scene, np.arange(len(tables.scenes)))
    greatest = np.maximum.reduceat(tables.distance, first, axis=0)  # [R, G], -1 if never visible
    for scene, name in enumerate(tables.scenes):
        here = np.flatnonzero(tables.object_scene == scene)
        for goal, target in enumerate(tables.targets):
            if target not in tables.classes or greatest[scene, goal] >= 0:
                continue
            items = here[tables.object_class[here] == tables.classes.index(target)]
            if len(items):
                found.append(InvisibleTarget(name, target, _reason(tables, scene, items)))
    return found


def _reason(tables: SceneTables, scene: int, items: np.ndarray) -> str:
    points = tables.position[tables.position_scene == scene][:, None, [0, 2]]
    box = tables.object_box[items]
    gap = np.maximum(np.maximum(box[:, [0, 2]] - points, points - box[:, [3, 5]]), 0)
    nearest = np.sqrt((gap * gap).sum(axis=-1)).min()
    if nearest > RULES.reach:
        return f"{nearest:.2f} m from the nearest reachable point"
    if not np.isin(tables.row_object, items).any():
        return "seen from nowhere (inside something closed)"
    return "hidden wherever it is within reach"


def disconnected_rooms(tables: SceneTables) -> dict[str, int]:
    """Rooms whose reachable points are not all connected -> number of connected components."""
    count, headings = tables.next_position.shape
    tail = np.repeat(np.arange(count), headings)
    links = coo_array(
        (np.ones(len(tail), bool), (tail, tables.next_position.reshape(-1))), (count, count)
    )
    _, label = connected_components(links, directed=False)
    components = {
        name: len(np.unique(label[tables.position_scene == scene]))
        for scene, name in enumerate(tables.scenes)
    }
    return {name: number for name, number in components.items() if number > 1}


def summary(tables: SceneTables) -> Iterator[str]:
    """Lines on the size of the tables, and on what in them cannot be reached."""
    yield (
        f"{len(tables.scenes)} rooms, {len(tables.position):,} positions, "
        f"{tables.num_states:,} states, {len(tables.row_object):,} detections, "
        f"{len(tables.classes)} classes; tables {tables.data_version}"
    )
    houses = tables.room_type < 0
    if houses.any():
        counts = np.bincount(tables.position_room_type[houses[tables.position_scene]])
        pairs = zip(tables.room_types, counts, strict=False)
        listed = ", ".join(f"{room} {count:,}" for room, count in pairs if count)
        yield f"Of these, houses with rooms of several types: {houses.sum()}; positions: {listed}"
    if split := disconnected_rooms(tables):
        listed = ", ".join(f"{name} ({count} parts)" for name, count in split.items())
        yield f"Reachable points not all connected: {listed}"
    lost = invisible_targets(tables)
    yield f"Targets visible from nowhere in a room that holds them: {len(lost)}"
    rooms = defaultdict(list)
    for case in lost:
        rooms[case.target, case.reason].append(case.scene)
    for (target, reason), names in sorted(rooms.items()):
        yield f"  {target}: {reason}: {', '.join(names)}"


def making(rooms: Rooms) -> Iterator[str]:
    """A line on how the rooms were made, if they are variants or generated."""
    if rooms.extras is not None and rooms.extras.made:
        yield "Made by " + ", ".join(f"{name} {value}" for name, value in rooms.extras.made.items())


def without_targets(rooms: Rooms) -> list[str]:
    """The rooms in which no target of their type can be found."""
    own = {} if rooms.extras is None else rooms.extras.targets
    meant: dict[str, set[str | None]]
    if own:
        meant = {room: {find(name, rooms.tables.classes) for name in own[room]} for room in own}
        every = in_order({name for names in meant.values() for name in names if name is not None})
        tables = with_targets(rooms.tables, every)
    else:
        tables, usual = find_targets(PAPER, Rooms(rooms.tables, None))
        meant = {room: {*names} for room, names in usual.items()}
    asked = np.array(
        [[t in meant.get(room, ()) for t in tables.targets] for room in tables.room_types]
    )
    found = (tables.reachable & asked[tables.position_room_type]).any(axis=1)
    full = np.bincount(tables.position_scene, found, len(tables.scenes)) > 0
    return [name for name, holds in zip(tables.scenes, full, strict=True) if not holds]


def uses(rooms: Rooms) -> Iterator[str]:
    """Lines on what rooms can be used for and what they need.

    Warns of rooms that no split uses, and if there is nothing to train or to be evaluated in.
    """
    tables, targets = find_targets(PAPER, rooms)
    split = assign_rooms(make_split("22/0", targets=targets), rooms)
    train = [name for name in tables.scenes if name in split.train_scenes]
    test = [name for name in tables.scenes if name in split.eval_scenes]
    yield f"Rooms to train in: {len(train)}; to be evaluated in: {len(test)}"
    own = {} if rooms.extras is None else rooms.extras.targets
    for room in (*own, *(r for r in tables.room_types[len(ROOM_TYPES) :] if r not in own)):
        yield f"Targets in rooms of type {room}: {_listed(targets[room])}"
        if lost := [name for name in own.get(room, ()) if name not in targets[room]]:
            yield f"  left out, found in no training room of type {room}: {_listed(lost)}"
    unused = [name for name in tables.scenes if name not in {*train, *test}]
    if unused or not train or not test:
        named = f"no split uses {', '.join(unused)}; " if unused else ""
        warnings.warn(
            f"{named}a run needs a room to train in and one to be evaluated in: by the names of "
            'iTHOR\'s rooms, by "split": "train" or "test" in the scene file, by --part or --rooms',
            stacklevel=2,
        )
    purposes = {"train in": train, "be evaluated in": test}
    empty = [
        use for use, names in purposes.items() if names and not _hold_target(tables, names, split)
    ]
    if empty:
        types = [tables.room_types[kind] for kind in np.unique(tables.position_room_type)]
        listed = "; ".join(f"in a {room}, {_listed(split.seen[room])}" for room in types)
        warnings.warn(
            f"no room to {' or to '.join(empty)} holds a target that can be found there, and a run "
            f"needs one: {listed}",
            stacklevel=2,
        )
    if not (tables.row_box >= 0).any():
        yield "No boxes in any room: an agent that sees detections will see nothing."
    bundled = words.load_bundled()
    described = bundled.described(tables.classes)
    if lacking := bundled.missing(name for name in tables.classes if name not in described):
        yield (
            f"No bundled word vectors for {', '.join(lacking)}: without --word-vectors, agents do "
            "not see such objects"
        )


def _listed(names: Sequence[str]) -> str:
    return ", ".join(names) or "none"


def _hold_target(tables: SceneTables, rooms: Sequence[str], split: Split) -> bool:
    """Whether an episode can start in any of these rooms."""
    chosen = np.isin(np.array(tables.scenes), rooms)[tables.position_scene]
    for kind, room in enumerate(tables.room_types):
        here = chosen & (tables.position_room_type == kind)
        goals = [tables.targets.index(name) for name in split.seen[room] if name in tables.targets]
        if tables.reachable[here][:, goals].any():
            return True
    return False
