"""How many operations a model's own arithmetic takes, counted in its program."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
from jax.core import ShapedArray
from jax.extend.core import Jaxpr, Literal, Var, jaxprs_in_params

from tdanet_jax.config import LearnerConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.vocabulary import NUM_ACTIONS

#: Operations of an update for each multiply-accumulate of a forward step, by convention: two
#: forward, and twice as many backward, for the gradients of both factors.
UPDATE_OPERATIONS = 6


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
    """Multiply-accumulates of a program's products of matrices and convolutions.

    Of a condition, those of all branches are counted, and of a `while` loop those of one turn.
    """
    total = 0
    for equation in program.eqns:
        kind, params = equation.primitive.name, equation.params
        if kind == "dot_general":
            (contracted, _), _ = params["dimension_numbers"]
            factor = _shape(equation.invars[0])
            each = math.prod(factor[axis] for axis in contracted)
            total += each * math.prod(_shape(equation.outvars[0]))
        elif kind == "conv_general_dilated":
            kernel = _shape(equation.invars[1])
            each = math.prod(kernel) // kernel[params["dimension_numbers"].rhs_spec[0]]
            total += each * math.prod(_shape(equation.outvars[0]))
        times = params["length"] if kind == "scan" else 1
        total += times * sum(map(product_macs, jaxprs_in_params(params)))
    return total


def _shape(variable: Var | Literal) -> tuple[int, ...]:
    assert isinstance(variable.aval, ShapedArray)
    shape: tuple[int, ...] = variable.aval.shape
    return shape
