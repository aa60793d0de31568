"""Partial rewards: Pr(t | p), the choice of parents, and the four values of Eq. 3."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig, TrainConfig
from tdanet_jax.env import dynamics, reward
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import Parents, find_parents
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables
from tdanet_jax.splits import make_split
from tdanet_jax.task import make_task
from tdanet_jax.vocabulary import TARGETS
from tdanet_jax.words import WordVectors
from tests.support import handmade, oracle
from tests.support.handmade import Room, Sighting, corridor, tables_of

CLASSES = ("Apple", "CounterTop", "Desk", "Drawer", "Fridge", "Mug", "Shelf", "Sink")


def furnished(kind: str, **places: float | tuple[float, ...]) -> Room:
    """A room whose objects stand on a line, at the given metres; several of a class in a tuple."""
    objects = []
    for name, where in places.items():
        for x in where if isinstance(where, tuple) else (where,):
            objects.append((name, (x, 0.5, 0.0)))
    return Room(kind, corridor(1), objects, {})


def parents_by_name(tables: SceneTables, found: Parents, target: str) -> list[tuple[str, float]]:
    """A target's parents in order, with R_p."""
    goal = tables.targets.index(target)
    pairs = zip(found.classes[goal], found.reward[goal], strict=True)
    return [(tables.classes[cls], float(worth)) for cls, worth in pairs if cls >= 0]


def test_r_p_is_half_the_share_of_rooms_in_which_parent_and_target_are_near() -> None:
    rooms = [
        # The nearest of two drawers counts; the counter stands exactly at the limit.
        furnished("kitchen", Mug=0.0, CounterTop=1.5, Drawer=(9.0, 1.0), Fridge=1.0),
        furnished("kitchen", Mug=(0.0, 8.0), CounterTop=8.5, Drawer=4.0),
        furnished("kitchen", Mug=0.0, CounterTop=1.51, Drawer=5.0),
        furnished("kitchen", Mug=0.0, CounterTop=0.2),
        furnished("kitchen", CounterTop=0.0, Drawer=0.1),  # without the target: does not count
    ]
    tables = tables_of(rooms, CLASSES, ["Mug"])
    found = find_parents(tables, {"kitchen": ["Mug"]})
    # Fridge 1 of 1, CounterTop 3 of 4, Drawer 1 of 3; R_p = 5 Pr 0.1.
    assert parents_by_name(tables, found, "Mug") == [
        ("Fridge", pytest.approx(0.5)),
        ("CounterTop", pytest.approx(0.375)),
        ("Drawer", pytest.approx(0.5 / 3)),
    ]
    assert found.classes.dtype == np.int32
    assert found.reward.dtype == np.float32


def test_the_three_likeliest_parents_stay_and_ties_go_to_the_nearer() -> None:
    rooms = [
        furnished("kitchen", Mug=0.0, CounterTop=1.0, Drawer=0.5, Fridge=1.2, Shelf=0.8, Sink=9.0)
    ]
    tables = tables_of(rooms, CLASSES, ["Mug"])
    found = find_parents(tables, {"kitchen": ["Mug"]})
    names = [name for name, _ in parents_by_name(tables, found, "Mug")]
    assert names == ["Drawer", "Shelf", "CounterTop"]


def test_a_class_that_is_never_near_is_no_parent_and_slots_stay_empty() -> None:
    tables = tables_of([furnished("kitchen", Mug=0.0, CounterTop=4.0, Sink=1.0)], CLASSES, ["Mug"])
    found = find_parents(tables, {"kitchen": ["Mug"]})
    assert parents_by_name(tables, found, "Mug") == [("Sink", pytest.approx(0.5))]
    assert found.classes[0].tolist()[1:] == [-1, -1]
    assert found.reward[0].tolist()[1:] == [0, 0]


def test_only_larger_classes_are_parents_and_never_the_target_itself() -> None:
    rooms = [furnished("living_room", Desk=(0.0, 0.5), Apple=0.1, Mug=0.2)]
    tables = tables_of(rooms, CLASSES, ["Desk", "Mug"])
    found = find_parents(tables, {"living_room": ["Desk", "Mug"]})
    assert parents_by_name(tables, found, "Desk") == []
    assert [name for name, _ in parents_by_name(tables, found, "Mug")] == ["Desk"]


def test_rooms_of_another_type_do_not_count() -> None:
    rooms = [
        furnished("kitchen", Mug=0.0, Sink=1.0),
        furnished("bedroom", Mug=0.0, Sink=9.0, Desk=0.1),
    ]
    tables = tables_of(rooms, CLASSES, ["Mug"])
    found = find_parents(tables, {"kitchen": ["Mug"]})
    assert parents_by_name(tables, found, "Mug") == [("Sink", pytest.approx(0.5))]


