"""Rollouts against the slow world, and the update against the gradient of the plain loss."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from tdanet_jax.config import LearnerConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import Parents
from tdanet_jax.env.types import EnvParams
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic, Output
from tdanet_jax.models.layers import Linear
from tdanet_jax.models.lstm import Carry
from tdanet_jax.models.tdanet import TDANetEncoder
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.training import learner
from tdanet_jax.training.gae import advantages
from tdanet_jax.training.learner import Rollout, TrainState
from tests.support import handmade, oracle
from tests.support.handmade import Room, Sighting, corridor, tables_of
from tests.support.oracle import Episode, World, pose_of, state_of
from tests.support.samples import randomised

LIMITS = (4, 5, 3, 4)
CLASSES = ("Bed", "CD", "CounterTop", "Mug", "Sink")
WORTH = {"Mug": {"CounterTop": 0.375, "Sink": 0.125}, "CD": {"Bed": 0.25}}
B, T = 24, 10


def house() -> handmade.SceneTables:
    """A kitchen with a mug and a bedroom with a CD, both small enough to be found by chance."""

    def room(kind: str, *names: str) -> Room:
        objects = [(name, (0.0, 0.0, 0.0)) for name in names]
        others, sightings = range(1, len(names)), {}
        for place in range(3):
            for heading in range(0, 225, 45):
                x, size = 600 + 4 * heading, 300 + 600 * place  # where it is tells where one is
                box = (x, 1000, x + size, 1000 + size)
                sightings[handmade.state(place, heading)] = [
                    Sighting(0, box, visible=place > 0 and heading < 180),
                    *(Sighting(i, box, heading == 45 * (i - 1 + place)) for i in others),
                ]
        return Room(kind, corridor(3), objects, sightings)

    rooms = [room("kitchen", "Mug", "CounterTop", "Sink"), room("bedroom", "CD", "Bed")]
    return tables_of(rooms, CLASSES, ["CD", "Mug"])


TABLES = house()
WORDS = jnp.asarray(np.random.default_rng(0).normal(size=(len(CLASSES), 4)), jnp.float32)
MODEL = ActorCritic(TDANetEncoder(width=12, dropout=0.25), hidden=8)
CONFIG = LearnerConfig(
    num_envs=B, rollout_steps=T, learning_rate=9e-4, adam_epsilon=1e-5, final_entropy_weight=0.002
)


def house_params(spec: ObservationSpec) -> EnvParams:
    classes = np.full((2, 3), -1, np.int32)
    reward = np.zeros((2, 3), np.float32)
    for goal, target in enumerate(TABLES.targets):
        for slot, (name, worth) in enumerate(WORTH[target].items()):
            classes[goal, slot], reward[goal, slot] = CLASSES.index(name), worth
    targets = {"kitchen": ["Mug"], "bedroom": ["CD"]}
    return make_params(TABLES, targets, Parents(classes, reward), LIMITS, spec)


PARAMS = house_params(ObservationSpec())
SENSORS = ObservationSpec(sensors=("odometry", "triangulation"))
#: Network and task without sensors, and the same with them.
TASKS = {False: (MODEL, PARAMS), True: (MODEL.clone(spec=SENSORS), house_params(SENSORS))}
begin = jax.jit(learner.init, static_argnums=(1, 2))
rollout = jax.jit(learner.rollout, static_argnums=(2, 3))
update = jax.jit(learner.update, static_argnums=(2, 3))


def start(seed: int = 0, config: LearnerConfig = CONFIG, sensors: bool = False) -> TrainState:
    """A run with parameters that are far from the cautious initial ones."""
    model, params = TASKS[sensors]
    state = begin(jax.random.key(seed), config, model, WORDS, params)
    leaves, tree = jax.tree.flatten(state.params)
    rng = np.random.default_rng(seed)
    noise = [jnp.asarray(0.3 * rng.normal(size=x.shape), jnp.float32) for x in leaves]
    changed = jax.tree.unflatten(tree, [x + n for x, n in zip(leaves, noise, strict=True)])
    return state.replace(params=changed)


@functools.cache
def example(
    sensors: bool = False,
) -> tuple[TrainState, TrainState, Rollout, jax.Array, jax.Array]:
    """A state in mid-training, the state after its rollout, the rollout, values, advantages."""
    model, params = TASKS[sensors]
    state = start(sensors=sensors)
    before, *_ = rollout(state, jax.random.key(1), CONFIG, model, WORDS, params)
    after, steps, last = rollout(before, jax.random.key(2), CONFIG, model, WORDS, params)
    return before, after, steps, last, advantages_of(steps, last)


@functools.partial(jax.jit, static_argnames="model")
def forward(
    weights: Any, carry: Carry, *seen: Any, model: ActorCritic = MODEL
) -> tuple[Carry, Output]:
    """The network without an activation cache."""
    table = actor_critic.prepare(model, weights, WORDS)
    return actor_critic.forward(model, weights, table, carry, *seen)


def advantages_of(steps: Rollout, last: jax.Array) -> jax.Array:
    flags = (steps.terminal, steps.bootstrap_only)
    return advantages(steps.reward, steps.value, last, *flags, CONFIG.gamma, CONFIG.gae_lambda)


@pytest.mark.parametrize("bootstrap", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_rollouts_follow_the_slow_world_and_value_time_outs_in_one_more_step(
    bootstrap: bool,
) -> None:
    config = dataclasses.replace(CONFIG, rollout_steps=1, bootstrap_truncated=bootstrap)
    world = World(TABLES, WORTH, LIMITS)
    state = start(3)
    episodes = [begun(state, b) for b in range(B)]
    waiting = np.zeros(B, bool)
    seen = {"success": 0, "time-out": 0, "valued": 0}
    for t in range(40):
        before = jax.device_get(state)
        key = jax.random.fold_in(jax.random.key(4), t)
        state, steps, _ = rollout(state, key, config, MODEL, WORDS, PARAMS)
        steps = steps._replace(activations=None)
        step: Rollout = jax.device_get(jax.tree.map(lambda x: x[0], steps))
        after = jax.device_get(state)
        np.testing.assert_array_equal(step.bootstrap_only, waiting)
        np.testing.assert_array_equal(step.is_first, before.recurrent.is_first)
        np.testing.assert_array_equal(step.prev_action_probs, before.recurrent.prev_action_probs)
        probs = after.recurrent.prev_action_probs
        for b in range(B):
            is_first = waiting[b]
            if waiting[b]:
                # The last state of a truncated episode: nothing happens, then a new episode.
                seen["valued"] += 1
                assert float(step.reward[b]) == 0
                assert bool(step.terminal[b])
                assert not step.done[b]
                assert not step.success[b]
                waiting[b] = False
            else:
                expected = world.act(episodes[b], int(step.action[b]))
                assert float(step.reward[b]) == pytest.approx(expected.reward, abs=1e-6)
                assert bool(step.success[b]) == expected.success
                assert bool(step.done[b]) == (expected.terminated or expected.truncated)
                assert int(step.length[b]) == episodes[b].steps
                assert int(step.shortest[b]) == int(before.env_state.shortest[b])
                waiting[b] = expected.truncated and bootstrap
                is_first = (expected.terminated or expected.truncated) and not waiting[b]
                assert bool(step.terminal[b]) == is_first
                seen["success"] += expected.success
                seen["time-out"] += expected.truncated
            assert bool(after.recurrent.is_first[b]) == is_first
            if is_first:
                assert not probs[b].any()
                episodes[b] = begun(state, b)
            else:
                # The episode continues: its own last state, and the policy's own probabilities.
                assert int(after.env_state.pose[b]) == state_of(episodes[b].pose)
                assert probs[b].sum() == pytest.approx(1, abs=1e-5)
                assert np.log(probs[b, step.action[b]]) == pytest.approx(step.log_prob[b], abs=1e-5)
        np.testing.assert_array_equal(after.bootstrap_only, waiting)
        if t % 8 == 0:
            agrees_with_observe(step, before)
    assert min(seen["success"], seen["time-out"]) > 20
    assert (seen["valued"] > 20) == bootstrap


def begun(state: TrainState, b: int) -> Episode:
    """The episode that the slow world should play next to the state's row b."""
    row = jax.tree.map(lambda x: x[b], state.env_state)
    assert int(row.steps) == 0
    return Episode(pose_of(int(row.pose)), TABLES.targets[int(row.target)])


