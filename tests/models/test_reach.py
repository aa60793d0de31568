"""The estimate of reach: what it reads, what it is taught, and when it forbids `Done`."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.env import dynamics
from tdanet_jax.env.types import Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic, Output
from tdanet_jax.models.tdanet import TDANetEncoder
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.training import learner
from tdanet_jax.training.learner import Rollout, TrainState
from tdanet_jax.vocabulary import Action
from tests.support import samples
from tests.support.oracle import World
from tests.training import test_learner as house

SPEC = ObservationSpec(sensors=("odometry", "triangulation"))
PLAIN = ActorCritic(TDANetEncoder(width=12), hidden=8, spec=SPEC)
MODEL = PLAIN.clone(reach_threshold=0.6)


def frames(*shape: int) -> Observation:
    """Random observations in which every other target is in view."""
    obs = samples.observations(*shape)
    chosen = jnp.arange(obs.target.size).reshape(shape) % 2 == 0
    target = jnp.where(chosen & ~obs.empty, obs.classes[..., 0], obs.target)
    readings = samples.readings(*shape, triangulation=True)
    return obs.replace(target=target, sensors=readings, cells=None, features=None)


WORDS = jnp.asarray(samples.words())
#: Random parameters whose estimates lie on both sides of the threshold.
WEIGHTS = samples.parameters(MODEL, WORDS)


@functools.partial(jax.jit, static_argnums=(0, 2))
def outputs(model: ActorCritic, obs: Observation, training: bool = False) -> Output:
    """Policy and value in a batch of first steps."""
    unused = () if model.reach_threshold else ("reach",)
    own = {name: part for name, part in WEIGHTS.items() if name not in unused}
    count = obs.target.shape[0]
    table = actor_critic.prepare(model, own, WORDS)
    state = actor_critic.initial_state(model, own, count)
    return actor_critic.act(model, own, table, state, obs, training=training)[1]


def test_done_is_forbidden_out_of_view_and_where_the_target_is_probably_out_of_reach() -> None:
    obs = frames(400)
    out, plain = jax.device_get((outputs(MODEL, obs), outputs(PLAIN, obs)))
    in_view = [
        bool((np.asarray(classes) == target)[np.asarray(mask)].any())
        for classes, mask, target in zip(obs.classes, obs.mask, obs.target, strict=True)
    ]
    assert plain.reach_logit is None
    layers = jax.device_get(WEIGHTS["reach"])
    hidden = np.asarray(obs.sensors["triangulation"], np.float64)
    for name in ("linear1", "linear2"):
        hidden = np.maximum(hidden @ layers[name]["kernel"] + layers[name]["bias"], 0)
    logit = (hidden @ layers["linear3"]["kernel"] + layers["linear3"]["bias"])[:, 0]
    np.testing.assert_allclose(out.reach_logit, logit, atol=1e-5)
    probable = 1 / (1 + np.exp(-logit)) >= 0.6
    allowed = np.array(in_view) & probable
    assert {(bool(v), bool(p)) for v, p in zip(in_view, probable, strict=True)} == {
        (a, b) for a in (True, False) for b in (True, False)
    }
    others = np.delete(np.arange(6), Action.DONE)
    np.testing.assert_array_equal(out.logits[:, others], plain.logits[:, others])
    np.testing.assert_array_equal(out.value, plain.value)
    done = out.logits[:, Action.DONE]
    np.testing.assert_array_equal(done[allowed], plain.logits[allowed, Action.DONE])
    probability = np.asarray(jax.nn.softmax(out.logits))[:, Action.DONE]
    assert not probability[~allowed].any()
    assert probability[allowed].min() > 1e-3
    in_training = outputs(MODEL, obs, True)
    np.testing.assert_array_equal(in_training.logits, plain.logits)
    np.testing.assert_array_equal(in_training.reach_logit, out.reach_logit)


@pytest.mark.parametrize(("temperature", "done_bias"), [(0.5, 2.0), (3.0, -1.5), (1.0, 0.0)])
def test_a_trained_network_decides_at_a_temperature_and_with_a_bias_for_done(
    temperature: float, done_bias: float
) -> None:
    """Where the rule forbids Done, the same holds for the other actions."""
    obs = frames(400)
    own = np.asarray(outputs(PLAIN, obs).logits, np.float64)
    model = MODEL.clone(temperature=temperature, done_bias=done_bias)
    ruled = np.asarray(jax.nn.softmax(outputs(MODEL, obs).logits))
    powers = np.exp((own + done_bias * np.eye(6)[Action.DONE]) / temperature) * (ruled > 0)
    found = jax.nn.softmax(outputs(model, obs).logits)
    np.testing.assert_allclose(found, powers / powers.sum(1, keepdims=True), atol=1e-6)
    in_training = outputs(model, obs, True)
    np.testing.assert_array_equal(in_training.logits, outputs(PLAIN, obs).logits)


def test_what_a_network_remembers_of_its_policy_is_what_it_remembered_in_training() -> None:
    obs, model = frames(40), PLAIN.clone(temperature=0.1, done_bias=5.0)
    own = {name: part for name, part in WEIGHTS.items() if name != "reach"}
    table = actor_critic.prepare(model, own, WORDS)
    state = actor_critic.initial_state(model, own, 40)
    after, out, _ = actor_critic.act(model, own, table, state, obs)
    trained, unchanged, _ = actor_critic.act(model, own, table, state, obs, training=True)
    np.testing.assert_array_equal(after.prev_action_probs, trained.prev_action_probs)
    np.testing.assert_allclose(after.prev_action_probs, jax.nn.softmax(unchanged.logits), atol=1e-6)
    assert abs(np.asarray(jax.nn.softmax(out.logits)) - after.prev_action_probs).max() > 0.1


def test_no_name_enters_the_estimate() -> None:
    obs = frames(60)
    renamed = obs.replace(classes=(obs.classes + 1) % 9, target=(obs.target + 1) % 9)
    one, other = outputs(MODEL, obs), outputs(MODEL, renamed)
    np.testing.assert_array_equal(one.reach_logit, other.reach_logit)
    assert (np.asarray(one.value) != np.asarray(other.value)).any()


@functools.cache
def example() -> tuple[TrainState, Rollout, jax.Array]:
    """A state, a rollout from it with estimates on both sides, and advantages."""
    _, params = house.TASKS[True]
    state = house.begin(jax.random.key(0), house.CONFIG, MODEL, house.WORDS, params)
    changed = samples.randomised(state.params)
    state = state.replace(params=changed)
    _, steps, last = house.rollout(
        state, jax.random.key(1), house.CONFIG, MODEL, house.WORDS, params
    )
    return state, steps, house.advantages_of(steps, last)


def test_what_it_is_taught_is_where_done_succeeds() -> None:
    _, steps, _ = example()
    assert steps.within_reach is not None
    counted = ~np.asarray(steps.bootstrap_only)
    success, taught = np.asarray(steps.success)[counted], np.asarray(steps.within_reach)[counted]
    np.testing.assert_array_equal(success, taught & (steps.action[counted] == Action.DONE))
    assert success.any()
    assert not taught.all()
    world, (_, params) = World(house.TABLES, house.WORTH, house.LIMITS), house.TASKS[True]

    @jax.jit
    @jax.vmap
    def succeeds(target: jax.Array, pose: jax.Array) -> jax.Array:
        return dynamics.would_succeed(dynamics.start(pose, target, params), params)

    shape = len(house.TABLES.targets), house.TABLES.num_states
    found = np.asarray(succeeds(*np.indices(shape, np.int32).reshape(2, -1))).reshape(shape)
    for target, pose in np.ndindex(shape):
        assert found[target, pose] == (house.TABLES.targets[target] in world.visible(pose))


def test_its_loss_is_the_cross_entropy_where_the_target_is_in_view() -> None:
    state, steps, advantage = example()
    experience = learner.Experience(steps, advantage, state.recurrent.carry)
    now = learner.Scheduled(*map(jnp.float32, (0, 0.01, 0)))

    @jax.jit
    def total(params: Any) -> Any:
        return learner.loss(params, experience, now, house.CONFIG, MODEL, house.WORDS)

    @jax.jit
    @jax.grad
    def without(params: Any) -> Any:
        loss, parts = total(params)
        return loss - 0.1 * parts["reach_loss"]

    (loss, parts), grads = jax.jit(jax.value_and_grad(total, has_aux=True))(state.params)
    inputs = (steps.obs, steps.prev_action_probs, steps.is_first, steps.dropout_mask)
    _, out = house.forward(state.params, state.recurrent.carry, *inputs, model=MODEL)
    logits, surprises = np.asarray(out.reach_logit, np.float64), []
    forbidden = ~np.asarray(steps.obs.target_in_view) | (1 / (1 + np.exp(-logits)) < 0.6)
    counted = ~np.asarray(steps.bootstrap_only)
    assert (steps.action == Action.DONE)[counted & forbidden].any(), "it is forbidden in training"
    for index in np.ndindex(*logits.shape):
        seen = np.asarray(steps.obs.classes[index])[np.asarray(steps.obs.mask[index])]
        if bool(steps.bootstrap_only[index]) or int(steps.obs.target[index]) not in seen:
            continue
        probability = 1 / (1 + np.exp(-logits[index]))
        surprises.append(-np.log(probability if steps.within_reach[index] else 1 - probability))
    assert 10 < len(surprises) < logits.size
    assert float(parts["reach_loss"]) == pytest.approx(np.mean(surprises), rel=1e-4)
    rest = (
        parts["policy_loss"]
        + house.CONFIG.value_weight * parts["value_loss"]
        - 0.01 * parts["entropy"]
    )
    assert float(loss) == pytest.approx(float(rest + 0.1 * parts["reach_loss"]), rel=1e-5)

    others = without(state.params)
    assert not any(np.asarray(leaf).any() for leaf in jax.tree.leaves(others.pop("reach")))
    mine = grads.pop("reach")
    assert all(np.asarray(leaf).any() for leaf in jax.tree.leaves(mine))
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-4, atol=1e-6), grads, others)


@pytest.mark.slow
def test_updates_make_the_estimate_better() -> None:
    _, params = house.TASKS[True]
    state = house.begin(jax.random.key(0), house.CONFIG, MODEL, house.WORDS, params)
    losses = []
    for _ in range(120):
        state, metrics = house.update(
            state, jnp.float32(0), house.CONFIG, MODEL, house.WORDS, params
        )
        losses.append(float(metrics["reach_loss"]))
    assert np.mean(losses[-5:]) < 0.75 * np.mean(losses[:5])
