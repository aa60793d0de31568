"""Small rooms made by hand or at random, as scene tables with readable arrays."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence

import numpy as np
from hypothesis import strategies as st

from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.scenes import SceneTables
from tests.support.oracle import ROOMS, World

#: Whole frame in the units of `row_box`: 300 pixels of sixteen parts.
FRAME = 4800


@dataclasses.dataclass(frozen=True)
class Sighting:
    """An object in view from a state."""

    item: int  # index among the room's objects
    box: tuple[int, int, int, int] = (1200, 1200, 3600, 3600)  # x1, y1, x2, y2, of FRAME
    visible: bool = True  # within 1.5 m


@dataclasses.dataclass(frozen=True)
class Room:
    """One room, all indices counted from its own first entry."""

    kind: str | Sequence[str]  # of a house, at each position
    next_position: Sequence[Sequence[int]]  # [P][rotations], by heading
    objects: Sequence[tuple[str, tuple[float, float, float]]]  # class and centre in metres
    sightings: Mapping[int, Sequence[Sighting]]  # state -> what is in view


def tables_of(
    rooms: Sequence[Room],
    classes: Sequence[str],
    targets: Sequence[str],
    seed: int = 0,
    grid: PoseGrid = ITHOR,
) -> SceneTables:
    """Scene tables of some rooms. Distances are the oracle's; the raster is noise from `seed`."""
    positions = [len(room.next_position) for room in rooms]
    objects = [len(room.objects) for room in rooms]
    first_position = np.concatenate([[0], np.cumsum(positions)])
    first_object = np.concatenate([[0], np.cumsum(objects)])
    index = {name: i for i, name in enumerate(classes)}
    rows: list[list[tuple[int, Sighting]]] = []
    for room, offset in zip(rooms, first_object, strict=False):
        for state in range(len(room.next_position) * grid.views):
            found = room.sightings.get(state, ())
            found = sorted(found, key=lambda s: (index[room.objects[s.item][0]], s.item))
            rows.append([(int(offset) + s.item, s) for s in found])
    flat = [entry for state in rows for entry in state]
    all_objects = [item for room in rooms for item in room.objects]
    states = grid.views * sum(positions)
    centre = np.array([place for _, place in all_objects], float).reshape(-1, 3)
    rng = np.random.default_rng(seed)
    tables = SceneTables(
        scenes=tuple(f"Room{i}" for i in range(len(rooms))),
        classes=tuple(classes),
        targets=tuple(targets),
        object_id=tuple(f"{name}|{i}" for i, (name, _) in enumerate(all_objects)),
        position_room_type=np.array(
            [
                ROOMS.index(kind)
                for room in rooms
                for kind in np.broadcast_to(room.kind, len(room.next_position))
            ],
            np.int8,
        ),
        position=np.column_stack([np.arange(sum(positions)) * 0.25, np.zeros((sum(positions), 2))]),
        position_scene=np.repeat(np.arange(len(rooms), dtype=np.int16), positions),
        next_position=np.concatenate(
            [
                np.array(room.next_position) + offset
                for room, offset in zip(rooms, first_position, strict=False)
            ]
        ).astype(np.int32),
        row_start=np.cumsum([0] + [len(state) for state in rows]).astype(np.int32),
        row_object=np.array([item for item, _ in flat], np.int32),
        row_box=np.array([s.box for _, s in flat], np.int16).reshape(-1, 4),
        row_visible=np.array([s.visible for _, s in flat], bool),
        object_class=np.array([index[name] for name, _ in all_objects], np.int16),
        object_scene=np.repeat(np.arange(len(rooms), dtype=np.int16), objects),
        object_box=np.concatenate([centre - 0.1, centre + 0.1], axis=1),
        distance=np.full((states, len(targets)), -1, np.int16),
        raster=rng.integers(-1, len(classes), (states, 7, 7)).astype(np.int8),
        grid=grid,
    )
    world = World(tables, {}, (1, 1, 1, 1))
    for goal, target in enumerate(targets):
        for scene in range(len(rooms)):
            for state, away in world.distances(scene, target).items():
                tables.distance[state, goal] = away
    return tables


def corridor(length: int) -> list[list[int]]:
    """Points in a row along +z: MoveAhead works along heading 0 and back along heading 180."""
    ahead = [[p] * 8 for p in range(length)]
    for p in range(length - 1):
        ahead[p][0] = p + 1
        ahead[p + 1][4] = p
    return ahead


