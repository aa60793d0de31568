"""A critic that knows where the target is, in training alone (Pinto et al. 2018).

The simulator knows what the agent has to find out, and a critic is not needed for acting. One that
is told how far the target is predicts returns better, so that the advantages of actions contain
less of what no action could have changed. The agent is told nothing more, and its own critic keeps
learning beside this one.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct

from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.models.actor_critic import Output
from tdanet_jax.vocabulary import NUM_ACTIONS, Action

#: Distances d, in actions, are shown as exp(-d / scale) and as d / FAR.
SCALES = (2.0, 5.0, 12.0)
FAR = 20.0
#: Numbers that the critic is shown.
INPUTS = 3 + len(SCALES) + 3 * NUM_ACTIONS
#: Units of its only hidden layer.
UNITS = 64


class CriticState(struct.PyTreeNode):
    """The critic in training."""

    params: Any
    opt_state: optax.OptState


class PrivilegedCritic(nn.Module):
    """The expected discounted return, from what `inputs` tells."""

    @nn.compact
    def __call__(self, known: jax.Array) -> jax.Array:
        """[..., INPUTS] -> [...]."""
        hidden = nn.relu(nn.Dense(UNITS, kernel_init=nn.initializers.he_normal())(known))
        return nn.Dense(1)(hidden)[..., 0]


def init(key: jax.Array, optimizer: optax.GradientTransformation) -> CriticState:
    """A critic before its first update."""
    params = PrivilegedCritic().init(key, jnp.zeros(INPUTS))["params"]
    return CriticState(params, optimizer.init(params))


def inputs(state: EnvState, params: EnvParams, out: Output) -> jax.Array:
    """What the critic is told about B states: [B, INPUTS].

    Args:
      state: of the environments, [B].
      params: the environment.
      out: the agent's own policy and value in these states.

    Returns:
      The distance to the target in actions and whether it is within reach; for each action, how it
      changes the distance and whether it is on a shortest path; the policy and the agent's value.
    """
    after = jax.vmap(dynamics.distances_after, (0, None))(state, params)  # [B, 6]
    here = params.distance[state.pose, state.target][:, None].astype(jnp.float32)
    nearer = (after >= 0) & (after < here)
    within_reach = here == 0
    return jnp.concatenate(
        [
            here / FAR,
            within_reach,
            *(jnp.exp(-here / scale) for scale in SCALES),
            jnp.clip(after - here, -2.0, 2.0),
            nearer | (within_reach & (jnp.arange(NUM_ACTIONS) == Action.DONE)),
            jax.nn.softmax(out.logits),
            out.value[:, None],
        ],
        axis=-1,
    )


def value(critic: CriticState, known: jax.Array) -> jax.Array:
    """The critic's values [...] of states of which it is told `known` [..., INPUTS]."""
    return _value(critic.params, known)


def _value(params: Any, known: jax.Array) -> jax.Array:
    found: Any = PrivilegedCritic().apply({"params": params}, known)
    return found


def update(
    critic: CriticState,
    known: jax.Array,
    returns: jax.Array,
    counted: jax.Array,
    optimizer: optax.GradientTransformation,
    rate: jax.Array,
) -> CriticState:
    """The critic after one optimiser step on the squared error of its values.

    Args:
      critic: before it.
      known: [T, B, INPUTS], from `inputs`.
      returns: [T, B], what the values should have been.
      counted: [T, B] bool, the steps to learn from.
      optimizer: without a learning rate.
      rate: the learning rate.
    """

    def loss(params: Any) -> jax.Array:
        return jnp.mean(0.5 * (returns - _value(params, known)) ** 2, where=counted)

    grads = jax.grad(loss)(critic.params)
    scaled, opt_state = optimizer.update(grads, critic.opt_state, critic.params)
    return CriticState(jax.tree.map(lambda p, g: p - rate * g, critic.params, scaled), opt_state)
