"""Policies that can be evaluated: a trained network, uniformly random, and the shortest path."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import io_callback

from tdanet_jax.env import dynamics
from tdanet_jax.env.environment import Environment, FlatObservations
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.vocabulary import NUM_ACTIONS, Action


class Policy(NamedTuple):
    """How to act in a batch of B episodes.

    `start(weights, batch)` gives the policy's memory at the start of the episodes, and
    `act(weights, memory, key, state, params)` the memory and the actions [B] of the next step.

    If `in_parts`, `act` can be asked for some of the episodes: given `rows` [b] as well, their
    places in the batch, `state` and the actions are those of these rows, and the memory is that of
    all. Rows from B on are padding. What a row does must not depend on which others are asked for.
    """

    start: Callable[[Any, int], Any]
    act: Callable[..., tuple[Any, jax.Array]]
    in_parts: bool = False


def random() -> Policy:
    """Every action with the same probability."""

    def act(
        weights: Any, memory: Any, key: jax.Array, state: EnvState, params: EnvParams
    ) -> tuple[Any, jax.Array]:
        return memory, jax.random.randint(key, state.pose.shape, 0, NUM_ACTIONS)

    return Policy(lambda weights, batch: (), act)


def shortest_path() -> Policy:
    """Descends the table of distances and says Done as soon as the target is visible."""
    best_actions = jax.vmap(dynamics.best_actions, (0, None))

    def act(
        weights: Any, memory: Any, key: jax.Array, state: EnvState, params: EnvParams
    ) -> tuple[Any, jax.Array]:
        return memory, jnp.argmax(best_actions(state, params), axis=-1)

    return Policy(lambda weights, batch: (), act)


def network(
    model: ActorCritic, words: jax.Array, greedy: bool = False, forbidden: Collection[Action] = ()
) -> Policy:
    """A trained actor-critic; its actions are sampled, or the most probable ones if `greedy`.

    Actions in `forbidden` are never taken.
    """
    observe = jax.vmap(dynamics.observe, (0, None))
    never = np.array([*forbidden], int)

    def start(weights: Any, batch: int) -> Any:
        class_table = actor_critic.prepare(model, weights, words)
        return class_table, actor_critic.initial_state(model, weights, batch)

    def act(
        weights: Any,
        memory: Any,
        key: jax.Array,
        state: EnvState,
        params: EnvParams,
        rows: jax.Array | None = None,
    ) -> tuple[Any, jax.Array]:
        class_table, recurrent = memory
        own, batch = take(recurrent, rows), len(recurrent.is_first)
        own, out, _ = actor_critic.act(model, weights, class_table, own, observe(state, params))
        logits = out.logits.at[:, never].set(-jnp.inf) if len(never) else out.logits
        if not greedy:  # the categorical distribution's own sampling, by the Gumbel trick
            logits += take(jax.random.gumbel(key, (batch, NUM_ACTIONS)), rows)
        return (class_table, put(recurrent, rows, own)), jnp.argmax(logits, axis=-1)

    return Policy(start, act, in_parts=True)


def take(tree: Any, rows: jax.Array | None) -> Any:
    """These rows [b] of every leaf [B, ...]; all of them if `rows` is None."""
    return tree if rows is None else jax.tree.map(lambda x: x[rows], tree)


def put(tree: Any, rows: jax.Array | None, new: Any) -> Any:
    """The tree with new values in these rows; rows from B on are left out."""
    if rows is None:
        return new
    return jax.tree.map(lambda x, y: x.at[rows].set(y, mode="drop"), tree, new)


#: A policy that has to know the environment that it is evaluated in.
MakePolicy = Callable[[Environment], Policy]


def on_vectors(
    start: Callable[[int], Any],
    act: Callable[[Any, jax.Array, jax.Array], tuple[Any, jax.Array]],
) -> MakePolicy:
    """A policy in JAX that sees vectors, such as one that was trained on `FlatObservations`.

    Args:
      start: `start(batch)` gives the memory at the start of the episodes.
      act: `act(memory, key, vectors [B, size])` gives the memory and the actions [B].
    """

    def make(env: Environment) -> Policy:
        def batched(
            weights: Any, memory: Any, key: jax.Array, state: EnvState, params: EnvParams
        ) -> tuple[Any, jax.Array]:
            return act(memory, key, _vectors(env, state, params))

        return Policy(lambda weights, batch: start(batch), batched)

    return make


def on_host(
    predict: Callable[[np.ndarray], np.ndarray],
    start: Callable[[int], None] = lambda batch: None,
) -> MakePolicy:
    """A policy outside of JAX, such as one of Stable-Baselines3 that was trained on vectors.

    Args:
      predict: actions [B] for vectors [B, size], called once a step, in order; what it remembers
        of earlier steps is its own affair.
      start: called with the number of episodes when they begin.
    """

    def begin(weights: Any, batch: int) -> tuple[()]:
        io_callback(lambda: start(batch), None, ordered=True)
        return ()

    def asked(vectors: jax.Array) -> np.ndarray:
        return np.asarray(predict(np.asarray(vectors)), np.int32)

    def make(env: Environment) -> Policy:
        def act(
            weights: Any, memory: Any, key: jax.Array, state: EnvState, params: EnvParams
        ) -> tuple[Any, jax.Array]:
            actions = jax.ShapeDtypeStruct(state.pose.shape, jnp.int32)
            return memory, io_callback(asked, actions, _vectors(env, state, params), ordered=True)

        return Policy(begin, act)

    return make


def _vectors(env: Environment, state: EnvState, params: EnvParams) -> jax.Array:
    flat = FlatObservations(env)

    def one(state: EnvState) -> jax.Array:
        return flat.flatten(dynamics.observe(state, params), params)

    return jax.vmap(one)(state)
