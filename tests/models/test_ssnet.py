"""SSNet's encoder against the published equations, and which classes it sees."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.env.types import Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.activation_cache import ACTIVATIONS
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.shared.class_rows import class_rows, make_row_table
from tdanet_jax.models.ssnet import SSNetEncoder
from tests.support import class_equations, equations, samples
from tests.support.samples import CLASSES

KNOWN = (0, 1, 3, 4, 6, 8)
T, B, H = 3, 4, 6
WORDS = jnp.asarray(samples.words())
#: Sums of a few dozen float32 products, in another order.
CLOSE = {"rtol": 3e-5, "atol": 3e-6}

encoder = SSNetEncoder(known=KNOWN)


def observations(*shape: int, seed: int = 1) -> Observation:
    return samples.one_per_class(samples.observations(*shape, seed=seed))


def parameters() -> Any:
    rng = np.random.default_rng(2)
    names = ("query", "key", "value")
    return {name: jnp.asarray(rng.normal(size=(5, 5)), jnp.float32) for name in names}


@jax.jit
def features(params: Any, obs: Observation, words: jax.Array = WORDS) -> jax.Array:
    class_table = encoder.apply({"params": params}, words, method="prepare")
    return encoder.apply({"params": params}, class_table, obs, None)


def plain(xp: Any, params: Any, obs: Observation) -> Any:
    """[frames, 5 n] of a flat batch."""
    words = np.asarray(WORDS, np.float64)
    rows = [
        class_equations.context(*frame, words, KNOWN)
        for frame in class_equations.frames(obs, words)
    ]
    return xp.stack([class_equations.ssnet(xp, params, xp.asarray(row)) for row in rows])


def test_a_row_is_present_x_y_area_and_the_cosine_to_the_target() -> None:
    obs = observations(B)
    found = class_rows(make_row_table(WORDS, KNOWN), obs)
    words = np.asarray(WORDS, np.float64)
    for i, frame in enumerate(class_equations.frames(obs, words)):
        expected = class_equations.context(*frame, words, KNOWN)
        np.testing.assert_allclose(found[i], expected, **CLOSE)
    assert not found[0, :, :4].any(), "the first frame is empty"
    assert 0 < found[-1, :, 0].sum() < len(KNOWN) + 1


def test_a_class_without_a_word_vector_is_like_no_target() -> None:
    class_table = make_row_table(WORDS.at[3].set(0.0), KNOWN)
    assert not np.asarray(class_table.cosine)[:, KNOWN.index(3)].any()
    assert np.isfinite(class_table.cosine).all()


def test_the_features_are_those_of_the_published_equations() -> None:
    obs = observations(12)
    found = features(parameters(), obs)
    assert found.shape == (12, 5 * len(KNOWN))
    expected = plain(np, equations.in_float64(parameters()), obs)
    np.testing.assert_allclose(found, expected, **CLOSE)


@pytest.mark.slow
@pytest.mark.parametrize("from_cache", [False, True], ids=["computed", "from the cache"])
def test_the_gradient_is_that_of_the_published_equations(from_cache: bool) -> None:
    obs = observations(T, B)
    mix = jnp.asarray(np.random.default_rng(4).normal(size=(T, B, 5 * len(KNOWN))), jnp.float32)
    class_table, flat = make_row_table(WORDS, KNOWN), samples.flat(obs)
    variables: dict[str, Any] = {}
    if from_cache:
        step = jax.vmap(
            lambda obs: encoder.apply(
                {"params": parameters()}, class_table, obs, None, mutable=[ACTIVATIONS]
            )[1][ACTIVATIONS]
        )
        variables = {ACTIVATIONS: step(obs)}

    def fast(params: Any) -> jax.Array:
        return (encoder.apply({"params": params, **variables}, class_table, obs, None) * mix).sum()

    def slow(params: Any) -> jax.Array:
        return (plain(jnp, params, flat) * mix.reshape(T * B, -1)).sum()

    found, expected = jax.grad(fast)(parameters()), jax.jit(jax.grad(slow))(parameters())
    chex.assert_trees_all_close(found, expected, rtol=1e-3, atol=1e-4)


def test_the_whole_network_is_the_published_one() -> None:
    """The last action probabilities enter the LSTM as they are."""
    model = ActorCritic(encoder, hidden=H)
    weights = samples.parameters(model, WORDS)
    obs, is_first = observations(B), jnp.asarray([True, False, False, True])
    rng = np.random.default_rng(0)
    prev_action_probs = jnp.asarray(rng.dirichlet(np.ones(6), B), jnp.float32)
    carry = tuple(jnp.asarray(rng.normal(size=(B, H)), jnp.float32) for _ in range(2))
    class_table = actor_critic.prepare(model, weights, WORDS)
    _, out = actor_critic.forward(
        model, weights, class_table, carry, obs, prev_action_probs, is_first
    )
    exact = equations.in_float64(weights)
    x = plain(np, exact["encoder"], obs)
    hidden, _ = equations.lstm_rollout(
        np,
        exact["lstm"],
        *np.asarray(carry),
        x[None],
        np.asarray(prev_action_probs)[None],
        is_first[None],
    )
    np.testing.assert_allclose(out.logits, equations.linear(exact["actor"], hidden[0]), **CLOSE)
    value = equations.linear(exact["critic"], hidden[0])[..., 0]
    np.testing.assert_allclose(out.value, value, **CLOSE)


def test_blind_to_classes_that_it_does_not_know_and_to_the_order_of_detections() -> None:
    obs = observations(12)
    unknown = ~np.isin(obs.classes, KNOWN)
    noise = jnp.asarray(np.random.default_rng(5).random(obs.boxes.shape), jnp.float32)
    other = obs.replace(boxes=jnp.where(unknown[..., None], noise, obs.boxes))
    assert (np.asarray(other.boxes) != obs.boxes).any()
    chex.assert_trees_all_equal(features(parameters(), obs), features(parameters(), other))
    back = obs.replace(
        classes=obs.classes[:, ::-1], boxes=obs.boxes[:, ::-1], mask=obs.mask[:, ::-1]
    )
    chex.assert_trees_all_equal(features(parameters(), obs), features(parameters(), back))


def test_an_unknown_target_is_known_by_its_word_vector() -> None:
    unknown = sorted(set(range(CLASSES)) - set(KNOWN))[0]
    obs = observations(B).replace(target=jnp.full(B, unknown))
    other = WORDS.at[unknown].add(1.0)
    assert not np.allclose(features(parameters(), obs), features(parameters(), obs, other))
