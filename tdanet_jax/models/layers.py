"""Building blocks shared by the models: dense products, an LSTM, and the tape.

The tape makes one update cost one forward and one backward pass. While acting, every `Linear` and
`LSTM` records its output in the Flax collection `tape`; the loss then applies the same module with
the recorded tape, over all time steps at once, and takes each output from it instead of computing
it again. Gradients are those of the plain form.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

TAPE = "tape"
#: The Flax collection of what each environment adds to the parameters of the dense layers: arrays
#: of the parameters' names and shapes, with a leading axis B; and perhaps `gate` [B] bool, where
#: they count.
OWN = "own"

#: A recurrent state: hidden and cell, each [B, H] float32.
Carry = tuple[jax.Array, jax.Array]


def _keeps_transposed(dtype: Any) -> bool:
    """Whether the tape keeps each input transposed, for the gradient of the kernel.

    XLA's CPU backend gives a bfloat16 product to the processor's matrix units only if both operands
    lie in memory as a plain `a @ b` reads them. So the backward pass must be handed `x.T` and
    `kernel.T` as arrays of their own; elsewhere a transposed operand costs nothing.
    """
    return jnp.dtype(dtype) == jnp.bfloat16 and jax.default_backend() == "cpu"


def _dot(a: jax.Array, b: jax.Array, dtype: Any) -> jax.Array:
    """a [..., n] @ b [n, m] with operands in `dtype`, accumulated and returned in float32."""
    return jnp.dot(a.astype(dtype), b.astype(dtype), preferred_element_type=jnp.float32)


def _dot_rows(a: jax.Array, b: jax.Array, dtype: Any) -> jax.Array:
    """The sum over rows of a [..., n] times b [..., m], [n, m]; as `_dot`.

    Time and environments stay axes of their own: as one, devices that share the environments would
    have to exchange them all. On a processor one after the other along the first axis, commonly
    time: the operands of a step fit its caches.
    """

    def over_rows(a: jax.Array, b: jax.Array) -> jax.Array:
        rows = tuple(range(a.ndim - 1))
        a, b = a.astype(dtype), b.astype(dtype)
        return jax.lax.dot_general(
            a, b, ((rows, rows), ((), ())), preferred_element_type=jnp.float32
        )

    if a.ndim <= 2 or jax.default_backend() != "cpu":
        return over_rows(a, b)

    def add(total: jax.Array, step: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        return total + over_rows(*step), None

    return jax.lax.scan(add, jnp.zeros((a.shape[-1], b.shape[-1])), (a, b))[0]


def _pack(x: jax.Array) -> jax.Array:
    """bfloat16 as its bits, anything else as it is, for arrays that a loop stacks.

    XLA's CPU backend updates a bfloat16 array by converting all of it to float32 and back.
    """
    return jax.lax.bitcast_convert_type(x, jnp.uint16) if x.dtype == jnp.bfloat16 else x


def _unpack(x: jax.Array) -> jax.Array:
    """The inverse of `_pack`."""
    return jax.lax.bitcast_convert_type(x, jnp.bfloat16) if x.dtype == jnp.uint16 else x


def own_transpose(kernel: jax.Array, dtype: Any) -> jax.Array:
    """kernel.T in `dtype`; where `_keeps_transposed`, as an array of its own.

    XLA folds a plain transpose into the product that reads it, and a loop's result it cannot fold.
    """
    blocks = 4
    if not _keeps_transposed(dtype) or kernel.shape[1] % blocks:
        return kernel.T.astype(dtype)
    width = kernel.shape[1] // blocks

    def block(i: jax.Array) -> jax.Array:
        columns = jax.lax.dynamic_slice_in_dim(kernel, i * width, width, axis=1)
        return _pack(columns.T.astype(dtype))

    return _unpack(jax.lax.map(block, jnp.arange(blocks))).reshape(kernel.shape[::-1])


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def product(x: jax.Array, kernel: jax.Array, dtype: Any) -> jax.Array:
    """`x @ kernel` with operands rounded to `dtype`, accumulated and returned in float32.

    The products of the backward pass round their operands to the same dtype and also accumulate
    in float32, so a gradient is never rounded itself.
    """
    return _dot(x, kernel, dtype)


def _product_fwd(x: jax.Array, kernel: jax.Array, dtype: Any) -> tuple[jax.Array, tuple]:
    return product(x, kernel, dtype), (x, kernel)


def _product_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    x, kernel = saved
    return _dot(cotangent, kernel.T, dtype), _dot_rows(x, cotangent, dtype)


product.defvjp(_product_fwd, _product_bwd)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def paired_product(x: jax.Array, kernel: jax.Array, transposed: jax.Array, dtype: Any) -> jax.Array:
    """`product(x, kernel, dtype)` for x [B, n], whose backward pass reads arrays that lie ready.

    Args:
      x: [B, n].
      kernel: [n, m].
      transposed: [m, n], `kernel.T`; gets no gradient.
      dtype: of the operands.
    """
    return _dot(x, kernel, dtype)


def _paired_product_fwd(
    x: jax.Array, kernel: jax.Array, transposed: jax.Array, dtype: Any
) -> tuple[jax.Array, tuple]:
    kept = _pack(x.astype(dtype).T) if _keeps_transposed(dtype) else x.T
    return paired_product(x, kernel, transposed, dtype), (kept, transposed)


def _paired_product_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple:
    kept, transposed = saved
    return _dot(cotangent, transposed, dtype), _dot(_unpack(kept), cotangent, dtype), None


paired_product.defvjp(_paired_product_fwd, _paired_product_bwd)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def recall_product(
    x: jax.Array, kernel: jax.Array, dtype: Any, value: jax.Array, transposed: jax.Array | None
) -> jax.Array:
    """`product(x, kernel, dtype)` over a rollout, taken from the tape.

    Args:
      x: [T, B, n].
      kernel: [n, m].
      dtype: of the operands.
      value: [T, B, m], the product as it was recorded.
      transposed: [T, n, B] packed, x of every step transposed; or None to take it from x.
    """
    return value


def _recall_product_fwd(
    x: jax.Array, kernel: jax.Array, dtype: Any, value: jax.Array, transposed: jax.Array | None
) -> tuple[jax.Array, tuple]:
    return value, (x, kernel, transposed)


def _recall_product_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple:
    x, kernel, transposed = saved
    if transposed is None:
        return *_product_bwd(dtype, (x, kernel), cotangent), None, None
    back = own_transpose(kernel, dtype)

    def body(grad_kernel: jax.Array, step: tuple) -> tuple[jax.Array, jax.Array]:
        x_t, cotangent_t = step
        rounded = cotangent_t.astype(dtype)
        return grad_kernel + _dot(_unpack(x_t), rounded, dtype), _dot(rounded, back, dtype)

    grad_kernel, grad_x = jax.lax.scan(body, jnp.zeros(kernel.shape), (transposed, cotangent))
    return grad_x, grad_kernel, None, None


recall_product.defvjp(_recall_product_fwd, _recall_product_bwd)


def look_up(table: jax.Array, index: jax.Array) -> jax.Array:
    """Rows of a table that is learned: [C, n] at index [...] -> [..., n].

    On a GPU as a product with one-hot rows: the gradient of a plain look-up is added up there in
    whatever order threads come, and a run could not be repeated to the last bit.
    """
    if jax.default_backend() == "cpu":
        return table[index]
    return jnp.dot(jax.nn.one_hot(index, len(table)), table, precision="highest")


def look_up_in_rows(table: jax.Array, row: jax.Array, column: jax.Array) -> jax.Array:
    """Entries of a table that is learned: [R, C] at row [...], column [..., K] -> [..., K].

    As `look_up`.
    """
    if jax.default_backend() == "cpu":
        return table[row[..., None], column]
    rows = look_up(table, row)[..., None, :]
    return jnp.sum(jax.nn.one_hot(column, table.shape[1]) * rows, axis=-1)


def recorded(module: nn.Module, name: str, compute: Callable[[], Any]) -> Any:
    """What `compute` gives, recorded on the tape while acting and taken from there afterwards.

    What is taken from the tape is data: its gradient is the business of whoever reads it.
    """
    if module.is_mutable_collection(TAPE):
        value = compute()
        module.put_variable(TAPE, name, value)
        return value
    return module.get_variable(TAPE, name) if module.has_variable(TAPE, name) else compute()


def not_negative(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """The start of a kernel whose single output, of inputs that are not negative, meets a ReLU.

    The sign of their sum, and with it whether the ReLU lets anything through, would otherwise be an
    accident of the seed.
    """
    return abs(nn.initializers.he_uniform()(key, shape))


class Linear(nn.Module):
    """A dense layer that can record its product on the tape, or take it from there."""

    features: int
    dtype: Any = jnp.float32  # of the operands; parameters and results are float32
    kernel_init: Any = nn.initializers.lecun_normal()
    use_bias: bool = True

    @nn.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        """[..., n] -> [..., features]."""
        kernel = self.param("kernel", self.kernel_init, (x.shape[-1], self.features))
        bias: Any = 0.0
        if self.use_bias:
            bias = self.param("bias", nn.initializers.zeros, (self.features,))
        taken: tuple = self.get_variable(TAPE, "product", ())
        if not self.is_mutable_collection(TAPE):
            # What is recorded may be of another call: of fewer rows, or of a table of classes.
            if taken and taken[0].shape == (*x.shape[:-1], self.features):
                return recall_product(x, kernel, self.dtype, *taken) + bias
            return product(x, kernel, self.dtype) + bias + self.own(x)
        y = product(x, kernel, self.dtype)
        # One row per environment is recorded; products over more than that are taken again, and so
        # are those of a layer that is called twice.
        if x.ndim == 2:
            kept = _keeps_transposed(self.dtype)
            transposed = _pack(x.astype(self.dtype).T) if kept else None
            once = not self.has_variable(TAPE, "product")
            self.put_variable(TAPE, "product", (y, transposed) if once else ())
        return y + bias + self.own(x)

    @property
    def adapted(self) -> bool:
        """Whether each environment adds a part of its own."""
        return self.has_variable(OWN, "kernel")

    def own(self, x: jax.Array) -> jax.Array | float:
        """What each environment's own part of the parameters adds: [B, ..., n] -> [B, ..., m]."""
        if not self.adapted:
            return 0.0
        y = jnp.einsum("b...n,bnm->b...m", x, self.get_variable(OWN, "kernel"))
        if self.use_bias:
            bias: Any = self.get_variable(OWN, "bias")
            y += bias.reshape(len(bias), *(1,) * (y.ndim - 2), -1)
        if self.has_variable(OWN, "gate"):
            gate: Any = self.get_variable(OWN, "gate")
            y = jnp.where(gate.reshape(-1, *(1,) * (y.ndim - 1)), y, 0.0)
        return y


