"""Actions, rooms and targets are those of the literature."""

from __future__ import annotations

import pytest

from tdanet_jax.vocabulary import (
    ACTION_NAMES,
    ALL_TARGETS,
    ROOM_TYPES,
    TARGETS,
    Action,
    class_words,
)


def test_actions_and_their_order() -> None:
    expected = ("MoveAhead", "RotateLeft", "RotateRight", "LookUp", "LookDown", "Done")
    assert expected == ACTION_NAMES
    for action, name in zip(Action, ACTION_NAMES, strict=True):
        assert action.name.replace("_", "").lower() == name.lower()


def test_the_22_targets_by_room() -> None:
    assert len(ALL_TARGETS) == len(set(ALL_TARGETS)) == 22
    assert [len(TARGETS[room]) for room in ROOM_TYPES] == [6, 6, 5, 5]
    assert ROOM_TYPES == ("kitchen", "living_room", "bedroom", "bathroom")


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
