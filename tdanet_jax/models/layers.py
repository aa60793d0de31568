"""Building blocks shared by the models: dense products, an LSTM, and the tape.

The tape makes one update cost one forward and one backward pass. While acting, every `Linear` and
`LSTM` records its output in the Flax collection `tape`; the loss then applies the same module with
the recorded tape, over all time steps at once, and takes each output from it instead of computing
it again. Gradients are those of the plain form.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

TAPE = "tape"

#: A recurrent state: hidden and cell, each [B, H] float32.
Carry = tuple[jax.Array, jax.Array]


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def product(x: jax.Array, kernel: jax.Array, dtype: Any) -> jax.Array:
    """`x @ kernel` with operands rounded to `dtype`, accumulated and returned in float32.

    The products of the backward pass round their operands to the same dtype and also accumulate
    in float32, so a gradient is never rounded itself.
    """
    return _dot(x, kernel, dtype)


def _dot(a: jax.Array, b: jax.Array, dtype: Any) -> jax.Array:
    """a [..., n] @ b [n, m]."""
    rows = a.reshape(-1, a.shape[-1]).astype(dtype)
    out = jnp.dot(rows, b.astype(dtype), preferred_element_type=jnp.float32)
    return out.reshape(*a.shape[:-1], b.shape[-1])


def _kernel_gradient(x: jax.Array, cotangent: jax.Array, dtype: Any) -> jax.Array:
    """The gradient of `product` for its kernel, summed over all leading axes: [n, m]."""
    return _dot(x.reshape(-1, x.shape[-1]).T, cotangent.reshape(-1, cotangent.shape[-1]), dtype)


def _product_fwd(x: jax.Array, kernel: jax.Array, dtype: Any) -> tuple[jax.Array, tuple]:
    return product(x, kernel, dtype), (x, kernel)


def _product_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    return _dot(cotangent, kernel.T, dtype), _kernel_gradient(x, cotangent, dtype)


product.defvjp(_product_fwd, _product_bwd)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def recall_product(x: jax.Array, kernel: jax.Array, dtype: Any, value: jax.Array) -> jax.Array:
    """`product(x, kernel, dtype)` whose `value` is known and is not computed again."""
    return value


def _recall_product_fwd(
    x: jax.Array, kernel: jax.Array, dtype: Any, value: jax.Array
) -> tuple[jax.Array, tuple]:
    return value, (x, kernel)


def _recall_product_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple:
    return *_product_bwd(dtype, saved, cotangent), None


recall_product.defvjp(_recall_product_fwd, _recall_product_bwd)


class Linear(nn.Module):
    """A dense layer with bias that can record its product on the tape, or take it from there."""

    features: int
    dtype: Any = jnp.float32  # of the operands; parameters and results are float32
    kernel_init: Any = nn.initializers.lecun_normal()

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """[..., n] -> [..., features]."""
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        bias = self.param("bias", nn.initializers.zeros, (self.features,))
        if self.has_variable(TAPE, "product") and not self.is_mutable_collection(TAPE):
            return recall_product(x, kernel, self.dtype, self.get_variable(TAPE, "product")) + bias
        y = product(x, kernel, self.dtype)
        if self.is_mutable_collection(TAPE):
            self.put_variable(TAPE, "product", y)
        return y + bias


class LSTM(nn.Module):
    """A long short-term memory (Hochreiter and Schmidhuber 1997), as torch.nn.LSTMCell counts it.

    Gates i, f, g, o = sigmoid, sigmoid, tanh, sigmoid of [x, h] W + b_ih + b_hh.
    """

    features: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, carry: Carry, x: jax.Array, fresh: jax.Array) -> tuple[Carry, jax.Array]:
        """One step, or with a leading time axis on `x` and `fresh`, a whole rollout.

        Args:
          carry: (h, c), each [B, H], from before the (first) step.
          x: [B, n], or [T, B, n].
          fresh: [B] or [T, B] bool, True where an episode starts: the carry is zero there.

        Returns:
          The carry after the last step and the hidden state of every step, [B, H] or [T, B, H].
        """
        size = x.shape[-1]
        uniform = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")
        kernel = self.param("kernel", uniform, (size + self.features, 4 * self.features))
        # Two biases, as in the published counts; they act as their sum.
        bias = self.param("bias_ih", nn.initializers.zeros, (4 * self.features,))
        bias = bias + self.param("bias_hh", nn.initializers.zeros, (4 * self.features,))
        if x.ndim == 2:
            after, memory = lstm_step(kernel, bias, carry, x, fresh, self.dtype)
            if self.is_mutable_collection(TAPE):
                self.put_variable(TAPE, "memory", memory)
            return after, after[0]
        if self.has_variable(TAPE, "memory") and not self.is_mutable_collection(TAPE):
            memory = self.get_variable(TAPE, "memory")
            hidden, cell = recall_lstm(kernel, bias, carry, x, fresh, self.dtype, memory)
            return (hidden[-1], cell[-1]), hidden

        def body(carry: Carry, inputs: tuple[jax.Array, jax.Array]) -> tuple[Carry, jax.Array]:
            after, _ = lstm_step(kernel, bias, carry, *inputs, self.dtype)
            return after, after[0]

        return jax.lax.scan(body, carry, (x, fresh))


#: What one LSTM step keeps for the backward pass: the four gates after their nonlinearity
#: [B, 4 H] and the cell [B, H].
Memory = tuple[jax.Array, jax.Array]


def _clear(carry: Carry, fresh: jax.Array) -> Carry:
    hidden, cell = carry
    keep = ~fresh[..., None]
    return jnp.where(keep, hidden, 0.0), jnp.where(keep, cell, 0.0)


def lstm_step(
    kernel: jax.Array,
    bias: jax.Array,
    carry: Carry,
    x: jax.Array,
    fresh: jax.Array,
    dtype: Any,
) -> tuple[Carry, Memory]:
    """One LSTM step over a batch; the carry of fresh rows is zeroed first."""
    hidden, cell = _clear(carry, fresh)
    z = product(jnp.concatenate([x, hidden], axis=-1), kernel, dtype) + bias
    i, f, g, o = jnp.split(z, 4, axis=-1)
    i, f, g, o = jax.nn.sigmoid(i), jax.nn.sigmoid(f), jnp.tanh(g), jax.nn.sigmoid(o)
    cell = f * cell + i * g
    return (o * jnp.tanh(cell), cell), (jnp.concatenate([i, f, g, o], axis=-1), cell)


@functools.partial(jax.custom_vjp, nondiff_argnums=(5,))
def recall_lstm(
    kernel: jax.Array,
    bias: jax.Array,
    carry: Carry,
    x: jax.Array,
    fresh: jax.Array,
    dtype: Any,
    memory: Memory,
) -> Carry:
    """Hidden state and cell of every step, [T, B, H] each, from what the steps have kept.

    The backward pass walks back through time only for the recurrent part; the products for the
    input and the kernel are taken once, over all steps.
    """
    gates, cell = memory
    return gates[..., -cell.shape[-1] :] * jnp.tanh(cell), cell


def _recall_lstm_fwd(
    kernel: jax.Array,
    bias: jax.Array,
    carry: Carry,
    x: jax.Array,
    fresh: jax.Array,
    dtype: Any,
    memory: Memory,
) -> tuple[Carry, tuple]:
    out = recall_lstm(kernel, bias, carry, x, fresh, dtype, memory)
    return out, (kernel, carry, x, fresh, memory, out[0])


def _recall_lstm_bwd(dtype: Any, saved: tuple, cotangents: Carry) -> tuple:
    kernel, carry, x, fresh, (gates, cell), hidden = saved
    size = x.shape[-1]
    recurrent = kernel[size:].T  # [4 H, H]

    def before(first: jax.Array, later: jax.Array) -> jax.Array:
        """The state that each step started from, [T, B, H]."""
        shifted = jnp.concatenate([first[None], later[:-1]])
        return jnp.where(fresh[..., None], 0.0, shifted)

    previous_hidden, previous_cell = before(carry[0], hidden), before(carry[1], cell)

    def body(grads: Carry, inputs: tuple) -> tuple[Carry, jax.Array]:
        grad_hidden, grad_cell = grads
        gates_t, cell_t, previous_t, fresh_t, out_hidden, out_cell = inputs
        i, f, g, o = jnp.split(gates_t, 4, axis=-1)
        tanh_cell = jnp.tanh(cell_t)
        grad_hidden = grad_hidden + out_hidden
        grad_cell = grad_cell + out_cell + grad_hidden * o * (1 - tanh_cell**2)
        grad_z = jnp.concatenate(
            [
                grad_cell * g * i * (1 - i),
                grad_cell * previous_t * f * (1 - f),
                grad_cell * i * (1 - g**2),
                grad_hidden * tanh_cell * o * (1 - o),
            ],
            axis=-1,
        )
        earlier = _clear((_dot(grad_z, recurrent, dtype), grad_cell * f), fresh_t)
        return earlier, grad_z

    zeros = (jnp.zeros_like(carry[0]), jnp.zeros_like(carry[1]))
    grad_carry, grad_z = jax.lax.scan(
        body, zeros, (gates, cell, previous_cell, fresh, *cotangents), reverse=True
    )
    inputs = jnp.concatenate([x, previous_hidden], axis=-1)
    grad_x = _dot(grad_z, kernel[:size].T, dtype)
    grad_kernel = _kernel_gradient(inputs, grad_z, dtype)
    grad_bias = grad_z.sum(axis=(0, 1))
    return grad_kernel, grad_bias, grad_carry, grad_x, None, None


recall_lstm.defvjp(_recall_lstm_fwd, _recall_lstm_bwd)