def agrees_with_observe(step: Rollout, before: TrainState) -> None:
    """The network saw the state that it acted in (or valued, where an episode was cut)."""
    expected = jax.vmap(dynamics.observe, (0, None))(before.env_state, PARAMS)
    chex.assert_trees_all_equal(step.obs, jax.device_get(expected))


def test_recorded_values_and_probabilities_are_those_of_the_network() -> None:
    before, after, steps, last, _ = example()
    seen = (steps.obs, steps.prev_action_probs, steps.is_first, steps.dropout_mask)
    carry, out = forward(before.params, before.recurrent.carry, *seen)
    log_probs = jax.nn.log_softmax(out.logits)
    log_prob = jnp.take_along_axis(log_probs, steps.action[..., None], -1)[..., 0]
    # The same float32 sums, taken over all steps at once.
    close = {"rtol": 1e-4, "atol": 1e-5}
    chex.assert_trees_all_close((steps.value, steps.log_prob), (out.value, log_prob), **close)
    chex.assert_trees_all_close(after.recurrent.carry, carry, **close)
    # The last value is of the state that the next rollout starts from, without dropout.
    obs = jax.vmap(dynamics.observe, (0, None))(after.env_state, PARAMS)
    rest = (obs, after.recurrent.prev_action_probs, after.recurrent.is_first)
    _, out = forward(before.params, after.recurrent.carry, *rest)
    chex.assert_trees_all_close(last, out.value, **close)


