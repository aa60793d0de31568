"""Variants as files and as training rooms: from training rooms alone, built once, bit for bit."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import chex
import numpy as np
import pytest

from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.scenes import SceneTables, cache, dataset, ithor, pools, tabulation, variants
from tdanet_jax.scenes.checks import survey
from tdanet_jax.scenes.dataset import Extras, Rooms
from tdanet_jax.scenes.pools import Part
from tdanet_jax.scenes.records import of_scenes
from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.task import task_in

#: A training room, one that validation evaluates in, and a test room, of three types.
NAMES = ("FloorPlan15", "FloorPlan18", "FloorPlan28", "FloorPlan313", "FloorPlan317",
         "FloorPlan321", "FloorPlan416", "FloorPlan420", "FloorPlan421")  # fmt: skip
SMALL = NetworkConfig(width=8, hidden=4, precision="float32")


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    return [scene for scene in ithor.load_scenes() if scene.name in NAMES]


@pytest.fixture(scope="module")
def rooms(ithor: SceneTables, scenes: list[Scene]) -> Rooms:
    """Some of the bundled rooms, as if from a file."""
    return Rooms(ithor.subset(NAMES), Extras(), records=of_scenes(scenes))


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


TRAIN = ("FloorPlan15", "FloorPlan313", "FloorPlan416")


def load(rooms: Rooms, copies: int, progress: Progress | None = None) -> SceneTables:
    return pools.load(variants.parts(rooms, TRAIN, copies), rooms.tables.classes, progress)


def test_variants_are_built_once(
    rooms: Rooms, folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[tuple[float, int]] = []
    first = load(rooms, 2, lambda done, total: told.append((done, total)))
    assert first.scenes == tuple(f"{name}-v{i:02d}" for i in (1, 2) for name in TRAIN)
    assert first.classes == rooms.tables.classes
    assert first.targets == rooms.tables.targets
    assert told[-1] == (6, 6)
    assert all(done <= total == 6 for done, total in told)
    stored = sorted(path.name for path in folder.glob("variants-*.npz"))
    assert len(stored) == 2

    def build(*_: object, **__: object) -> None:
        raise AssertionError("built although cached")

    monkeypatch.setattr(tabulation, "build", build)
    again = load(rooms, 2)
    assert again.data_version == first.data_version
    # Fewer of them are the first of these.
    one = load(rooms, 1)
    assert one.data_version == first.subset(one.scenes).data_version


def test_other_rooms_and_other_code_are_other_variants(
    rooms: Rooms, monkeypatch: pytest.MonkeyPatch
) -> None:
    keys = {variants.source(rooms, TRAIN), variants.source(rooms, TRAIN[:2])}
    assert rooms.records is not None
    flags = rooms.records["flags"].copy()
    flags[0] ^= True
    keys.add(
        variants.source(
            dataclasses.replace(rooms, records={**rooms.records, "flags": flags}), TRAIN
        )
    )
    monkeypatch.setattr(cache.inspect, "getsource", lambda module: module.__name__)
    keys.add(variants.source(rooms, TRAIN))
    assert len(keys) == 4


def test_a_file_is_made_of_training_rooms_again_bit_for_bit(rooms: Rooms, tmp_path: Path) -> None:
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    for path in files:
        made = variants.make(rooms, NAMES[:1], TRAIN, 2, seed=3)
        dataset.save_rooms(made, path)
    assert files[0].read_bytes() == files[1].read_bytes()
    back = dataset.load_rooms(files[0])
    assert back.tables.scenes == ("FloorPlan15-v01", "FloorPlan15-v02")
    assert back.extras is not None
    assert back.extras.parts == {"FloorPlan15-v01": "train", "FloorPlan15-v02": "train"}
    assert {name: back.extras.made[name] for name in ("command", "copies", "seed")} == {
        "command": "vary", "copies": 2, "seed": 3
    }  # fmt: skip
    assert set(back.extras.made) == {"command", "copies", "seed", "source", "rooms", "version"}
    other, same = (variants.make(rooms, NAMES[:1], TRAIN, 1, seed) for seed in (4, 3))
    assert other.tables.data_version != same.tables.data_version
    assert same.tables.data_version == back.tables.subset(["FloorPlan15-v01"]).data_version


def test_rooms_in_which_no_target_can_be_found_are_named(rooms: Rooms) -> None:
    assert survey.without_targets(rooms) == []
    bare = dataclasses.replace(
        rooms.tables,
        distance=np.where(
            (rooms.tables.position_scene == 1).repeat(16)[:, None], -1, rooms.tables.distance
        ).astype(np.int16),
    )
    assert survey.without_targets(Rooms(bare, None)) == [NAMES[1]]


def test_variants_have_the_types_and_targets_that_their_rooms_came_with(
    rooms: Rooms, tmp_path: Path
) -> None:
    """Kettle is no target of the paper's, and an office no room type of iTHOR's."""
    first, second = rooms.scenes(NAMES[:2])
    office = dataclasses.replace(first, name="A1", room_type="office")
    for scene, targets in ((office, {}), (second, {second.room_type: ("Kettle", "Cabinet")})):
        others = {"lab": ("Mug",)} if targets else {}  # of a type that is not varied
        extras = Extras(targets=targets | others, parts={scene.name: "train"})
        given = Rooms(
            tabulation.build([scene], rooms.tables.classes, rooms.tables.targets),
            extras,
            records=of_scenes([scene]),
        )
        made = variants.make(given, [scene.name], [scene.name], 1, seed=3)
        assert made.tables.scenes == (f"{scene.name}-v01",)
        assert made.tables.room_types[made.tables.room_type[0]] == scene.room_type
        dataset.save_rooms(made, tmp_path / f"{scene.name}.npz")
        back = dataset.load_rooms(tmp_path / f"{scene.name}.npz")
        assert back.extras is not None
        assert back.extras.targets == targets
        nothing = dataclasses.replace(extras, targets={"bedroom": ("Pillow",)})
        assert survey.without_targets(Rooms(made.tables, nothing)) == [f"{scene.name}-v01"]


def perturbed(scenes: list[Scene], names: tuple[str, ...]) -> list[Scene]:
    """The rooms, with all objects of some of them elsewhere and on other receptacles."""

    def moved(scene: Scene, item: SceneObject, k: int) -> SceneObject:
        parents = (scene.objects[(7 * k + 3) % len(scene.objects)].object_id,)
        return dataclasses.replace(
            item, box=item.box + np.array([0.1, 0.3, 0.2]), parents=parents, pickupable=k % 2 == 0
        )

    return [
        scene if scene.name not in names else dataclasses.replace(
            scene, objects=tuple(moved(scene, o, k) for k, o in enumerate(scene.objects)))
        for scene in scenes
    ]  # fmt: skip


@pytest.mark.parametrize("validation", [pytest.param(False, marks=pytest.mark.slow), True])
def test_nothing_of_the_rooms_of_the_evaluation_is_in_variants(
    rooms: Rooms,
    scenes: list[Scene],
    glove: object,
    validation: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Perturb all of these rooms and see nothing change; of a training room, it is noticed."""
    config = TrainConfig(validation=validation, variants=1, network=SMALL)
    asked: list[tuple[str, ...]] = []
    parts = variants.parts

    def noted(given: Rooms, names: tuple[str, ...], copies: int) -> list[Part]:
        asked.append(tuple(names))
        return parts(given, names, copies)

    monkeypatch.setattr(variants, "parts", noted)
    version = task_in(rooms, config).variants_version
    train = set(asked[0])
    assert train == {*TRAIN} if validation else train == {*TRAIN, "FloorPlan18", "FloorPlan317",
                                                          "FloorPlan420"}  # fmt: skip
    others = tuple(name for name in NAMES if name not in train)

    def version_without(names: tuple[str, ...]) -> str | None:
        changed = perturbed(scenes, names)
        arrays = of_scenes(changed)
        boxes = np.concatenate([[o.box.reshape(6) for o in scene.objects] for scene in changed])
        tables = dataclasses.replace(rooms.tables, object_box=boxes)
        return task_in(Rooms(tables, Extras(), records=arrays), config).variants_version

    assert version_without(others) == version
    assert version_without(("FloorPlan15",)) != version


@pytest.mark.slow
def test_a_run_trains_in_variants_and_is_evaluated_as_ever(rooms: Rooms) -> None:
    plain = task_in(rooms, TrainConfig(network=SMALL))
    task = task_in(rooms, TrainConfig(network=SMALL, variants=2))
    assert plain.variants_version is None
    chex.assert_trees_all_equal(task.eval_params, plain.eval_params)
    assert task.tables.data_version == plain.tables.data_version
    np.testing.assert_array_equal(task.train_params.parent_class, plain.train_params.parent_class)
    np.testing.assert_array_equal(task.train_params.parent_reward, plain.train_params.parent_reward)
    assert task.classes == plain.classes
    positions = [len(one.train_params.next_position) for one in (plain, task)]
    assert 2.8 * positions[0] < positions[1] < 3.1 * positions[0]
    # An episode can begin in each of them: 6 rooms and 12 variants.
    assert (
        task.train_params.room_scenes[:, 1].sum() == 3 * plain.train_params.room_scenes[:, 1].sum()
    )
