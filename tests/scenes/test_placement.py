"""Small objects put elsewhere: what is known of training rooms, and every rule of a new place."""

from __future__ import annotations

import dataclasses
import itertools
from collections import Counter

import numpy as np
import pytest

from tdanet_jax.scenes import ithor, placement
from tdanet_jax.scenes.placement import Rest, Statistics
from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.splits import make_split
from tests.support import toy

#: Training rooms of all types; L-shaped counters, towels, burners, shelves and beds among them.
ROOMS = ("FloorPlan1", "FloorPlan6", "FloorPlan203", "FloorPlan216", "FloorPlan301", "FloorPlan318",
         "FloorPlan403", "FloorPlan409")  # fmt: skip


@pytest.fixture(scope="module")
def train() -> dict[str, Scene]:
    names = make_split("22/0").train_scenes
    return {scene.name: scene for scene in ithor.load_scenes() if scene.name in names}


@pytest.fixture(scope="module")
def known(train: dict[str, Scene]) -> Statistics:
    return placement.statistics([*train.values()])


@pytest.fixture(scope="module")
def pairs(train: dict[str, Scene], known: Statistics) -> list[tuple[Scene, Scene]]:
    """Rooms, and the same with their small objects elsewhere."""
    found = []
    for name, seed in itertools.product(ROOMS, range(3)):
        objects = placement.rearrange(train[name], known, np.random.default_rng(seed), 0.1)
        found.append((train[name], dataclasses.replace(train[name], objects=objects)))
    return found


def moved(before: Scene, after: Scene) -> list[tuple[SceneObject, SceneObject]]:
    old = {item.object_id: item for item in before.objects}
    return [
        (old[item.object_id], item)
        for item in after.objects
        if not np.array_equal(old[item.object_id].box, item.box)
    ]


def lying(item: SceneObject, below: SceneObject, height: float = 0.0, **more: bool) -> SceneObject:
    """An object with its bottom `height` above the top of another, in which it is held."""
    lift = below.box[1, 1] + height - item.box[0, 1]
    return dataclasses.replace(
        item,
        box=item.box + np.array([0, lift, 0]),
        parents=(below.object_id,),
        pickupable=True,
        **more,
    )


TABLE = toy.thing("DiningTable", (2.0, 0.4, 0.0), (1.0, 0.8, 2.0))
DESK = toy.thing("Desk", (-2.0, 0.35, 0.0), (0.8, 0.7, 1.6))
FRIDGE = toy.thing("Fridge", (0.0, 1.0, 3.0), (0.8, 2.0, 0.8))


def kitchen(*more: SceneObject) -> Scene:
    mugs = [lying(toy.thing("Mug", (2.0, 1, z), (0.1, 0.1, 0.1), i), TABLE)
            for i, z in enumerate((-0.8, 0.0, 0.7))]  # fmt: skip
    bowl = lying(toy.thing("Bowl", (2.3, 1, 0.4), (0.3, 0.2, 0.3)), TABLE)
    return toy.room(toy.line(5), TABLE, DESK, FRIDGE, *mugs, bowl, *more)


def test_statistics_by_hand() -> None:
    book = lying(toy.thing("Book", (-2.0, 1, 0.0)), DESK, 0.01)
    egg = dataclasses.replace(toy.thing("Egg", (0, 1, 3)), parents=("Fridge|0",), pickupable=True)
    found = placement.statistics([kitchen(book, egg)])
    assert found.holds == {
        ("kitchen", "Mug"): {"DiningTable": 3},
        ("kitchen", "Bowl"): {"DiningTable": 1},
        ("kitchen", "Book"): {"Desk": 1},
    }  # nobody sees what is in the fridge
    table, desk = found.rest["DiningTable"], found.rest["Desk"]
    assert (table.from_top, desk.from_top) == (True, True)
    assert table.height == pytest.approx(0.0)
    assert desk.height == pytest.approx(0.01)
    assert table.margin == pytest.approx(0.05)  # of the bowl, and nine in ten keep as much
    assert table.gap == pytest.approx(1.95, abs=0.1)
    assert found.overhangs == frozenset()


def test_heights_that_vary_are_no_usual_height() -> None:
    rows = np.array([(h, h - 0.8, 0.1, 0.5) for h in (0.2, 0.4, 0.6, 0.8)])
    assert placement._rest(rows).height is None
    rows[:, 0] = 0.4
    assert placement._rest(rows) == Rest(0.4, False, 0.1, 0.5)


def test_what_holds_a_class_is_counted_as_a_loop_does(
    train: dict[str, Scene], known: Statistics
) -> None:
    counts: Counter[tuple[str, str, str]] = Counter()
    for scene in train.values():
        by_id = {item.object_id: item for item in scene.objects}
        for item in scene.objects:
            held = [by_id[name].object_class for name in item.parents if name in by_id]
            if item.pickupable and len(held) == 1:
                counts[str(scene.room_type), item.object_class, held[0]] += 1
    closed = {"Box", "Cabinet", "Drawer", "Fridge", "Microwave", "Safe"}
    small = {"Plate", "Bowl", "Pot", "Pan"}
    for (room, name, below), count in counts.items():
        if below not in closed | small:
            assert known.holds[room, name][below] >= count, (room, name, below)
    total = sum(sum(held.values()) for held in known.holds.values())
    # Things with several parents add the rest.
    assert 0 <= total - sum(n for (_, _, b), n in counts.items() if b not in closed | small) < 40


