"""Imitation of shortest paths: which moves are taught, when, and how they enter the loss."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.env import dynamics
from tdanet_jax.training import imitation, learner
from tdanet_jax.vocabulary import ACTION_NAMES, NUM_ACTIONS, Action
from tests.support.oracle import World
from tests.training import test_learner as house

WORLD = World(house.TABLES, house.WORTH, house.LIMITS)
CONFIG = dataclasses.replace(house.CONFIG, imitation_weight=0.4)
MOVES = [a for a in range(NUM_ACTIONS) if a != Action.DONE]


@functools.cache
def far(state: int, target: str) -> int | None:
    """Fewest moves until the target is visible."""
    return WORLD.distance(state, target)


def best(target: str, state: int) -> list[bool]:
    """Which actions begin a shortest path."""
    here = far(state, target)
    if here in (None, 0):
        return [name == "Done" and here == 0 for name in ACTION_NAMES]
    there = [WORLD.state_of(WORLD.moved(WORLD.pose_of(state), a)) for a in range(NUM_ACTIONS)]
    return [a in MOVES and far(there[a], target) == here - 1 for a in range(NUM_ACTIONS)]


def test_best_actions_begin_the_shortest_paths() -> None:
    @jax.jit
    @jax.vmap
    def found(target: jax.Array, pose: jax.Array) -> jax.Array:
        return dynamics.best_actions(dynamics.start(pose, target, house.PARAMS), house.PARAMS)

    shape = len(house.TABLES.targets), house.TABLES.num_states
    actions = np.asarray(found(*np.indices(shape, np.int32).reshape(2, -1))).reshape(*shape, -1)
    kinds = set()
    for target, state in np.ndindex(shape):
        expected = best(house.TABLES.targets[target], state)
        assert actions[target, state].tolist() == expected
        kinds.add(tuple(expected))
    assert len(kinds) > 6
    assert (False,) * 6 in kinds, "a target that is in another room"


def test_moves_are_taught_once_the_target_has_been_seen_in_the_episode() -> None:
    config = dataclasses.replace(CONFIG, rollout_steps=1)
    state, seen, taught, lost = house.start(3, CONFIG), np.zeros(house.B, bool), 0, 0
    for t in range(40):
        before, key = jax.device_get(state), jax.random.key(t)
        arguments = (config, house.MODEL, house.WORDS, house.PARAMS)
        state, steps, _ = house.rollout(state, key, *arguments)
        step = jax.device_get(jax.tree.map(lambda x: x[0], steps._replace(activations=None)))
        np.testing.assert_array_equal(before.target_seen, seen)
        for b in range(house.B):
            in_view = int(step.obs.target[b]) in step.obs.classes[b][step.obs.mask[b]]
            lost += bool(seen[b]) and not in_view
            seen[b] |= in_view
            target = house.CLASSES[int(step.obs.target[b])]
            expected = best(target, int(before.env_state.pose[b])) if seen[b] else [False] * 6
            expected[Action.DONE] = False
            assert step.best_moves[b].tolist() == expected
            taught += any(expected)
            seen[b] &= not step.terminal[b]
    assert taught > 50
    assert lost > 50, "it remembers that it has seen its target"


def test_without_it_nothing_is_computed() -> None:
    state = house.start(0)
    arguments = (jax.random.key(0), house.CONFIG, house.MODEL, house.WORDS, house.PARAMS)
    after, steps, _ = house.rollout(state, *arguments)
    assert (state.target_seen, after.target_seen, steps.best_moves) == (None, None, None)


@given(
    logits=st.lists(st.floats(-30, 30, width=32), min_size=6, max_size=6),
    best=st.lists(st.booleans(), min_size=5, max_size=5),
)
def test_the_loss_is_the_surprise_at_the_best_moves_among_all_moves(
    logits: list[float], best: list[bool]
) -> None:
    one, taught = jnp.asarray(logits, jnp.float32), jnp.asarray([*best, False])
    loss, grad = jax.value_and_grad(imitation.loss)(one, taught)
    weights = np.exp(np.asarray(logits[:5], np.float64) - max(logits[:5]))
    expected = -np.log(weights[best].sum() / weights.sum()) if any(best) else 0.0
    assert float(loss) == pytest.approx(expected, rel=1e-4, abs=1e-4)
    assert float(grad[Action.DONE]) == 0, "it says nothing about Done"
    assert np.isfinite(grad).all()
    if not any(best):
        assert not np.asarray(grad).any()


def test_its_mean_enters_the_loss_with_its_weight() -> None:
    state = house.start(0, CONFIG)
    arguments = (CONFIG, house.MODEL, house.WORDS, house.PARAMS)
    state, *_ = house.rollout(state, jax.random.key(1), *arguments)
    _, steps, last = house.rollout(state, jax.random.key(2), *arguments)
    advantage = house.advantages_of(steps, last)
    experience = learner.Experience(steps, advantage, state.recurrent.carry)

    @jax.jit
    def loss(weight: jax.Array) -> Any:
        now = learner.Scheduled(jnp.float32(0), jnp.float32(0.01), weight)
        config, model, words, _ = arguments
        return learner.loss(state.params, experience, now, config, model, words)

    total, parts = loss(jnp.float32(0.25))
    without, _ = loss(jnp.float32(0))
    inputs = (steps.obs, steps.prev_action_probs, steps.is_first, steps.dropout_mask)
    _, out = house.forward(state.params, state.recurrent.carry, *inputs)
    each = np.asarray(imitation.loss(out.logits, steps.best_moves))
    counted = ~np.asarray(steps.bootstrap_only)
    assert (each[~counted] > 0).any()
    assert float(parts["imitation_loss"]) == pytest.approx(each[counted].mean(), rel=1e-4)
    assert float(total - without) == pytest.approx(0.25 * each[counted].mean(), rel=1e-3)


@pytest.mark.parametrize("until", [0.25, 0.5, 1.0])
def test_its_weight_reaches_nothing_at_the_share_that_is_chosen(until: float) -> None:
    config = dataclasses.replace(CONFIG, imitation_until=until)
    weights = [
        float(learner.schedule(config, jnp.float32(x * until)).imitation_weight)
        for x in (0.0, 0.25, 0.5, 1.0, 1.5)
    ]
    assert weights == pytest.approx([0.4, 0.3, 0.2, 0.0, 0.0])


@pytest.mark.parametrize(("spent", "share"), [(0.0, 1.0), (0.125, 0.75), (0.5, 0.0), (1.0, 0.0)])
def test_its_weight_falls_to_nothing_at_half_of_the_budget(spent: float, share: float) -> None:
    state, progress = house.start(0, CONFIG), jnp.float32(spent)
    rest = (house.MODEL, house.WORDS, house.PARAMS)
    after, _ = house.update(state, progress, CONFIG, *rest)
    weight = 0.4 * share
    assert float(learner.schedule(CONFIG, progress).imitation_weight) == pytest.approx(weight)
    plain, _ = house.update(state.replace(target_seen=None), progress, house.CONFIG, *rest)
    if weight:
        apart = jax.tree.map(lambda a, b: np.abs(a - b).max(), after.params, plain.params)
        assert max(jax.tree.leaves(apart)) > 1e-4
    else:
        chex.assert_trees_all_close(after.params, plain.params, rtol=1e-5, atol=1e-6)


def test_it_is_part_of_every_minibatch() -> None:
    config = dataclasses.replace(CONFIG, num_minibatches=3, learning_rate=0.0)
    state, rest = house.start(0, CONFIG), (house.MODEL, house.WORDS, house.PARAMS)
    _, whole = house.update(state, jnp.float32(0), CONFIG, *rest)
    _, parts = house.update(state, jnp.float32(0), config, *rest)
    # Without a step in between, the parts have the loss of the whole, but for steps left out.
    assert float(parts["imitation_loss"]) == pytest.approx(float(whole["imitation_loss"]), rel=0.05)


@pytest.mark.slow
def test_it_teaches_the_way_to_a_target_that_was_seen() -> None:
    config = dataclasses.replace(CONFIG, imitation_weight=3.0, learning_rate=2e-2)
    state, losses = house.start(0, config), []
    for _ in range(60):
        rest = (house.MODEL, house.WORDS, house.PARAMS)
        state, metrics = house.update(state, jnp.float32(0), config, *rest)
        losses.append(float(metrics["imitation_loss"]))
    assert np.mean(losses[-5:]) < 0.5 * np.mean(losses[:5])
