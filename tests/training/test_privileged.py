"""The critic that knows where the target is: what it is told, and what it learns."""

from __future__ import annotations

import dataclasses
import math

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from tdanet_jax.env.dynamics import start
from tdanet_jax.models.actor_critic import Output
from tdanet_jax.training import learner, privileged
from tdanet_jax.vocabulary import Action
from tests.support.oracle import World
from tests.support.samples import normal
from tests.training import test_learner as examples
from tests.training.test_learner import (
    CONFIG,
    LIMITS,
    MODEL,
    PARAMS,
    TABLES,
    WORDS,
    WORTH,
    B,
    advantages_of,
    begin,
    rollout,
    update,
)

WITHOUT = dataclasses.replace(CONFIG, privileged_critic=False)


def test_it_is_told_the_way_and_the_agents_own_view_of_the_state() -> None:
    world = World(TABLES, WORTH, LIMITS)
    pairs = [
        (pose, goal)
        for pose in range(TABLES.num_states)
        for goal, target in enumerate(TABLES.targets)
        if world.distance(pose, target) is not None
    ][::7]
    poses, goals = (jnp.asarray(column, jnp.int32) for column in zip(*pairs, strict=True))
    states = jax.jit(jax.vmap(start, (0, 0, None)))(poses, goals, PARAMS)
    out = Output(normal(len(pairs), 6, seed=1), normal(len(pairs), seed=2))
    told = np.asarray(jax.jit(privileged.inputs)(states, PARAMS, out))
    assert told.shape == (len(pairs), privileged.INPUTS)
    within = 0
    for row, (pose, goal), logits, value in zip(told, pairs, *map(np.asarray, out), strict=True):
        target = TABLES.targets[goal]
        here = world.distance(pose, target)
        assert here is not None
        within += here == 0
        changes, best = [], []
        for action in Action:
            after = world.distance(world.state_of(world.moved(world.pose_of(pose), action)), target)
            assert after is not None
            changes.append(min(max(after - here, -2), 2))
            best.append(action == Action.DONE if here == 0 else after < here)
        odds = np.exp(logits) / np.exp(logits).sum()
        near = [math.exp(-here / scale) for scale in privileged.SCALES]
        expected = [here / privileged.FAR, here == 0, *near, *changes, *best, *odds, value]
        np.testing.assert_allclose(row, np.asarray(expected, float), rtol=1e-5, atol=1e-6)
    assert 0 < within < len(pairs)


def test_advantages_are_relative_to_its_values() -> None:
    state = examples.start(3)
    assert state.critic is not None
    _, steps, last = rollout(state, jax.random.key(1), CONFIG, MODEL, WORDS, PARAMS)
    first, second = state.critic.params["Dense_0"], state.critic.params["Dense_1"]
    known = np.asarray(steps.known, np.float64)
    hidden = np.maximum(known @ np.asarray(first["kernel"]) + np.asarray(first["bias"]), 0)
    values = (hidden @ np.asarray(second["kernel"]) + np.asarray(second["bias"]))[..., 0]
    np.testing.assert_allclose(steps.baseline, values, rtol=1e-4, atol=1e-5)
    assert last.shape == (B,)
    assert not np.allclose(steps.baseline, steps.value, atol=0.1)
    # The last state's baseline is that of the state that the next rollout begins with.
    one = dataclasses.replace(CONFIG, rollout_steps=1)
    quiet = MODEL.clone(encoder=MODEL.encoder.clone(dropout=0.0))
    after, _, last = rollout(state, jax.random.key(1), one, quiet, WORDS, PARAMS)
    _, following, _ = rollout(after, jax.random.key(2), one, quiet, WORDS, PARAMS)
    np.testing.assert_allclose(last, following.baseline[0], rtol=1e-4, atol=1e-5)