def test_carries_cross_the_borders_of_rollouts() -> None:
    before, after, _, _, _ = example()
    in_progress = ~np.asarray(before.recurrent.is_first)
    assert in_progress.any()
    assert np.asarray(before.recurrent.carry[0])[in_progress].any(axis=-1).all()
    assert not np.array_equal(after.recurrent.carry[0], before.recurrent.carry[0])


@functools.partial(jax.jit, static_argnames="model")
def gradient(
    state: TrainState,
    steps: Rollout,
    advantage: jax.Array,
    entropy: jax.Array,
    model: ActorCritic = MODEL,
) -> Any:
    """Loss, its parts and its gradient for the parameters that acted."""

    def total(params: Any) -> Any:
        experience = learner.Experience(steps, advantage, state.recurrent.carry)
        now = learner.Scheduled(jnp.float32(0), entropy, jnp.float32(0))
        return learner.loss(params, experience, now, CONFIG, model, WORDS)

    return jax.value_and_grad(total, has_aux=True)(state.params)


@pytest.mark.parametrize(
    "sensors",
    [False, pytest.param(True, marks=pytest.mark.slow)],
    ids=["plain", "triangulation"],
)
def test_the_activation_cache_changes_neither_the_loss_nor_its_gradient(sensors: bool) -> None:
    before, _, steps, _, advantage = example(sensors)
    model, _ = TASKS[sensors]
    cached = gradient(before, steps, advantage, 0.01, model=model)
    plain = gradient(before, steps._replace(activations=None), advantage, 0.01, model=model)
    # float32 sums over 240 states, in another order.
    chex.assert_trees_all_close(cached, plain, rtol=2e-4, atol=2e-6)
    if sensors:
        assert "way" in steps.activations
        assert all(np.asarray(grad).any() for grad in cached[1]["way"].values())


def test_sensor_states_begin_with_every_episode_and_last_as_long_as_it() -> None:
    _, after, steps, *_ = example(sensors=True)
    whole = jax.tree.map(
        lambda *x: jnp.concatenate([x[0], x[1][None]]),
        (steps.obs, steps.is_first),
        (
            jax.jit(jax.vmap(dynamics.observe, (0, None)))(after.env_state, TASKS[True][1]),
            after.recurrent.is_first,
        ),
    )
    obs, is_first = jax.device_get(whole)  # [T + 1, B]
    odometry = obs.sensors["odometry"]
    seen = (obs.mask & (obs.classes == obs.target[..., None])).any(axis=-1)
    known = obs.sensors["triangulation"].any(axis=-1)
    # At first what is in view is all that is known; later, all that was.
    np.testing.assert_array_equal(known[is_first], seen[is_first])
    np.testing.assert_array_equal(known[1:], seen[1:] | (known[:-1] & ~is_first[1:]))
    assert (known & ~seen).any()
    assert (known[:-1] & ~known[1:]).any()
    here = np.zeros((9, 9), bool)
    here[4, 4] = True
    for t, b in np.ndindex(T + 1, B):
        position, last = odometry.motion[t, b, :2], odometry.motion[t, b, 6:]
        if is_first[t, b]:
            assert not position.any()
            assert not last.any()
            np.testing.assert_array_equal(odometry.window[t, b], here)
        elif t:
            # Also in a step that only values: there it is of the episode's last state.
            np.testing.assert_array_equal(last, np.eye(6)[steps.action[t - 1, b]])
            assert odometry.window[t, b][4, 4] & 1
    assert is_first[1:].sum() > 20
    assert steps.bootstrap_only.any()
    assert np.abs(odometry.motion[..., :2]).max() > 0


