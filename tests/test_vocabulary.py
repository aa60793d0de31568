"""Actions, rooms, targets and splits are those of the literature."""

from __future__ import annotations

import pytest

from tdanet_jax.scenes import SceneTables
from tdanet_jax.vocabulary import (
    ACTION_NAMES,
    ALL_TARGETS,
    ROOM_TYPES,
    TARGETS,
    Action,
    class_words,
    make_split,
)

UNSEEN = {
    "22/0": set(),
    "18/4": {"Toaster", "Laptop", "Pillow", "ToiletPaper"},
    "14/8": {
        "Apple", "Toaster", "Television", "Laptop", "AlarmClock", "Pillow", "ToiletPaper", "Mirror",
    },
}  # fmt: skip


def names(groups: dict[str, tuple[str, ...]]) -> set[str]:
    return {name for group in groups.values() for name in group}


def test_actions_and_their_order() -> None:
    expected = ("MoveAhead", "RotateLeft", "RotateRight", "LookUp", "LookDown", "Done")
    assert expected == ACTION_NAMES
    for action, name in zip(Action, ACTION_NAMES, strict=True):
        assert action.name.replace("_", "").lower() == name.lower()


def test_the_22_targets_by_room() -> None:
    assert len(ALL_TARGETS) == len(set(ALL_TARGETS)) == 22
    assert [len(TARGETS[room]) for room in ROOM_TYPES] == [6, 6, 5, 5]
    assert ROOM_TYPES == ("kitchen", "living_room", "bedroom", "bathroom")


@pytest.mark.parametrize("name", UNSEEN)
def test_splits_hide_the_published_classes(name: str) -> None:
    split = make_split(name)
    seen, unseen = map(int, name.split("/"))
    assert names(split.unseen) == set(split.hidden) == UNSEEN[name]
    assert names(split.seen) == set(ALL_TARGETS) - UNSEEN[name]
    assert (len(names(split.seen)), len(names(split.unseen))) == (seen, unseen)
    for room in ROOM_TYPES:
        assert set(split.seen[room]) | set(split.unseen[room]) == set(TARGETS[room])


@pytest.mark.parametrize("name", UNSEEN)
def test_training_and_test_rooms(name: str) -> None:
    split = make_split(name)
    first = {"kitchen": 1, "living_room": 201, "bedroom": 301, "bathroom": 401}
    train = {f"FloorPlan{n + i}" for n in first.values() for i in range(20)}
    test = {f"FloorPlan{n + i}" for n in first.values() for i in range(20, 30)}
    assert set(split.train_scenes) == train
    assert set(split.eval_scenes) == test
    assert (len(split.train_scenes), len(split.eval_scenes)) == (80, 40)


@pytest.mark.parametrize("name", UNSEEN)
def test_validation_touches_neither_test_rooms_nor_unseen_classes(name: str) -> None:
    split, final = make_split(name, validation=True), make_split(name)
    assert set(split.train_scenes) | set(split.eval_scenes) == set(final.train_scenes)
    assert not set(split.train_scenes) & set(split.eval_scenes)
    assert (len(split.train_scenes), len(split.eval_scenes)) == (64, 16)
    for room in ROOM_TYPES:
        assert len(split.unseen[room]) == 1
        assert set(split.unseen[room]) <= set(final.seen[room])
    assert set(split.hidden) == UNSEEN[name] | names(split.unseen)
    assert names(split.seen) == set(ALL_TARGETS) - split.hidden
    assert split.name != final.name


def test_an_unknown_split_is_refused_with_the_ones_there_are() -> None:
    with pytest.raises(ValueError, match=r"17/5.*22/0, 18/4, 14/8"):
        make_split("17/5")


def test_targets_and_rooms_exist_in_the_bundled_scenes(ithor: SceneTables) -> None:
    split = make_split("18/4")
    assert set(split.train_scenes) | set(split.eval_scenes) == set(ithor.scenes)
    assert set(ALL_TARGETS) <= set(ithor.classes)
    assert ithor.targets == ALL_TARGETS
    for scene, kind in zip(ithor.scenes, ithor.room_type, strict=True):
        hundred = int(scene.removeprefix("FloorPlan")) // 100
        assert {0: 0, 2: 1, 3: 2, 4: 3}[hundred] == kind


@pytest.mark.parametrize("validation", [False, True])
@pytest.mark.parametrize("name", UNSEEN)
def test_every_target_occurs_in_the_rooms_that_ask_for_it(
    ithor: SceneTables, name: str, validation: bool
) -> None:
    split = make_split(name, validation)
    for scenes, groups in (
        (split.train_scenes, (split.seen,)),
        (split.eval_scenes, (split.seen, split.unseen)),
    ):
        rooms = ithor.subset(scenes)
        for group in groups:
            for kind, room in enumerate(ROOM_TYPES):
                inside = rooms.room_type[rooms.state_scene] == kind
                for target in group[room]:
                    assert (rooms.distance[inside, rooms.targets.index(target)] >= 0).any(), target


@pytest.mark.parametrize(
    ("label", "words"),
    [
        ("CoffeeMachine", ("coffee", "machine")),
        ("TVStand", ("tv", "stand")),
        ("CD", ("cd",)),
        ("Mug", ("mug",)),
        ("coffee machine", ("coffee", "machine")),
        ("coffee_machine", ("coffee", "machine")),
        ("Coffee-Machine", ("coffee", "machine")),
        ("wine bottle 2", ("wine", "bottle", "2")),
        ("", ()),
    ],
)
def test_labels_split_into_lower_case_words(label: str, words: tuple[str, ...]) -> None:
    assert class_words(label) == words


def test_a_split_within_fewer_rooms_and_classes() -> None:
    split = make_split("18/4")
    left = split.within({"FloorPlan1", "FloorPlan230", "FloorPlan301", "Lab"}, {"Mug", "Laptop"})
    assert left.train_scenes == ("FloorPlan1", "FloorPlan301")
    assert left.eval_scenes == ("FloorPlan230",)
    assert left.hidden == {"Laptop"}
    assert left.seen["kitchen"] == ("Mug",)
    assert left.seen["bedroom"] == ()
    assert left.unseen["living_room"] == ("Laptop",)
    with pytest.raises(ValueError, match=r"none of the training rooms of split 18/4 .* 1 rooms"):
        split.within({"Lab"}, {"Mug"})
