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
from tdanet_jax.models.shared.class_rows import class_rows, make_table
from tests.models.shared.test_adaptation import (
    FRESH,
    LIMIT,
    RATE,
    STRETCH,
    assert_gradients_close,
    slow_rollout,
)
from tests.models.test_mjolnir import KNOWN, VOCABULARY, WORDS, observations, rows_of
from tests.support import class_equations, equations, samples

T, B, H, WIDTH = 5, 3, 4, 7  # two stretches of two steps, and one step more
MODEL = dataclasses.replace(
    li.make(NetworkConfig(width=WIDTH, hidden=H, inner_rate=RATE), VOCABULARY, jnp.float32),
    stretch=STRETCH,
    limit=LIMIT,
)
PLAIN = ActorCritic(MODEL.encoder, hidden=H)
#: What all environments share: the whole graph but the linear layer behind it.
SHARED = ("adjacency", *KERNELS, "last")
CLOSE = {"rtol": 1e-3, "atol": 1e-4}  # float32 sums in another order, through inner steps


@functools.cache
def parameters() -> Any:
    return samples.parameters(MODEL, WORDS)


def inputs() -> tuple[Any, ...]:
    """Observations, previous probabilities and episode starts of a rollout."""
    fresh = FRESH[:T]
    previous = np.random.default_rng(0).dirichlet(np.ones(6), (T, B))
    previous = np.where(fresh[..., None], 0, previous)
    return observations(T, B), jnp.asarray(previous, jnp.float32), jnp.asarray(fresh)


@functools.partial(jax.jit, static_argnums=0)
def play(model: Any, params: Any, given: Any) -> Output:
    table = actor_critic.prepare(model, params, WORDS)
    carry = model.initial_carry(B, params, training=True)
    return actor_critic.forward(model, params, table, carry, *given)[1]


def test_before_the_first_inner_step_it_is_the_published_network() -> None:
    obs, previous, fresh = jax.tree.map(lambda x: x[:STRETCH], inputs())
    exact, words = equations.in_float64(parameters()), np.asarray(WORDS, np.float64)
    rows = rows_of(samples.flat(obs))
    features = [class_equations.mjolnir_o(np, exact["encoder"], r, words, KNOWN) for r in rows]
    actions = equations.relu(np, equations.linear(exact["action_embedding"], previous))
    zero = np.zeros((B, H))
    x = np.reshape(features, (STRETCH, B, -1))
    hidden, _ = equations.lstm_rollout(np, exact["lstm"], zero, zero, x, actions, fresh)
    out = play(MODEL, parameters(), (obs, previous, fresh))
    np.testing.assert_allclose(out.logits, equations.linear(exact["actor"], hidden), **CLOSE)
    value = equations.linear(exact["critic"], hidden)[..., 0]
    np.testing.assert_allclose(out.value, value, **CLOSE)


def test_inner_steps_are_those_of_plain_per_environment_parameters() -> None:
    given = jax.tree.map(lambda x: x[: STRETCH + 1], inputs())
    out = play(MODEL, parameters(), given)
    plain = functools.partial(slow_rollout, plain=PLAIN, shared=SHARED)
    chex.assert_trees_all_close(out, jax.jit(plain)(parameters(), given), **CLOSE)
    still = play(dataclasses.replace(MODEL, rate=0.0), parameters(), given)
    changed = np.abs(out.logits - still.logits).max(axis=-1) > 1e-5
    np.testing.assert_array_equal(changed[STRETCH], ~FRESH[STRETCH])
    assert not changed[:STRETCH].any()


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


def test_every_environment_has_its_own_of_small_layers_but_of_the_convolutions() -> None:
    own = MODEL.initial_carry(B, parameters()).own
    assert set(own) == {"action_embedding", "encoder", "actor"}
    assert jax.tree.map(jnp.shape, own["encoder"]) == {
        "graph": {"mapping": {"kernel": (B, len(KNOWN), WIDTH), "bias": (B, WIDTH)}}
    }


def test_what_it_remembers_of_a_frame_says_the_same() -> None:
    obs = observations(12)
    view = MODEL.encoder.view(obs)
    table = make_table(WORDS, KNOWN)
    np.testing.assert_array_equal(class_rows(table, view), class_rows(table, obs))
    assert view.mask.shape == (12, len(KNOWN))
