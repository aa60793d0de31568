"""Synchronous advantage actor-critic (Mnih et al. 2016, without the asynchrony) in one scan.

File order is execution order: `init` makes the state, `rollout` acts for T steps in B
environments, `loss` looks back at them, `learn` takes an optimiser step, `update` does all of
this, and `make_train` compiles many updates into one call.

An update takes one optimiser step on its whole rollout, or several on minibatches of its
environments, with the loss of PPO (Schulman et al. 2017).

Axis letters: T steps of a rollout, B environments, H units, K detections, C classes.
"""

from __future__ import annotations

import functools
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax
from flax import struct

from tdanet_jax.config import LearnerConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams, EnvState, Observation
from tdanet_jax.models import actor_critic, reach
from tdanet_jax.models.activation_cache import ACTIVATIONS
from tdanet_jax.models.actor_critic import ActorCritic, RecurrentState
from tdanet_jax.training import imitation
from tdanet_jax.training.gae import advantages
from tdanet_jax.vocabulary import NUM_ACTIONS

#: Kernels with more weights than this are rounded to their layer's precision once per rollout.
SMALL = 2**16


class TrainState(struct.PyTreeNode):
    """Everything that a run needs to resume exactly where it was."""

    #: Fields whose arrays have a row per environment.
    PER_ENVIRONMENT: ClassVar = ("env_state", "bootstrap_only", "recurrent", "target_seen")

    params: Any
    opt_state: optax.OptState
    env_state: EnvState  # [B]
    bootstrap_only: jax.Array  # [B] bool, the episode was truncated; its last state is to be valued
    recurrent: RecurrentState  # [B]
    key: jax.Array  # the run's key; every update folds its number into it
    updates: jax.Array  # int32, updates done
    episodes: jax.Array  # int32, training episodes finished
    skipped: jax.Array  # int32, updates skipped because the loss or gradient was not finite
    #: [B] bool, the target has been seen earlier in the episode; if shortest paths are imitated.
    target_seen: jax.Array | None = None


class Rollout(NamedTuple):
    """T steps of B environments; every field but `activations` is [T, B, ...]."""

    obs: Observation
    prev_action_probs: jax.Array
    is_first: jax.Array
    dropout_mask: jax.Array | None
    activations: Any  # the activation cache; empty if an update has several optimiser steps
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    terminal: jax.Array  # no bootstrap after this step
    bootstrap_only: jax.Array  # the step only valued the last state of a truncated episode
    done: jax.Array  # an episode finished with this step
    success: jax.Array
    length: jax.Array
    shortest: jax.Array
    within_reach: jax.Array | None  # the target was, before the action; if the network estimates it
    best_moves: jax.Array | None  # [..., 6], what `imitation` teaches in this state, if anything


class Scheduled(NamedTuple):
    """What depends on how much of the budget is spent."""

    learning_rate: jax.Array
    entropy_weight: jax.Array
    imitation_weight: jax.Array


def schedule(config: LearnerConfig, progress: jax.Array) -> Scheduled:
    """The values after a share of the budget, 0 to 1; later ones are those of its end."""

    def mix(start: float, end: float) -> jax.Array:
        return start + (end - start) * jnp.clip(progress, 0.0, 1.0)

    return Scheduled(
        learning_rate=mix(config.learning_rate, config.final_learning_rate),
        entropy_weight=mix(config.entropy_weight, config.final_entropy_weight),
        imitation_weight=imitation.weight(
            config.imitation_weight, config.imitation_until, progress
        ),
    )


class Experience(NamedTuple):
    """What an optimiser step learns from."""

    steps: Rollout
    advantage: jax.Array  # [T, B]
    carry: Any  # of the network before the first step, [B, ...]