class LSTM(nn.Module):
    """A long short-term memory (Hochreiter and Schmidhuber 1997), as torch.nn.LSTMCell counts it.

    Gates i, f, g, o = sigmoid, sigmoid, tanh, sigmoid of [x, aside, h] W + b_ih + b_hh. The few
    inputs in `aside` have rows of W of their own, which keeps the sizes of the large product round.
    """

    features: int
    dtype: Any = jnp.float32

    @nn.compact
    def __call__(
        self, carry: Carry, x: jax.Array, aside: jax.Array, fresh: jax.Array
    ) -> tuple[Carry, jax.Array]:
        """One step, or with a leading time axis on `x`, `aside` and `fresh`, a whole rollout.

        Args:
          carry: (h, c), each [B, H], from before the (first) step.
          x: [B, n], or [T, B, n].
          aside: [B, m], or [T, B, m].
          fresh: [B] or [T, B] bool, True where an episode starts: the carry is zero there.

        Returns:
          The carry after the last step and the hidden state of every step, [B, H] or [T, B, H].
        """
        bound = self.features**-0.5

        def uniform(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
            return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

        gates = 4 * self.features
        kernel = self.param("kernel", uniform, (x.shape[-1] + self.features, gates))
        kernel_aside = jnp.zeros((0, gates))
        if aside.shape[-1]:  # a checkpoint takes no empty array
            kernel_aside = self.param("kernel_aside", uniform, (aside.shape[-1], gates))
        # Two biases, as in the published counts; they act as their sum.
        bias = self.param("bias_ih", nn.initializers.zeros, (gates,))
        bias = bias + self.param("bias_hh", nn.initializers.zeros, (gates,))
        weights = kernel, kernel_aside, bias
        records = self.is_mutable_collection(TAPE)
        if x.ndim == 2:
            after, memory = lstm_step(weights, carry, x, aside, fresh, self.dtype)
            if records:
                self.put_variable(TAPE, "memory", memory)
            return after, after[0]
        if self.has_variable(TAPE, "memory") and not records:
            memory = self.get_variable(TAPE, "memory")
            hidden, cell = recall_lstm(weights, carry, x, aside, fresh, self.dtype, memory)
            return (hidden[-1], cell[-1]), hidden

        def body(carry: Carry, inputs: tuple) -> tuple[Carry, jax.Array]:
            x, aside, fresh = inputs
            after, _ = lstm_step(weights, carry, x, aside, fresh, self.dtype)
            return after, after[0]

        return jax.lax.scan(body, carry, (x, aside, fresh))


#: An LSTM's kernel [n + H, 4 H], its rows for the inputs in `aside` [m, 4 H], and its bias [4 H].
Weights = tuple[jax.Array, jax.Array, jax.Array]

#: What one LSTM step keeps for the backward pass: the four gates after their nonlinearity
#: [B, 4 H], the cell [B, H], and [x, h] transposed [n + H, B] and packed.
Memory = tuple[jax.Array, jax.Array, jax.Array]


def clear(carry: Carry, fresh: jax.Array) -> Carry:
    """The carry, zero where an episode starts."""
    hidden, cell = carry
    keep = ~fresh[..., None]
    return jnp.where(keep, hidden, 0.0), jnp.where(keep, cell, 0.0)


def lstm_step(
    weights: Weights,
    carry: Carry,
    x: jax.Array,
    aside: jax.Array,
    fresh: jax.Array,
    dtype: Any,
) -> tuple[Carry, Memory]:
    """One LSTM step over a batch; the carry of fresh rows is zeroed first.

    Args:
      weights: kernel, kernel_aside and bias.
      carry: (h, c), each [B, H].
      x: [B, n].
      aside: [B, m].
      fresh: [B] bool.
      dtype: of the large product's operands.
    """
    kernel, kernel_aside, bias = weights
    hidden, cell = clear(carry, fresh)
    inputs = jnp.concatenate([x.astype(dtype), hidden.astype(dtype)], axis=-1)
    z = product(inputs, kernel, dtype) + (product(aside, kernel_aside, jnp.float32) + bias)
    after, gates = lstm_cell(z, cell)
    return after, (gates, after[1], _pack(inputs.T))


def lstm_cell(z: jax.Array, cell: jax.Array) -> tuple[Carry, jax.Array]:
    """The carry behind a step, and its gates [..., 4 H], from the gates' inputs and the cell."""
    i, f, g, o = jnp.split(z, 4, axis=-1)
    i, f, g, o = jax.nn.sigmoid(i), jax.nn.sigmoid(f), jnp.tanh(g), jax.nn.sigmoid(o)
    cell = f * cell + i * g
    return (o * jnp.tanh(cell), cell), jnp.concatenate([i, f, g, o], axis=-1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(5,))
def recall_lstm(
    weights: Weights,
    carry: Carry,
    x: jax.Array,
    aside: jax.Array,
    fresh: jax.Array,
    dtype: Any,
    memory: Memory,
) -> Carry:
    """Hidden state and cell of every step, [T, B, H] each, from what the steps have kept."""
    gates, cell, _ = memory
    return gates[..., -cell.shape[-1] :] * jnp.tanh(cell), cell


def _recall_lstm_fwd(
    weights: Weights,
    carry: Carry,
    x: jax.Array,
    aside: jax.Array,
    fresh: jax.Array,
    dtype: Any,
    memory: Memory,
) -> tuple[Carry, tuple]:
    out = recall_lstm(weights, carry, x, aside, fresh, dtype, memory)
    return out, (weights, carry, aside, fresh, memory)


def _recall_lstm_bwd(dtype: Any, saved: tuple, cotangents: Carry) -> tuple:
    (kernel, kernel_aside, bias), carry, aside, fresh, (gates, cell, inputs) = saved
    before = jnp.concatenate([carry[1][None], cell[:-1]])  # the cell that each step started from
    back = own_transpose(kernel, dtype)  # [4 H, n + H]
    split = kernel.shape[0] - cell.shape[-1]  # n

    def body(grads: tuple, step: tuple) -> tuple[tuple, tuple]:
        (grad_hidden, grad_cell), (grad_kernel, grad_aside, grad_bias) = grads
        gates_t, cell_t, before_t, inputs_t, aside_t, fresh_t, out_hidden, out_cell = step
        i, f, g, o = jnp.split(gates_t, 4, axis=-1)
        tanh_cell = jnp.tanh(cell_t)
        grad_hidden = grad_hidden + out_hidden
        grad_cell = grad_cell + out_cell + grad_hidden * o * (1 - tanh_cell**2)
        before_t = jnp.where(fresh_t[:, None], 0.0, before_t)
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
        grad_inputs = _dot(rounded, back, dtype)
        earlier = clear((grad_inputs[:, split:], grad_cell * f), fresh_t)
        grad_weights = (
            grad_kernel + _dot(_unpack(inputs_t), rounded, dtype),
            grad_aside + aside_t.T @ grad_z,
            grad_bias + grad_z.sum(axis=0),
        )
        return (earlier, grad_weights), (grad_inputs[:, :split], grad_z @ kernel_aside.T)

    zeros = jax.tree.map(jnp.zeros_like, (carry, (kernel, kernel_aside, bias)))
    steps = (gates, cell, before, inputs, aside, fresh, *cotangents)
    (grad_carry, grad_weights), grad_inputs = jax.lax.scan(body, zeros, steps, reverse=True)
    return grad_weights, grad_carry, *grad_inputs, None, None


recall_lstm.defvjp(_recall_lstm_fwd, _recall_lstm_bwd)
