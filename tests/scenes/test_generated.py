"""Generated rooms as files and as training rooms: built once, bit for bit, from training rooms."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import chex
import numpy as np
import pytest

from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneTables, cache, dataset, generated, pools
from tdanet_jax.scenes import ithor as bundled
from tdanet_jax.scenes.dataset import Extras, Rooms
from tdanet_jax.scenes.pools import Part
from tdanet_jax.scenes.records import of_scenes
from tdanet_jax.scenes.scene import Scene, SceneError
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.task import task_in
from tests.support import toy

SMALL = NetworkConfig(width=8, hidden=4, precision="float32")
#: Two training rooms of each type, one that validation evaluates in, and a test room.
KNOWN = tuple(f"FloorPlan{number + i}" for number in (9, 209, 309, 409) for i in (0, 1))
NAMES = (*KNOWN, "FloorPlan20", "FloorPlan30")


@pytest.fixture(scope="module")
def rooms(ithor: SceneTables) -> Rooms:
    """Some of the bundled rooms, as if from a file."""
    scenes = [scene for scene in bundled.load_scenes() if scene.name in NAMES]
    return Rooms(ithor.subset(NAMES), Extras(), records=of_scenes(scenes))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_a_file_says_how_it_was_made_and_is_the_same_again(rooms: Rooms, tmp_path: Path) -> None:
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for path in files:
        dataset.save_rooms(generated.make(rooms, KNOWN, 2, 3), path)
    assert files[0].read_bytes() == files[1].read_bytes()
    back = dataset.load_rooms(files[0])
    assert back.tables.scenes == ("kitchen-0001", "living_room-0001")
    assert back.extras is not None
    assert back.extras.parts == dict.fromkeys(back.tables.scenes, "train")
    assert {**back.extras.made} == {
        "command": "generate", "rooms": 2, "seed": 3, "known": "8 rooms",
        "source": generated.source(rooms, KNOWN), "version": back.extras.made["version"],
    }  # fmt: skip
    [scene, _] = back.scenes(back.tables.scenes)
    assert any(item.parents for item in scene.objects)
    assert any(item.corners is not None for item in scene.objects)


def test_rooms_are_built_once_in_chunks_whatever_their_number(
    rooms: Rooms, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[int] = []

    class Recorder:
        def __init__(self, scenes: list[Scene]) -> None:
            assert {scene.name for scene in scenes} <= {*KNOWN}

        def room(self, number: int, seed: int) -> Scene:
            made.append(number)
            assert seed == generated.SEED
            return dataclasses.replace(toy.corridor(), name=f"Room{number}")

    monkeypatch.setattr(generated, "Generator", Recorder)
    monkeypatch.setattr(generated, "CHUNK", 2)
    told: list[tuple[float, int]] = []

    def load(known: tuple[str, ...], count: int, progress: Progress | None = None) -> SceneTables:
        return pools.load(generated.parts(rooms, known, count), rooms.tables.classes, progress)

    tables = load(KNOWN, 3, lambda done, total: told.append((done, total)))
    assert sorted(made) == [1, 2, 3]
    assert tables.scenes == ("Room1", "Room2", "Room3")
    assert tables.classes == rooms.tables.classes
    assert told == [(0, 3), (1, 3), (2, 3), (2, 3), (3, 3)]
    assert len([*folder.glob("generated-*.npz")]) == 2
    again = load(KNOWN, 3)
    assert again.data_version == tables.data_version
    load(KNOWN, 4)
    assert sorted(made) == [1, 2, 3, 3, 4]  # the first chunk is known
    load(KNOWN[:-1], 2)
    assert len(made) == 7


def test_what_is_seen_from_nowhere_is_left_out() -> None:
    corridor = toy.corridor()
    cabinet = toy.thing("Cabinet", (0.0, 0.6, 2.25), (0.4, 0.4, 0.4))
    bread = toy.thing("Bread", (0.0, 0.6, 2.25))  # in the cabinet, which is closed
    apple, bread = (dataclasses.replace(o, pickupable=True) for o in (*corridor.objects, bread))
    scene = dataclasses.replace(corridor, objects=(apple, bread, cabinet))
    kept, tables = generated._seen(scene, ("Apple", "Bread"))
    assert [item.object_class for item in kept.objects] == ["Apple", "Cabinet"]
    assert tables.object_id == ("Apple|0", "Cabinet|0")


def test_rooms_on_another_grid_are_refused(rooms: Rooms) -> None:
    other = dataclasses.replace(rooms.tables, grid=PoseGrid(0.5))
    with pytest.raises(SceneError, match="on iTHOR's grid"):
        generated.make(Rooms(other, Extras(), records=rooms.records), KNOWN, 1, 0)


@pytest.mark.parametrize("alone", [False, True])
def test_a_run_trains_in_generated_rooms_and_is_evaluated_as_ever(
    rooms: Rooms, monkeypatch: pytest.MonkeyPatch, alone: bool
) -> None:
    plain = task_in(rooms, TrainConfig(network=SMALL, validation=True))
    assert not {"FloorPlan20", "FloorPlan30"} & {*plain.split.train_scenes}
    asked: list[tuple[tuple[str, ...], int]] = []
    made = rooms.tables.subset(["FloorPlan9", "FloorPlan309"])

    def parts(_: Rooms, known: tuple[str, ...], count: int) -> list[Part]:
        asked.append((known, count))
        named = dataclasses.replace(made, scenes=("kitchen-0001", "bedroom-0001"))
        return [Part(2, lambda _: named)]

    monkeypatch.setattr(generated, "parts", parts)
    config = TrainConfig(network=SMALL, validation=True, generated=2, generated_only=alone)
    task = task_in(rooms, config)
    # Like the rooms that validation trains in, and no others.
    assert asked == [(KNOWN, 2)]
    chex.assert_trees_all_equal(task.eval_params, plain.eval_params)
    np.testing.assert_array_equal(task.train_params.parent_class, plain.train_params.parent_class)
    assert task.classes == plain.classes
    assert task.variants_version is not None
    assert plain.variants_version is None
    both = len(plain.train_params.next_position) + len(made.position)
    assert len(task.train_params.next_position) == (len(made.position) if alone else both)


def test_rooms_that_are_too_many_are_dealt_to_pools(
    rooms: Rooms, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four parts of a room each: two pools of two, of which one is loaded at the start."""
    loaded: list[str] = []

    def part(name: str) -> Part:
        def load(_: Progress) -> SceneTables:
            loaded.append(name)
            return dataclasses.replace(rooms.tables.subset([name]), scenes=(f"{name}-v01",))

        return Part(1, load)

    monkeypatch.setattr(generated, "parts", lambda *_: [part(name) for name in KNOWN[::2]])
    config = TrainConfig(
        network=SMALL, validation=True, generated=4, generated_only=True, pool_rooms=3
    )
    task = task_in(rooms, config)
    assert loaded == [KNOWN[0], KNOWN[4]]
    assert len(task.further_pools) == 1
    points = len(rooms.tables.subset([KNOWN[0], KNOWN[4]]).position)
    assert len(task.train_params.next_position) == points
    further = task.further_pools[0](lambda done, total: None)
    assert loaded == list(KNOWN[::4]) + list(KNOWN[2::4])
    assert len(further.next_position) == len(rooms.tables.subset([KNOWN[2], KNOWN[6]]).position)
    whole = task_in(rooms, dataclasses.replace(config, pool_rooms=4))
    assert whole.further_pools == ()
    assert whole.variants_version != task.variants_version
