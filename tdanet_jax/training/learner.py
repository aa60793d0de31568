"""Synchronous advantage actor-critic (Mnih et al. 2016, without the asynchrony) in one scan.

File order is execution order: `init` makes the state, `rollout` acts for T steps in B
environments, `loss` looks back at them, `update` does both and takes one optimiser step, and
`make_train` compiles many updates into one call.

Axis letters: T steps of a rollout, B environments, H units, K detections, C classes.
"""

from __future__ import annotations

from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from tdanet_jax.config import LearnerConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.dynamics import EnvParams, EnvState, Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.layers import Carry
from tdanet_jax.training.gae import advantages
from tdanet_jax.vocabulary import NUM_ACTIONS

#: Parameters of more numbers than this have operands of the network's precision while acting.
SMALL = 2**16


class TrainState(struct.PyTreeNode):
    """All that a run needs to go on exactly where it was."""

    #: Fields whose arrays have a row per environment.
    PER_ENVIRONMENT: ClassVar = ("env_state", "held", "carry", "previous", "fresh")

    params: Any
    opt_state: optax.OptState
    env_state: EnvState  # [B]
    held: jax.Array  # [B] bool, the episode was truncated and waits to be valued
    carry: Any  # recurrent state, a batch of B
    previous: jax.Array  # [B, 6], action probabilities of the step before
    fresh: jax.Array  # [B] bool, the episode has just begun
    key: jax.Array  # the run's key; every update folds its number into it
    updates: jax.Array  # int32, updates done
    episodes: jax.Array  # int32, training episodes finished
    skipped: jax.Array  # int32, updates skipped because the loss or gradient was not finite


class Rollout(NamedTuple):
    """T steps of B environments; every field is [T, B, ...]."""

    obs: Observation
    previous: jax.Array
    fresh: jax.Array
    keep: jax.Array | None
    tape: Any
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    ended: jax.Array  # no bootstrap behind this step
    held: jax.Array  # the step only valued the last state of a truncated episode
    over: jax.Array  # an episode finished with this step
    success: jax.Array
    length: jax.Array
    shortest: jax.Array


def make_optimizer(config: LearnerConfig) -> optax.GradientTransformation:
    """Clipping and Adam; the learning rate is applied in `update`, which knows the progress.

    AMSGrad is PyTorch's: the largest second moment is taken before the correction for its start.
    Of corrected ones, the first few gradients would be the largest for good.
    """
    clip, epsilon = optax.clip_by_global_norm(config.max_grad_norm), config.adam_epsilon
    if not config.amsgrad:
        return optax.chain(clip, optax.scale_by_adam(eps=epsilon))
    decay = 0.999
    return optax.chain(
        clip,
        optax.scale_by_amsgrad(b2=decay, eps=epsilon, bias_correction_nu=False),
        optax.scale_by_schedule(lambda count: jnp.sqrt(1.0 - decay ** (count + 1.0))),
    )


def init(
    key: jax.Array, config: LearnerConfig, model: ActorCritic, words: jax.Array, params: EnvParams
) -> TrainState:
    """The state of a run before its first update."""
    model_key, env_key, run_key = jax.random.split(key, 3)
    weights = model.initialise(model_key, words)
    batch = config.num_envs
    return TrainState(
        params=weights,
        opt_state=make_optimizer(config).init(weights),
        env_state=_reset(env_key, params, batch),
        held=jnp.zeros(batch, bool),
        carry=model.initial_carry(batch, weights, training=True),
        previous=jnp.zeros((batch, NUM_ACTIONS)),
        fresh=jnp.ones(batch, bool),
        key=run_key,
        updates=jnp.zeros((), jnp.int32),
        episodes=jnp.zeros((), jnp.int32),
        skipped=jnp.zeros((), jnp.int32),
    )


def _reset(key: jax.Array, params: EnvParams, batch: int) -> EnvState:
    return jax.vmap(dynamics.reset_state, (0, None))(jax.random.split(key, batch), params)


