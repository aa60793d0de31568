"""Matrix products of the layers: operands rounded to a dtype, sums and results in float32."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp


def needs_plain_layout(dtype: Any) -> bool:
    """Whether a product is slow unless both operands lie in memory as a plain `a @ b` reads them.

    XLA's CPU backend gives only such bfloat16 products to the processor's matrix units. There the
    backward pass needs materialized copies of `x.T` and `kernel.T`; elsewhere a transposed operand
    costs nothing.
    """
    return jnp.dtype(dtype) == jnp.bfloat16 and jax.default_backend() == "cpu"


def dot(a: jax.Array, b: jax.Array, dtype: Any) -> jax.Array:
    """a [..., n] @ b [n, m] with operands in `dtype`, accumulated and returned in float32."""
    return jnp.dot(a.astype(dtype), b.astype(dtype), preferred_element_type=jnp.float32)


def dot_rows(a: jax.Array, b: jax.Array, dtype: Any) -> jax.Array:
    """The sum over rows of the outer products of a [..., n] and b [..., m], [n, m]; as `dot`.

    Time and environments stay separate axes: devices that share the environments would have to
    exchange all of them if the axes were merged.
    """
    rows = tuple(range(a.ndim - 1))
    return jax.lax.dot_general(
        a.astype(dtype),
        b.astype(dtype),
        ((rows, rows), ((), ())),
        preferred_element_type=jnp.float32,
    )


def pack(x: jax.Array) -> jax.Array:
    """bfloat16 as its bits, any other array as it is, for arrays that a scan stacks.

    XLA's CPU backend updates a bfloat16 array by converting all of it to float32 and back.
    """
    return jax.lax.bitcast_convert_type(x, jnp.uint16) if x.dtype == jnp.bfloat16 else x


def unpack(x: jax.Array) -> jax.Array:
    """The inverse of `pack`."""
    return jax.lax.bitcast_convert_type(x, jnp.bfloat16) if x.dtype == jnp.uint16 else x


def materialized_transpose(kernel: jax.Array, dtype: Any) -> jax.Array:
    """kernel.T in `dtype`, materialized where products need a plain layout.

    XLA would fuse a plain transpose into the matmul; computing it in a loop prevents that.
    """
    blocks = 4
    if not needs_plain_layout(dtype) or kernel.shape[1] % blocks:
        return kernel.T.astype(dtype)
    width = kernel.shape[1] // blocks

    def block(i: jax.Array) -> jax.Array:
        columns = jax.lax.dynamic_slice_in_dim(kernel, i * width, width, axis=1)
        return pack(columns.T.astype(dtype))

    return unpack(jax.lax.map(block, jnp.arange(blocks))).reshape(kernel.shape[::-1])


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def product(x: jax.Array, kernel: jax.Array, dtype: Any) -> jax.Array:
    """`x @ kernel` with operands rounded to `dtype`, accumulated and returned in float32.

    The products of the backward pass round their operands to the same dtype and also accumulate
    in float32, so a gradient is never rounded itself.
    """
    return dot(x, kernel, dtype)


def _product_fwd(x: jax.Array, kernel: jax.Array, dtype: Any) -> tuple[jax.Array, tuple]:
    return product(x, kernel, dtype), (x, kernel)


def product_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The gradients of `product` with respect to `saved`, (x, kernel)."""
    x, kernel = saved
    return dot(cotangent, kernel.T, dtype), dot_rows(x, cotangent, dtype)


product.defvjp(_product_fwd, product_bwd)


@functools.partial(jax.custom_vjp, nondiff_argnums=(3,))
def product_with_transpose(
    x: jax.Array, kernel: jax.Array, transposed: jax.Array, dtype: Any
) -> jax.Array:
    """`product(x, kernel, dtype)` with a backward pass that reads a transpose made beforehand.

    Args:
      x: [B, n].
      kernel: [n, m].
      transposed: [m, n], `kernel.T`; gets no gradient.
      dtype: of the operands.
    """
    return dot(x, kernel, dtype)


def _product_with_transpose_fwd(
    x: jax.Array, kernel: jax.Array, transposed: jax.Array, dtype: Any
) -> tuple[jax.Array, tuple]:
    saved = pack(x.astype(dtype).T) if needs_plain_layout(dtype) else x.T
    return product_with_transpose(x, kernel, transposed, dtype), (saved, transposed)


def _product_with_transpose_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple:
    x_transposed, transposed = saved
    return dot(cotangent, transposed, dtype), dot(unpack(x_transposed), cotangent, dtype), None


product_with_transpose.defvjp(_product_with_transpose_fwd, _product_with_transpose_bwd)
