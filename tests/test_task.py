"""Feature maps of imported rooms, from the file to the observation; what `auto` stands for."""

from __future__ import annotations

import contextlib
import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import task as task_module
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env import dynamics
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.factory import make_model, unused_flags
from tdanet_jax.registry import MODELS
from tdanet_jax.scenes.dataset import Extras
from tdanet_jax.scenes.offline.features import features_path
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.splits import make_split
from tdanet_jax.task import Task, make_task, resolve
from tdanet_jax.words import WordVectors
from tests.support.handmade import Room, corridor, tables_of

SMALL = NetworkConfig(width=8, hidden=4, precision="float32")


@pytest.mark.parametrize("published", [{}, {"kitchen": {}}, {"kitchen": {"Mug": {}}}])
def test_parents_are_estimated_where_data_name_none(published: dict) -> None:
    things = [("Mug", (0.0, 0.5, 0.0)), ("Sink", (0.1, 0.5, 0.0))]
    tables = tables_of([Room("kitchen", corridor(1), things, {})], ["Mug", "Sink"], ["Mug"])
    extras = Extras(parents=published)
    found = task_module._parents(tables, {"kitchen": ["Mug"]}, (), extras)
    assert found.classes.tolist() == [[1, -1, -1]]


def rooms(tables: SceneTables) -> SceneTables:
    """A room that trains, one that tests, and another that trains."""
    return tables.subset(("FloorPlan7", "FloorPlan29", "FloorPlan204"))


def test_each_pose_has_its_own_feature_map_in_training_and_in_tests(
    ithor: SceneTables, glove: WordVectors
) -> None:
    tables = rooms(ithor)
    states = tables.num_states
    code = np.arange(states, dtype=np.float64) % 2048  # exact in float16
    cells = np.arange(49.0).reshape(7, 7)
    # One channel tells the states apart, the other the cells; two do for 512.
    marked = np.stack(
        [
            np.broadcast_to(code[:, None, None], (states, 7, 7)),
            np.broadcast_to(cells, (states, 7, 7)),
        ],
        axis=1,
    ).astype(np.float16)
    network = dataclasses.replace(SMALL, image="features")
    config = TrainConfig(model="baseline", network=network)
    task = make_task(config, tables, glove, features=marked)
    assert task.model.encoder.maps
    assert task.image is not None
    assert "ResNet" in task.image
    shown = ((task.train_params, task.split.train_scenes), (task.eval_params, tables.scenes))
    for params, scenes in shown:
        chosen = np.isin(np.array(tables.scenes), scenes)[tables.position_scene]
        position = np.flatnonzero(chosen)
        poses = jnp.arange(16 * len(position), dtype=jnp.int32)
        state = jax.vmap(dynamics.start, (0, None, None))(poses, jnp.int32(0), params)
        seen = np.asarray(jax.vmap(dynamics.observe, (0, None))(state, params).features)
        assert seen.shape == (len(poses), 49, 2)
        expected = (16 * position[:, None] + np.arange(16)).reshape(-1) % 2048
        np.testing.assert_array_equal(seen[:, :, 0], np.repeat(expected[:, None], 49, 1))
        np.testing.assert_array_equal(seen[0, :, 1], np.arange(49))


def test_a_model_of_feature_maps_needs_them(ithor: SceneTables, glove: WordVectors) -> None:
    config = TrainConfig(model="baseline", network=dataclasses.replace(SMALL, image="features"))
    with pytest.raises(
        ValueError, match="baseline needs ResNet-18's feature maps, and these rooms have none"
    ):
        make_task(config, rooms(ithor), glove)


def test_a_model_that_numbers_classes_is_kept_from_others(
    ithor: SceneTables, glove: WordVectors
) -> None:
    tables = rooms(ithor)
    for model, numbered in (("ssnet", True), ("baseline", True), ("tdanet", False)):
        network = dataclasses.replace(SMALL, image="raster")
        task = make_task(TrainConfig(model=model, network=network), tables, glove)
        task.check_known("runs/a", tables.classes)
        task.check_known("runs/a", ())
        with (
            contextlib.nullcontext()
            if not numbered
            else pytest.raises(ValueError, match="runs/a: the model knows classes by their index")
        ):
            task.check_known("runs/a", tables.classes[1:])


def renamed(tables: SceneTables, **names: str) -> SceneTables:
    """The rooms with other names of some classes."""
    return dataclasses.replace(tables, classes=tuple(names.get(c, c) for c in tables.classes))


