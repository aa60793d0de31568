"""The interface of encoders: where the previous action and the sensors enter."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.env.types import Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import SENSOR_UNITS, ActorCritic
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.sensors import suite
from tests.support import samples

B = 3
WORDS = jnp.asarray(samples.words())


class Counts(Encoder):
    """How many detections there are, and the target's word vector."""

    def prepare(self, words: jax.Array) -> jax.Array:
        return words

    # The names of parameters are up to a custom model: callers pass them by position.
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


def logits(encoder: Encoder, prev_action_probs: jax.Array) -> tuple[Any, jax.Array]:
    model = ActorCritic(encoder, hidden=6)
    weights = samples.parameters(model, WORDS)
    class_table = actor_critic.prepare(model, weights, WORDS)
    carry, obs = model.initial_carry(B, weights), samples.observations(B)
    inputs = carry, obs, prev_action_probs, jnp.ones(B, bool)
    return weights, actor_critic.forward(model, weights, class_table, *inputs)[1].logits


@pytest.mark.parametrize(
    ("encoder", "skip_inputs", "inputs"),
    [(Counts(), 10, 12), (Plain(), 6, 12), (Inside(), 0, 22)],
)
def test_the_previous_action_enters_where_the_model_says(
    encoder: Encoder, skip_inputs: int, inputs: int
) -> None:
    prev_action_probs = jnp.eye(6)[:B]
    weights, first = logits(encoder, prev_action_probs)
    assert weights["lstm"].get("kernel_skip", jnp.zeros((0, 24))).shape == (skip_inputs, 24)
    assert weights["lstm"]["kernel"].shape == (inputs, 24)
    assert ("action_embedding" in weights) == (encoder.ACTION != "plain")
    _, second = logits(encoder, jnp.roll(prev_action_probs, 1, axis=-1))
    assert np.all(np.abs(first - second).max(-1) > 1e-4)


@pytest.mark.parametrize("names", [("odometry",), ("odometry", "triangulation")])
def test_the_sensors_follow_the_encoders_features_and_leave_them_alone(
    names: tuple[str, ...],
) -> None:
    spec = ObservationSpec(sensors=names)
    plain = ActorCritic(Plain(), hidden=6)
    model = plain.clone(spec=spec)
    weights = samples.parameters(model, WORDS)
    readings = samples.readings(2, B, triangulation="triangulation" in names)
    obs = samples.observations(2, B).replace(sensors=readings)
    inputs = WORDS, obs, jnp.zeros((2, B, 6)), None
    alone, _ = plain.apply({"params": {}}, *inputs, method="perceive")
    features, skip_inputs = model.apply({"params": weights}, *inputs, method="perceive")
    assert skip_inputs.shape == (2, B, 6)
    assert features.shape == (2, B, alone.shape[-1] + SENSOR_UNITS)
    np.testing.assert_array_equal(features[..., : alone.shape[-1]], alone)
    layer = weights["way"]
    expected = np.maximum(suite.features(spec, readings) @ layer["kernel"] + layer["bias"], 0)
    np.testing.assert_allclose(features[..., alone.shape[-1] :], expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("readings", "missing"),
    [({}, "'odometry', 'triangulation'"), (samples.readings(B), "'triangulation'")],
)
def test_observations_without_the_networks_sensors_are_refused_by_name(
    readings: Any, missing: str
) -> None:
    spec = ObservationSpec(sensors=("odometry", "triangulation"))
    obs = samples.observations(B).replace(sensors=readings)
    inputs = WORDS, obs, jnp.zeros((B, 6)), None
    with pytest.raises(ValueError, match=rf"lack what the network senses: \[{missing}\]"):
        ActorCritic(Plain(), spec=spec).apply({"params": {}}, *inputs, method="perceive")