def test_the_same_draws_give_the_same_places(train: dict[str, Scene], known: Statistics) -> None:
    first, again, other = (
        placement.rearrange(train["FloorPlan1"], known, np.random.default_rng(seed), 0.1)
        for seed in (5, 5, 6)
    )
    assert [o.object_id for o in first] == [o.object_id for o in again]
    assert all(np.array_equal(a.box, b.box) for a, b in zip(first, again, strict=True))
    assert any(not np.array_equal(a.box, b.box) for a, b in zip(first, other, strict=False))


def test_most_small_objects_move_and_some_are_left_out(pairs: list[tuple[Scene, Scene]]) -> None:
    small = sum(item.pickupable for before, _ in pairs for item in before.objects)
    left = sum(len(before.objects) - len(after.objects) for before, after in pairs)
    assert 0.05 * small < left < 0.25 * small
    assert sum(len(moved(*pair)) for pair in pairs) > 0.55 * small
    for before, after in pairs:
        kept = {item.object_id: item for item in after.objects}
        for item in before.objects:
            assert item.pickupable or kept[item.object_id].box is item.box


def test_everything_rests_on_a_receptacle_that_holds_its_class(
    pairs: list[tuple[Scene, Scene]], known: Statistics
) -> None:
    checked = 0
    for before, after in pairs:
        below = {item.object_id: item for item in after.objects}
        for _, item in moved(before, after):
            [name] = item.parents
            receptacle = below[name]
            if receptacle.pickupable:  # contents that moved with it
                continue
            checked += 1
            pair = item.object_class, receptacle.object_class
            assert known.holds[str(before.room_type), pair[0]][pair[1]] > 0
            own = [o.box[0, 1] for o in before.objects if name in o.parents]
            usual = known.rest[pair[1]].level(receptacle)
            heights = [*own, *([] if usual is None else [usual])]
            assert min(abs(item.box[0, 1] - height) for height in heights) < 1e-3
            margin = np.minimum(item.box[0] - receptacle.box[0], receptacle.box[1] - item.box[1])
            if pair in known.overhangs:
                off = (item.box + receptacle.box * -1).mean(axis=0)
                np.testing.assert_allclose(off[[0, 2]], 0, atol=1e-3)
            else:
                assert margin[[0, 2]].min() > -1e-3
    assert checked > 250


def test_nothing_that_moved_meets_anything(pairs: list[tuple[Scene, Scene]]) -> None:
    """But what holds it, what that is a part of (a sink in a counter), and its own contents."""
    for before, after in pairs:
        by_id = {item.object_id: item for item in after.objects}
        for _, item in moved(before, after):
            [below] = [by_id[name] for name in item.parents]
            for other in after.objects:
                common = np.minimum(item.box[1], other.box[1])
                common = common - np.maximum(item.box[0], other.box[0])
                thinner = np.minimum(np.ptp(item.box, axis=0), np.ptp(other.box, axis=0))
                apart = (common <= np.minimum(0.011, thinner / 2 + 1e-4)).any()
                if apart or other in (item, below) or below.pickupable:
                    continue
                span = np.minimum(below.box[1], other.box[1])
                span = span - np.maximum(below.box[0], other.box[0])
                inside = (span / (below.box[1] - below.box[0]))[[0, 2]].prod()
                within = (span > 0).all() and inside >= 0.79
                assert within or item.object_id in other.parents, (item, other)


def test_nothing_stands_where_an_agent_can(pairs: list[tuple[Scene, Scene]]) -> None:
    for before, after in pairs:
        for old, item in moved(before, after):
            if item.box[0, 1] < before.points[0, 1] + 0.9:
                was = placement._gaps(old.box[None], before.points)[0]
                assert placement._gaps(item.box[None], before.points)[0] >= min(was, 0.18)


def test_what_is_on_a_counter_around_a_corner_keeps_clear_of_the_corners_floor() -> None:
    """Of an L-shaped counter, the box has floor in it; its edge may be a step from the points."""
    spots = toy.points(*((0.25 * x, 0.25 * z) for x in range(5) for z in range(5)))
    counter = toy.thing("CounterTop", (0.5, 0.45, 0.5), (3.0, 0.9, 3.0))
    mug = lying(toy.thing("Mug", (-0.8, 1, -0.8), (0.1, 0.1, 0.1)), counter)
    room = toy.room(spots, counter, mug)
    known = placement.statistics([room])
    known = dataclasses.replace(
        known, rest={"CounterTop": dataclasses.replace(known.rest["CounterTop"], gap=0.2)}
    )
    seen = []
    for seed in range(40):
        objects = placement.rearrange(room, known, np.random.default_rng(seed), 0.0)
        [item] = [o for o in objects if o.pickupable]
        seen.append(placement._gaps(item.box[None], spots)[0])
    assert 0.43 < min(seen) < 0.5