def test_classes_without_a_word_vector_are_hidden_with_one_warning(
    ithor: SceneTables, glove: WordVectors
) -> None:
    odd = renamed(rooms(ithor), Faucet="flux capacitor", Cabinet="zzqx", Pan="Lampstand")
    message = r"for zzqx \(zzqx\), flux capacitor \(.*capacitor\): agents do not see such objects"
    with pytest.warns(UserWarning, match=message) as said:
        task = make_task(TrainConfig(network=SMALL), odd, glove, added=odd)
    assert len(said) == 1
    hidden = [odd.classes.index(name) for name in ("flux capacitor", "zzqx")]
    known = odd.classes.index("Lampstand")  # its vector is that of "lamp stand"
    assert not np.asarray(task.words)[hidden].any()
    assert np.asarray(task.words)[known].any()
    assert np.isin([*hidden, known], odd.object_class).all()
    for params in (task.train_params, task.eval_params):
        assert not np.isin(hidden, np.asarray(params.row_class)).any()
    assert known in np.asarray(task.eval_params.row_class)


def test_a_target_without_a_word_vector_is_refused(ithor: SceneTables, glove: WordVectors) -> None:
    odd = renamed(rooms(ithor), Faucet="zzqx")
    with pytest.raises(ValueError, match=r"^no word vectors for the targets zzqx \(zzqx\): give a"):
        make_task(TrainConfig(network=SMALL, targets="zzqx,Sink"), odd, glove)


def test_extra_targets_are_for_training_alone_and_half_of_it(
    some_rooms: SceneTables, glove: WordVectors
) -> None:
    tables = some_rooms
    varied = tables.subset(["FloorPlan7"])
    varied = dataclasses.replace(varied, scenes=("FloorPlan7-v01",))
    split, classes = make_split("18/4"), np.array(tables.classes)
    plain, more = (
        make_task(TrainConfig(network=SMALL, extra_targets=extra), tables, glove, added=varied)
        for extra in (None, "all")
    )
    chex.assert_trees_all_equal(plain.eval_params, more.eval_params)
    assert plain.tables.data_version == more.tables.data_version
    keys = jax.random.split(jax.random.key(0), 20_000)
    params = more.train_params
    state = jax.vmap(dynamics.reset_state, (0, None))(keys, params)
    asked = classes[np.asarray(params.target_class)[np.asarray(state.target)]]
    position = np.asarray(state.pose) // params.grid.views
    room = np.array(tables.room_types)[np.asarray(params.position_room)[position]]
    assert not {*asked} & split.hidden
    assert (np.asarray(params.distance)[state.pose, state.target] >= 0).all()
    for kind, names in split.seen.items():
        here = asked[room == kind]
        own = np.isin(here, names)
        assert 0.4 < own.mean() < 0.6
        assert len({*here[~own]}) > 20
        assert {*here[own]} <= {*names}
    # Extra targets have parents, too, as far as the rooms tell.
    assert params.parent_class.shape == (len(params.target_class), 3)
    assert (np.asarray(params.parent_class)[len(tables.targets) :] >= 0).any()
    with pytest.raises(ValueError, match="--extra-targets Boots: can be found in no training room"):
        make_task(TrainConfig(network=SMALL, extra_targets="kitchen: Boots"), tables, glove)


def test_models_without_an_image_are_shown_none(ithor: SceneTables, glove: WordVectors) -> None:
    task = make_task(TrainConfig(network=SMALL), rooms(ithor), glove)
    assert task.image is None
    assert task.train_params.features is None


@pytest.mark.parametrize("sensors", [(), ("odometry",), ("odometry", "triangulation")])
def test_odometry_and_triangulation_reach_the_network_and_both_environments(
    ithor: SceneTables, glove: WordVectors, sensors: tuple[str, ...]
) -> None:
    flags = dict.fromkeys(sensors, True)
    task = make_task(TrainConfig(network=dataclasses.replace(SMALL, **flags)), rooms(ithor), glove)
    assert task.spec.sensors == task.model.spec.sensors == sensors
    for params in (task.train_params, task.eval_params):
        assert params.spec == task.spec
        obs, state = jax.eval_shape(dynamics.reset, jax.random.key(0), params)
        assert tuple(obs.sensors) == tuple(state.sensors) == sensors


