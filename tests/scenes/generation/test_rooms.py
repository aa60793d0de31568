"""Generated rooms: sound, furnished, from training rooms alone, and the same again."""

from __future__ import annotations

import dataclasses
from collections import Counter

import numpy as np
import pytest

from tdanet_jax.scenes import furniture, reachable
from tdanet_jax.scenes.generation import rooms as rooms_module
from tdanet_jax.scenes.generation.floor import AHEAD, RIGHT
from tdanet_jax.scenes.generation.rooms import Generator
from tdanet_jax.scenes.placement import TOUCHING
from tdanet_jax.scenes.scene import Scene, SceneError
from tdanet_jax.splits import make_split

#: What every room of a type has.
ALWAYS = {
    "kitchen": {"CounterTop", "Sink", "SinkBasin", "Faucet", "StoveBurner", "StoveKnob", "Fridge",
                "Cabinet"},
    "living_room": {"Sofa", "Television"},
    "bedroom": {"Bed"},
    "bathroom": {"Toilet", "Sink", "SinkBasin", "Faucet"},
}  # fmt: skip


def same(one: Scene, other: Scene) -> bool:
    """Whether two rooms are equal, object by object."""
    boxes = [[item.box.tolist() for item in scene.objects] for scene in (one, other)]
    names = [[item.object_id for item in scene.objects] for scene in (one, other)]
    return boxes[0] == boxes[1] and names[0] == names[1] and bool(
        np.array_equal(one.points, other.points)
    )  # fmt: skip


def test_types_take_turns_and_every_room_has_what_it_needs(rooms: list[Scene]) -> None:
    assert [room.name for room in rooms[:5]] == [
        "kitchen-0001", "living_room-0001", "bedroom-0001", "bathroom-0001", "kitchen-0002"
    ]  # fmt: skip
    for room in rooms:
        classes = {item.object_class for item in room.objects}
        assert ALWAYS[str(room.room_type)] <= classes
        assert room.part == "train"
        ids = [item.object_id for item in room.objects]
        assert len(set(ids)) == len(ids)
        assert [*room.objects] == sorted(
            room.objects, key=lambda item: (item.object_class, item.object_id)
        )


def test_agents_stand_free_in_one_connected_part(rooms: list[Scene]) -> None:
    for room in rooms:
        assert furniture._parts(room.points) == 1
        on = {o.object_id for o in room.objects if o.parents}
        standing = [item for item in room.objects if item.object_id not in on]
        assert reachable.clear(room.points[:, [0, 2]], 0.9, standing).all()
        assert np.abs(room.points[:, [0, 2]] / 0.25 % 1).max() == 0


def test_small_objects_rest_on_what_holds_them_and_meet_nothing(rooms: list[Scene]) -> None:
    counts: Counter[str] = Counter()
    for room in rooms:
        items = {item.object_id: item for item in room.objects}
        small = [item for item in room.objects if item.pickupable and item.parents]
        for item in small:
            below = items[item.parents[0]]
            counts[below.object_class] += 1
            assert item.box[0, 1] > below.box[0, 1] - 0.8
            assert (item.box[0, [0, 2]] < below.box[1, [0, 2]]).all()
            assert (item.box[1, [0, 2]] > below.box[0, [0, 2]]).all()
        for k, item in enumerate(small):
            for other in small[:k]:
                common = np.minimum(item.box[1], other.box[1]) - np.maximum(
                    item.box[0], other.box[0]
                )
                assert common.min() <= TOUCHING + 1e-6 or _thin(item, other, common)
    assert counts["CounterTop"] > 20
    assert counts["Bed"] > 3
    assert counts["Sofa"] > 1


def _thin(item: object, other: object, common: np.ndarray) -> bool:
    sizes = [np.ptp(o.box, axis=0) for o in (item, other)]  # type: ignore[attr-defined]
    return bool((common <= np.minimum(*sizes) / 2 + 1e-6).any())


