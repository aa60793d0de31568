"""Imitation of shortest paths, for a part of a run or all of it.

Left to its rewards, an agent turns one way only. To look for its target, either way will do; by the
time that training has taught it to go back to a target that it has seen, it has given up one of
them. So training shows it which moves lead nearer, from the tables of distances: only once the
target has been seen in the episode, for before, the shortest path depends on what the agent cannot
know; and never when to take `Done`, which is learned from rewards, as they weigh success against
haste.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.vocabulary import NUM_ACTIONS, Action

#: All actions but `Done`, [6] bool.
MOVES = np.arange(NUM_ACTIONS) != Action.DONE


def weight(initial: float, until: float, progress: jax.Array) -> jax.Array:
    """The weight of imitation in the loss: falls linearly from `initial` to 0.

    Args:
      initial: at the start.
      until: share of the budget at which it is 0.
      progress: share that is spent.
    """
    return initial * jnp.clip(1.0 - progress / until, 0.0, 1.0)


def loss(logits: jax.Array, best_moves: jax.Array) -> jax.Array:
    """Minus the logarithm of the probability of the best moves among all moves.

    Args:
      logits: [..., 6], of the actions.
      best_moves: [..., 6] bool, moves that lead nearer; without any, the loss is 0.

    Returns:
      [...] float32, in nats.
    """
    taught = jnp.any(best_moves, axis=-1, keepdims=True)
    best = jnp.where(taught, best_moves, MOVES)
    every = jnp.broadcast_to(MOVES, logits.shape)
    return _logsumexp(logits, every) - _logsumexp(logits, best)


def _logsumexp(logits: jax.Array, where: jax.Array) -> jax.Array:
    return jax.nn.logsumexp(logits, axis=-1, where=where)
