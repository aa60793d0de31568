"""The image trunk and the baseline against the published network, cell by cell."""

from __future__ import annotations

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.env.types import Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic, Output
from tdanet_jax.models.baseline import BaselineEncoder
from tdanet_jax.models.shared.image import CELLS, CHANNELS, DROPOUT_UNITS, one_hot_look_up
from tests.support import equations, samples
from tests.support.samples import CLASSES, observations

T, B, H = 3, 2, 6
CLOSE = {"rtol": 5e-5, "atol": 1e-5}  # float32 sums of thousands of products, in another order
WORDS = jnp.asarray(samples.words())
MODEL = ActorCritic(BaselineEncoder(dropout=0.25), hidden=H)
MAPS = ActorCritic(BaselineEncoder(dropout=0.25, maps=True), hidden=H)
CASES = pytest.mark.parametrize(
    ("model", "dropped"),
    [
        pytest.param(MODEL, False, marks=pytest.mark.slow),
        (MODEL, True),
        pytest.param(MAPS, True, marks=pytest.mark.slow),
    ],
    ids=["evaluating", "training", "training on feature maps"],
)


@functools.cache
def parameters(model: ActorCritic = MODEL) -> Any:
    return samples.parameters(model, WORDS)


def inputs() -> tuple[Any, ...]:
    """A rollout's carry, observations, previous action probabilities, starts and dropout mask."""
    rng = np.random.default_rng(0)
    is_first = np.array([[True, False], [False, False], [False, True]])
    prev_action_probs = np.where(is_first[..., None], 0, rng.dirichlet(np.ones(6), (T, B)))
    carry = tuple(jnp.asarray(rng.normal(size=(B, H)), jnp.float32) for _ in range(2))
    dropout_mask = jnp.asarray(rng.random((T, B, DROPOUT_UNITS)) < 0.75)
    obs = observations(T, B)
    return (
        carry,
        obs,
        jnp.asarray(prev_action_probs, jnp.float32),
        jnp.asarray(is_first),
        dropout_mask,
    )


@functools.partial(jax.jit, static_argnums=(0, 2))
def forward(model: ActorCritic, params: Any, dropped: bool) -> Output:
    *given, dropout_mask = inputs()
    class_table = actor_critic.prepare(model, params, WORDS)
    return actor_critic.forward(
        model, params, class_table, *given, dropout_mask if dropped else None
    )[1]


def plain(xp: Any, model: ActorCritic, params: Any, dropped: bool) -> tuple[Any, Any]:
    """The published network, one frame at a time."""
    carry, obs, prev_action_probs, is_first, mask = jax.device_get(inputs())
    words = xp.asarray(np.asarray(WORDS))
    actions = equations.relu(xp, equations.linear(params["action_embedding"], prev_action_probs))
    features = [
        xp.stack(
            [
                equations.image(
                    xp, params["encoder"]["trunk"], obs.cells[t, b], words, int(obs.target[t, b]),
                    actions[t, b], mask[t, b].reshape(2, CELLS, CHANNELS) if dropped else None,
                    maps=obs.features[t, b].astype(words.dtype) if model is MAPS else None,
                )
                for b in range(B)
            ]
        )
        for t in range(T)
    ]  # fmt: skip
    hidden, _ = equations.lstm_rollout(
        xp, params["lstm"], *carry, xp.stack(features), xp.zeros((T, B, 0)), is_first
    )
    logits = equations.linear(params["actor"], hidden)
    return logits, equations.linear(params["critic"], hidden)[..., 0]


@CASES
def test_the_fast_forms_equal_the_published_network(model: ActorCritic, dropped: bool) -> None:
    params = parameters(model)
    out = forward(model, params, dropped)
    logits, value = plain(np, model, equations.in_float64(params), dropped)
    np.testing.assert_allclose(out.logits, logits, **CLOSE)
    np.testing.assert_allclose(out.value, value, **CLOSE)


@pytest.mark.slow
@CASES
def test_the_fast_forms_have_the_gradient_of_the_published_network(
    model: ActorCritic, dropped: bool
) -> None:
    mix = np.random.default_rng(1).normal(size=(T, B, 6)).astype(np.float32)

    def fast(params: Any) -> jax.Array:
        out = forward(model, params, dropped)
        return (out.logits * mix).sum() + (out.value * mix[..., 0]).sum()

    def slow(params: Any) -> jax.Array:
        logits, value = plain(jnp, model, params, dropped)
        return (logits * mix).sum() + (value * mix[..., 0]).sum()

    grads = jax.jit(jax.grad(fast))(parameters(model))
    for path, leaf in jax.tree.leaves_with_path(grads):
        assert not leaf.size or np.asarray(leaf).any(), jax.tree_util.keystr(path)
    chex.assert_trees_all_close(grads, jax.grad(slow)(parameters(model)), rtol=2e-4, atol=1e-4)


@pytest.mark.parametrize("lead", [(2,), (1, 2), (3, 2)])
def test_a_one_hot_look_up_has_the_gradient_of_plain_indexing(lead: tuple[int, ...]) -> None:
    table = jnp.asarray(np.random.default_rng(0).normal(size=(5, 3)), jnp.float32)
    index = jnp.asarray(np.random.default_rng(2).integers(0, 5, (*lead, 3)))
    mix = jnp.asarray(np.random.default_rng(1).normal(size=(*lead, 3, 3)), jnp.float32)
    fast = jax.value_and_grad(lambda x: (one_hot_look_up(x, index, jnp.float32) * mix).sum())(table)
    slow = jax.value_and_grad(lambda x: (x[index] * mix).sum())(table)
    chex.assert_trees_all_close(fast, slow, rtol=1e-6)


def test_the_published_size() -> None:
    model = ActorCritic(BaselineEncoder())
    shapes = jax.eval_shape(model.initialise, jax.random.key(0), jnp.zeros((22, 300)))
    # conv 512 -> 64, target 300 -> 64, action 6 -> 10, pointwise 138 -> 64, LSTM 3136 -> 512 with
    # two biases, actor and critic, every layer with its bias. The convolution has no weights for
    # the zeros after the word vector.
    layers = [(513, 64), (301, 64), (7, 10), (139, 64), (3136 + 512 + 2, 2048), (513, 6), (513, 1)]
    published = sum(n * m for n, m in layers)
    size = sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    assert size == published - 64 * (512 - 300)


@pytest.mark.parametrize("part", ["cells", "target"])
def test_the_image_and_the_target_matter(part: str) -> None:
    carry, obs, prev_action_probs, is_first, _ = jax.tree.map(lambda x: x[0], inputs())
    carry = MODEL.initial_carry(B, parameters())

    @jax.jit
    def logits(obs: Observation) -> jax.Array:
        class_table = actor_critic.prepare(MODEL, parameters(), WORDS)
        return actor_critic.forward(
            MODEL, parameters(), class_table, carry, obs, prev_action_probs, is_first
        )[1][0]

    changed = {
        "cells": obs.cells.at[:, 6, 0].set((obs.cells[:, 6, 0] + 1) % CLASSES),
        "target": (obs.target + 1) % CLASSES,
    }
    difference = np.abs(logits(obs) - logits(obs.replace(**{part: changed[part]})))
    assert (difference.max(axis=-1) > 1e-5).all()
