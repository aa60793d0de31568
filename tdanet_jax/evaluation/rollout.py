"""Runs a policy on a fixed list of episodes, in one compiled call."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.evaluation.policies import Policy, put, take
from tdanet_jax.vocabulary import Action

PART = 128  # episodes that a CPU plays at once


@dataclasses.dataclass(frozen=True)
class Records:
    """What happened in each of E episodes.

    Attributes:
      shortest: [E] int32, L, actions on the shortest path, including Done.
      length: [E] int32, e, actions taken, including Done.
      success: [E] bool, Done while an instance of the target was visible.
      actions: [E, N] int8, actions taken; -1 after the last, N the largest step limit.
      collided: [E] bool, whether something blocked a MoveAhead.
    """

    shortest: np.ndarray
    length: np.ndarray
    success: np.ndarray
    actions: np.ndarray
    collided: np.ndarray


def evaluate(
    policy: Policy, weights: Any, params: EnvParams, episodes: Episodes, key: jax.Array
) -> Records:
    """Plays every episode to its end, in one compiled call; equal keys give equal records."""
    limit = int(np.max(np.asarray(params.step_limit)))
    pose, target = jnp.asarray(episodes.pose), jnp.asarray(episodes.target)
    out = jax.device_get(_play(policy, limit, weights, params, pose, target, key))
    return Records(*out)


def evaluate_lists(
    policy: Policy, weights: Any, params: EnvParams, lists: Mapping[str, Episodes], seed: int
) -> dict[str, tuple[Episodes, Records]]:
    """`evaluate` on every list of a split, each with its own random stream."""
    key = jax.random.key(seed)
    return {
        group: (chosen, evaluate(policy, weights, params, chosen, jax.random.fold_in(key, i)))
        for i, (group, chosen) in enumerate(lists.items())
    }


def evaluate_stacked(
    policy: Policy,
    weights: Any,
    params: EnvParams,
    lists: Mapping[str, Episodes],
    seed: int | Sequence[int],
    batched: bool | None = None,
) -> list[dict[str, tuple[Episodes, Records]]]:
    """`evaluate_lists` for W networks, with one compiled call per list.

    Args:
      weights: parameters stacked, each leaf [W, ...].
      seed: of all, or one for each [W].
      batched: whether the networks play in parallel or one after the other. None chooses the faster
        way: in parallel on an accelerator, one after the other on a CPU.

    Returns:
      What `evaluate_lists` gives for each network. Equal seeds, equal random streams.
    """
    if batched is None:
        batched = jax.default_backend() != "cpu"
    limit = int(np.max(np.asarray(params.step_limit)))
    count = len(jax.tree.leaves(weights)[0])
    key = jax.vmap(jax.random.key)(np.broadcast_to(np.asarray(seed, np.uint32), count))
    out: dict[str, list[Records]] = {}
    for i, (group, chosen) in enumerate(lists.items()):
        pose, target = jnp.asarray(chosen.pose), jnp.asarray(chosen.target)
        own = jax.vmap(jax.random.fold_in, (0, None))(key, i)
        played = jax.device_get(
            _play_each(policy, limit, batched, weights, params, pose, target, own)
        )
        out[group] = [Records(*one) for one in zip(*played, strict=True)]
    return [{group: (lists[group], out[group][w]) for group in lists} for w in range(count)]


@functools.partial(jax.jit, static_argnums=(0, 1, 2))
def _play_each(
    policy: Policy,
    limit: int,
    batched: bool,
    weights: Any,
    params: EnvParams,
    pose: jax.Array,
    target: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, ...]:
    def play(one: tuple[Any, jax.Array]) -> tuple[jax.Array, ...]:
        own, stream = one
        out: tuple[jax.Array, ...] = _play(policy, limit, own, params, pose, target, stream)
        return out

    each = weights, key
    return jax.vmap(play)(each) if batched else jax.lax.map(play, each)


@functools.partial(jax.jit, static_argnums=(0, 1))
def _play(
    policy: Policy,
    limit: int,
    weights: Any,
    params: EnvParams,
    pose: jax.Array,
    target: jax.Array,
    key: jax.Array,
) -> tuple[jax.Array, ...]:
    count, part = pose.shape[0], _part(policy, pose.shape[0])
    transition = jax.vmap(dynamics.transition, (0, 0, None))
    own = None
    if params.noise is not None:  # no step folds this number into the key
        own = jax.random.split(jax.random.fold_in(key, limit), count)
    state = jax.vmap(dynamics.start, (0, 0, None, None, 0))(pose, target, params, None, own)

    def unfinished(loop: tuple) -> jax.Array:
        step, _, (_, alive, *_) = loop
        return (step < limit) & jnp.any(alive)

    def step_of(step: jax.Array, memory: Any, played: tuple, rows: jax.Array | None) -> tuple:
        """The next step of some episodes, or of all."""
        state, alive, success, actions, collided = take(played, rows)
        some = {} if rows is None else {"rows": rows}
        own = jax.random.fold_in(key, step)
        memory, action = policy.act(weights, memory, own, state, params, **some)
        out = transition(state, action, params)
        blocked = (action == Action.MOVE_AHEAD) & (out.state.pose == state.pose)
        collided = collided | (alive & blocked)
        state = dynamics.choose(alive, out.state, state)
        actions = actions.at[:, step].set(jnp.where(alive, action, -1).astype(jnp.int8))
        success = success | (alive & out.success)
        alive = alive & ~out.terminated & ~out.truncated
        return memory, put(played, rows, (state, alive, success, actions, collided))

    def body(loop: tuple) -> tuple:
        step, memory, played = loop
        if part == count:
            return step + 1, *step_of(step, memory, played, None)
        _, alive, *_ = played
        order = jnp.argsort(~alive, stable=True)  # those that go on are first
        padded = jnp.pad(order, (0, -count % part), constant_values=count)

        def some(i: jax.Array, carried: tuple) -> tuple:
            rows = jax.lax.dynamic_slice(padded, (i * part,), (part,))
            memory, played = carried
            return step_of(step, memory, played, rows)

        parts = -(-alive.sum() // part)
        return step + 1, *jax.lax.fori_loop(0, parts, some, (memory, played))

    played = (
        state,
        jnp.ones(count, bool),
        jnp.zeros(count, bool),
        jnp.full((count, limit), -1, jnp.int8),
        jnp.zeros(count, bool),
    )
    loop = jnp.zeros((), jnp.int32), policy.start(weights, count), played
    _, _, (state, _, success, actions, collided) = jax.lax.while_loop(unfinished, body, loop)
    return state.shortest, state.steps, success, actions, collided


def _part(policy: Policy, count: int) -> int:
    """How many episodes play at once: those that have ended cost nothing if others do not wait.

    An accelerator would rather play all of them, ended or not.
    """
    few = policy.in_parts and jax.default_backend() == "cpu"
    return min(PART, count) if few else count
