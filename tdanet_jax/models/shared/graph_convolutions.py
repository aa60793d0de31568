"""Three graph convolutions, relu(A X W), of nodes that share a part of their input.

The first part of a node's input is what the frame shows, equal for all nodes; the second is its own
class's word vector. MJOLNIR and the scene priors both have such nodes.

Equal but cheaper forms are used; the tests of either model compare them with the published one. The
shared part makes the first layer an outer product with the row sums of A, and the word vectors'
part is computed once per update. A and W are multiplied in the order that suits the layer. The
batch axis is between nodes and units, so that either product of a layer is one of two matrices.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.models.activation_cache import cached
from tdanet_jax.models.matmul import materialized_transpose, product

#: With bfloat16 operands, sizes are padded with zeros to multiples of this: matrix units need it.
ROUND = 32


class Convolutions(struct.PyTreeNode):
    """The weights of the three layers, for n nodes with h units, and u after the last layer."""

    words: jax.Array  # [n, h], A E W0 of the word vectors E
    degree: jax.Array  # [n], row sums of A
    adjacency: jax.Array  # [n, n], A
    second: jax.Array  # [h, h], W1
    third: jax.Array  # [h, u], W2

    def padded(self, more_nodes: int, more_units: int) -> Convolutions:
        """The same with additional nodes and units of zeros."""
        nodes, units = (0, more_nodes), (0, more_units)
        return Convolutions(
            words=jnp.pad(self.words, (nodes, units)),
            degree=jnp.pad(self.degree, nodes),
            adjacency=jnp.pad(self.adjacency, nodes),
            second=jnp.pad(self.second, units),
            third=jnp.pad(self.third, (units, (0, 0))),
        )


class Layers(NamedTuple):
    """The layers of a batch, one by one."""

    first: jax.Array  # [n, B, h], A X W0 after ReLU
    mixed: jax.Array  # [n, B, h], first W1
    second: jax.Array  # [n, B, h], A mixed after ReLU
    lower: jax.Array  # [n, B u], second W2
    last: jax.Array  # [n, B u], A lower


def apply(module: nn.Module, weights: Convolutions, shared: jax.Array, dtype: Any) -> jax.Array:
    """The nodes' numbers after three layers, [..., n, u], through the activation cache.

    Args:
      module: the module whose cache is used.
      weights: of the layers.
      shared: [B, h] or [T, B, h], the product of the shared input and its rows of W0.
      dtype: operands of the large products.
    """
    count, width = weights.words.shape
    multiple = ROUND if jnp.dtype(dtype) == jnp.bfloat16 else 1
    units = -width % multiple
    shared = jnp.pad(shared, ((0, 0),) * (shared.ndim - 1) + ((0, units),))
    padded = weights.padded(-count % multiple, units)
    constant = jax.lax.stop_gradient((padded, shared))
    value = cached(module, "nodes", lambda: forward(*constant, dtype))
    return convolve(padded, shared, dtype, value)[..., :count, :]


def layers_of(weights: Convolutions, shared: jax.Array, dtype: Any) -> Layers:
    """All layers of a batch with shared [B, h], the large ones in `dtype`."""
    count = len(weights.words)
    first = nn.relu(weights.degree[:, None, None] * shared + weights.words[:, None]).astype(dtype)
    mixed = product(first, weights.second, dtype).astype(dtype)
    second = product(weights.adjacency, mixed.reshape(count, -1), dtype).reshape(first.shape)
    second = nn.relu(second).astype(dtype)
    lower = product(second, weights.third, dtype).reshape(count, -1)
    return Layers(first, mixed, second, lower, weights.adjacency.astype(jnp.float32) @ lower)


def forward(weights: Convolutions, shared: jax.Array, dtype: Any) -> jax.Array:
    """The three layers of shared [..., h]: [..., n, u]."""
    *lead, width = shared.shape
    count, units = len(weights.words), weights.third.shape[1]
    last = nn.relu(layers_of(weights, shared.reshape(-1, width), dtype).last)
    return last.reshape(count, -1, units).swapaxes(0, 1).reshape(*lead, count, units)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def convolve(weights: Convolutions, shared: jax.Array, dtype: Any, value: jax.Array) -> jax.Array:
    """`forward(weights, shared, dtype)` with a known value; shared [B, h] or [T, B, h].

    The backward pass goes through one step at a time and computes its layers again, so that only
    the results are stored: the layers of a rollout would fill the memory.
    """
    return value


def _convolve_fwd(
    weights: Convolutions, shared: jax.Array, dtype: Any, value: jax.Array
) -> tuple[jax.Array, tuple[Convolutions, jax.Array]]:
    return value, (weights, shared)


def _convolve_bwd(
    dtype: Any, saved: tuple[Convolutions, jax.Array], cotangent: jax.Array
) -> tuple[Convolutions, jax.Array, None]:
    weights, shared = saved
    transposed = (
        materialized_transpose(weights.adjacency, dtype),
        materialized_transpose(weights.second, dtype),
    )

    def body(
        total: Convolutions, step: tuple[jax.Array, jax.Array]
    ) -> tuple[Convolutions, jax.Array]:
        grads, grad_shared = gradient(weights, transposed, *step, dtype)
        return jax.tree.map(jnp.add, total, grads), grad_shared

    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape), weights)
    steps = shared.reshape(-1, *shared.shape[-2:]), cotangent.reshape(-1, *cotangent.shape[-3:])
    total, grad_shared = jax.lax.scan(body, zeros, steps)
    total = jax.tree.map(lambda x, w: x.astype(w.dtype), total, weights)
    return total, grad_shared.reshape(shared.shape), None


convolve.defvjp(_convolve_fwd, _convolve_bwd)


def gradient(
    weights: Convolutions,
    transposed: tuple[jax.Array, jax.Array],
    shared: jax.Array,
    cotangent: jax.Array,
    dtype: Any,
) -> tuple[Convolutions, jax.Array]:
    """The gradient of `forward` with respect to its weights and `shared`, of one step.

    Args:
      weights: of the layers.
      transposed: A and W1 transposed and materialized.
      shared: [B, h].
      cotangent: [B, n, u].
      dtype: operands of the large products.
    """
    count, width = weights.words.shape
    units = weights.third.shape[1]
    at = layers_of(weights, shared, dtype)
    last = jnp.where(at.last > 0, cotangent.swapaxes(0, 1).reshape(count, -1), 0.0)
    lower = (weights.adjacency.astype(jnp.float32).T @ last).reshape(-1, units)
    second = lower @ weights.third.astype(jnp.float32).T
    second = jnp.where(at.second.reshape(-1, width) > 0, second, 0.0).astype(dtype)
    second = second.reshape(count, -1)
    mixed = product(transposed[0], second, dtype).astype(dtype).reshape(-1, width)
    # The first layer's transpose is computed anew, unit by unit: large transposes are slow.
    turned = shared.T[:, None] * weights.degree[:, None] + weights.words.T[..., None]
    first = product(mixed, transposed[1], dtype).reshape(at.first.shape)
    first = jnp.where(at.first > 0, first, 0.0)
    adjacency = product(second, at.mixed.reshape(count, -1).T, dtype)
    grads = Convolutions(
        words=first.sum(axis=1),
        degree=jnp.einsum("nbh,bh->n", first, shared),
        adjacency=adjacency + last @ at.lower.T,
        second=product(nn.relu(turned).astype(dtype).reshape(width, -1), mixed, dtype),
        third=at.second.reshape(-1, width).T.astype(jnp.float32) @ lower,
    )
    return grads, jnp.einsum("nbh,n->bh", first, weights.degree)
