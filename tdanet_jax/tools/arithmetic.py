"""How many operations a model's own arithmetic takes, counted in its program."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Jaxpr, jaxprs_in_params

from tdanet_jax.config import LearnerConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.vocabulary import NUM_ACTIONS

#: Operations of an update for each multiply-accumulate of a forward step: two forward, and twice as
#: many backward, for the gradients of inputs and of weights.
OPERATIONS = 6


def forward_macs(model: ActorCritic, words: jax.Array, params: EnvParams) -> int:
    """Multiply-accumulates of one forward step of an environment, in products of matrices.

    The steps are those of a rollout, with the inner steps of a model that adapts. What is computed
    once for all environments, such as the table of classes, is not counted.

    Args:
      words: [C, D], word vectors.
      params: the environments; they give the shapes of observations.
    """
    steps = LearnerConfig().rollout_steps
    one, two = (_rollout_macs(model, words, params, batch, steps) for batch in (1, 2))
    return (two - one) // steps


def _rollout_macs(
    model: ActorCritic, words: jax.Array, params: EnvParams, batch: int, steps: int
) -> int:
    def run(weights: object, words: jax.Array, params: EnvParams) -> object:
        keys = jax.random.split(jax.random.key(0), batch)
        obs, _ = jax.vmap(dynamics.reset, (0, None))(keys, params)
        obs = jax.tree.map(lambda x: jnp.stack([x] * steps), obs)
        class_table = actor_critic.prepare(model, weights, words)
        carry = model.initial_carry(batch, weights)
        probs, is_first = jnp.zeros((steps, batch, NUM_ACTIONS)), jnp.zeros((steps, batch), bool)
        return actor_critic.forward(model, weights, class_table, carry, obs, probs, is_first)

    weights = model.parameter_shapes(*words.shape)
    return product_macs(jax.make_jaxpr(run)(weights, words, params).jaxpr)


def product_macs(program: Jaxpr) -> int:
    """Multiply-accumulates of a program's products of matrices; of a condition, both branches'."""
    total = 0
    for equation in program.eqns:
        if equation.primitive.name == "dot_general":
            (contracted, _), _ = equation.params["dimension_numbers"]
            factor, result = (v[0].aval for v in (equation.invars, equation.outvars))
            assert isinstance(factor, ShapedArray)
            assert isinstance(result, ShapedArray)
            total += math.prod(factor.shape[axis] for axis in contracted) * result.size
        times = equation.params["length"] if equation.primitive.name == "scan" else 1
        total += times * sum(map(product_macs, jaxprs_in_params(equation.params)))
    return total
