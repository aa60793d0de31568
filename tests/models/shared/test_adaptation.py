"""The inner steps against plain per-environment parameters, `jax.grad` and Python loops."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import Parents
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic, Output
from tdanet_jax.models.baseline import BaselineEncoder
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic, AdaptiveState, LearnedLoss
from tdanet_jax.models.shared.image import DROPOUT_UNITS
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.training import learner
from tests.support import samples
from tests.training.test_learner import house

T, B, H = 7, 3, 4  # three intervals of two steps, and one step
INTERVAL, LIMIT, RATE = 2, 2, 0.02
WORDS = jnp.asarray(samples.words())
ENCODER = BaselineEncoder(dropout=0.25)
MODEL = AdaptiveActorCritic(ENCODER, hidden=H, rate=RATE, interval=INTERVAL, limit=LIMIT)
PLAIN = ActorCritic(ENCODER, hidden=H)
#: The first environment adapts twice and no more; the others begin an episode within an
#: interval and at its start.
IS_FIRST = np.zeros((T, B), bool)
IS_FIRST[0, 0] = IS_FIRST[3, 1] = IS_FIRST[2, 2] = True
CLOSE = {"rtol": 1e-3, "atol": 1e-4}  # float32 sums of thousands of products, through inner steps


@functools.cache
def parameters(model: AdaptiveActorCritic = MODEL) -> Any:
    params = samples.parameters(model, WORDS)
    # Gates that are not saturated: 3,136 features go into each.
    lstm = {name: 0.3 * value for name, value in params["lstm"].items()}
    return {**params, "lstm": lstm}


def inputs(odometry: bool = False) -> tuple[Any, ...]:
    """Observations, previous action probabilities, starts and dropout mask of a rollout."""
    rng = np.random.default_rng(0)
    prev_action_probs = np.where(IS_FIRST[..., None], 0, rng.dirichlet(np.ones(6), (T, B)))
    dropout_mask = jnp.asarray(rng.random((T, B, DROPOUT_UNITS)) < 0.75)
    obs = samples.observations(T, B)
    if odometry:
        obs = obs.replace(sensors=samples.readings(T, B))
    return obs, jnp.asarray(prev_action_probs, jnp.float32), jnp.asarray(IS_FIRST), dropout_mask


def start(params: Any, batch: int = B, model: AdaptiveActorCritic = MODEL) -> AdaptiveState:
    return model.initial_carry(batch, params, training=True)


@functools.partial(jax.jit, static_argnums=0)
def play(model: AdaptiveActorCritic, params: Any, state: AdaptiveState, given: Any) -> Any:
    class_table = actor_critic.prepare(model, params, WORDS)
    return actor_critic.forward(model, params, class_table, state, *given)


def learned_loss(params: Any, record: jax.Array) -> jax.Array:
    """SAVN's loss of one environment's record [k, U], as it is printed in its code."""
    x = record
    for level in range(2):
        kernel, bias = params[f"kernel{level}"], params[f"bias{level}"]
        gap, rows = 2**level, []
        for feature in range(kernel.shape[-1]):
            now = sum(kernel[1, c, feature] * x[c] for c in range(len(x)))
            past = sum(kernel[0, c, feature] * x[c] for c in range(len(x)))
            row = now + bias[feature] + jnp.concatenate([jnp.zeros(gap), past[:-gap]])
            rows.append(jnp.where(row > 0, row, 0.01 * row))
        x = jnp.stack(rows)
    return jnp.sqrt((x[0] ** 2).sum())


def adapted(params: Any, shared: Sequence[str]) -> dict[str, Any]:
    """The parameters that are not under a shared name, by their path."""
    return {
        jax.tree_util.keystr(path): leaf
        for path, leaf in jax.tree.leaves_with_path(params)
        if not any(key.key in shared for key in path)
    }


def joined(params: Any, new: dict[str, Any]) -> Any:
    """The parameters, some of them replaced by path."""
    return jax.tree.map_with_path(
        lambda path, leaf: new.get(jax.tree_util.keystr(path), leaf), params
    )


def slow(
    params: Any,
    given: Any,
    first_order: bool,
    plain: ActorCritic = PLAIN,
    shared: Sequence[str] = (),
) -> Output:
    """One environment's rollout: it has all parameters to itself, gradients by `jax.grad`.

    Args:
      given: the network's inputs, [T, 1, ...].
      plain: the network without adaptation.
      shared: names of parameters and layers that are not adapted.
    """
    network = {name: value for name, value in params.items() if name != "learned_loss"}
    theta, carry, count, outs = network, plain.initial_carry(1, network), 0, []

    def step(theta: Any, carry: Any, shown: Any) -> tuple[Any, Output]:
        class_table = actor_critic.prepare(plain, theta, WORDS)
        return actor_critic.forward(plain, theta, class_table, carry, *shown)

    def inner(own: Any, theta: Any, carry: Any, interval: list[Any]) -> jax.Array:
        theta, record = joined(theta, own), []
        for shown in interval:
            carry, out = step(theta, carry, shown)
            record.append(jnp.concatenate([carry[0][0], jax.nn.softmax(out.logits[0])]))
        return learned_loss(params["learned_loss"], jnp.stack(record))

    steps = len(given[2])
    for begin in range(0, steps, INTERVAL):
        interval = [
            jax.tree.map(lambda x, t=t: x[t], given)
            for t in range(begin, min(begin + INTERVAL, steps))
        ]
        is_first = jnp.stack([shown[2][0] for shown in interval])
        before = carry
        for shown in interval:
            begun = shown[2][0]
            theta = jax.tree.map(lambda own, new, b=begun: jnp.where(b, new, own), theta, network)
            count = jnp.where(begun, 0, count)
            carry, out = step(theta, carry, shown)
            outs.append(out)
        if len(interval) == INTERVAL:
            at = jax.lax.stop_gradient((theta, before)) if first_order else (theta, before)
            grad = jax.grad(inner)(adapted(at[0], shared), *at, interval)
            due = ~is_first[1:].any() & (count < LIMIT)
            own = adapted(theta, shared)
            own = jax.tree.map(lambda p, g, d=due: jnp.where(d, p - RATE * g, p), own, grad)
            theta = joined(theta, own)
            count = count + due
    return jax.tree.map(lambda *x: jnp.concatenate(x), *outs)


def slow_rollout(params: Any, given: Any, first_order: bool = False, **network: Any) -> Output:
    """`slow` in every environment: [T, B, ...]."""
    each = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1)[:, :, None], given)  # [B, T, 1, ...]
    out = jax.vmap(lambda given: slow(params, given, first_order, **network))(each)
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), out)


#: The layer that is not adapted.
NOT_ADAPTED = ("way",)


@pytest.mark.parametrize(
    "odometry",
    [pytest.param(False, marks=pytest.mark.slow), pytest.param(True, marks=pytest.mark.slow)],
    ids=["plain", "odometry"],
)
def test_values_are_those_of_plain_per_environment_parameters(odometry: bool) -> None:
    spec = ObservationSpec(sensors=("odometry",) if odometry else ())
    model, plain = (m.clone(spec=spec) for m in (MODEL, PLAIN))
    params = parameters(model)
    given = jax.tree.map(lambda x: x[:3], inputs(odometry))  # an interval, and one step after it
    _, out = play(model, params, start(params, model=model), given)
    slow = functools.partial(slow_rollout, plain=plain, shared=NOT_ADAPTED)
    chex.assert_trees_all_close(out, jax.jit(slow)(params, given), **CLOSE)
    if odometry:
        still = given[0].replace(sensors=jax.tree.map(jnp.zeros_like, given[0].sensors))
        _, other = play(model, params, start(params, model=model), (still, *given[1:]))
        assert np.all(np.abs(out.logits - other.logits).max(-1) > 1e-4)


@pytest.mark.slow
def test_unused_parts_of_the_observations_are_not_stored() -> None:
    """The environment may have sensors that another network needs."""
    given = jax.tree.map(lambda x: x[0], inputs(odometry=True))
    params = parameters()
    _, out = play(MODEL, params, start(params), given)
    _, plain = play(MODEL, params, start(params), jax.tree.map(lambda x: x[0], inputs()))
    chex.assert_trees_all_equal(out, plain)


@pytest.mark.slow
@pytest.mark.parametrize("first_order", [False, True], ids=["second order", "first order"])
def test_values_and_gradients_are_those_of_plain_per_environment_parameters(
    first_order: bool,
) -> None:
    model = dataclasses.replace(MODEL, first_order=first_order)
    given = jax.tree.map(lambda x: x[:5], inputs())  # two intervals, and one step after them
    mix = np.random.default_rng(2).normal(size=(5, B, 6)).astype(np.float32)

    def mixed(out: Output) -> tuple[jax.Array, Output]:
        return (out.logits * mix).sum() + (out.value * mix[..., 0]).sum(), out

    def fast(params: Any) -> tuple[jax.Array, Output]:
        return mixed(play(model, params, start(params), given)[1])

    def plain(params: Any) -> tuple[jax.Array, Output]:
        return mixed(slow_rollout(params, given, first_order))

    grad, out = jax.jit(jax.grad(fast, has_aux=True))(parameters())
    slow_grad, slow_out = jax.jit(jax.grad(plain, has_aux=True))(parameters())
    chex.assert_trees_all_close(out, slow_out, **CLOSE)
    assert_gradients_close(grad, slow_grad)


def assert_gradients_close(found: Any, expected: Any) -> None:
    """Every parameter has a gradient, and the expected one as far as float32 tells."""
    for (path, mine), theirs in zip(
        jax.tree.leaves_with_path(found), jax.tree.leaves(expected), strict=True
    ):
        if mine.size:
            scale = float(np.abs(theirs).max())
            name = jax.tree_util.keystr(path)
            assert scale > 0, name
            np.testing.assert_allclose(mine, theirs, rtol=1e-3, atol=2e-4 * scale, err_msg=name)


@pytest.mark.slow
def test_the_inner_steps_change_what_follows_them_and_no_other_episode() -> None:
    _, out = play(MODEL, parameters(), start(parameters()), inputs())
    still = dataclasses.replace(MODEL, rate=0.0)
    _, plain = play(still, parameters(), start(parameters()), inputs())
    changed = np.abs(out.logits - plain.logits).max(-1) > 1e-5
    expected = np.ones((T, B), bool)
    expected[:2] = False  # nothing has been adapted yet
    expected[3, 1] = False  # a new episode, within an interval ...
    expected[2:4, 2] = False  # ... and at its start
    # The second environment's new episode first adapts after step 5.
    expected[4:6, 1] = False
    np.testing.assert_array_equal(changed, expected)


@pytest.mark.slow
def test_the_plain_network_is_the_one_that_adapts() -> None:
    params = parameters()
    still = dataclasses.replace(MODEL, rate=0.0)
    _, out = play(still, params, start(params), inputs())
    network = {name: value for name, value in params.items() if name != "learned_loss"}
    class_table = actor_critic.prepare(PLAIN, network, WORDS)
    _, plain = actor_critic.forward(
        PLAIN, network, class_table, PLAIN.initial_carry(B, network), *inputs()
    )
    chex.assert_trees_all_close(out, plain, **CLOSE)


@pytest.mark.slow
def test_a_rollout_equals_its_steps_and_stores_the_same() -> None:
    params, given = parameters(), inputs()
    state, outs = start(params), []
    for t in range(T):
        state, out = play(MODEL, params, state, jax.tree.map(lambda x, t=t: x[t], given))
        outs.append(out)
    last, whole = play(MODEL, params, start(params), given)
    chex.assert_trees_all_close(jax.tree.map(lambda *x: jnp.stack(x), *outs), whole, **CLOSE)
    # In an interval that is not full, the rest are steps of the interval before.
    for mine, theirs in zip(state.steps, last.steps, strict=True):
        chex.assert_trees_all_close(
            *(jax.tree.map(lambda x: x[:, :1], s) for s in (mine, theirs)), **CLOSE
        )
    chex.assert_trees_all_close(state.replace(steps=0), last.replace(steps=0), **CLOSE)
    assert state.count.tolist() == [2, 1, 2]


@pytest.mark.slow
def test_jit_is_eager_and_an_environment_alone_is_one_among_others() -> None:
    params, given = parameters(), jax.tree.map(lambda x: x[:3], inputs())
    _, together = play(MODEL, params, start(params), given)
    with jax.disable_jit():
        class_table = actor_critic.prepare(MODEL, params, WORDS)
        _, eager = actor_critic.forward(MODEL, params, class_table, start(params), *given)
    chex.assert_trees_all_close(eager, together, **CLOSE)
    alone = [
        play(MODEL, params, start(params, 1), jax.tree.map(lambda x, b=b: x[:, b : b + 1], given))
        for b in range(B)
    ]
    stacked = jax.tree.map(lambda *x: jnp.concatenate(x, axis=1), *(out for _, out in alone))
    chex.assert_trees_all_close(stacked, together, **CLOSE)


def test_a_rollout_begins_a_new_interval() -> None:
    params, given = parameters(), inputs()
    state, _ = play(MODEL, params, start(params), given)
    assert state.phase.tolist() == [1] * B
    assert MODEL.begin_rollout(state).phase.tolist() == [0] * B


def test_the_learned_loss_is_the_published_convolution() -> None:
    record = jnp.asarray(np.random.default_rng(3).normal(size=(B, 6, 11)), jnp.float32)
    module = LearnedLoss()
    params = samples.randomised(module.init(jax.random.key(0), record)["params"])
    found = module.apply({"params": params}, record)
    expected = [learned_loss(params, row) for row in record]
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    grad = jax.jit(jax.grad(lambda x: module.apply({"params": params}, x).sum()))(0 * record)
    assert np.isfinite(grad).all()


@pytest.mark.slow
def test_the_update_sees_the_values_that_the_rollout_saw() -> None:
    targets = {"kitchen": ["Mug"], "bedroom": ["CD"]}
    parents = Parents(np.full((2, 3), -1, np.int32), np.zeros((2, 3), np.float32))
    spec = ObservationSpec(image="raster")
    world = make_params(house(), targets, parents, (5,) * 4, spec)
    words = jnp.asarray(
        np.random.default_rng(0).normal(size=(len(house().classes), 4)), jnp.float32
    )
    config = LearnerConfig(num_envs=8, rollout_steps=T, learning_rate=1e-3)
    state = jax.jit(learner.init, static_argnums=(1, 2))(
        jax.random.key(0), config, MODEL, words, world
    )
    update = jax.jit(learner.update, static_argnums=(2, 3))
    for _ in range(2):
        state, _ = update(state, jnp.float32(0), config, MODEL, words, world)
    assert int(state.skipped) == 0
    assert np.asarray(state.recurrent.carry.count).any()
    after, steps, _ = jax.jit(learner.rollout, static_argnums=(2, 3))(
        state, jax.random.key(1), config, MODEL, words, world
    )
    assert not jax.tree.leaves(steps.activations)
    given = (steps.obs, steps.prev_action_probs, steps.is_first, steps.dropout_mask)
    class_table = actor_critic.prepare(MODEL, state.params, words)
    carry, out = actor_critic.forward(
        MODEL,
        state.params,
        class_table,
        state.recurrent.carry,
        *given,
        activations=steps.activations,
    )
    np.testing.assert_allclose(out.value, steps.value, **CLOSE)
    chex.assert_trees_all_close(carry.hidden, after.recurrent.carry.hidden, **CLOSE)
    np.testing.assert_array_equal(carry.count, after.recurrent.carry.count)