def rollout(
    state: TrainState,
    key: jax.Array,
    config: LearnerConfig,
    model: ActorCritic,
    words: jax.Array,
    params: EnvParams,
) -> tuple[TrainState, Rollout, jax.Array]:
    """T steps of every environment.

    Returns:
      The state after it, what happened, and the value of each last state [B].
    """
    observe = jax.vmap(dynamics.observe, (0, None))
    transition = jax.vmap(dynamics.transition, (0, 0, None))
    # Cast once per rollout what every step would cast: the kernels of the large products.
    weights = jax.tree.map(
        lambda x: x.astype(model.dtype) if x.ndim > 1 and x.size > SMALL else x, state.params
    )
    table = actor_critic.prepare(model, state.params, words)
    rate = model.encoder.dropout
    batch, units = state.fresh.shape[0], model.encoder.dropout_units

    def act(state: TrainState, step_key: jax.Array) -> tuple[TrainState, Rollout]:
        action_key, dropout_key, reset_key = jax.random.split(step_key, 3)
        obs = observe(state.env_state, params)
        keep = _keep(dropout_key, rate, (batch, units)) if rate else None
        carry, out, tape = actor_critic.record(
            model, weights, table, state.carry, obs, state.previous, state.fresh, keep
        )
        log_probs = jax.nn.log_softmax(out.logits)
        action = jax.random.categorical(action_key, out.logits)
        moved = transition(state.env_state, action, params)
        held = state.held
        terminated, truncated = moved.terminated & ~held, moved.truncated & ~held
        waits = truncated if config.bootstrap_truncated else jnp.zeros_like(truncated)
        over = held | terminated | (truncated & ~waits)
        begun = _reset(reset_key, params, batch)
        following = dynamics.choose(over, begun, moved.state)
        step = Rollout(
            obs=obs,
            previous=state.previous,
            fresh=state.fresh,
            keep=keep,
            tape=tape,
            action=action,
            log_prob=jnp.take_along_axis(log_probs, action[:, None], -1)[:, 0],
            value=out.value,
            reward=jnp.where(held, 0.0, moved.reward),
            ended=over,
            held=held,
            over=terminated | truncated,
            success=moved.success & ~held,
            length=moved.state.steps,
            shortest=state.env_state.shortest,
        )
        following_state = state.replace(
            env_state=following,
            held=waits,
            carry=carry,
            previous=jnp.where(over[:, None], 0.0, jnp.exp(log_probs)),
            fresh=over,
        )
        return following_state, step

    state = state.replace(carry=model.begin_rollout(state.carry))
    after, steps = jax.lax.scan(act, state, jax.random.split(key, config.rollout_steps))
    obs = observe(after.env_state, params)
    _, out = actor_critic.forward(
        model, weights, table, after.carry, obs, after.previous, after.fresh
    )
    return after, steps, out.value


def _keep(key: jax.Array, rate: float, shape: tuple[int, ...]) -> jax.Array:
    """Which units dropout keeps; the rate is rounded to 1/256, for a quarter of the random bits."""
    return jax.random.bits(key, shape, jnp.uint8) >= round(256 * rate)


