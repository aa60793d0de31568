"""The interface of models: how the previous action enters, and modules of the user's own."""

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
from tdanet_jax.models.registry import MODELS
from tdanet_jax.env.dynamics import Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ODOMETRY_UNITS, ActorCritic
from tdanet_jax.models.classes import Classes
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import TAPE, Linear
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sensors.odometry import numbers
from tdanet_jax.models.registry import make_model
from tdanet_jax.task import make_task
from tdanet_jax.training import learner
from tdanet_jax.words import WordVectors
from tests.support import samples

B = 3
WORDS = jnp.asarray(samples.words())
SMALL = TrainConfig(network=NetworkConfig(width=8, hidden=6, precision="float32"))


class Counts(Encoder):
    """How many detections there are, and the target's word vector."""

    def prepare(self, words: jax.Array) -> jax.Array:
        return words

    def __call__(
        self, table: Any, obs: Observation, action: jax.Array, keep: jax.Array | None = None
    ) -> jax.Array:
        count = obs.mask.sum(-1, keepdims=True).astype(jnp.float32)
        return jnp.concatenate([count, table[obs.target]], axis=-1)


class Plain(Counts):
    ACTION = "plain"


class Inside(Counts):
    ACTION = "inside"

    def __call__(
        self, table: Any, obs: Observation, action: jax.Array, keep: jax.Array | None = None
    ) -> jax.Array:
        return jnp.concatenate([super().__call__(table, obs, action, keep), action], axis=-1)


def logits(encoder: Encoder, previous: jax.Array) -> tuple[Any, jax.Array]:
    model = ActorCritic(encoder, hidden=6)
    weights = samples.parameters(model, WORDS)
    table = actor_critic.prepare(model, weights, WORDS)
    state = model.initial_carry(B, weights), samples.observations(B), previous, jnp.ones(B, bool)
    return weights, actor_critic.forward(model, weights, table, *state)[1].logits


@pytest.mark.parametrize(
    ("encoder", "aside", "inputs"), [(Counts(), 10, 12), (Plain(), 6, 12), (Inside(), 0, 22)]
)
def test_the_previous_action_enters_where_the_model_says(
    encoder: Encoder, aside: int, inputs: int
) -> None:
    previous = jnp.eye(6)[:B]
    weights, first = logits(encoder, previous)
    assert weights["lstm"].get("kernel_aside", jnp.zeros((0, 24))).shape == (aside, 24)
    assert weights["lstm"]["kernel"].shape == (inputs, 24)
    assert ("action_embedding" in weights) == (encoder.ACTION != "plain")
    _, second = logits(encoder, jnp.roll(previous, 1, axis=-1))
    assert np.all(np.abs(first - second).max(-1) > 1e-4)


