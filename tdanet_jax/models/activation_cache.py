"""The activation cache: one update costs one forward and one backward pass.

While acting, layers write their products to the Flax collection `activations`. The loss then
applies the same module to all time steps at once, and with the collection takes each product from
it instead of computing it again. The gradients are those of the module without a cache.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn

from tdanet_jax.models.matmul import (
    dot,
    materialized_transpose,
    needs_plain_layout,
    pack,
    product,
    product_bwd,
    unpack,
)

#: The Flax collection that holds the cache.
ACTIVATIONS = "activations"


def cached(module: nn.Module, name: str, compute: Callable[[], Any]) -> Any:
    """The result of `compute`: written to the cache while acting, read from it afterwards.

    A value from the cache is a constant. The caller provides its gradient.
    """
    if module.is_mutable_collection(ACTIVATIONS):
        value = compute()
        module.put_variable(ACTIVATIONS, name, value)
        return value
    if module.has_variable(ACTIVATIONS, name):
        return module.get_variable(ACTIVATIONS, name)
    return compute()


def dense_product(module: nn.Module, x: jax.Array, kernel: jax.Array, dtype: Any) -> jax.Array:
    """`product(x, kernel, dtype)` of a dense layer, through the cache where it can be.

    Args:
      module: the layer; it has a single kernel.
      x: [B, n] while acting, [T, B, n] afterwards. A product of more rows per environment, or of a
        layer that is called twice, is not cached but computed again.
      kernel: [n, m].
      dtype: of the operands.
    """
    cache: Any = module.get_variable(ACTIVATIONS, "product", ())
    if not module.is_mutable_collection(ACTIVATIONS):
        # The cached product may belong to another call, of fewer rows or of a table of classes.
        if cache and cache[0].shape == (*x.shape[:-1], kernel.shape[1]):
            return cached_product(x, kernel, dtype, *cache)
        return product(x, kernel, dtype)
    y = product(x, kernel, dtype)
    if x.ndim == 2:
        transposed = pack(x.astype(dtype).T) if needs_plain_layout(dtype) else None
        once = not module.has_variable(ACTIVATIONS, "product")
        module.put_variable(ACTIVATIONS, "product", (y, transposed) if once else ())
    return y


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def cached_product(
    x: jax.Array, kernel: jax.Array, dtype: Any, value: jax.Array, transposed: jax.Array | None
) -> jax.Array:
    """`product(x, kernel, dtype)` over a rollout, with the value taken from the cache.

    Args:
      x: [T, B, n].
      kernel: [n, m].
      dtype: of the operands.
      value: [T, B, m], the cached product.
      transposed: [T, n, B] packed, x of every step transposed; or None to take it from x.
    """
    return value


def _cached_product_fwd(
    x: jax.Array, kernel: jax.Array, dtype: Any, value: jax.Array, transposed: jax.Array | None
) -> tuple[jax.Array, tuple]:
    return value, (x, kernel, transposed)


def _cached_product_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple:
    x, kernel, transposed = saved
    if transposed is None:
        return *product_bwd(dtype, (x, kernel), cotangent), None, None
    kernel_transposed = materialized_transpose(kernel, dtype)

    def body(grad_kernel: jax.Array, step: tuple) -> tuple[jax.Array, jax.Array]:
        x_t, cotangent_t = step
        rounded = cotangent_t.astype(dtype)
        grad_x = dot(rounded, kernel_transposed, dtype)
        return grad_kernel + dot(unpack(x_t), rounded, dtype), grad_x

    grad_kernel, grad_x = jax.lax.scan(body, jnp.zeros(kernel.shape), (transposed, cotangent))
    return grad_x, grad_kernel, None, None


cached_product.defvjp(_cached_product_fwd, _cached_product_bwd)