def test_without_it_advantages_are_relative_to_the_agents_own_values() -> None:
    state = begin(jax.random.key(3), WITHOUT, MODEL, WORDS, PARAMS)
    assert state.critic is None
    _, steps, _ = rollout(state, jax.random.key(1), WITHOUT, MODEL, WORDS, PARAMS)
    assert steps.known is None
    np.testing.assert_array_equal(steps.baseline, steps.value)


def test_the_agent_is_not_told_what_it_is_told() -> None:
    """Whatever the critic says, the same actions are taken, of the same views."""
    state = examples.start(4)
    assert state.critic is not None
    other = jax.tree.map(lambda x: x + 1.0, state.critic.params)
    changed = state.replace(critic=state.critic.replace(params=other))
    _, steps, _ = rollout(state, jax.random.key(1), CONFIG, MODEL, WORDS, PARAMS)
    _, same, _ = rollout(changed, jax.random.key(1), CONFIG, MODEL, WORDS, PARAMS)
    assert not np.allclose(steps.baseline, same.baseline)
    chex.assert_trees_all_equal(
        steps._replace(baseline=None, known=None), same._replace(baseline=None, known=None)
    )


def test_an_update_is_one_step_on_the_squared_error_of_the_steps_that_count() -> None:
    state = examples.start(5)
    critic = state.critic
    assert critic is not None
    key = jax.random.fold_in(state.key, 0)
    _, steps, last = rollout(state, key, CONFIG, MODEL, WORDS, PARAMS)
    counted = ~np.asarray(steps.bootstrap_only)
    known = np.asarray(steps.known, np.float64)[counted]
    returns = (np.asarray(steps.baseline) + np.asarray(advantages_of(steps, last)))[counted]
    first, second = critic.params["Dense_0"], critic.params["Dense_1"]
    kernel, row = np.asarray(first["kernel"]), np.asarray(second["kernel"])[:, 0]
    hidden = np.maximum(known @ kernel + np.asarray(first["bias"]), 0)
    error = (hidden @ row + float(second["bias"][0]) - returns) / len(returns)
    back = error[:, None] * row * (hidden > 0)
    grads = {
        "Dense_0": {"kernel": known.T @ back, "bias": back.sum(axis=0)},
        "Dense_1": {"kernel": (hidden.T @ error)[:, None], "bias": error.sum(keepdims=True)},
    }
    given = (steps.known, jnp.float32(steps.baseline + advantages_of(steps, last)), counted)
    # With no optimiser but the gradient itself: Adam's first step has always the same size.
    moved = privileged.update(critic, *given, optax.identity(), jnp.float32(1))
    changes = jax.tree.map(lambda old, new: old - new, critic.params, moved.params)
    chex.assert_trees_all_close(changes, grads, rtol=1e-3, atol=1e-5)
    optimizer, rate = learner.make_optimizer(CONFIG), jnp.float32(CONFIG.learning_rate)
    expected = privileged.update(critic, *given, optimizer, rate)
    after, _ = update(state, jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)
    # Adam divides by the gradient's own size: where that is tiny, its rounding shows.
    chex.assert_trees_all_close(after.critic.params, expected.params, rtol=1e-4, atol=2e-5)


@pytest.mark.parametrize("seed", range(2))
def test_it_predicts_returns_better_than_the_agent_does(seed: int) -> None:
    """What it is for: of the same returns, less is left unexplained."""
    state, learning = examples.start(seed), dataclasses.replace(CONFIG, learning_rate=3e-3)
    for _ in range(60):
        state, _ = update(state, jnp.float32(0), learning, MODEL, WORDS, PARAMS)
    _, steps, last = rollout(state, jax.random.key(9), CONFIG, MODEL, WORDS, PARAMS)
    returns = np.asarray(steps.baseline) + np.asarray(advantages_of(steps, last))
    counted = ~np.asarray(steps.bootstrap_only)
    left, own = (
        np.var((returns - np.asarray(values))[counted]) for values in (steps.baseline, steps.value)
    )
    assert left < 0.8 * own