def test_products_over_more_than_one_row_per_environment_get_their_gradient_without_a_tape() -> (
    None
):
    layer = Linear(4)
    x = jax.random.normal(jax.random.key(0), (2, B, 5, 3))  # [T, B, rows, n]
    params = samples.randomised(layer.init(jax.random.key(1), x)["params"])
    y, tape = layer.apply({"params": params}, x[0], mutable=[TAPE])
    assert not tape.get(TAPE)
    np.testing.assert_allclose(y, x[0] @ params["kernel"] + params["bias"], rtol=1e-5)

    def total(params: Any) -> jax.Array:
        return (layer.apply({"params": params, TAPE: {}}, x) ** 2).sum()

    def plain(params: Any) -> jax.Array:
        return ((x @ params["kernel"] + params["bias"]) ** 2).sum()

    for mine, theirs in zip(
        *map(jax.tree.leaves, (jax.grad(total)(params), jax.grad(plain)(params))), strict=True
    ):
        np.testing.assert_allclose(mine, theirs, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", MODELS)
def test_no_array_of_a_model_is_empty(name: str) -> None:
    # A checkpoint takes none.
    names = tuple(f"Class{i}" for i in range(samples.CLASSES))
    model = make_model(dataclasses.replace(SMALL, model=name), Classes(names, tuple(range(7))))

    def state() -> Any:
        weights = model.initialise(jax.random.key(0), WORDS)
        return weights, model.initial_carry(B, weights, training=True)

    for path, leaf in jax.tree.leaves_with_path(jax.eval_shape(state)):
        assert leaf.size, jax.tree_util.keystr(path)


def sensing(config: TrainConfig, sights: bool) -> TrainConfig:
    """The same for an agent that senses its way, and maybe where its target is."""
    network = dataclasses.replace(config.network, odometry=True, triangulation=sights)
    return dataclasses.replace(config, network=network)


@pytest.mark.parametrize("name", MODELS)
def test_every_named_model_is_made_and_answers(name: str) -> None:
    names = tuple(f"Class{i}" for i in range(samples.CLASSES))
    model = make_model(dataclasses.replace(SMALL, model=name), Classes(names, tuple(range(7))))
    obs = samples.one_per_class(samples.observations(B))

    def answer(key: jax.Array) -> Any:
        weights = model.initialise(key, WORDS)
        table = actor_critic.prepare(model, weights, WORDS)
        state = model.initial_carry(B, weights), obs, jnp.zeros((B, 6)), jnp.ones(B, bool)
        return actor_critic.forward(model, weights, table, *state)[1]

    out = jax.jit(answer)(jax.random.key(0))
    assert out.logits.shape == (B, 6)
    assert np.isfinite(out.logits).all()


def test_who_does_not_sense_its_way_cannot_sense_where_its_target_is() -> None:
    model = ActorCritic(Plain(), hidden=6, triangulation=True)
    with pytest.raises(ValueError, match="senses its target's place senses its way, too"):
        jax.eval_shape(model.initialise, jax.random.key(0), WORDS)


@pytest.mark.parametrize("sights", [False, True], ids=["odometry", "triangulation"])
def test_the_odometry_stands_behind_the_encoders_features_and_leaves_them_alone(
    sights: bool,
) -> None:
    plain = ActorCritic(Plain(), hidden=6)
    model = plain.clone(odometry=True, triangulation=sights)
    weights = samples.parameters(model, WORDS)
    obs = samples.observations(2, B).replace(odometry=samples.odometry(2, B, sights=sights))
    arguments = WORDS, obs, jnp.zeros((2, B, 6)), None
    alone, _ = plain.apply({"params": {}}, *arguments, method="perceive")
    features, aside = model.apply({"params": weights}, *arguments, method="perceive")
    assert aside.shape == (2, B, 6)
    assert features.shape == (2, B, alone.shape[-1] + ODOMETRY_UNITS)
    np.testing.assert_array_equal(features[..., : alone.shape[-1]], alone)
    way = weights["way"]
    product = numbers(obs.odometry) @ way["kernel"] + way["bias"]
    expected = np.maximum(product, 0)
    np.testing.assert_allclose(features[..., alone.shape[-1] :], expected, rtol=1e-4, atol=1e-5)


def can_triangulate(name: str) -> bool:
    """Whether a named model is shown a box of every object."""
    return name.startswith("tdanet")


@pytest.mark.parametrize(
    ("name", "sights"),
    [(name, sights) for name in MODELS for sights in {False, can_triangulate(name)}],
)
def test_every_named_model_takes_odometry(name: str, sights: bool) -> None:
    names = tuple(f"Class{i}" for i in range(samples.CLASSES))
    config = sensing(dataclasses.replace(SMALL, model=name), sights)
    model = make_model(config, Classes(names, tuple(range(7))))
    sensed = samples.odometry(2, B, sights=sights)
    obs = samples.one_per_class(samples.observations(2, B)).replace(odometry=sensed)

    def answer(obs: Observation) -> Any:
        weights = model.initialise(jax.random.key(0), WORDS)
        table = actor_critic.prepare(model, weights, WORDS)
        state = model.initial_carry(B, weights), obs, jnp.zeros((2, B, 6)), jnp.ones((2, B), bool)
        return weights, actor_critic.forward(model, weights, table, *state)[1]

    with pytest.raises(ValueError, match="senses its way, and the observations do not hold it"):
        jax.eval_shape(answer, obs.replace(odometry=None))
    weights, out = jax.eval_shape(answer, obs)
    assert out.logits.shape == (2, B, 6)
    assert weights["way"]["kernel"].shape == (741 + 9 * sights, ODOMETRY_UNITS)


@pytest.mark.slow
@pytest.mark.parametrize("name", MODELS)
def test_every_named_model_learns_with_odometry(
    name: str, some_rooms: SceneTables, glove: WordVectors
) -> None:
    learning = LearnerConfig(num_envs=4, rollout_steps=7, step_limit=5)  # an inner step, and resets
    config = sensing(
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
    assert not np.array_equal(state.params["way"]["kernel"], before["way"]["kernel"])


def test_a_module_of_the_users_own_is_a_model(monkeypatch: pytest.MonkeyPatch) -> None:
    module: Any = types.ModuleType("my_lab.counts")
    module.make = lambda config, classes, dtype: ActorCritic(Counts(), hidden=config.hidden)
    monkeypatch.setitem(sys.modules, "my_lab", types.ModuleType("my_lab"))
    monkeypatch.setitem(sys.modules, "my_lab.counts", module)
    config = dataclasses.replace(SMALL, model="my_lab.counts")
    config.check()
    assert isinstance(make_model(config, Classes()).encoder, Counts)
    model = make_model(sensing(config, sights=True), Classes())
    assert model.odometry
    assert model.triangulation
    # What it senses of its own accord, it senses without a flag, too.
    module.make = lambda config, classes, dtype: ActorCritic(Counts(), odometry=True)
    assert make_model(config, Classes()).odometry


@pytest.mark.parametrize(
    ("name", "message"),
    [("no_such.module", "no_such"), ("json.decoder", "has no function `make`")],
)
def test_a_module_that_makes_no_model_is_one_clear_error(name: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_model(dataclasses.replace(SMALL, model=name), Classes())
