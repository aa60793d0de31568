"""The models by name, with and without sensors, and custom models."""

from __future__ import annotations

import dataclasses
import sys
import types
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env.types import Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import SENSOR_UNITS, ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.factory import make_model
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.registry import MODELS
from tdanet_jax.scenes import SceneTables
from tdanet_jax.task import make_task
from tdanet_jax.training import learner
from tdanet_jax.words import WordVectors
from tests.models.test_encoder import Counts
from tests.support import samples

B = 3
WORDS = jnp.asarray(samples.words())
SMALL = TrainConfig(network=NetworkConfig(width=8, hidden=6, precision="float32"))
VOCABULARY = ClassVocabulary(tuple(f"Class{i}" for i in range(samples.CLASSES)), tuple(range(7)))


@pytest.mark.parametrize("name", MODELS)
def test_no_array_of_a_model_is_empty(name: str) -> None:
    # A checkpoint takes none.
    model = make_model(dataclasses.replace(SMALL, model=name), VOCABULARY)

    def state() -> Any:
        weights = model.initialise(jax.random.key(0), WORDS)
        return weights, model.initial_carry(B, weights, training=True)

    for path, leaf in jax.tree.leaves_with_path(jax.eval_shape(state)):
        assert leaf.size, jax.tree_util.keystr(path)


def with_sensors(config: TrainConfig, triangulation: bool) -> TrainConfig:
    """The same for an agent with odometry, and perhaps with triangulation."""
    network = dataclasses.replace(config.network, odometry=True, triangulation=triangulation)
    return dataclasses.replace(config, network=network)


@pytest.mark.parametrize("name", MODELS)
def test_every_named_model_is_made_and_answers(name: str) -> None:
    model = make_model(dataclasses.replace(SMALL, model=name), VOCABULARY)
    obs = samples.one_per_class(samples.observations(B))

    def answer(key: jax.Array) -> Any:
        weights = model.initialise(key, WORDS)
        class_table = actor_critic.prepare(model, weights, WORDS)
        state = model.initial_carry(B, weights), obs, jnp.zeros((B, 6)), jnp.ones(B, bool)
        return actor_critic.forward(model, weights, class_table, *state)[1]

    assert jax.eval_shape(answer, jax.random.key(0)).logits.shape == (B, 6)


def can_triangulate(name: str) -> bool:
    """Whether a named model is shown a box of every object."""
    return name.startswith("tdanet")


#: Of each kind of model one, of which the sensors are tested every time.
KINDS = ("tdanet", "ssnet", "savn", "li")


@pytest.mark.parametrize(
    ("name", "triangulation"),
    [
        pytest.param(
            name, can_triangulate(name), marks=() if name in KINDS else pytest.mark.slow, id=name
        )
        for name in MODELS
    ],
)
def test_every_named_model_takes_sensors(name: str, triangulation: bool) -> None:
    config = with_sensors(dataclasses.replace(SMALL, model=name), triangulation)
    model = make_model(config, VOCABULARY)
    readings = samples.readings(2, B, triangulation=triangulation)
    obs = samples.one_per_class(samples.observations(2, B)).replace(sensors=readings)

    def answer(obs: Observation) -> Any:
        weights = model.initialise(jax.random.key(0), WORDS)
        class_table = actor_critic.prepare(model, weights, WORDS)
        state = model.initial_carry(B, weights), obs, jnp.zeros((2, B, 6)), jnp.ones((2, B), bool)
        return weights, actor_critic.forward(model, weights, class_table, *state)[1]

    with pytest.raises(ValueError, match="odometry"):
        jax.eval_shape(answer, obs.replace(sensors={}))
    weights, out = jax.eval_shape(answer, obs)
    assert out.logits.shape == (2, B, 6)
    kernel = weights["way"]["kernel"]
    assert kernel.shape == (741 + 9 * triangulation, SENSOR_UNITS)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_every_named_model_learns_with_sensors(
    name: str, some_rooms: SceneTables, glove: WordVectors
) -> None:
    learning = LearnerConfig(num_envs=4, rollout_steps=7, step_limit=5)  # an inner step, and resets
    config = with_sensors(
        dataclasses.replace(SMALL, model=name, learner=learning), can_triangulate(name)
    )
    task = make_task(config, some_rooms, glove)
    state = learner.init(
        jax.random.key(0), learning, task.model, task.train_words, task.train_params
    )
    state = state.replace(params=samples.randomised(state.params))
    before = jax.device_get(state.params)
    chunk = learner.make_train(learning, task.model, 1)
    state, metrics = chunk(state, jnp.zeros(2), task.train_words, task.train_params)
    assert int(state.skipped) == 0
    chex.assert_tree_all_finite((state.params, metrics))
    after, before = (x["way"]["kernel"] for x in (state.params, before))
    assert not np.array_equal(after, before)


@pytest.mark.parametrize(
    ("rate", "drawn"), [(0.25, 64), (0.1, 26), (1 / 256, 1), (0.996, 255), (0.0, 0)]
)
def test_dropout_is_scaled_by_the_rate_that_is_drawn(rate: float, drawn: int) -> None:
    network = dataclasses.replace(SMALL.network, dropout=rate)
    TrainConfig(network=network).check()
    model = make_model(dataclasses.replace(SMALL, network=network), VOCABULARY)
    assert model.encoder.dropout == drawn / 256
    kept = learner._dropout_mask(jax.random.key(0), model.encoder.dropout, (2**16,))
    bits = jax.random.bits(jax.random.key(0), (2**16,), jnp.uint8)
    assert np.array_equal(kept, bits >= drawn)


def test_a_custom_module_is_a_model(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = types.ModuleType("my_lab.counts")
    module.make = lambda config, classes, dtype: ActorCritic(Counts(), hidden=config.hidden)
    monkeypatch.setitem(sys.modules, "my_lab", types.ModuleType("my_lab"))
    monkeypatch.setitem(sys.modules, "my_lab.counts", module)
    config = dataclasses.replace(SMALL, model="my_lab.counts")
    config.check()
    assert isinstance(make_model(config, ClassVocabulary()).encoder, Counts)
    model = make_model(with_sensors(config, triangulation=True), ClassVocabulary())
    assert model.spec.sensors == ("odometry", "triangulation")
    # Sensors that the model itself asks for need no flag.
    spec = ObservationSpec(sensors=("odometry",))
    module.make = lambda config, classes, dtype: ActorCritic(Counts(), spec=spec)
    assert make_model(config, ClassVocabulary()).spec.sensors == ("odometry",)


@pytest.mark.parametrize(
    ("name", "message"),
    [("no_such.module", "no_such"), ("json.decoder", "has no function `make`")],
)
def test_a_module_that_makes_no_model_is_one_clear_error(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(dataclasses.replace(SMALL, model=name), ClassVocabulary())