def state(position: int, heading: int, horizon: int = 0) -> int:
    """A state's index in its room, from degrees."""
    return (position * 8 + heading // 45) * 2 + horizon // 30


def lopsided() -> SceneTables:
    """Rooms whose sizes, numbers and targets differ, so that uniform means different things.

    Kitchens: one with both targets; one with three mugs and no bread; one that is cut in two (its
    mug is seen from the first two points alone); one whose mug is invisible. Bedroom: one.
    """
    both = [("Mug", (0.0, 0.0, 0.0)), ("Bread", (0.0, 0.0, 0.0))]
    mugs = [("Mug", (0.0, 0.0, float(i))) for i in range(3)]
    here = state(0, 0)
    cut = corridor(5)
    cut[1][0], cut[2][4] = 1, 2
    rooms = [
        Room("kitchen", corridor(2), both, {here: [Sighting(0), Sighting(1)]}),
        Room("kitchen", corridor(3), mugs, {here: [Sighting(0), Sighting(1), Sighting(2)]}),
        Room("kitchen", cut, mugs[:1], {here: [Sighting(0)]}),
        Room("kitchen", corridor(4), mugs[:1], {here: [Sighting(0, visible=False)]}),
        Room("bedroom", corridor(2), both, {here: [Sighting(0), Sighting(1)]}),
    ]
    return tables_of(rooms, ["Bread", "Mug"], ["Mug", "Bread"])


def houses() -> SceneTables:
    """Two houses with a kitchen and a bedroom, a corridor each.

    In the second, which has a closet that is cut off, nobody gets from the bedroom to the kitchen.
    """
    objects = [("Mug", (0.0, 1.0, 0.0)), ("Pillow", (0.0, 1.0, 1.0))]
    sightings = {state(0, 0): [Sighting(0)], state(3, 0): [Sighting(1)]}
    shut = corridor(5)
    shut[2][4], shut[3][0], shut[4][4] = 2, 3, 4
    kinds = ["kitchen", "kitchen", "bedroom", "bedroom"]
    rooms = [
        Room(kinds, corridor(4), objects, sightings),
        Room([*kinds, "bedroom"], shut, objects, sightings),
    ]
    return tables_of(rooms, ["Mug", "Pillow"], ["Mug", "Pillow"])


@st.composite
def random_tables(draw: st.DrawFn) -> SceneTables:
    """Tables of up to four rooms with arbitrary turns, moves (one-way ones too) and detections.

    Sizes are drawn, contents follow from a drawn seed. More than 32 classes occur, so that bit
    sets take two words; so do empty frames, invisible targets and unreachable ones.
    """
    kinds = draw(st.lists(st.sampled_from(ROOMS), min_size=1, max_size=4), label="room types")
    largest = draw(st.integers(1, 4), label="most positions of a room")
    classes = [f"Class{i:02}" for i in range(draw(st.sampled_from((3, 34)), label="classes"))]
    density = draw(st.sampled_from((0.03, 0.2, 0.6)), label="share of objects in view")
    grid = PoseGrid(
        rotations=draw(st.sampled_from((8, 4, 12)), label="rotations"),
        horizons=draw(st.sampled_from(((0, 30), (0,), (-30, 0, 30))), label="horizons"),
    )
    seed = draw(st.integers(0, 2**32 - 1), label="seed")
    rng = np.random.default_rng(seed)
    rooms = []
    for kind in kinds:
        count = int(rng.integers(1, largest + 1))
        ahead = np.where(
            rng.random((count, grid.rotations)) < 0.5,
            np.arange(count)[:, None],
            rng.integers(count, size=(count, grid.rotations)),
        )
        objects = [
            (str(rng.choice(classes)), tuple(rng.uniform(0, 4, 3)))
            for _ in range(rng.integers(1, 9))
        ]
        sightings = {
            place: [
                Sighting(item, _random_box(rng), bool(rng.random() < 0.5))
                for item in range(len(objects))
                if rng.random() < density
            ]
            for place in range(grid.views * count)
        }
        house = rng.random() < 0.3
        kinds_at = rng.choice(ROOMS, count).tolist() if house else kind
        rooms.append(Room(kinds_at, ahead.tolist(), objects, sightings))
    # One target is always in view somewhere, so that an episode is possible.
    rooms[0].sightings[0] = [Sighting(0, _random_box(rng), True)]
    always = rooms[0].objects[0][0]
    others = [str(name) for name in rng.permutation([c for c in classes if c != always])[:4]]
    return tables_of(rooms, classes, [always, *others], seed, grid)


def _random_box(rng: np.random.Generator) -> tuple[int, int, int, int]:
    x1, x2 = sorted(rng.choice(FRAME + 1, 2, replace=False).tolist())
    y1, y2 = sorted(rng.choice(FRAME + 1, 2, replace=False).tolist())
    return x1, y1, x2, y2