def test_the_loss_is_the_one_that_is_documented() -> None:
    before, _, steps, _, advantage = example()
    (total, parts), _ = gradient(before, steps, advantage, 0.03)
    seen = (steps.obs, steps.prev_action_probs, steps.is_first, steps.dropout_mask)
    _, out = forward(before.params, before.recurrent.carry, *seen)
    logits, value = np.asarray(out.logits, np.float64), np.asarray(out.value, np.float64)
    policy, critic, entropy, count = 0.0, 0.0, 0.0, 0
    for t in range(T):
        for b in range(B):
            if steps.bootstrap_only[t, b]:
                continue
            count += 1
            p = np.exp(logits[t, b]) / np.exp(logits[t, b]).sum()
            advantage_tb = float(advantage[t, b])
            policy -= np.log(p[int(steps.action[t, b])]) * advantage_tb
            critic += 0.5 * (float(steps.value[t, b]) + advantage_tb - value[t, b]) ** 2
            entropy -= (p * np.log(p)).sum()
    assert 0 < count < T * B, "the rollout should hold both kinds of steps"
    assert float(parts["policy_loss"]) == pytest.approx(policy / count, rel=1e-4)
    assert float(parts["value_loss"]) == pytest.approx(critic / count, rel=1e-4)
    assert float(parts["entropy"]) == pytest.approx(entropy / count, rel=1e-4)
    expected = (policy + CONFIG.value_weight * critic - 0.03 * entropy) / count
    assert float(total) == pytest.approx(expected, rel=1e-4)


def test_bootstrap_only_steps_do_not_count() -> None:
    before, _, steps, _, advantage = example()
    only = steps.bootstrap_only
    assert only.any()
    other = steps._replace(
        action=jnp.where(only, (steps.action + 1) % 6, steps.action),
        value=jnp.where(only, 100.0, steps.value),
        reward=jnp.where(only, 50.0, steps.reward),
    )
    chex.assert_trees_all_equal(
        gradient(before, steps, advantage, 0.01),
        gradient(before, other, jnp.where(only, 7.0, advantage), 0.01),
    )


@dataclasses.dataclass
class TorchAdam:
    """torch.optim.Adam in NumPy; with `amsgrad` line by line as in PyTorch's first versions."""

    rate: float
    epsilon: float
    amsgrad: bool
    count: int = 0
    memory: dict[int, Any] = dataclasses.field(default_factory=dict)  # by a leaf's number

    def step(self, grads: Any) -> Any:
        """The change of the parameters."""
        self.count += 1
        leaves, tree = jax.tree.flatten(jax.device_get(grads))
        return jax.tree.unflatten(tree, [self._one(i, g) for i, g in enumerate(leaves)])

    def _one(self, number: int, grad: np.ndarray) -> np.ndarray:
        zero = np.zeros_like(grad)
        first, second, largest = self.memory.get(number, (zero, zero, zero))
        first, second = 0.9 * first + 0.1 * grad, 0.999 * second + 0.001 * grad**2
        largest = np.maximum(largest, second)
        self.memory[number] = first, second, largest
        correction = np.sqrt(1 - 0.999**self.count)
        size = self.rate * correction / (1 - 0.9**self.count)
        if self.amsgrad:
            return -size * first / (np.sqrt(largest) + self.epsilon)
        return -size * first / (np.sqrt(second) + self.epsilon * correction)