def loss(
    weights: Any,
    steps: Rollout,
    advantage: jax.Array,
    carry: Carry,
    entropy_weight: jax.Array,
    config: LearnerConfig,
    model: ActorCritic,
    words: jax.Array,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The actor-critic loss of a rollout, and its parts.

    The network's values are those recorded while acting; only the gradients are new work.
    """
    table = actor_critic.prepare(model, weights, words)
    seen = (steps.obs, steps.previous, steps.fresh, steps.keep)
    _, out = actor_critic.forward(model, weights, table, carry, *seen, tape=steps.tape)
    counted = ~steps.held
    count = counted.sum()

    def mean(x: jax.Array) -> jax.Array:
        return jnp.sum(jnp.where(counted, x, 0.0)) / count

    log_probs = jax.nn.log_softmax(out.logits)
    log_prob = jnp.take_along_axis(log_probs, steps.action[..., None], -1)[..., 0]
    entropy = mean(-jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1))
    policy_loss = -mean(log_prob * advantage)
    value_loss = mean(0.5 * (steps.value + advantage - out.value) ** 2)
    total = policy_loss + config.value_weight * value_loss - entropy_weight * entropy
    parts = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
    return total, parts


def update(
    state: TrainState,
    progress: jax.Array,
    config: LearnerConfig,
    model: ActorCritic,
    words: jax.Array,
    params: EnvParams,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One rollout and one optimiser step.

    Args:
      state: the run.
      progress: share of the budget that is spent, 0 to 1; drives the schedules.

    Returns:
      The run after it, and sums and means to log.
    """
    key = jax.random.fold_in(state.key, state.updates)
    after, steps, last_value = rollout(state, key, config, model, words, params)
    advantage = advantages(
        steps.reward, steps.value, last_value, steps.ended, steps.held, config.gamma,
        config.gae_lambda,
    )  # fmt: skip

    def mix(start: float, end: float) -> jax.Array:
        return start + (end - start) * jnp.clip(progress, 0.0, 1.0)

    entropy_weight = mix(config.entropy_weight, config.final_entropy_weight)
    (total, parts), grads = jax.value_and_grad(loss, has_aux=True)(
        state.params, steps, advantage, state.carry, entropy_weight, config, model, words
    )
    grad_norm = optax.tree.norm(grads)
    finite = jnp.isfinite(total) & jnp.isfinite(grad_norm)
    scaled, opt_state = make_optimizer(config).update(grads, state.opt_state, state.params)
    rate = mix(config.learning_rate, config.final_learning_rate)
    weights = jax.tree.map(lambda p, g: p - rate * g, state.params, scaled)
    # A non-finite loss or gradient must not reach the parameters: the update is skipped, counted.
    weights, opt_state = jax.tree.map(
        lambda new, old: jnp.where(finite, new, old),
        (weights, opt_state),
        (state.params, state.opt_state),
    )
    finished = steps.over.sum()
    after = after.replace(
        params=weights,
        opt_state=opt_state,
        updates=state.updates + 1,
        episodes=state.episodes + finished,
        skipped=state.skipped + ~finite,
    )
    metrics = {
        **parts,
        "explained_variance": _explained_variance(steps, advantage),
        "grad_norm": grad_norm,
        "learning_rate": rate,
    }
    return after, metrics | _episode_sums(steps)


def _explained_variance(steps: Rollout, advantage: jax.Array) -> jax.Array:
    """1 - Var(return - value) / Var(return) over the steps that count; NaN if returns are alike."""
    counted = ~steps.held
    rest = jnp.var(advantage, where=counted)
    return 1.0 - rest / jnp.var(steps.value + advantage, where=counted)


def _episode_sums(steps: Rollout) -> dict[str, jax.Array]:
    """Sums over the episodes that finished in a rollout."""
    success = (steps.success & steps.over).astype(jnp.float32)
    length = jnp.maximum(steps.length, 1)
    efficiency = success * steps.shortest / jnp.maximum(steps.shortest, length)
    return {
        "episodes": steps.over.sum(),
        "success_sum": success.sum(),
        "spl_sum": jnp.where(steps.over, efficiency, 0.0).sum(),
        "length_sum": jnp.where(steps.over, steps.length, 0).sum(),
        "reward_sum": steps.reward.sum(),
        "held_steps": steps.held.sum(),
    }


def make_train(
    config: LearnerConfig, model: ActorCritic, updates: int, shardings: Any = None
) -> jax.stages.Wrapped:
    """Compiles `updates` updates into one call: `chunk(state, progress, words, params)`.

    `progress` is a pair, the share of the budget spent before and after the chunk. The call
    returns the state and the metrics, stacked over the updates. The state's buffers are donated.
    `shardings` says where the state and the metrics lie, on several devices.
    """

    def chunk(
        state: TrainState, progress: jax.Array, words: jax.Array, params: EnvParams
    ) -> tuple[TrainState, dict[str, jax.Array]]:
        def body(state: TrainState, index: jax.Array) -> tuple[TrainState, dict[str, jax.Array]]:
            share = progress[0] + (progress[1] - progress[0]) * index / updates
            return update(state, share, config, model, words, params)

        return jax.lax.scan(body, state, jnp.arange(updates))

    return jax.jit(chunk, donate_argnums=0, out_shardings=shardings)
