"""Splits are those of the literature, or leave out the classes that they name."""

from __future__ import annotations

import itertools
import random
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.scenes import SceneTables
from tdanet_jax.splits import file_name, make_split, split_name
from tdanet_jax.vocabulary import ALL_TARGETS, ROOM_TYPES, TARGETS

UNSEEN = {
    "22/0": set(),
    "18/4": {"Toaster", "Laptop", "Pillow", "ToiletPaper"},
    "14/8": {
        "Apple", "Toaster", "Television", "Laptop", "AlarmClock", "Pillow", "ToiletPaper", "Mirror",
    },
}  # fmt: skip


def names(groups: dict[str, tuple[str, ...]]) -> set[str]:
    return {name for group in groups.values() for name in group}


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


@st.composite
def custom_splits(draw: st.DrawFn, left: int = 1) -> tuple[str, ...]:
    """Unseen classes in any order; `left` seen ones at least stay in each room type."""
    chosen = [
        draw(
            st.lists(
                st.sampled_from(TARGETS[room]), unique=True, max_size=len(TARGETS[room]) - left
            )
        )
        for room in ROOM_TYPES
    ]
    flat = [name for names in chosen for name in names] or ["Mug"]
    return tuple(draw(st.permutations(flat)))


def typed(classes: tuple[str, ...], seed: int) -> str:
    """The classes as a user may type them."""
    rng = random.Random(seed)
    ways = (str, str.lower, str.upper, lambda name: re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name))
    return rng.choice((",", ", ")).join(rng.choice(ways)(name) for name in classes)


@given(custom_splits(), st.integers(0, 99))
def test_a_custom_split_hides_the_classes_that_it_names(
    classes: tuple[str, ...], seed: int
) -> None:
    split = make_split(typed(classes, seed))
    assert names(split.unseen) == set(split.hidden) == set(classes)
    for room in ROOM_TYPES:
        assert split.seen[room] == tuple(c for c in TARGETS[room] if c not in classes)
        assert split.unseen[room] == tuple(c for c in TARGETS[room] if c in classes)
    assert (split.train_scenes, split.eval_scenes) == (
        make_split("18/4").train_scenes, make_split("18/4").eval_scenes
    )  # fmt: skip
    # A split has one name, which describes it and can be part of a file name.
    assert split.name == split_name(",".join(sorted(classes))) == split_name(split.name)
    assert make_split(split.name) == split
    assert re.fullmatch(r"[A-Za-z0-9-]+", file_name(split.name))


def test_a_custom_split_takes_any_name_of_a_class() -> None:
    assert split_name("tv, Arm-Chairs,mugs") == "Mug,Television,ArmChair"
    with pytest.raises(ValueError, match="--split tv,television: Television is given twice"):
        split_name("tv,television")
    with pytest.raises(ValueError, match="--split couch,Mug: no target is called couch"):
        split_name("couch,Mug")


def test_every_set_of_classes_has_its_own_name_and_file_name() -> None:
    sets = [c for count in (1, 2, 3) for c in itertools.combinations(ALL_TARGETS, count)]
    found = [split_name(",".join(classes)) for classes in sets]
    assert len(set(found)) == len({file_name(name) for name in found}) == len(sets)


@pytest.mark.parametrize("name", ["18/4", "14/8"])
def test_the_classes_of_a_published_split_are_that_split(name: str) -> None:
    for classes in (sorted(UNSEEN[name]), sorted(UNSEEN[name], reverse=True)):
        assert make_split(",".join(classes)) == make_split(name)
        assert make_split(",".join(classes), validation=True) == make_split(name, validation=True)


@given(custom_splits(left=2))
def test_validation_of_a_custom_split_holds_out_one_more_class_per_room_type(
    classes: tuple[str, ...],
) -> None:
    split, final = make_split(",".join(classes), validation=True), make_split(",".join(classes))
    standard = names(make_split("22/0", validation=True).unseen)
    for room in ROOM_TYPES:
        [held_out] = split.unseen[room]
        assert held_out in final.seen[room]
        assert held_out in standard or standard & set(TARGETS[room]) <= set(classes)
        assert set(split.seen[room]) == set(final.seen[room]) - {held_out} != set()
    assert set(split.hidden) == set(classes) | names(split.unseen)
    assert split.name == f"{final.name}-validation"
    assert split.eval_scenes == make_split("18/4", validation=True).eval_scenes


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "17/5",
            "choose one of 22/0, 18/4, 14/8, open, or name the unseen classes, separated by",
        ),
        ("", "choose one of 22/0"),
        ("18/4,Mug", "no target is called 18/4; choose one of 22/0"),
        ("Mug,Sofa", "no target is called Sofa; choose one of 22/0"),
        ("Mug,Vaze", "no target is called Vaze; did you mean Vase?"),
        ("mirorr", "no target is called mirorr; did you mean Mirror?"),
        ("Mug,CD,mug", "Mug is given twice"),
        ("Mug,", "a comma without a class on both sides"),
        ("Mug,,CD", "a comma without a class on both sides"),
        (",".join(TARGETS["bathroom"]), "leaves no class to train on in bathroom"),
        (
            ",".join(ALL_TARGETS),
            "leaves no class to train on in kitchen, living_room, bedroom, bathroom",
        ),
    ],
)
def test_what_is_not_a_split_is_refused_in_one_line(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=re.escape(f"--split {text}: {message}")) as caught:
        make_split(text)
    assert "\n" not in str(caught.value)


def test_validation_needs_a_class_to_hold_out_besides_one_to_train_on() -> None:
    text = ",".join(TARGETS["bathroom"][1:])
    assert make_split(text).seen["bathroom"] == TARGETS["bathroom"][:1]
    with pytest.raises(ValueError, match="in bathroom besides the one that --validation holds out"):
        make_split(text, validation=True)


def test_validation_holds_out_what_no_room_type_needs() -> None:
    targets = {"kitchen": ("Mug", "Book", "Kettle"), "living_room": ("Book",)}
    for text, held in (("22/0", "Mug"), ("Kettle", "Mug"), ("Mug", "Kettle")):
        split = make_split(text, True, targets)
        assert split.unseen == {"kitchen": (held,), "living_room": ()}
        assert split.seen["living_room"] == ("Book",)
    shops = {"shop": ("Lathe", "Vase"), **dict.fromkeys(ROOM_TYPES, ())}
    assert make_split("22/0", True, shops).unseen["shop"] == ("Lathe",)


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