def test_amsgrad_forgets_a_large_first_gradient_no_faster_than_torch() -> None:
    config = dataclasses.replace(CONFIG, amsgrad=True, max_grad_norm=1e9)
    ours, theirs = learner.make_optimizer(config), TorchAdam(1.0, config.adam_epsilon, True)
    params, step = jnp.zeros(3), jax.jit(ours.update)
    state = ours.init(params)
    for number in range(50):
        grads = jnp.array([1.0, -2.0, 0.5]) * (100.0 if number == 0 else 1.0)
        change, state = step(grads, state, params)
        expected = theirs.step(grads)
        np.testing.assert_allclose(-change, expected, rtol=1e-3)


@pytest.mark.parametrize(
    ("amsgrad", "progress"), [(False, 0.25), pytest.param(True, 0.0, marks=pytest.mark.slow)]
)
def test_an_update_is_one_step_of_clipped_adam_on_the_gradient_of_the_loss(
    amsgrad: bool, progress: float
) -> None:
    config = dataclasses.replace(CONFIG, amsgrad=amsgrad)
    state = start(5)
    rate = 9e-4 * (1 - progress)
    entropy = 0.01 + progress * (0.002 - 0.01)
    reference = TorchAdam(rate, config.adam_epsilon, amsgrad)
    state = state.replace(opt_state=learner.make_optimizer(config).init(state.params))
    for number in range(2):
        key = jax.random.fold_in(state.key, number)
        _, steps, last = rollout(state, key, CONFIG, MODEL, WORDS, PARAMS)
        advantage = advantages_of(steps, last)
        grads = jax.device_get(
            gradient(state, steps._replace(activations=None), advantage, entropy)[1]
        )
        norm = np.sqrt(sum((leaf**2).sum() for leaf in jax.tree.leaves(grads)))
        assert norm > config.max_grad_norm or number
        share = min(1.0, config.max_grad_norm / norm)
        change = reference.step(jax.tree.map(lambda leaf, by=share: by * leaf, grads))
        expected = jax.tree.map(np.add, jax.device_get(state.params), change)
        state, _ = update(state, jnp.float32(progress), config, MODEL, WORDS, PARAMS)
        assert int(state.updates) == number + 1
        # Adam divides by the gradient's own size: where that is tiny, its rounding shows.
        chex.assert_trees_all_close(state.params, expected, rtol=1e-4, atol=2e-5)


@functools.partial(jax.jit, static_argnames=("clip",))
def ppo(
    params: Any,
    steps: Rollout,
    advantage: jax.Array,
    carry: Any,
    entropy_weight: float,
    clip: float,
) -> Any:
    """PPO's loss (Schulman et al. 2017, Eq. 7), how many ratios it clips, and its gradient."""

    def total(params: Any) -> tuple[jax.Array, jax.Array]:
        seen = (steps.obs, steps.prev_action_probs, steps.is_first, steps.dropout_mask)
        _, out = forward(params, carry, *seen)
        probs = jax.nn.softmax(out.logits)
        chosen = jnp.take_along_axis(probs, steps.action[..., None], -1)[..., 0]
        ratio = chosen / jnp.exp(steps.log_prob)
        policy = jnp.where(
            advantage > 0,
            jnp.where(ratio > 1 + clip, 1 + clip, ratio) * advantage,
            jnp.where(ratio < 1 - clip, 1 - clip, ratio) * advantage,
        )
        critic = 0.5 * (out.value - (steps.value + advantage)) ** 2
        entropy = -(probs * jnp.log(probs)).sum(-1)
        each = -policy + CONFIG.value_weight * critic - entropy_weight * entropy
        counted = ~steps.bootstrap_only
        clipped = counted & (jnp.abs(ratio - 1) > clip)
        return jnp.where(counted, each, 0).sum() / counted.sum(), clipped.sum()

    return jax.value_and_grad(total, has_aux=True)(params)