def test_what_is_shut_in_or_on_the_floor_stays() -> None:
    egg = dataclasses.replace(toy.thing("Egg", (0, 1, 3)), parents=("Fridge|0",), pickupable=True)
    ball = dataclasses.replace(toy.thing("BasketBall", (0, 0.1, -1)), pickupable=True)
    room = kitchen(egg, ball)
    known = dataclasses.replace(
        placement.statistics([room]),
        holds={("kitchen", name): {"DiningTable": 1} for name in ("Egg", "BasketBall", "Mug")},
    )
    objects = {
        o.object_id: o for o in placement.rearrange(room, known, np.random.default_rng(0), 0.0)
    }
    for item in (egg, ball):
        np.testing.assert_array_equal(objects[item.object_id].box, item.box)
    assert any(not np.array_equal(o.box, objects[o.object_id].box) for o in room.objects)


def test_contents_move_with_their_container() -> None:
    spoon = toy.thing("Spoon", (2.3, 0, 0.45), (0.05, 0.1, 0.1))
    room = kitchen()
    [bowl] = [item for item in room.objects if item.object_class == "Bowl"]
    spoon = dataclasses.replace(lying(spoon, bowl, -0.15), parents=("Bowl|0", "DiningTable|0"))
    room = kitchen(spoon)
    known = placement.statistics([room])
    for seed in range(5):
        draw = np.random.default_rng(seed)
        after = {o.object_id: o for o in placement.rearrange(room, known, draw, 0.3)}
        assert ("Spoon|0" in after) == ("Bowl|0" in after)
        if "Spoon|0" in after:
            new, old = after["Bowl|0"].box, bowl.box
            lift = after["Spoon|0"].box[0, 1] - new[0, 1]
            assert lift == pytest.approx(spoon.box[0, 1] - old[0, 1])
            middle = after["Spoon|0"].box.mean(axis=0)
            assert ((new[0] < middle) & (middle < new[1])).all()


def test_one_of_the_small_objects_always_stays() -> None:
    room = kitchen()
    after = placement.rearrange(room, placement.statistics([room]), np.random.default_rng(0), 1.0)
    assert sum(item.pickupable for item in after) == 1


def test_a_towel_goes_to_a_holder_that_is_turned_likewise() -> None:
    """A towel sticks out of its holder: it hangs from the middle of another, turned with it."""

    def holder(x: float, z: float, size: tuple[float, float], turn: float, i: int) -> SceneObject:
        item = toy.thing("TowelHolder", (x, 1.5, z), (size[0], 0.05, size[1]), i)
        return dataclasses.replace(item, rotation=(0.0, turn, 0.0))

    first, second = holder(0, 2, (0.6, 0.05), 0.0, 0), holder(2, 0, (0.05, 0.6), 90.0, 1)
    towel = lying(toy.thing("Towel", (0, 1.5, 2), (0.5, 0.6, 0.1)), first, -0.6)
    room = toy.room(toy.line(2), first, second, towel, room_type=3)
    known = placement.statistics([room])
    assert known.overhangs == {("Towel", "TowelHolder")}
    found = set()
    for seed in range(20):
        draw = np.random.default_rng(seed)
        [item] = [o for o in placement.rearrange(room, known, draw, 0.0) if o.pickupable]
        size = item.box[1] - item.box[0]
        middle = item.box.mean(axis=0)[[0, 2]].round(3)
        found.add((item.parents[0], *size.round(3), *middle))
    assert found == {
        ("TowelHolder|0", 0.5, 0.6, 0.1, 0.0, 2.0), ("TowelHolder|1", 0.1, 0.6, 0.5, 2.0, 0.0)
    }  # fmt: skip


def test_an_object_is_turned_with_its_corners_and_keeps_its_size() -> None:
    box = np.array([(0.0, 0.0, 0.0), (0.4, 0.1, 0.2)])
    corners = np.array([(0, 0, 0), (0.4, 0, 0), (0.4, 0, 0.2), (0, 0, 0.2)])
    corners = np.concatenate([corners, corners + np.array([0, 0.1, 0])])
    item = SceneObject("Book|1", "Book", box, corners, (0.0, 300.0, 0.0))
    turned = placement.turned(item, 1, box.mean(axis=0))
    np.testing.assert_allclose(turned.box, [(0.1, 0, -0.1), (0.3, 0.1, 0.3)], atol=1e-9)
    assert turned.rotation == (0.0, 30.0, 0.0)
    assert turned.corners is not None
    np.testing.assert_allclose(turned.corners.min(axis=0), turned.box[0], atol=1e-9)
    # Clockwise from above: what pointed along +x points along -z.
    np.testing.assert_allclose(turned.corners[1] - turned.corners[0], (0, 0, -0.4), atol=1e-9)
    whole = placement.turned(item, 4, box.mean(axis=0))
    np.testing.assert_array_equal(whole.box, item.box)
