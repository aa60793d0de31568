"""The class graph: its rule by hand, and against a slow form in the real rooms."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from tdanet_jax.config import TrainConfig
from tdanet_jax.models import class_graph
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.dataset import Extras
from tdanet_jax.task import make_task
from tdanet_jax.words import WordVectors
from tests.support.handmade import Room, corridor, tables_of

CLASSES = ("Apple", "Bed", "Mug", "Sink", "Sofa")


def tables(*rooms: dict[str, float | tuple[float, ...]]) -> SceneTables:
    """Rooms whose objects stand on a line, at the given metres."""
    made = []
    for places in rooms:
        objects = [
            (name, (x, 0.0, 0.0))
            for name, where in places.items()
            for x in (where if isinstance(where, tuple) else (where,))
        ]
        made.append(Room("kitchen", corridor(1), objects, {}))
    return tables_of(made, CLASSES, ["Mug"])


def joined(found: np.ndarray) -> set[tuple[str, str]]:
    return {(CLASSES[i], CLASSES[j]) for i, j in np.argwhere(found) if i < j}


def test_two_classes_are_joined_if_half_of_two_rooms_show_them_near() -> None:
    found = class_graph.co_occurrence(
        tables(
            {"Apple": 0.0, "Mug": (9.0, 1.5), "Sink": 0.5, "Sofa": 0.1},
            {"Apple": 0.0, "Mug": 1.51, "Sink": 5.0},
            {"Apple": 0.0, "Sink": 5.0},
        )
    )
    # Apple and Sink are near in one of three rooms, Sofa shares only one room with the others.
    # Mug and Sink: 1.0 m in the first room, 3.49 in the second.
    assert joined(found) == {("Apple", "Mug"), ("Mug", "Sink")}
    np.testing.assert_array_equal(found, found.T)
    assert found.dtype == np.float32


def test_the_training_rooms_graph_is_the_one_of_a_slow_form(
    some_rooms: SceneTables, glove: WordVectors
) -> None:
    centres = (some_rooms.object_box[:, :3] + some_rooms.object_box[:, 3:]) / 2
    found = class_graph.co_occurrence(some_rooms)
    by_room: list[dict[int, list[np.ndarray]]] = [{} for _ in some_rooms.scenes]
    for scene, cls, centre in zip(
        some_rooms.object_scene, some_rooms.object_class, centres, strict=True
    ):
        by_room[scene].setdefault(int(cls), []).append(centre)
    for i in range(len(some_rooms.classes)):
        for j in range(i):
            gaps = [
                min(float(np.linalg.norm(a - b)) for a in room[i] for b in room[j])
                for room in by_room
                if i in room and j in room
            ]
            near = sum(gap <= 1.5 for gap in gaps)
            assert found[i, j] == (len(gaps) >= 2 and near >= len(gaps) / 2)


def test_an_imported_graph_replaces_that_of_the_rooms(
    ithor: SceneTables, glove: WordVectors
) -> None:
    names = ithor.classes
    mug, sink, toaster = (names.index(name) for name in ("Mug", "Sink", "Toaster"))
    adjacency = np.zeros((len(names), len(names)), np.float32)
    adjacency[mug, sink] = adjacency[mug, toaster] = 1.0
    task = make_task(
        TrainConfig(split="18/4"), ithor, glove, Extras(graph_classes=names, adjacency=adjacency)
    )
    assert task.classes.edges == ((mug, sink, 1.0),)  # Toaster is unseen
    built = make_task(TrainConfig(split="18/4"), ithor, glove).classes
    assert 400 < len(built.edges) < 900
    assert {i for edge in built.edges for i in edge[:2]} <= set(built.known)


@pytest.mark.parametrize("split", ["22/0", "14/8"])
def test_no_unseen_class_is_a_node(ithor: SceneTables, glove: WordVectors, split: str) -> None:
    classes = make_task(TrainConfig(split=split), ithor, glove).classes
    assert classes.normalised_adjacency().shape == (len(classes.known),) * 2
    assert len(ithor.classes) - len(classes.known) == int(split.partition("/")[2])


def test_an_object_in_an_unknown_place_joins_and_parts_nothing(some_rooms: SceneTables) -> None:
    """Imported rooms may have such objects beside others of their class."""
    kept = np.ones(len(some_rooms.object_class), bool)
    kept[::5] = False
    unknown = np.where(kept[:, None], some_rooms.object_box, np.nan).astype(np.float32)
    arrays = {
        name: getattr(some_rooms, name)[kept]
        for name in ("object_box", "object_class", "object_scene")
    }
    found = class_graph.co_occurrence(dataclasses.replace(some_rooms, object_box=unknown))
    without = class_graph.co_occurrence(SimpleNamespace(**vars(some_rooms) | arrays))
    np.testing.assert_array_equal(found, without)
    assert (found != class_graph.co_occurrence(some_rooms)).any()