@pytest.mark.parametrize(("parts", "epochs"), [(3, 2), pytest.param(1, 2, marks=pytest.mark.slow)])
def test_several_optimiser_steps_are_ppo_on_minibatches(parts: int, epochs: int) -> None:
    config = dataclasses.replace(
        CONFIG, num_minibatches=parts, update_epochs=epochs, clip_coef=0.05, learning_rate=0.01
    )
    state, progress = start(5), 0.25
    entropy_weight = 0.01 + progress * (0.002 - 0.01)
    key = jax.random.fold_in(state.key, 0)
    _, steps, last = rollout(state, key, CONFIG, MODEL, WORDS, PARAMS)
    advantage = advantages_of(steps, last)
    steps = steps._replace(activations=None)
    adam = TorchAdam(0.01 * (1 - progress), config.adam_epsilon, amsgrad=False)
    expected, clipped, norms = state.params, 0, []
    for _ in range(epochs):
        for part in range(parts):
            mine = slice(part, None, parts)
            given = jax.tree.map(lambda x, mine=mine: x[:, mine], (steps, advantage))
            carry = jax.tree.map(lambda x, mine=mine: x[mine], state.recurrent.carry)
            (_, count), grads = ppo(expected, *given, carry, entropy_weight, clip=0.05)
            clipped += int(count)
            grads = jax.device_get(grads)
            norms.append(np.sqrt(sum((leaf**2).sum() for leaf in jax.tree.leaves(grads))))
            share = min(1.0, config.max_grad_norm / norms[-1])
            change = adam.step(jax.tree.map(lambda leaf, by=share: by * leaf, grads))
            expected = jax.tree.map(np.add, jax.device_get(expected), change)
    assert clipped > 10
    after, metrics = update(state, jnp.float32(progress), config, MODEL, WORDS, PARAMS)
    chex.assert_trees_all_close(after.params, expected, rtol=1e-3, atol=1e-4)
    assert float(metrics["grad_norm"]) == pytest.approx(np.mean(norms), rel=1e-3)
    assert int(after.updates) == 1
    assert int(after.skipped) == 0


def test_a_step_that_is_not_finite_is_left_out_and_the_others_are_taken() -> None:
    state = start(5)
    carry = jax.tree.map(lambda x: x.at[1].set(jnp.nan), state.recurrent.carry)
    broken = state.replace(
        recurrent=state.recurrent.replace(carry=carry, is_first=jnp.zeros(B, bool))
    )
    config = dataclasses.replace(CONFIG, num_minibatches=2)
    after, _ = update(broken, jnp.float32(0), config, MODEL, WORDS, PARAMS)
    assert int(after.skipped) == 1
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after.params))
    moved = jax.tree.map(lambda new, old: (new != old).any(), after.params, state.params)
    assert any(jax.tree.leaves(moved))


class Mixed(TDANetEncoder):
    """TDANet's encoder with a layer in float32 and one that is no `Linear`."""

    def setup(self) -> None:
        self.attention, self.linear3 = Linear(self.width), Linear(self.width)
        self.linear1, self.linear2 = Linear(self.width, self.dtype), Linear(self.width, self.dtype)
        self.linear4 = nn.Dense(self.width)