def test_a_house_counts_for_the_targets_of_each_of_its_rooms() -> None:
    house = furnished("kitchen", Mug=0.0, Desk=0.0, Sink=1.0)
    house = dataclasses.replace(
        house, kind=["kitchen", "bathroom"], next_position=corridor(2), sightings={}
    )
    tables = tables_of([furnished("bedroom", Mug=0.0, Sink=9.0), house], CLASSES, ["Mug"])
    for room, worth in (("kitchen", 0.5), ("bathroom", 0.5), ("bedroom", None)):
        found = dict(parents_by_name(tables, find_parents(tables, {room: ["Mug"]}), "Mug"))
        assert found.get("Sink") == worth
        targets = {room: ["Mug"]}
        slow = oracle.parent_rewards(tables, targets, reward.PARENT_CANDIDATES, reward.MIN_SUPPORT)
        assert found == pytest.approx(slow["Mug"])


def test_a_parent_that_few_rooms_of_the_target_hold_is_left_out() -> None:
    rooms = [furnished("kitchen", Mug=0.0, Sink=1.0) for _ in range(4)]
    rooms.append(furnished("kitchen", Mug=0.0, Fridge=0.5))
    tables = tables_of(rooms, CLASSES, ["Mug"])
    names = dict(parents_by_name(tables, find_parents(tables, {"kitchen": ["Mug"]}), "Mug"))
    assert names == {"Sink": pytest.approx(0.5)}


def test_a_target_of_two_room_types_has_its_parents_from_both() -> None:
    rooms = [furnished("kitchen", Mug=0.0, Sink=1.0), furnished("bedroom", Mug=0.0, Sink=2.0)]
    tables = tables_of(rooms, CLASSES, ["Mug"])
    for targets, worth in (
        ({"kitchen": ["Mug"]}, {"Sink": 0.5}),
        ({"bedroom": ["Mug"]}, {}),
        ({"kitchen": ["Mug"], "bedroom": ["Mug"]}, {"Sink": 0.25}),
    ):
        assert dict(parents_by_name(tables, find_parents(tables, targets), "Mug")) == worth


def test_published_parents_of_two_room_types_are_the_three_largest_of_both() -> None:
    tables = tables_of([furnished("kitchen", Mug=0.0)], CLASSES, ["Apple", "Mug"])
    published = {
        "kitchen": {"Mug": {"Sink": 0.4, "Shelf": 0.3, "Desk": 0.2}},
        "bedroom": {"Mug": {"Desk": 0.1, "Drawer": 0.25, "Lamp": 0.5, "Fridge": 0.5}},
    }
    targets = {"kitchen": ["Mug"], "bedroom": ["Mug"]}
    for rooms in (targets, dict(reversed(targets.items()))):
        found = reward.published_parents(tables, rooms, published, {"Fridge"})
        expected = [("Sink", 0.4), ("Shelf", 0.3), ("Drawer", 0.25)]
        assert parents_by_name(tables, found, "Mug") == [(n, pytest.approx(r)) for n, r in expected]
        assert parents_by_name(tables, found, "Apple") == []
    del published["bedroom"]["Mug"]["Drawer"]
    found = reward.published_parents(tables, targets, published, {"Fridge"})
    assert parents_by_name(tables, found, "Mug")[2] == ("Desk", pytest.approx(0.2))


def test_a_target_that_is_not_asked_for_has_no_parents() -> None:
    tables = tables_of([furnished("kitchen", Mug=0.0, Apple=0.5, Sink=1.0)], CLASSES, ["Apple"])
    found = find_parents(tables, {"kitchen": []})
    assert (found.classes == -1).all()
    assert not found.reward.any()


def test_the_training_rooms_parents_are_the_slow_worlds(ithor: SceneTables) -> None:
    split = make_split("22/0")
    tables = ithor.subset(split.train_scenes)
    found = find_parents(tables, TARGETS)
    expected = oracle.parent_rewards(tables, TARGETS, reward.PARENT_CANDIDATES, reward.MIN_SUPPORT)
    for target, worth in expected.items():
        assert dict(parents_by_name(tables, found, target)) == pytest.approx(worth), target
        assert all(0 < r <= 0.5 for r in worth.values())
    assert sum(map(len, expected.values())) > 50, "nearly every target has three parents"


TARGET, LARGE, SMALL = "Mug", "Fridge", "Sink"
WORTH = {LARGE: 0.4, SMALL: 0.15}

#: What is visible along a corridor that is walked along heading 0, by position.
SCENERY: tuple[tuple[str, ...], ...] = (
    (), (SMALL,), (SMALL,), (SMALL, LARGE), (LARGE,), (TARGET,), (TARGET, SMALL),
    (TARGET, SMALL, LARGE), (),
)  # fmt: skip


