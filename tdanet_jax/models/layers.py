"""Layers that the models share: dense layers, look-ups and initialisers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from tdanet_jax.models import rounding
from tdanet_jax.models.activation_cache import dense_product

#: The Flax collection of per-environment weights, which are added to the parameters of dense
#: layers: arrays of the parameters' names and shapes with a leading axis B, and optionally `gate`
#: [B] bool, False where they are not added.
PER_ENVIRONMENT = "per_environment"


class Linear(nn.Module):
    """A dense layer with an activation cache; networks that adapt add per-environment weights."""

    features: int
    dtype: Any = jnp.float32  # of the operands; parameters and results are float32
    kernel_init: Any = nn.initializers.lecun_normal()
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """[..., n] -> [..., features]."""
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        rounding.declare(self, "kernel", self.dtype)
        y = dense_product(self, x, kernel, self.dtype)
        if self.use_bias:
            y += self.param("bias", nn.initializers.zeros, (self.features,))
        return y + self.per_environment(x) if self.adapted else y

    @property
    def adapted(self) -> bool:
        """Whether there are per-environment weights."""
        return self.has_variable(PER_ENVIRONMENT, "kernel")

    def per_environment(self, x: jax.Array) -> jax.Array | float:
        """What per-environment weights add: [B, ..., n] -> [B, ..., features]; 0 without any."""
        if not self.adapted:
            return 0.0
        y = jnp.einsum("b...n,bnm->b...m", x, self.get_variable(PER_ENVIRONMENT, "kernel"))
        if self.use_bias:
            bias: Any = self.get_variable(PER_ENVIRONMENT, "bias")
            y += bias.reshape(len(bias), *(1,) * (y.ndim - 2), -1)
        if self.has_variable(PER_ENVIRONMENT, "gate"):
            gate: Any = self.get_variable(PER_ENVIRONMENT, "gate")
            y = jnp.where(gate.reshape(-1, *(1,) * (y.ndim - 1)), y, 0.0)
        return y


def by_part(
    layer: Callable[[jax.Array], jax.Array], words: jax.Array, columns: int
) -> tuple[jax.Array, jax.Array]:
    """What a dense layer makes of each part of a row [box, word]; a row's is the sum of its parts'.

    Args:
      layer: [..., F + D] -> [..., n], with a bias.
      words: [C, D].
      columns: F, numbers of the box.

    Returns:
      Of each word, bias included [C, n]; of a unit of each number of the box [F, n].
    """
    width = columns + words.shape[1]
    bias = layer(jnp.zeros((1, width)))
    units = layer(jnp.eye(columns, width)) - bias
    return layer(jnp.pad(words, ((0, 0), (columns, 0)))), units


def look_up(table: jax.Array, index: jax.Array) -> jax.Array:
    """Rows of a trained table: [C, n] at index [...] -> [..., n].

    On a GPU this is a product with one-hot rows: the gradient of a plain look-up is summed there in
    no fixed order, so that runs would not repeat to the last bit.
    """
    if jax.default_backend() == "cpu":
        return table[index]
    return jnp.dot(jax.nn.one_hot(index, len(table)), table, precision="highest")


def look_up_in_rows(table: jax.Array, row: jax.Array, column: jax.Array) -> jax.Array:
    """Entries of a trained table: [R, C] at row [...], column [..., K] -> [..., K].

    As `look_up`.
    """
    if jax.default_backend() == "cpu":
        return table[row[..., None], column]
    rows = look_up(table, row)[..., None, :]
    return jnp.sum(jax.nn.one_hot(column, table.shape[1]) * rows, axis=-1)


def nonnegative_init(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Non-negative initialiser for a one-output kernel with non-negative inputs, then ReLU.

    With weights of either sign, the seed would decide whether the ReLU's output is ever positive.
    """
    return abs(nn.initializers.he_uniform()(key, shape))
