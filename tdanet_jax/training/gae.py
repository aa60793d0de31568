"""Generalised advantage estimation (Schulman et al. 2016) over a rollout."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def advantages(
    reward: jax.Array,
    value: jax.Array,
    last_value: jax.Array,
    ended: jax.Array,
    held: jax.Array,
    gamma: float,
    lam: float,
) -> jax.Array:
    """Advantages of a rollout in which truncated episodes are held for one more step.

    A truncated episode is not over for the value function: its last state is held for one step,
    in which the network values it and no action is taken. Time-outs are thus bootstrapped at no
    extra cost, and a held step has no advantage of its own.

    Args:
      reward: [T, B] reward of each step.
      value: [T, B] value of the state that each step started from.
      last_value: [B] value of the state after the last step.
      ended: [T, B] bool, the step ended its episode for good (its value is not bootstrapped).
      held: [T, B] bool, the step only valued the last state of a truncated episode.
      gamma: discount.
      lam: GAE's lambda; 1 gives plain n-step returns.

    Returns:
      [T, B]; `value + advantage` are the targets of the critic.
    """
    following = jnp.concatenate([value[1:], last_value[None]])
    carry_on = gamma * (1.0 - ended)
    delta = reward + carry_on * following - value

    def body(later: jax.Array, step: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        delta_t, carry_on_t, held_t = step
        advantage = jnp.where(held_t, 0.0, delta_t + lam * carry_on_t * later)
        return advantage, advantage

    _, out = jax.lax.scan(body, jnp.zeros_like(last_value), (delta, carry_on, held), reverse=True)
    return out