@pytest.mark.parametrize("name", MODELS)
def test_a_model_that_is_not_shown_every_object_cannot_triangulate(name: str) -> None:
    """In one line that says what to do instead."""
    network = dataclasses.replace(SMALL, image="raster", odometry=True, triangulation=True)
    config = TrainConfig(model=name, network=network)
    classes = ClassVocabulary(("Mug", "Sink"), (0, 1))
    if name.startswith("tdanet"):
        assert make_model(config, classes).spec.sensors == ("odometry", "triangulation")
        return
    message = (
        f"^--triangulation: needs a box of every object, which {name} does not show; "
        "use --no-triangulation$"
    )
    with pytest.raises(ValueError, match=message):
        make_model(config, classes)
    alone = dataclasses.replace(network, triangulation=False)
    model = make_model(dataclasses.replace(config, network=alone), classes)
    assert model.spec.sensors == ("odometry",)


def test_auto_takes_the_feature_maps_that_lie_beside_the_data(tmp_path) -> None:
    data = tmp_path / "mine.npz"
    config = TrainConfig(model="baseline", network=SMALL, data=str(data))
    assert resolve(config).network.image == "raster"
    features_path(data).write_bytes(b"maps")
    assert resolve(config).network.image == "features"
    assert resolve(TrainConfig(network=SMALL)).network.image == "raster"
    chosen = dataclasses.replace(SMALL, image="raster")
    assert resolve(dataclasses.replace(config, network=chosen)).network.image == "raster"


def test_feature_maps_need_imported_rooms() -> None:
    network = dataclasses.replace(SMALL, image="features")
    with pytest.raises(ValueError, match="--image features: needs --data"):
        TrainConfig(network=network).check()


@pytest.mark.parametrize(
    ("model", "network", "idle"),
    [
        ("tdanet", NetworkConfig(), []),
        ("tdanet", NetworkConfig(width=64, dropout=0.25, rows="class", precision="float32"), []),
        ("tdanet", NetworkConfig(image="raster"), ["--image"]),
        ("tdanet", NetworkConfig(inner_rate=1e-3), ["--inner-rate"]),
        (
            "ssnet",
            NetworkConfig(width=64, dropout=0.25, rows="class"),
            ["--width", "--dropout", "--rows"],
        ),
        ("baseline", NetworkConfig(dropout=0.25, image="raster", hidden=64), []),
        ("savn", NetworkConfig(first_order=True, precision="bfloat16"), ["--precision"]),
        ("my_lab.most_alike", NetworkConfig(image="raster"), []),
        ("tdanet", NetworkConfig(odometry=True), []),
        ("savn", NetworkConfig(odometry=True), []),
        ("tdanet", NetworkConfig(odometry=True, triangulation=True), []),
    ],
)
def test_flags_that_change_nothing_are_named(model, network, idle) -> None:
    config = TrainConfig(model=model, network=network)
    assert sorted(unused_flags(config, ClassVocabulary())) == sorted(idle)


def test_training_with_wrong_detections_is_refused_to_a_model_of_images(
    some_rooms: SceneTables, glove: WordVectors
) -> None:
    learner, network = LearnerConfig(noise="detector"), NetworkConfig(image="raster")
    config = TrainConfig(model="mjolnir-r", learner=learner, network=network)
    with pytest.raises(ValueError, match=r"^--noise misses: is of detections"):
        make_task(config, some_rooms, glove)


@pytest.mark.parametrize("model", ["tdanet", "ssnet", "mjolnir-r", "baseline"])
def test_size_noise_changes_nothing_for_a_model_without_boxes(model: str) -> None:
    images = model in ("mjolnir-r", "baseline")
    network = NetworkConfig(image="raster") if images else NetworkConfig()
    for noise in (0.0, 0.5):
        config = TrainConfig(model=model, network=network, learner=LearnerConfig(size_noise=noise))
        idle = ["--size-noise"] if noise and model == "baseline" else []
        assert unused_flags(config, ClassVocabulary()) == idle


def test_the_rooms_of_tests_are_loaded_with_those_added_to_training(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """These may have more in view, and observations in both have as many rows."""
    loaded: list[TrainConfig] = []

    def load(config: TrainConfig) -> Task:
        loaded.append(config)
        raise InterruptedError

    monkeypatch.setattr(task_module, "load_task", load)
    for split in ("train", "test"):
        with pytest.raises(InterruptedError):
            tdanet_jax.make("ithor-18/4", split, TrainConfig(generated=1000, variants=2))
    train, test = loaded
    assert train == test
    assert (test.generated, test.variants) == (1000, 2)
