"""Generalised advantage estimation (Schulman et al. 2016) over a rollout."""

from __future__ import annotations

import jax
import jax.numpy as jnp


def advantages(
    reward: jax.Array,
    value: jax.Array,
    last_value: jax.Array,
    terminal: jax.Array,
    bootstrap_only: jax.Array,
    gamma: float,
    lam: float,
) -> jax.Array:
    """Advantages of a rollout in which a truncated episode's last state has a step of its own.

    A truncated episode is not over for the value function. So its last state stays for one more
    step, in which the network only values it and takes no action. Time-outs are thus bootstrapped
    at no extra cost, and a bootstrap-only step has no advantage of its own.

    Args:
      reward: [T, B] reward of each step.
      value: [T, B] value of the state that each step started from.
      last_value: [B] value of the state after the last step.
      terminal: [T, B] bool, the return is not bootstrapped after the step.
      bootstrap_only: [T, B] bool, the step only valued the last state of a truncated episode.
      gamma: discount.
      lam: GAE's lambda; 1 gives plain n-step returns.

    Returns:
      [T, B]; `value + advantage` are the targets of the critic.
    """
    next_value = jnp.concatenate([value[1:], last_value[None]])
    discount = gamma * (1.0 - terminal)
    delta = reward + discount * next_value - value

    def body(later: jax.Array, step: tuple[jax.Array, ...]) -> tuple[jax.Array, jax.Array]:
        delta_t, discount_t, bootstrap_only_t = step
        advantage = jnp.where(bootstrap_only_t, 0.0, delta_t + lam * discount_t * later)
        return advantage, advantage

    steps = (delta, discount, bootstrap_only)
    _, out = jax.lax.scan(body, jnp.zeros_like(last_value), steps, reverse=True)
    return out