def test_no_kernel_is_rounded_that_its_layer_would_not_round(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(learner, "SMALL", 0)
    spec = SENSORS
    model = ActorCritic(Mixed(width=12, dtype=jnp.bfloat16), 8, dtype=jnp.bfloat16, spec=spec)
    params = TASKS[True][1]
    state = begin(jax.random.key(1), CONFIG, model, WORDS, params)
    state = state.replace(params=randomised(state.params, seed=2))
    rounded = actor_critic.round_kernels(model, state.params, WORDS, learner.SMALL)
    names = {
        jax.tree_util.keystr(path, simple=True, separator="/")
        for path, leaf in jax.tree.leaves_with_path(rounded)
        if leaf.dtype == jnp.bfloat16
    }
    assert names == {f"{name}/kernel" for name in ("encoder/linear1", "encoder/linear2", "lstm")}
    _, steps, _ = rollout(state, jax.random.key(3), CONFIG, model, WORDS, params)
    obs = jax.vmap(dynamics.observe, (0, None))(state.env_state, params)
    recurrent = state.recurrent
    seen = (recurrent.carry, obs, recurrent.prev_action_probs, recurrent.is_first)
    _, out = forward(state.params, *seen, model=model)
    np.testing.assert_allclose(steps.value[0], out.value, rtol=1e-5)


def test_only_large_kernels_are_rounded_while_acting() -> None:
    model = ActorCritic(TDANetEncoder(width=12, dtype=jnp.bfloat16), hidden=8, dtype=jnp.bfloat16)
    state = start(1)
    state = state.replace(params=randomised(state.params, seed=2))
    _, steps, _ = rollout(state, jax.random.key(3), CONFIG, model, WORDS, PARAMS)
    assert max(x.size for x in jax.tree.leaves(state.params)) < learner.SMALL
    obs = jax.vmap(dynamics.observe, (0, None))(state.env_state, PARAMS)
    recurrent = state.recurrent
    seen = (recurrent.carry, obs, recurrent.prev_action_probs, recurrent.is_first)
    _, out = forward(state.params, *seen, model=model)
    np.testing.assert_allclose(steps.value[0], out.value, rtol=1e-5)


def test_the_explained_variance_is_that_of_the_returns_that_count() -> None:
    state, progress = start(7), jnp.float32(0)
    key = jax.random.fold_in(state.key, 0)
    _, steps, last = rollout(state, key, CONFIG, MODEL, WORDS, PARAMS)
    advantage = np.asarray(advantages_of(steps, last))
    counted = ~np.asarray(steps.bootstrap_only)
    returns = (np.asarray(steps.value) + advantage)[counted]
    _, metrics = update(state, progress, CONFIG, MODEL, WORDS, PARAMS)
    expected = 1 - advantage[counted].var() / returns.var()
    assert float(metrics["explained_variance"]) == pytest.approx(expected, rel=1e-3, abs=1e-4)
    assert float(metrics["learning_rate"]) == pytest.approx(9e-4)


def test_schedules_reach_their_end_and_stay_there() -> None:
    state = start(6)
    for progress in (1.0, 1.5):
        after, _ = update(state, jnp.float32(progress), CONFIG, MODEL, WORDS, PARAMS)
        chex.assert_trees_all_equal(after.params, state.params)  # the final learning rate is 0


def test_metrics_are_sums_over_the_episodes_that_finished() -> None:
    state = start(7)
    after, metrics = update(state, jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)
    key = jax.random.fold_in(state.key, state.updates)
    _, steps, _ = rollout(state, key, CONFIG, MODEL, WORDS, PARAMS)
    won, least, taken = [], [], []
    for t in range(T):
        for b in range(B):
            if steps.done[t, b]:
                won.append(bool(steps.success[t, b]))
                least.append(int(steps.shortest[t, b]))
                taken.append(int(steps.length[t, b]))
    rate, spl = oracle.success_rate_and_spl(won, least, taken)
    assert 5 < sum(won) < len(won)
    assert int(metrics["episodes"]) == int(after.episodes) == len(won)
    assert float(metrics["success_sum"]) == sum(won)
    assert 100 * float(metrics["success_sum"]) / len(won) == pytest.approx(rate)
    assert 100 * float(metrics["spl_sum"]) / len(won) == pytest.approx(spl, rel=1e-5)
    assert int(metrics["length_sum"]) == sum(taken)
    assert int(metrics["bootstrap_only_steps"]) == int(steps.bootstrap_only.sum()) > 0
    acted = np.asarray(steps.action)[~np.asarray(steps.bootstrap_only)]
    np.testing.assert_array_equal(metrics["actions"], np.bincount(acted, minlength=6))
    assert float(metrics["reward_sum"]) == pytest.approx(float(steps.reward.sum()), rel=1e-5)
    assert int(update(after, jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)[0].episodes) > len(won)


@pytest.mark.parametrize("fault", ["rewards", "words"])
def test_a_gradient_that_is_not_finite_skips_the_update_and_is_counted(fault: str) -> None:
    state, _ = update(start(8), jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)
    params, words = PARAMS, WORDS
    if fault == "rewards":
        params = PARAMS.replace(parent_reward=PARAMS.parent_reward + jnp.inf)
    else:
        words = WORDS.at[0].set(jnp.nan)
    after, metrics = update(state, jnp.float32(0), CONFIG, MODEL, words, params)
    assert not np.isfinite(float(metrics["grad_norm"]))
    chex.assert_trees_all_equal((after.params, after.opt_state), (state.params, state.opt_state))
    assert int(after.skipped) == 1
    assert int(after.updates) == 2
    assert int(after.episodes) > int(state.episodes)
    # Once the fault is gone, training continues with what was kept.
    for _ in range(3):
        after, metrics = update(after, jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)
    assert np.isfinite(float(metrics["grad_norm"]))
    assert int(after.skipped) < 4
    chex.assert_tree_all_finite(after.params)
    assert not np.array_equal(after.params["actor"]["kernel"], state.params["actor"]["kernel"])


def data(state: TrainState) -> TrainState:
    """The state with its random key as numbers."""
    return state.replace(key=jax.random.key_data(state.key))


def test_equal_keys_give_equal_runs_and_others_do_not() -> None:
    runs = []
    for seed in (9, 9, 10):
        state = begin(jax.random.key(seed), CONFIG, MODEL, WORDS, PARAMS)
        for _ in range(2):
            state, _ = update(state, jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)
        runs.append(state)
    chex.assert_trees_all_equal(data(runs[0]), data(runs[1]))
    assert not np.array_equal(runs[0].env_state.pose, runs[2].env_state.pose)
    assert not np.array_equal(runs[0].params["actor"]["kernel"], runs[2].params["actor"]["kernel"])


def test_updates_do_not_repeat_their_randomness() -> None:
    state = start(11)
    later = state.replace(updates=jnp.int32(1))
    one, _ = update(state, jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)
    two, _ = update(later, jnp.float32(0), CONFIG, MODEL, WORDS, PARAMS)
    assert not np.array_equal(one.env_state.pose, two.env_state.pose)


def test_a_chunk_of_updates_equals_single_ones_and_is_traced_once(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    chex.clear_trace_counter()
    monkeypatch.setattr(learner, "update", chex.assert_max_traces(learner.update, n=1))
    chunk = learner.make_train(CONFIG, MODEL, 3)
    whole, metrics = chunk(start(12), jnp.array([0.0, 0.3]), WORDS, PARAMS)
    state = start(12)
    rows = []
    for share in (0.0, 0.1, 0.2):
        state, row = update(state, jnp.float32(share), CONFIG, MODEL, WORDS, PARAMS)
        rows.append(row)
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *rows)
    # Two compilations may order float32 sums differently; whole numbers must agree exactly.
    chex.assert_trees_all_close(metrics, stacked, rtol=1e-4, atol=1e-5)
    chex.assert_trees_all_close(data(whole), data(state), rtol=1e-3, atol=1e-5)
    chex.assert_trees_all_equal(whole.env_state, state.env_state)
    assert int(whole.updates) == 3
    again, _ = chunk(whole, jnp.array([0.5, 1.0]), WORDS, PARAMS)
    chex.assert_trees_all_equal_shapes_and_dtypes(data(again), data(start(12)))


def test_dropout_keeps_its_share_and_is_off_at_zero() -> None:
    *_, steps, _, _ = example()
    assert steps.dropout_mask is not None
    kept = np.asarray(steps.dropout_mask)
    # 2,880 draws at 0.75: the standard deviation of their mean is 0.008.
    assert abs(kept.mean() - 0.75) < 0.04
    assert len(np.unique(kept.reshape(-1, kept.shape[-1]), axis=0)) > T * B / 4
    none = ActorCritic(TDANetEncoder(width=12, dropout=0.0), hidden=8)
    _, steps, _ = jax.eval_shape(
        lambda state: learner.rollout(state, state.key, CONFIG, none, WORDS, PARAMS), start()
    )
    assert steps.dropout_mask is None


def test_a_small_task_is_learnt() -> None:
    config = LearnerConfig(
        num_envs=32, rollout_steps=20, learning_rate=5e-3, entropy_weight=0.02,
        final_entropy_weight=0.0,
    )  # fmt: skip
    params = PARAMS.replace(step_limit=jnp.full(4, 25, jnp.int32))
    model = ActorCritic(TDANetEncoder(width=32, dropout=0.1), hidden=32)
    state = begin(jax.random.key(14), config, model, WORDS, params)
    chunk = learner.make_train(config, model, 200)
    _, metrics = chunk(state, jnp.array([0.0, 1.0]), WORDS, params)
    success = np.asarray(metrics["success_sum"]) / np.asarray(metrics["episodes"])
    efficiency = np.asarray(metrics["spl_sum"]) / np.asarray(metrics["episodes"])
    assert success[:10].mean() < 0.3
    assert success[-25:].mean() > 0.7
    assert efficiency[-25:].mean() > 2 * efficiency[:10].mean()
    assert int(metrics["episodes"].sum()) > 7_000