@pytest.fixture(scope="module")
def params() -> EnvParams:
    """The corridor, with two parents; everything is in view everywhere, near only as listed."""
    objects = [(name, (0.0, 0.0, 0.0)) for name in (TARGET, LARGE, SMALL)]
    sightings = {
        handmade.state(place, heading): [
            Sighting(item, visible=name in near and heading == 0)
            for item, (name, _) in enumerate(objects)
        ]
        for place, near in enumerate(SCENERY)
        for heading in (0, 90)
    }
    room = Room("kitchen", corridor(len(SCENERY)), objects, sightings)
    tables = tables_of([room], CLASSES, [TARGET])
    classes = [[CLASSES.index(SMALL), CLASSES.index(LARGE), -1]]
    worth = [[WORTH[SMALL], WORTH[LARGE], 0.0]]
    parents = Parents(np.array(classes, np.int32), np.array(worth, np.float32))
    return make_params(tables, {"kitchen": [TARGET]}, parents, (50,) * 4, ObservationSpec())


def rewards(params: EnvParams, state: EnvState, actions: str) -> list[float]:
    """Rewards along a walk: m moves ahead, l and r turn, d says Done."""
    found = []
    for letter in actions:
        out = dynamics.transition(
            state, jnp.int32({"m": 0, "l": 1, "r": 2, "d": 5}[letter]), params
        )
        found.append(float(out.reward))
        state = out.state
    return found


def standing(params: EnvParams, place: int, heading: int = 0) -> EnvState:
    """An episode of the first target that starts in the corridor."""
    return dynamics.start(jnp.int32(handmade.state(place, heading)), jnp.int32(0), params)


STEP = pytest.approx(-0.01)


@pytest.mark.parametrize(
    ("start", "actions", "expected"),
    [
        (0, "r", [-0.01]),  # nothing new
        (0, "m", [0.15]),  # a parent for the first time: R_p instead of the step's cost
        (0, "mm", [0.15, -0.01]),  # once
        (0, "mlr", [0.15, -0.01, -0.01]),  # not again after it was out of sight
        (0, "mmm", [0.15, -0.01, 0.4]),  # a second parent is new although the first is not
        (2, "m", [0.4]),  # two at once pay the larger alone
        (2, "mlrmr", [0.4, -0.01, -0.01, -0.01, -0.01]),  # and the smaller never later
        (4, "md", [-0.01, 5.0]),  # the target in view earns nothing before Done
        (5, "md", [0.15, 5.15]),  # R_p at Done although that parent was seen before
        (6, "md", [0.4, 5.4]),  # the larger of two
        (5, "d", [5.0]),
        (6, "d", [5.15]),
        (7, "d", [5.4]),
        (0, "d", [-0.01]),  # a Done that fails
        (1, "d", [-0.01]),  # also with a parent in view that was never paid
        (4, "d", [-0.01]),
    ],
)
def test_each_step_earns_one_of_four_values(
    params: EnvParams, start: int, actions: str, expected: list[float]
) -> None:
    assert rewards(params, standing(params, start), actions) == pytest.approx(expected)


def test_what_is_in_view_but_beyond_reach_earns_nothing(params: EnvParams) -> None:
    # Turned by 90 degrees everything is in view and nothing is near.
    assert rewards(params, standing(params, 7, 90), "d") == [STEP]
    assert rewards(params, standing(params, 7, 45), "r") == [STEP]


def test_a_parents_reward_is_the_one_of_its_own_target() -> None:
    objects = [(name, (0.0, 0.0, 0.0)) for name in ("Mug", "Apple", "Sink")]
    sightings = {handmade.state(0, 0): [Sighting(i) for i in range(3)]}
    room = Room("kitchen", corridor(1), objects, sightings)
    tables = tables_of([room], CLASSES, ["Apple", "Mug"])
    sink = CLASSES.index("Sink")
    parents = Parents(
        np.array([[sink, -1, -1], [-1, sink, -1]], np.int32),
        np.array([[0.3, 0, 0], [0, 0.1, 0]], np.float32),
    )
    params = make_params(
        tables, {"kitchen": ["Apple", "Mug"]}, parents, (50,) * 4, ObservationSpec()
    )
    zero = jnp.int32(0)
    for goal, worth in ((0, 0.3), (1, 0.1)):
        state = EnvState(jnp.int32(handmade.state(0, 45)), jnp.int32(goal), zero, zero, zero)
        out = dynamics.transition(state, jnp.int32(1), params)
        assert float(out.reward) == pytest.approx(worth)


def test_parents_are_read_from_no_room_but_the_given_ones(ithor: SceneTables) -> None:
    train = ithor.subset(make_split("22/0").train_scenes)
    objects = train.object_box.copy()
    objects[:, [0, 3]] += 100.0 * np.arange(len(objects))[:, None]  # nothing is near anything
    moved = dataclasses.replace(train, object_box=objects)
    assert (find_parents(moved, TARGETS).classes == -1).all()


