"""A long short-term memory, with an activation cache."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from tdanet_jax.models import rounding
from tdanet_jax.models.activation_cache import ACTIVATIONS
from tdanet_jax.models.matmul import dot, materialized_transpose, pack, product, unpack

#: A recurrent state: hidden and cell, each [B, H] float32.
Carry = tuple[jax.Array, jax.Array]


class LSTMWeights(NamedTuple):
    """An LSTM's parameters."""

    kernel: jax.Array  # [n + H, 4 H], for the inputs and the hidden state
    kernel_skip: jax.Array  # [m, 4 H], for the skip inputs
    bias: jax.Array  # [4 H]


class LSTMCache(NamedTuple):
    """What the backward pass needs of one LSTM step."""

    gates: jax.Array  # [B, 4 H], the four gates after their nonlinearity
    cell: jax.Array  # [B, H], after the step
    inputs: jax.Array  # [n + H, B], [x, h] transposed and packed


class LSTM(nn.Module):
    """A long short-term memory (Hochreiter and Schmidhuber 1997), as torch.nn.LSTMCell.

    Gates i, f, g, o = sigmoid, sigmoid, tanh, sigmoid of [x, skip_inputs, h] W + b_ih + b_hh. The
    few `skip_inputs` are inputs like x, those that skip the encoder. Their rows of W are a separate
    kernel, which keeps the sizes of the large product round.
    """

    features: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(
        self, carry: Carry, x: jax.Array, skip_inputs: jax.Array, is_first: jax.Array
    ) -> tuple[Carry, jax.Array]:
        """One step, or a whole rollout if `x`, `skip_inputs` and `is_first` have a time axis.

        Args:
          carry: (h, c), each [B, H], from before the (first) step.
          x: [B, n], or [T, B, n].
          skip_inputs: [B, m], or [T, B, m].
          is_first: [B] or [T, B] bool, True where an episode starts: the carry is zero there.

        Returns:
          The carry after the last step and the hidden state of every step, [B, H] or [T, B, H].
        """
        bound = self.features**-0.5

        def uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
            return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

        gates = 4 * self.features
        kernel = self.param("kernel", uniform, (x.shape[-1] + self.features, gates))
        rounding.declare(self, "kernel", self.dtype)
        kernel_skip = jnp.zeros((0, gates))
        if skip_inputs.shape[-1]:  # a checkpoint takes no empty array
            kernel_skip = self.param("kernel_skip", uniform, (skip_inputs.shape[-1], gates))
        # Two biases, as in the published counts; only their sum matters.
        bias = self.param("bias_ih", nn.initializers.zeros, (gates,))
        bias = bias + self.param("bias_hh", nn.initializers.zeros, (gates,))
        weights = LSTMWeights(kernel, kernel_skip, bias)
        writes = self.is_mutable_collection(ACTIVATIONS)
        if x.ndim == 2:
            carry, cache = lstm_step(weights, carry, x, skip_inputs, is_first, self.dtype)
            if writes:
                self.put_variable(ACTIVATIONS, "lstm", cache)
            return carry, carry[0]
        if self.has_variable(ACTIVATIONS, "lstm") and not writes:
            cache = self.get_variable(ACTIVATIONS, "lstm")
            hidden, cell = cached_lstm(weights, carry, x, skip_inputs, is_first, self.dtype, cache)
            return (hidden[-1], cell[-1]), hidden

        def body(carry: Carry, step: tuple) -> tuple[Carry, jax.Array]:
            x, skip_inputs, is_first = step
            carry, _ = lstm_step(weights, carry, x, skip_inputs, is_first, self.dtype)
            return carry, carry[0]

        return jax.lax.scan(body, carry, (x, skip_inputs, is_first))


def reset_carry(carry: Carry, is_first: jax.Array) -> Carry:
    """The carry, zero where an episode starts."""
    hidden, cell = carry
    continues = ~is_first[..., None]
    return jnp.where(continues, hidden, 0.0), jnp.where(continues, cell, 0.0)


