"""The model of Li et al.: MJOLNIR-o's equations, and inner steps as with plain parameters."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import NetworkConfig
from tdanet_jax.models import actor_critic, li
from tdanet_jax.models.actor_critic import ActorCritic, Output
from tdanet_jax.models.mjolnir import KERNELS
from tdanet_jax.models.shared.class_rows import class_rows, make_row_table
from tests.models.shared.test_adaptation import (
    INTERVAL,
    IS_FIRST,
    LIMIT,
    RATE,
    assert_gradients_close,
    slow_rollout,
)
from tests.models.test_mjolnir import KNOWN, VOCABULARY, WORDS, observations, rows_of
from tests.support import class_equations, equations, samples

T, B, H, WIDTH = 5, 3, 4, 7  # two intervals of two steps, and one step
MODEL = dataclasses.replace(
    li.make(NetworkConfig(width=WIDTH, hidden=H, inner_rate=RATE), VOCABULARY, jnp.float32),
    interval=INTERVAL,
    limit=LIMIT,
)
PLAIN = ActorCritic(MODEL.encoder, hidden=H)
#: What all environments share: the whole graph, except for the linear layer after it.
SHARED = ("adjacency", *KERNELS, "last")
CLOSE = {"rtol": 1e-3, "atol": 1e-4}  # float32 sums in another order, through inner steps


@functools.cache
def parameters() -> Any:
    return samples.parameters(MODEL, WORDS)


def inputs() -> tuple[Any, ...]:
    """Observations, previous action probabilities and episode starts of a rollout."""
    is_first = IS_FIRST[:T]
    prev_action_probs = np.random.default_rng(0).dirichlet(np.ones(6), (T, B))
    prev_action_probs = np.where(is_first[..., None], 0, prev_action_probs)
    return observations(T, B), jnp.asarray(prev_action_probs, jnp.float32), jnp.asarray(is_first)


@functools.partial(jax.jit, static_argnums=0)
def play(model: Any, params: Any, given: Any) -> Output:
    class_table = actor_critic.prepare(model, params, WORDS)
    carry = model.initial_carry(B, params, training=True)
    return actor_critic.forward(model, params, class_table, carry, *given)[1]


def test_before_the_first_inner_step_it_is_the_published_network() -> None:
    obs, prev_action_probs, is_first = jax.tree.map(lambda x: x[:INTERVAL], inputs())
    exact, words = equations.in_float64(parameters()), np.asarray(WORDS, np.float64)
    rows = rows_of(samples.flat(obs))
    features = [class_equations.mjolnir_o(np, exact["encoder"], r, words, KNOWN) for r in rows]
    actions = equations.relu(np, equations.linear(exact["action_embedding"], prev_action_probs))
    zero = np.zeros((B, H))
    x = np.reshape(features, (INTERVAL, B, -1))
    hidden, _ = equations.lstm_rollout(np, exact["lstm"], zero, zero, x, actions, is_first)
    out = play(MODEL, parameters(), (obs, prev_action_probs, is_first))
    np.testing.assert_allclose(out.logits, equations.linear(exact["actor"], hidden), **CLOSE)
    value = equations.linear(exact["critic"], hidden)[..., 0]
    np.testing.assert_allclose(out.value, value, **CLOSE)


@pytest.mark.slow
def test_inner_steps_are_those_of_plain_per_environment_parameters() -> None:
    given = jax.tree.map(lambda x: x[: INTERVAL + 1], inputs())
    out = play(MODEL, parameters(), given)
    plain = functools.partial(slow_rollout, plain=PLAIN, shared=SHARED)
    chex.assert_trees_all_close(out, jax.jit(plain)(parameters(), given), **CLOSE)
    still = play(dataclasses.replace(MODEL, rate=0.0), parameters(), given)
    changed = np.abs(out.logits - still.logits).max(axis=-1) > 1e-5
    np.testing.assert_array_equal(changed[INTERVAL], ~IS_FIRST[INTERVAL])
    assert not changed[:INTERVAL].any()


@pytest.mark.slow
@pytest.mark.parametrize("first_order", [False, True], ids=["second order", "first order"])
def test_gradients_are_those_of_plain_per_environment_parameters(first_order: bool) -> None:
    model, given = dataclasses.replace(MODEL, first_order=first_order), inputs()
    mix = np.random.default_rng(2).normal(size=(T, B, 6)).astype(np.float32)

    def mixed(out: Output) -> jax.Array:
        return (out.logits * mix).sum() + (out.value * mix[..., 0]).sum()

    def fast(params: Any) -> jax.Array:
        return mixed(play(model, params, given))

    def plain(params: Any) -> jax.Array:
        return mixed(slow_rollout(params, given, first_order, plain=PLAIN, shared=SHARED))

    assert_gradients_close(
        jax.jit(jax.grad(fast))(parameters()), jax.jit(jax.grad(plain))(parameters())
    )


def test_small_layers_except_for_the_convolutions_have_per_environment_weights() -> None:
    weights = MODEL.initial_carry(B, parameters()).per_environment
    assert set(weights) == {"action_embedding", "encoder", "actor"}
    assert jax.tree.map(jnp.shape, weights["encoder"]) == {
        "graph": {"mapping": {"kernel": (B, len(KNOWN), WIDTH), "bias": (B, WIDTH)}}
    }


def test_the_stored_view_of_a_frame_has_the_same_rows() -> None:
    obs = observations(12)
    view = MODEL.encoder.view(obs)
    class_table = make_row_table(WORDS, KNOWN)
    np.testing.assert_array_equal(class_rows(class_table, view), class_rows(class_table, obs))
    assert view.mask.shape == (12, len(KNOWN))