#: Cosines of a frame's classes to Mug, by position of the corridor; -1 stands for an empty frame.
LIKENESS = {"Fridge": -0.5, "Sink": 0.25, "Apple": 0.75, "Mug": 1.0}
VIEWS: tuple[tuple[str, ...], ...] = (
    (), ("Sink",), ("Sink", "Fridge"), ("Apple", "Sink"), ("Sink",), ("Mug", "Fridge"), ("Fridge",),
)  # fmt: skip


@pytest.mark.parametrize(
    ("start", "actions", "expected"),
    [
        (0, "m", [0.025]),  # a tenth of the cosine instead of the step's cost
        (1, "mm", [0.025, 0.075]),  # the first frame is paid with the first step; more is more
        (2, "mmm", [0.075, -0.01, 0.1]),  # the largest so far counts, not the last
        (5, "m", [-0.01]),  # a negative cosine earns nothing
        (4, "md", [0.1, 5.1]),  # the target in view is worth 0.1, at Done again
        (3, "d", [-0.01]),  # a Done that fails, whatever is in view
    ],
)
def test_likeness_pays_when_it_is_the_largest_so_far(
    start: int, actions: str, expected: list[float]
) -> None:
    objects = [(name, (0.0, 0.0, 0.0)) for name in LIKENESS]
    sightings = {
        handmade.state(place, 0): [Sighting(list(LIKENESS).index(name)) for name in seen]
        for place, seen in enumerate(VIEWS)
    }
    room = Room("kitchen", corridor(len(VIEWS)), objects, sightings)
    tables = tables_of([room], CLASSES, ["Mug"])
    cosine = np.zeros((len(CLASSES), len(CLASSES)), np.float32)
    for name, value in LIKENESS.items():
        cosine[CLASSES.index("Mug"), CLASSES.index(name)] = value
    similarity = reward.greatest_similarity(tables, cosine)
    nobody = reward.no_parents(tables)
    params = make_params(
        tables, {"kitchen": ["Mug"]}, nobody, (50,) * 4, ObservationSpec(), similarity=similarity
    )
    assert rewards(params, standing(params, start), actions) == pytest.approx(expected)


def test_cosines_of_vectors_of_any_length_and_none() -> None:
    found = reward.cosines(np.array([[3.0, 0.0], [2.0, 2.0], [0.0, 0.0], [-1.0, 0.0]]))
    half = 0.5**0.5
    expected = [[1, half, 0, -1], [half, 1, 0, -half], [0, 0, 0, 0], [-1, -half, 0, 1]]
    np.testing.assert_allclose(found, expected, atol=1e-6)


@pytest.mark.parametrize("paid", ["parents", "similarity", "none"])
def test_the_configuration_says_what_is_paid_for(
    some_rooms: SceneTables, glove: WordVectors, paid: Any
) -> None:
    config = TrainConfig(learner=LearnerConfig(partial_reward=paid))
    task = make_task(config, some_rooms, glove)
    params = task.train_params
    assert bool((params.parent_class >= 0).any()) == (paid == "parents")
    assert (params.similarity is not None) == (paid == "similarity")
    if params.similarity is not None:
        # The target itself in view has a cosine of 1; a hidden class in view counts for nothing.
        visible = np.asarray(params.distance) == 0
        np.testing.assert_allclose(np.asarray(params.similarity)[visible], 1.0, rtol=1e-6)
        hidden = [some_rooms.targets.index(name) for name in task.split.hidden]
        assert not np.asarray(params.similarity)[:, hidden].any()


def test_an_object_in_an_unknown_place_is_as_if_it_were_not_there(some_rooms: SceneTables) -> None:
    """Imported rooms may have such objects beside others of their class."""
    scene, kind = 0, some_rooms.classes.index("Cabinet")
    here = np.flatnonzero((some_rooms.object_scene == scene) & (some_rooms.object_class == kind))
    assert len(here) > 1
    centres = some_rooms.object_box.reshape(-1, 2, 3).mean(axis=1)
    [mug] = np.flatnonzero(
        (some_rooms.object_scene == scene)
        & (some_rooms.object_class == some_rooms.classes.index("Mug"))
    )
    gaps = np.linalg.norm(centres[here] - centres[mug], axis=1)
    box = some_rooms.object_box.copy()
    box[here[gaps.argmin()]] = np.nan
    tables = dataclasses.replace(some_rooms, object_box=box)
    found = reward.nearest_distances(tables, "Mug", "Cabinet", np.array([scene]))
    assert found == pytest.approx(np.sort(gaps)[1])
    box[here] = np.nan
    assert np.isinf(reward.nearest_distances(tables, "Mug", "Cabinet", np.array([scene]))).all()