def test_furniture_at_walls_faces_the_room(rooms: list[Scene]) -> None:
    """An agent can stand in front of it, and not behind it."""
    counts: Counter[str] = Counter()
    for room in rooms:
        for item in room.objects:
            if item.object_class in ("Dresser", "Fridge", "Toilet"):
                turns = round(item.rotation[1] / 90) % 4
                ahead, right = AHEAD[turns], RIGHT[turns]
                offset = room.points[:, [0, 2]] - item.box.mean(axis=0)[[0, 2]]
                spans = np.ptp(item.box, axis=0)[[0, 2]]
                beside = np.abs(offset @ right) <= abs(spans @ right) / 2
                depth = abs(spans @ ahead) / 2
                along = offset[beside] @ ahead - depth
                assert (along > 0).any()
                assert along[along > 0].min() < 0.5
                assert not ((along < -2 * depth) & (along > -2 * depth - 0.3)).any()
                counts[item.object_class] += 1
    assert len(counts) == 3


def test_a_room_is_the_same_again_and_another_by_seed_and_number(
    generator: Generator, known: list[Scene], rooms: list[Scene]
) -> None:
    again = Generator(known).room(3, 7)
    assert same(again, rooms[2])
    assert not same(generator.room(3, 8), rooms[2])
    assert not same(rooms[2], rooms[6])


def test_nothing_but_the_known_rooms_is_looked_at(known: list[Scene]) -> None:
    """Those of validation give other rooms, whatever the held-out ones hold."""
    train = make_split("22/0", True).train_scenes
    fewer = [scene for scene in known if scene.name in train]
    room = Generator(fewer).room(2, 7)
    assert not same(room, Generator(known).room(2, 7))
    with pytest.raises(SceneError, match="there is no bathroom"):
        Generator([scene for scene in known if scene.room_type != "bathroom"])


def test_what_the_known_rooms_lack_is_named(known: list[Scene]) -> None:
    def without(scene: Scene) -> Scene:
        kept = [o for o in scene.objects if o.object_class not in ("Sink", "StoveKnob")]
        return dataclasses.replace(scene, objects=tuple(kept))

    with pytest.raises(SceneError, match=r"and none has a Sink, StoveKnob$"):
        Generator([without(scene) for scene in known])


def test_what_stands_in_the_way_of_a_room_is_named(
    generator: Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rooms_module, "ATTEMPTS", 1)
    said = r"kitchen-0001: no such room in 1 attempts; the last: "
    with monkeypatch.context() as patch:
        patch.setitem(rooms_module.BUILDERS, "kitchen", lambda room: False)
        with pytest.raises(SceneError, match=said + "no place for what is built in"):
            generator.room(1, 7)
    with monkeypatch.context() as patch:
        patch.setattr(rooms_module, "LEAST", 9.0)
        with pytest.raises(SceneError, match=said + "[0-9]+% of the reachable points"):
            generator.room(1, 7)
    monkeypatch.setattr(rooms_module, "LEAST", 0.0)
    monkeypatch.setattr(rooms_module, "MISSING", -1.0)
    with pytest.raises(SceneError, match=said + "no place for [0-9]+% of its objects"):
        generator.room(1, 7)


def test_sizes_are_those_of_training_rooms(rooms: list[Scene], known: list[Scene]) -> None:
    for room in rooms:
        points = [len(scene.points) for scene in known if scene.room_type == room.room_type]
        assert 0.6 * min(points) < len(room.points) < 1.4 * max(points)
        objects = [len(scene.objects) for scene in known if scene.room_type == room.room_type]
        assert 0.5 * min(objects) < len(room.objects) < 1.6 * max(objects)


def test_houses_are_no_models(known: list[Scene]) -> None:
    house = dataclasses.replace(known[0], room_type=("kitchen",) * len(known[0].points))
    same_without = Generator([*known, house])
    assert [*same_without._plans.room_types] == [*Generator(known)._plans.room_types]