def lstm_step(
    weights: LSTMWeights,
    carry: Carry,
    x: jax.Array,
    skip_inputs: jax.Array,
    is_first: jax.Array,
    dtype: Any,
) -> tuple[Carry, LSTMCache]:
    """One LSTM step over a batch; the carry is zeroed where an episode starts.

    Args:
      weights: the parameters.
      carry: (h, c), each [B, H].
      x: [B, n].
      skip_inputs: [B, m].
      is_first: [B] bool.
      dtype: of the large product's operands.
    """
    hidden, cell = reset_carry(carry, is_first)
    inputs = jnp.concatenate([x.astype(dtype), hidden.astype(dtype)], axis=-1)
    skip = product(skip_inputs, weights.kernel_skip, jnp.float32) + weights.bias
    carry, gates = lstm_cell(product(inputs, weights.kernel, dtype) + skip, cell)
    return carry, LSTMCache(gates, carry[1], pack(inputs.T))


def lstm_cell(z: jax.Array, cell: jax.Array) -> tuple[Carry, jax.Array]:
    """The carry after a step, and its gates [..., 4 H], from the gates' inputs and the cell."""
    i, f, g, o = jnp.split(z, 4, axis=-1)
    i, f, g, o = jax.nn.sigmoid(i), jax.nn.sigmoid(f), jnp.tanh(g), jax.nn.sigmoid(o)
    cell = f * cell + i * g
    return (o * jnp.tanh(cell), cell), jnp.concatenate([i, f, g, o], axis=-1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(5,))
def cached_lstm(
    weights: LSTMWeights,
    carry: Carry,
    x: jax.Array,
    skip_inputs: jax.Array,
    is_first: jax.Array,
    dtype: Any,
    cache: LSTMCache,
) -> Carry:
    """Hidden state and cell of every step, [T, B, H] each, from the steps' cache [T, ...]."""
    return cache.gates[..., -cache.cell.shape[-1] :] * jnp.tanh(cache.cell), cache.cell


def _cached_lstm_fwd(*inputs: Any) -> tuple[Carry, tuple]:
    weights, carry, _, skip_inputs, is_first, _, cache = inputs
    return cached_lstm(*inputs), (weights, carry, skip_inputs, is_first, cache)


def _cached_lstm_bwd(dtype: Any, saved: tuple, cotangents: Carry) -> tuple:
    weights, carry, skip_inputs, is_first, (gates, cell, inputs) = saved
    before = jnp.concatenate([carry[1][None], cell[:-1]])  # the cell that each step started from
    kernel_transposed = materialized_transpose(weights.kernel, dtype)  # [4 H, n + H]
    split = weights.kernel.shape[0] - cell.shape[-1]  # n

    def body(grads: tuple, step: tuple) -> tuple[tuple, tuple]:
        (grad_hidden, grad_cell), grad_weights = grads
        gates_t, cell_t, before_t, inputs_t, skip_t, is_first_t, out_hidden, out_cell = step
        i, f, g, o = jnp.split(gates_t, 4, axis=-1)
        tanh_cell = jnp.tanh(cell_t)
        grad_hidden = grad_hidden + out_hidden
        grad_cell = grad_cell + out_cell + grad_hidden * o * (1 - tanh_cell**2)
        before_t = jnp.where(is_first_t[:, None], 0.0, before_t)
        grad_z = jnp.concatenate(
            [
                grad_cell * g * i * (1 - i),
                grad_cell * before_t * f * (1 - f),
                grad_cell * i * (1 - g**2),
                grad_hidden * tanh_cell * o * (1 - o),
            ],
            axis=-1,
        )
        rounded = grad_z.astype(dtype)
        grad_inputs = dot(rounded, kernel_transposed, dtype)
        earlier = reset_carry((grad_inputs[:, split:], grad_cell * f), is_first_t)
        grad_weights = LSTMWeights(
            kernel=grad_weights.kernel + dot(unpack(inputs_t), rounded, dtype),
            kernel_skip=grad_weights.kernel_skip + skip_t.T @ grad_z,
            bias=grad_weights.bias + grad_z.sum(axis=0),
        )
        grad_skip = grad_z @ weights.kernel_skip.T
        return (earlier, grad_weights), (grad_inputs[:, :split], grad_skip)

    zeros = jax.tree.map(jnp.zeros_like, (carry, weights))
    steps = (gates, cell, before, inputs, skip_inputs, is_first, *cotangents)
    (grad_carry, grad_weights), grad_inputs = jax.lax.scan(body, zeros, steps, reverse=True)
    return grad_weights, grad_carry, *grad_inputs, None, None


cached_lstm.defvjp(_cached_lstm_fwd, _cached_lstm_bwd)
