"""Policies that can be evaluated: a trained network, uniformly random, and the shortest path."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.vocabulary import NUM_ACTIONS, Action


class Policy(NamedTuple):
    """How to act in a batch of B episodes.

    `start(weights, batch)` gives the policy's memory at the start of the episodes, and
    `act(weights, memory, key, state, params)` the memory and the actions [B] of the next step.
    """

    start: Callable[[Any, int], Any]
    act: Callable[[Any, Any, jax.Array, EnvState, EnvParams], tuple[Any, jax.Array]]


def random() -> Policy:
    """Every action with the same probability."""

    def act(
        weights: Any, memory: Any, key: jax.Array, state: EnvState, params: EnvParams
    ) -> tuple[Any, jax.Array]:
        return memory, jax.random.randint(key, state.pose.shape, 0, NUM_ACTIONS)

    return Policy(lambda weights, batch: (), act)


def shortest_path() -> Policy:
    """Descends the table of distances and says Done as soon as the target is visible."""
    move = jax.vmap(jax.vmap(dynamics.move, (None, 0, None)), (0, None, None))

    def act(
        weights: Any, memory: Any, key: jax.Array, state: EnvState, params: EnvParams
    ) -> tuple[Any, jax.Array]:
        poses = move(state.pose, jnp.arange(NUM_ACTIONS), params)  # [B, 6]
        distance = params.distance[poses, state.target[:, None]].astype(jnp.int32)
        far = jnp.iinfo(jnp.int32).max
        distance = jnp.where(distance < 0, far, distance).at[:, Action.DONE].set(far)
        here = params.distance[state.pose, state.target]
        return memory, jnp.where(here == 0, Action.DONE, jnp.argmin(distance, axis=-1))

    return Policy(lambda weights, batch: (), act)


def network(model: ActorCritic, words: jax.Array, greedy: bool = False) -> Policy:
    """A trained actor-critic; its actions are sampled, or the most probable ones if `greedy`."""
    observe = jax.vmap(dynamics.observe, (0, None))

    def start(weights: Any, batch: int) -> Any:
        class_table = actor_critic.prepare(model, weights, words)
        return class_table, actor_critic.initial_state(model, weights, batch)

    def act(
        weights: Any, memory: Any, key: jax.Array, state: EnvState, params: EnvParams
    ) -> tuple[Any, jax.Array]:
        class_table, recurrent = memory
        obs = observe(state, params)
        recurrent, out, _ = actor_critic.act(model, weights, class_table, recurrent, obs)
        sampled = jax.random.categorical(key, out.logits)
        action = jnp.argmax(out.logits, axis=-1) if greedy else sampled
        return (class_table, recurrent), action

    return Policy(start, act)