def make_optimizer(config: LearnerConfig) -> optax.GradientTransformation:
    """Clipping and Adam; the learning rate is applied in `learn`.

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
        bootstrap_only=jnp.zeros(batch, bool),
        recurrent=actor_critic.initial_state(model, weights, batch, training=True),
        key=run_key,
        updates=jnp.zeros((), jnp.int32),
        episodes=jnp.zeros((), jnp.int32),
        skipped=jnp.zeros((), jnp.int32),
        target_seen=_unseen(config),
    )


def _unseen(config: LearnerConfig) -> jax.Array | None:
    """`TrainState.target_seen` where episodes begin."""
    return jnp.zeros(config.num_envs, bool) if config.imitation_weight else None


def begin_again(
    state: TrainState, config: LearnerConfig, model: ActorCritic, params: EnvParams
) -> TrainState:
    """The run with new episodes in place of those in progress, in other rooms."""
    # Updates fold their numbers into the key; these are 2^31 above the number of the next one.
    key = jax.random.fold_in(state.key, jnp.uint32(2**31) + state.updates.astype(jnp.uint32))
    batch = config.num_envs
    return state.replace(
        env_state=_reset(key, params, batch),
        bootstrap_only=jnp.zeros(batch, bool),
        recurrent=actor_critic.initial_state(model, state.params, batch, training=True),
        target_seen=_unseen(config),
    )


@jax.named_scope("environment")
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
    scope = jax.named_scope("environment")
    observe = scope(jax.vmap(dynamics.observe, (0, None)))
    transition = scope(jax.vmap(dynamics.transition, (0, 0, None)))
    within_reach = scope(jax.vmap(lambda state: dynamics.would_succeed(state, params)))
    best_actions = scope(jax.vmap(lambda state: dynamics.best_actions(state, params)))
    # Round once per rollout what every step would round: the kernels of the large products.
    weights = actor_critic.round_kernels(model, state.params, words, SMALL)
    class_table = actor_critic.prepare(model, state.params, words)
    dropout, estimated = model.encoder.dropout, model.reach_threshold is not None
    batch, units = config.num_envs, model.encoder.dropout_units
    # The cache holds for the parameters that acted, and so for the first optimiser step alone.
    collections = (ACTIVATIONS,) if config.optimizer_steps == 1 else ()

    def act(state: TrainState, step_key: jax.Array) -> tuple[TrainState, Rollout]:
        action_key, dropout_key, reset_key = jax.random.split(step_key, 3)
        obs = observe(state.env_state, params)
        mask = _dropout_mask(dropout_key, dropout, (batch, units)) if dropout else None
        recurrent, out, kept = actor_critic.act(
            model, weights, class_table, state.recurrent, obs, mask, collections, training=True
        )
        log_probs = jax.nn.log_softmax(out.logits)
        action = jax.random.categorical(action_key, out.logits)
        moved = transition(state.env_state, action, params)
        only = state.bootstrap_only
        terminated, truncated = moved.terminated & ~only, moved.truncated & ~only
        valued_next = truncated if config.bootstrap_truncated else jnp.zeros_like(truncated)
        terminal = only | terminated | (truncated & ~valued_next)
        begun = _reset(reset_key, params, batch)
        seen = best_moves = None
        if state.target_seen is not None:
            seen = state.target_seen | obs.target_in_view
            best_moves = best_actions(state.env_state) & imitation.MOVES & seen[:, None]
        step = Rollout(
            obs=obs,
            prev_action_probs=state.recurrent.prev_action_probs,
            is_first=state.recurrent.is_first,
            dropout_mask=mask,
            activations=kept.get(ACTIVATIONS, {}),
            action=action,
            log_prob=jnp.take_along_axis(log_probs, action[:, None], -1)[:, 0],
            value=out.value,
            reward=jnp.where(only, 0.0, moved.reward),
            terminal=terminal,
            bootstrap_only=only,
            done=terminated | truncated,
            success=moved.success & ~only,
            length=moved.state.steps,
            shortest=state.env_state.shortest,
            within_reach=within_reach(state.env_state) if estimated else None,
            best_moves=best_moves,
        )
        following = state.replace(
            env_state=dynamics.choose(terminal, begun, moved.state),
            bootstrap_only=valued_next,
            target_seen=None if seen is None else seen & ~terminal,
            recurrent=recurrent.replace(prev_action_probs=jnp.exp(log_probs)).restarted(terminal),
        )
        return following, step

    carry = model.begin_rollout(state.recurrent.carry)
    state = state.replace(recurrent=state.recurrent.replace(carry=carry))
    after, steps = jax.lax.scan(act, state, jax.random.split(key, config.rollout_steps))
    obs = observe(after.env_state, params)
    _, out, _ = actor_critic.act(model, weights, class_table, after.recurrent, obs, training=True)
    return after, steps, out.value


def _dropout_mask(key: jax.Array, rate: float, shape: tuple[int, ...]) -> jax.Array:
    """Units that dropout keeps; the rate counts in 1/256, for a quarter of the random bits."""
    return jax.random.bits(key, shape, jnp.uint8) >= round(256 * rate)


def loss(
    weights: Any,
    experience: Experience,
    now: Scheduled,
    config: LearnerConfig,
    model: ActorCritic,
    words: jax.Array,
) -> tuple[jax.Array, dict[str, jax.Array]]:
    """The loss of a rollout, and its parts.

    If the network is still the one that acted, its values are those recorded while acting; only
    the gradients are new work.

    Args:
      weights: the network's parameters.
      experience: what to learn from.
      now: the weights of the loss's parts at this point of the budget.
    """
    steps, advantage, carry = experience
    class_table = actor_critic.prepare(model, weights, words)
    inputs = (steps.obs, steps.prev_action_probs, steps.is_first, steps.dropout_mask)
    _, out = actor_critic.forward(
        model, weights, class_table, carry, *inputs, activations=steps.activations
    )
    counted = ~steps.bootstrap_only

    def mean(x: jax.Array, where: jax.Array = counted) -> jax.Array:
        return jnp.sum(jnp.where(where, x, 0.0)) / jnp.maximum(where.sum(), 1)

    log_probs = jax.nn.log_softmax(out.logits)
    log_prob = jnp.take_along_axis(log_probs, steps.action[..., None], -1)[..., 0]
    entropy = mean(-jnp.sum(jnp.exp(log_probs) * log_probs, axis=-1))
    gain = log_prob * advantage
    if config.optimizer_steps > 1:  # after the first one, the network is not the one that acted
        ratio = jnp.exp(log_prob - steps.log_prob)
        clipped = jnp.clip(ratio, 1.0 - config.clip_coef, 1.0 + config.clip_coef)
        gain = jnp.minimum(ratio * advantage, clipped * advantage)
    policy_loss = -mean(gain)
    value_loss = mean(0.5 * (steps.value + advantage - out.value) ** 2)
    total = policy_loss + config.value_weight * value_loss - now.entropy_weight * entropy
    parts = {"policy_loss": policy_loss, "value_loss": value_loss, "entropy": entropy}
    if steps.best_moves is not None:
        parts["imitation_loss"] = mean(imitation.loss(out.logits, steps.best_moves))
        total += now.imitation_weight * parts["imitation_loss"]
    if out.reach_logit is not None:
        cross_entropy = optax.sigmoid_binary_cross_entropy(out.reach_logit, steps.within_reach)
        parts["reach_loss"] = mean(cross_entropy, counted & steps.obs.target_in_view)
        total += reach.WEIGHT * parts["reach_loss"]
    return total, parts


def minibatches(experience: Experience, count: int) -> Experience:
    """`count` parts with a leading axis: part i has the environments i, i + count, ...

    Environments are interchangeable, so there is no need to shuffle them. If they are divided
    between devices, so is every part (`devices.check_divides`).
    """

    def split(x: jax.Array, axis: int) -> jax.Array:
        shape = (*x.shape[:axis], x.shape[axis] // count, count, *x.shape[axis + 1 :])
        return jnp.moveaxis(x.reshape(shape), axis + 1, 0)

    steps, advantage = jax.tree.map(lambda x: split(x, 1), experience[:2])
    carry = jax.tree.map(lambda x: split(x, 0), experience.carry)
    return Experience(steps, advantage, carry)


def learn(
    weights: Any,
    opt_state: optax.OptState,
    experience: Experience,
    now: Scheduled,
    config: LearnerConfig,
    model: ActorCritic,
    words: jax.Array,
) -> tuple[Any, optax.OptState, dict[str, jax.Array]]:
    """One optimiser step.

    Args:
      weights: the network's parameters.
      opt_state: the optimiser's state.
      experience: what to learn from.
      now: the learning rate, and weights in the loss.

    Returns:
      Parameters and the optimiser's state after it, and means to log. `skipped` is 1 if the loss or
      the gradient was not finite: then nothing has changed.
    """
    (total, parts), grads = jax.value_and_grad(loss, has_aux=True)(
        weights, experience, now, config, model, words
    )
    with jax.named_scope("optimizer"):
        grad_norm = optax.tree.norm(grads)
        finite = jnp.isfinite(total) & jnp.isfinite(grad_norm)
        scaled, moved = make_optimizer(config).update(grads, opt_state, weights)
        stepped = jax.tree.map(lambda p, g: p - now.learning_rate * g, weights, scaled)
        weights, opt_state = jax.tree.map(
            lambda new, old: jnp.where(finite, new, old), (stepped, moved), (weights, opt_state)
        )
    return weights, opt_state, {**parts, "grad_norm": grad_norm, "skipped": 1 - finite}


def update(
    state: TrainState,
    progress: jax.Array,
    config: LearnerConfig,
    model: ActorCritic,
    words: jax.Array,
    params: EnvParams,
) -> tuple[TrainState, dict[str, jax.Array]]:
    """One rollout and its optimiser steps.

    Args:
      state: the run.
      progress: share of the budget that is spent, 0 to 1; drives the schedules.

    Returns:
      The run after it, and sums and means to log.
    """
    key = jax.random.fold_in(state.key, state.updates)
    after, steps, last_value = rollout(state, key, config, model, words, params)
    advantage = advantages(
        steps.reward, steps.value, last_value, steps.terminal, steps.bootstrap_only, config.gamma,
        config.gae_lambda,
    )  # fmt: skip

    now = schedule(config, progress)
    experience = Experience(steps, advantage, state.recurrent.carry)
    take_step = functools.partial(learn, now=now, config=config, model=model, words=words)
    if config.optimizer_steps == 1:
        weights, opt_state, metrics = take_step(state.params, state.opt_state, experience)
    else:
        parts = minibatches(experience, config.num_minibatches)

        def body(before: tuple[Any, Any], index: jax.Array) -> tuple[tuple[Any, Any], Any]:
            part = jax.tree.map(lambda x: x[index], parts)
            weights, opt_state, metrics = take_step(*before, part)
            return (weights, opt_state), metrics

        order = jnp.arange(config.optimizer_steps) % config.num_minibatches
        (weights, opt_state), metrics = jax.lax.scan(body, (state.params, state.opt_state), order)
        metrics = {n: x.max() if n == "skipped" else x.mean() for n, x in metrics.items()}
    skipped = metrics.pop("skipped")
    after = after.replace(
        params=weights,
        opt_state=opt_state,
        updates=state.updates + 1,
        episodes=state.episodes + steps.done.sum(),
        skipped=state.skipped + skipped,
    )
    metrics |= {
        "explained_variance": _explained_variance(steps, advantage),
        "learning_rate": now.learning_rate,
    }
    return after, metrics | _episode_sums(steps)


def _explained_variance(steps: Rollout, advantage: jax.Array) -> jax.Array:
    """1 - Var(return - value) / Var(return) over the steps that count; not finite if that is 0."""
    counted = ~steps.bootstrap_only
    rest = jnp.var(advantage, where=counted)
    return 1.0 - rest / jnp.var(steps.value + advantage, where=counted)


def _episode_sums(steps: Rollout) -> dict[str, jax.Array]:
    """Sums over a rollout, and over the episodes that finished in it."""
    success = (steps.success & steps.done).astype(jnp.float32)
    length = jnp.maximum(steps.length, 1)
    taken = steps.action[..., None] == jnp.arange(NUM_ACTIONS)
    efficiency = success * steps.shortest / jnp.maximum(steps.shortest, length)
    return {
        "episodes": steps.done.sum(),
        "success_sum": success.sum(),
        "spl_sum": jnp.where(steps.done, efficiency, 0.0).sum(),
        "length_sum": jnp.where(steps.done, steps.length, 0).sum(),
        "reward_sum": steps.reward.sum(),
        "actions": jnp.sum(taken & ~steps.bootstrap_only[..., None], axis=(0, 1)),
        "bootstrap_only_steps": steps.bootstrap_only.sum(),
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
