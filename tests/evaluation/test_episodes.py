"""The lists of evaluation episodes: valid, complete, drawn as described, and tied to the tables."""

from __future__ import annotations

import dataclasses
import hashlib
from collections import Counter
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import stats

from tdanet_jax.evaluation import episodes, report
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.dataset import PublishedEpisode, Rooms, find_targets
from tdanet_jax.splits import OPEN, UNSEEN, make_split
from tdanet_jax.vocabulary import TARGETS
from tests.support.handmade import houses, lopsided
from tests.support.oracle import ROOMS, World, pose_of

SPLITS = [(name, validation) for name in UNSEEN for validation in (False, True)]
OWN = [("Mug,Vase,CD,Towel", False), ("Mug,CD", False), ("Bread,Mug,Mirror", True)]


@pytest.mark.parametrize(("name", "validation"), SPLITS + OWN)
def test_the_lists_hold_250_valid_episodes_a_room_type(
    ithor: SceneTables, name: str, validation: bool
) -> None:
    split = make_split(name, validation)
    lists = episodes.load(ithor, split)
    assert list(lists) == (["seen", "unseen"] if any(split.unseen.values()) else ["seen"])
    for group, chosen in lists.items():
        allowed = split.seen if group == "seen" else split.unseen
        scene = ithor.position_scene[chosen.pose // 16]
        kinds = [ROOMS[ithor.room_type[s]] for s in scene]
        assert Counter(kinds) == dict.fromkeys((room for room in ROOMS if allowed[room]), 250)
        assert (chosen.pose % 2 == 0).all(), "episodes start looking level"
        assert (ithor.distance[chosen.pose, chosen.target] >= 0).all()
        assert {ithor.scenes[s] for s in scene} <= set(split.eval_scenes)
        for kind, goal in zip(kinds, chosen.target, strict=True):
            assert ithor.targets[goal] in allowed[kind]


@pytest.mark.parametrize(("name", "validation"), SPLITS)
def test_the_committed_lists_are_those_that_are_drawn_from_these_tables(
    ithor: SceneTables, name: str, validation: bool
) -> None:
    split = make_split(name, validation)
    loaded, drawn = episodes.load(ithor, split), episodes.draw_split(ithor, split)
    assert list(loaded) == list(drawn)
    for group in drawn:
        np.testing.assert_array_equal(loaded[group].pose, drawn[group].pose)
        np.testing.assert_array_equal(loaded[group].target, drawn[group].target)


def test_a_published_split_of_other_targets_has_other_episodes(ithor: SceneTables) -> None:
    targets = {"kitchen": ("Toaster", "Mug"), "bedroom": ("Pillow", "CD")}
    for chosen, group in zip(
        episodes.load(ithor, make_split("18/4", targets=targets)).values(),
        ({"Mug", "CD"}, {"Toaster", "Pillow"}),
        strict=True,
    ):
        assert {ithor.targets[goal] for goal in chosen.target} == group
        assert len(chosen) == 500


@pytest.mark.parametrize("validation", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_the_open_benchmark_has_as_many_episodes_for_every_target(
    ithor: SceneTables, validation: bool
) -> None:
    tables, targets = find_targets(OPEN, Rooms(ithor, None), validation)
    split = make_split(OPEN, validation, targets)
    loaded, drawn = episodes.load(tables, split), episodes.draw_split(tables, split)
    assert list(loaded) == list(drawn) == ["seen", "unseen"]
    for group, chosen in loaded.items():
        np.testing.assert_array_equal(chosen.pose, drawn[group].pose)
        np.testing.assert_array_equal(chosen.target, drawn[group].target)
        assert (tables.distance[chosen.pose, chosen.target] >= 0).all()
        scene = tables.position_scene[chosen.pose // 16]
        assert {tables.scenes[s] for s in scene} <= set(split.eval_scenes)
        asked = Counter(
            (ROOMS[tables.room_type[s]], tables.targets[goal])
            for s, goal in zip(scene, chosen.target, strict=True)
        )
        wanted = split.seen if group == "seen" else split.unseen
        pairs = {(room, name) for room, names in wanted.items() for name in names}
        assert set(asked) <= pairs
        assert validation or set(asked) == pairs
        assert set(asked.values()) == {10 if group == "seen" else 40}
        pair = [(s, goal) for s, goal in zip(scene, chosen.target, strict=True)]
        if group == "unseen" and not validation:  # 4 episodes or more in each of up to 10 rooms
            assert min(Counter(pair).values()) >= 4
    with pytest.raises(ValueError, match="belongs to scene tables"):
        episodes.load(dataclasses.replace(tables, field_of_view=91.0), split)


def test_the_lists_of_a_split_of_ones_own_are_the_same_everywhere(ithor: SceneTables) -> None:
    """Nobody commits them: this says that other machines and versions draw the same."""
    lists = episodes.load(ithor, make_split("towel,CD,Mug,Vase"))
    assert list(lists) == ["seen", "unseen"]
    drawn = [np.stack([one.pose, one.target]).astype("<i4") for one in lists.values()]
    assert [hashlib.sha256(array.tobytes()).hexdigest()[:16] for array in drawn] == [
        "05e032ab0def30a2", "ca59090c8c29f3d2"
    ]  # fmt: skip


def test_most_rooms_and_targets_occur(ithor: SceneTables) -> None:
    split = make_split("18/4")
    for group, targets in (("seen", split.seen), ("unseen", split.unseen)):
        chosen = episodes.load(ithor, split)[group]
        scenes = np.unique(ithor.position_scene[chosen.pose // 16])
        assert len(scenes) >= (38 if group == "seen" else 25)
        found = {ithor.targets[goal] for goal in chosen.target}
        assert found == {name for names in targets.values() for name in names}


def test_lists_of_other_tables_are_refused(ithor: SceneTables) -> None:
    other = dataclasses.replace(ithor, field_of_view=91.0)
    for name in ("18/4", "Mug,CD"):
        with pytest.raises(ValueError, match=other.data_version):
            episodes.load(other, make_split(name))


def test_draws_are_uniform_over_scenes_then_targets_then_starts() -> None:
    tables = lopsided()
    targets = {"kitchen": ("Mug", "Bread"), "bedroom": ("Bread",)}
    chosen = episodes.draw(tables, tables.scenes, targets, 10_000, seed=0)
    position, rotation = chosen.pose // 16, chosen.pose // 2 % 8
    scene = tables.position_scene[position]
    assert Counter(scene == 4) == {True: 10_000, False: 10_000}
    assert set(chosen.target[scene == 4]) == {1}
    for values, expected in (
        (scene[scene < 4], {0, 1, 2}),  # the fourth kitchen's mug is visible from nowhere
        (chosen.target[scene == 0], {0, 1}),
        (position[scene == 1], {2, 3, 4}),
        (position[scene == 2], {5, 6}),  # the rest of that room cannot reach the mug
        (rotation, set(range(8))),
    ):
        counts = Counter(values.tolist())
        assert set(counts) == expected
        assert stats.chisquare(list(counts.values())).pvalue > 1e-6
    world = World(tables, {}, (1, 1, 1, 1))
    for pose, goal in set(zip(chosen.pose.tolist(), chosen.target.tolist(), strict=True)):
        assert world.distance(pose, tables.targets[goal]) is not None
        assert pose_of(pose).horizon == 0


def test_in_a_house_the_room_of_the_start_says_what_is_looked_for() -> None:
    """Wherever in the house it is; each house counts once for each of its rooms' types."""
    tables = houses()
    targets = {"kitchen": ("Mug",), "bedroom": ("Pillow", "Mug")}
    chosen = episodes.draw(tables, tables.scenes, targets, 2_000, seed=0)
    position, goal = chosen.pose // 16, chosen.target
    home = tables.position_scene[position]
    world, kitchen = World(tables, {}, (1, 1, 1, 1)), np.arange(4000) < 2000
    assert {world.room(p) for p in position[kitchen]} == {"kitchen"}
    assert {world.room(p) for p in position[~kitchen]} == {"bedroom"}
    for room, names in targets.items():
        for scene in range(2):
            for target in names:
                here = (goal == tables.targets.index(target)) & (
                    tables.position_scene[position] == scene
                )
                drawn = set(position[here & (kitchen == (room == "kitchen"))].tolist())
                assert drawn == world.valid_starts(scene, target, room)
    counts = Counter(home[kitchen].tolist())
    assert stats.chisquare(list(counts.values())).pvalue > 1e-6
    rows = report.columns(
        tables, chosen, SimpleNamespace(shortest=0, length=0, success=0, collided=0)
    )
    assert rows["room"].tolist() == ["kitchen"] * 2000 + ["bedroom"] * 2000


def test_published_episodes_of_a_house_follow_the_room_of_their_start() -> None:
    tables = houses()
    listed = [
        PublishedEpisode("test", "Room0", 0.25 * place, 0.0, 0, 0, target)
        for place in range(4)
        for target in ("Mug", "Pillow")
    ]
    split = dataclasses.replace(make_split("22/0"), eval_scenes=("Room0",))
    found = episodes.published(tables, split, listed)["seen"]
    assert found.pose.tolist() == [0, 16, 32, 48]
    assert [tables.targets[goal] for goal in found.target] == ["Mug", "Mug", "Pillow", "Pillow"]


def test_equal_seeds_give_equal_lists(some_rooms: SceneTables) -> None:
    first, again, other = (
        episodes.draw(some_rooms, some_rooms.scenes, TARGETS, 20, seed) for seed in (1, 1, 2)
    )
    np.testing.assert_array_equal(first.pose, again.pose)
    np.testing.assert_array_equal(first.target, again.target)
    assert not np.array_equal(first.pose, other.pose)
    assert len(first) == 80


def test_room_types_without_targets_have_no_episodes(some_rooms: SceneTables) -> None:
    chosen = episodes.draw(some_rooms, some_rooms.scenes, {"kitchen": ("Mug",)}, 5, seed=0)
    assert len(chosen) == 5
