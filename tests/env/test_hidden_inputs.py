"""The zero-shot filter at its every entrance: whatever an input says of a hidden class is ignored.

Each input that can name a class is changed in what it says of one class. If that class is hidden,
training reads the same to the last bit, so that nothing leaks and nothing else is lost. If it is
not, training notices. ResNet-18's feature maps are not among the inputs: hidden classes are in the
pictures, and cannot be filtered out.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.dataset import Extras, PublishedEpisode
from tdanet_jax.task import Task, make_task
from tdanet_jax.vocabulary import ROOM_TYPES
from tdanet_jax.words import WordVectors
from tests.support.handmade import Room, Sighting, corridor, state, tables_of

#: Both are targets, and both can be parents of another one.
HIDDEN, SEEN = "CoffeeMachine", "ArmChair"
CLASSES = ("ArmChair", "Bread", "Cabinet", "CoffeeMachine", "CounterTop", "Fridge", "Sink")
TARGETS = ("ArmChair", "Bread", "CoffeeMachine")
PARENTS = {"Bread": {"CounterTop": 0.4, "Fridge": 0.3, "Sink": 0.2, "Cabinet": 0.1}}
PARTS = {"Room0": "train", "Room1": "train", "Room2": "train", "Room3": "test"}


class Inputs(NamedTuple):
    """All that a task is made from."""

    tables: SceneTables
    vectors: WordVectors
    extras: Extras


def rooms(studio: tuple[str, ...] = ("Bread", HIDDEN, SEEN)) -> SceneTables:
    """A living room and a kitchen to train in, a studio with these classes, a kitchen for tests."""
    everything = (HIDDEN, SEEN, "Bread", "CounterTop", "Fridge")
    named = (everything, everything, studio, everything)
    made = []
    for kind, names in zip(("living_room", *["kitchen"] * 3), named, strict=True):
        objects = [(name, (0.3 * i, 1.0, 0.0)) for i, name in enumerate(names)]
        # All but the first and, far away, the last object are in view from the middle.
        views = {state(1, 0): [Sighting(i, visible=i != 4) for i in range(len(names))]}
        made.append(Room(kind, corridor(3), objects, views))
    tables = tables_of(made, CLASSES, TARGETS)
    own_type = np.where(tables.position_scene == 2, len(ROOM_TYPES), tables.position_room_type)
    return dataclasses.replace(
        tables, room_types=(*ROOM_TYPES, "studio"), position_room_type=own_type.astype(np.int8)
    )


def word_vectors() -> WordVectors:
    """Vectors of four numbers for the words of these classes."""
    words = ("arm", "chair", "bread", "cabinet", "coffee", "machine", "counter", "top", "fridge",
             "sink")  # fmt: skip
    drawn = np.random.default_rng(0).normal(size=(len(words), 4)).astype(np.float32)
    return WordVectors({word: i for i, word in enumerate(words)}, drawn)


def other_graph(inputs: Inputs, name: str) -> Inputs:
    """Other weights of a class in the class graph, if there is one."""
    if not inputs.extras.graph_classes:
        return inputs
    adjacency = inputs.extras.adjacency.copy()
    adjacency[CLASSES.index(name)] = adjacency[:, CLASSES.index(name)] = 0.9
    return inputs._replace(extras=dataclasses.replace(inputs.extras, adjacency=adjacency))


def with_tables(change: Callable[[SceneTables, str], dict[str, Any]]) -> Callable[..., Inputs]:
    def changed(inputs: Inputs, name: str) -> Inputs:
        fields = change(inputs.tables, name)
        return inputs._replace(tables=dataclasses.replace(inputs.tables, **fields))

    return changed


def with_parents(others: Callable[[str], dict[str, dict[str, float]]]) -> Callable[..., Inputs]:
    def changed(inputs: Inputs, name: str) -> Inputs:
        if not inputs.extras.parents:
            return inputs
        parents = {room: PARENTS | others(name) for room in ("kitchen", "living_room")}
        return inputs._replace(extras=dataclasses.replace(inputs.extras, parents=parents))

    return changed


def edited(field: str, where: Callable[[SceneTables, str], Any], value: Any) -> Any:
    """A change of some elements of a field of the tables."""

    def change(tables: SceneTables, name: str) -> dict[str, Any]:
        array = getattr(tables, field).copy()
        array[where(tables, name)] = value
        return {field: array}

    return with_tables(change)


def detections_of(tables: SceneTables, name: str) -> np.ndarray:
    return tables.row_class == CLASSES.index(name)


def objects_of(tables: SceneTables, name: str) -> np.ndarray:
    return tables.object_class == CLASSES.index(name)


def other_words(inputs: Inputs, name: str) -> Inputs:
    rows = inputs.vectors.vectors.copy()
    rows[[inputs.vectors.index[w] for w in {HIDDEN: ("coffee",), SEEN: ("arm",)}[name]]] += 1.0
    return inputs._replace(vectors=WordVectors(inputs.vectors.index, rows))


#: What can name a class, and a change of what it says of that class.
ENTRANCES: dict[str, Callable[[Inputs, str], Inputs]] = {
    "published parents": with_parents(lambda name: {"Bread": PARENTS["Bread"] | {name: 0.45}}),
    "parents published for it": with_parents(lambda name: {name: {"Sink": 0.45}}),
    "class graph": other_graph,
    "word vectors": other_words,
    "raster": edited("raster", lambda t, n: t.raster == CLASSES.index(n), -1),
    "boxes in the image": edited("row_box", detections_of, (0, 0, 100, 100)),
    "detections": edited("row_box", detections_of, -1),
    "visibility": edited("row_visible", detections_of, False),
    "distances": edited("distance", lambda t, n: np.s_[:, TARGETS.index(n)], -1),
    "places in the room": edited("object_box", objects_of, 50.0),
    "targets of a custom room type": lambda inputs, name: inputs._replace(
        tables=rooms(tuple(n for n in ("Bread", HIDDEN, SEEN) if n != name))
    ),
}
#: The two ways to pay on the way, an image, and rows by class.
CONFIGS = tuple(
    TrainConfig(
        split=HIDDEN,
        model=model,
        learner=LearnerConfig(partial_reward=reward),
        network=NetworkConfig(image="raster", width=8, hidden=8),
    )
    for model, reward in (("tdanet", "parents"), ("ssnet", "similarity"), ("savn", "parents"))
)


def bases() -> tuple[Inputs, ...]:
    """Rooms that came with parents and a class graph, and rooms in which they are found."""
    weights = np.full((len(CLASSES), len(CLASSES)), 0.5, np.float32)
    published = Extras({"kitchen": PARENTS}, (), CLASSES, weights, PARTS)
    return tuple(
        Inputs(rooms(), word_vectors(), extras) for extras in (published, Extras(parts=PARTS))
    )


def read_by_training(inputs: Inputs) -> dict[str, Any]:
    """Everything of the tasks of all configurations that training reads, by its name."""
    out: dict[str, Any] = {}
    for config in CONFIGS:
        task = make_task(config, inputs.tables, inputs.vectors, inputs.extras)
        assert HIDDEN in task.split.hidden
        arrays = {"params": task.train_params, "words": task.train_words}
        for path, leaf in jax.tree_util.tree_leaves_with_path(arrays):
            name = config.model + jax.tree_util.keystr(path)
            out[name] = leaf.shape, str(leaf.dtype), np.asarray(leaf).tobytes()
        out[f"{config.model}, longest frame"] = task.train_params.max_detections
        out[f"{config.model}, classes"] = task.classes
        out[f"{config.model}, targets"] = task.split.seen
    return out


def differing(one: Inputs, other: Inputs) -> list[str]:
    """What training reads differently."""
    ours, theirs = read_by_training(one), read_by_training(other)
    return [name for name in ours | theirs if ours.get(name) != theirs.get(name)]


@pytest.mark.parametrize("entrance", ENTRANCES)
def test_what_an_input_says_of_a_hidden_class_is_ignored(entrance: str) -> None:
    change = ENTRANCES[entrance]
    noticed = []
    for base in bases():
        assert differing(base, change(base, HIDDEN)) == []
        noticed += differing(base, change(base, SEEN))
    assert noticed, "what it says of a class that is not hidden should matter"


def test_hidden_parents_leave_their_slots_to_others() -> None:
    inputs = ENTRANCES["published parents"](bases()[0], HIDDEN)
    task = make_task(CONFIGS[0], inputs.tables, inputs.vectors, inputs.extras)
    goal = TARGETS.index("Bread")
    found = [CLASSES[c] for c in np.asarray(task.train_params.parent_class[goal])]
    assert found == ["CounterTop", "Fridge", "Sink"]
    np.testing.assert_allclose(task.train_params.parent_reward[goal], [0.4, 0.3, 0.2])


def test_published_episodes_are_not_for_training() -> None:
    base = bases()[0]
    episode = PublishedEpisode("test", "Room3", 0.0, 0.0, 0, 0, HIDDEN)
    extras = dataclasses.replace(base.extras, episodes=(episode,))
    assert differing(base, base._replace(extras=extras)) == []


def test_no_target_of_training_is_hidden_in_any_room_type() -> None:
    task: Task = make_task(CONFIGS[0], *bases()[1])
    asked = {TARGETS[goal] for goal in np.unique(task.train_params.pair_target)}
    assert asked == {"ArmChair", "Bread"}
    assert task.split.seen["studio"] == ("Bread", "ArmChair")
    assert task.split.unseen["studio"] == (HIDDEN,)
