"""Three graph convolutions, relu(A X W), of nodes that share a part of their input.

A node's input is the same for all nodes in its first part, what the frame shows, and its own in the
second, its class's word vector. MJOLNIR and the scene priors are both made so.

Three equal, cheaper forms of the first layers are used; the tests of either model hold them equal
to the published one. What nodes share makes the first layer an outer product with the row sums of
A, and its part of word vectors is taken once per update. A and W are multiplied in the order that
suits the layer. The batch lies between nodes and units, so that either product of a layer is one of
two matrices.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.models.layers import own_transpose, product, recorded

#: Matrix units want sizes that this divides; zeros fill up what is missing.
ROUND = 32


class Convolutions(struct.PyTreeNode):
    """What the three layers of n nodes, h units and u units at the end are made of."""

    words: jax.Array  # [n, h], A E W0 of the word vectors E
    degree: jax.Array  # [n], row sums of A
    adjacency: jax.Array  # [n, n], A
    second: jax.Array  # [h, h], W1
    third: jax.Array  # [h, u], W2

    def padded(self) -> Convolutions:
        """The same with round sizes."""
        count, width = self.words.shape
        nodes, units = (0, -count % ROUND), (0, -width % ROUND)
        return Convolutions(
            words=jnp.pad(self.words, (nodes, units)),
            degree=jnp.pad(self.degree, nodes),
            adjacency=jnp.pad(self.adjacency, nodes),
            second=jnp.pad(self.second, units),
            third=jnp.pad(self.third, (units, (0, 0))),
        )


class Layers(NamedTuple):
    """The layers of a batch, one by one."""

    first: jax.Array  # [n, B, h], behind A X W0 and ReLU
    mixed: jax.Array  # [n, B, h], first W1
    second: jax.Array  # [n, B, h], behind A mixed and ReLU
    lower: jax.Array  # [n, B u], second W2
    last: jax.Array  # [n, B u], A lower


def apply(module: nn.Module, weights: Convolutions, shared: jax.Array, dtype: Any) -> jax.Array:
    """The nodes' numbers behind three layers, [..., n, u]; the tape of `module` keeps them.

    Args:
      shared: [B, h] or [T, B, h], the product of what the nodes share and its rows of W0.
      dtype: operands of the large products.
    """
    count, width = weights.words.shape
    shared = jnp.pad(shared, ((0, 0),) * (shared.ndim - 1) + ((0, -width % ROUND),))
    padded = weights.padded()
    given = jax.lax.stop_gradient((padded, shared))
    found = recorded(module, "nodes", lambda: forward(*given, dtype))
    return convolve(padded, shared, dtype, found)[..., :count, :]


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
def convolve(weights: Convolutions, shared: jax.Array, dtype: Any, found: jax.Array) -> jax.Array:
    """`forward(weights, shared, dtype)`, which has given `found`; shared [B, h] or [T, B, h].

    The backward pass goes through one step at a time and computes its layers again, so that nothing
    but the results is kept: those of a rollout would fill the memory.
    """
    return found


def _convolve_fwd(
    weights: Convolutions, shared: jax.Array, dtype: Any, found: jax.Array
) -> tuple[jax.Array, tuple[Convolutions, jax.Array]]:
    return found, (weights, shared)


def _convolve_bwd(
    dtype: Any, saved: tuple[Convolutions, jax.Array], cotangent: jax.Array
) -> tuple[Convolutions, jax.Array, None]:
    weights, shared = saved
    back = own_transpose(weights.adjacency, dtype), own_transpose(weights.second, dtype)

    def body(
        total: Convolutions, step: tuple[jax.Array, jax.Array]
    ) -> tuple[Convolutions, jax.Array]:
        found, of_shared = gradient(weights, back, *step, dtype)
        return jax.tree.map(jnp.add, total, found), of_shared

    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape), weights)
    steps = shared.reshape(-1, *shared.shape[-2:]), cotangent.reshape(-1, *cotangent.shape[-3:])
    total, of_shared = jax.lax.scan(body, zeros, steps)
    total = jax.tree.map(lambda x, w: x.astype(w.dtype), total, weights)
    return total, of_shared.reshape(shared.shape), None


convolve.defvjp(_convolve_fwd, _convolve_bwd)


def gradient(
    weights: Convolutions,
    back: tuple[jax.Array, jax.Array],
    shared: jax.Array,
    cotangent: jax.Array,
    dtype: Any,
) -> tuple[Convolutions, jax.Array]:
    """The gradient of `forward` in its weights and in shared, of one step.

    Args:
      back: A and W1 transposed, as arrays of their own.
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
    mixed = product(back[0], second, dtype).astype(dtype).reshape(-1, width)
    # The first layer transposed is made anew, unit by unit: large transposed operands are slow.
    turned = shared.T[:, None] * weights.degree[:, None] + weights.words.T[..., None]
    first = product(mixed, back[1], dtype).reshape(at.first.shape)
    first = jnp.where(at.first > 0, first, 0.0)
    adjacency = product(second, at.mixed.reshape(count, -1).T, dtype)
    found = Convolutions(
        words=first.sum(axis=1),
        degree=jnp.einsum("nbh,bh->n", first, shared),
        adjacency=adjacency + last @ at.lower.T,
        second=product(nn.relu(turned).astype(dtype).reshape(width, -1), mixed, dtype),
        third=at.second.reshape(-1, width).T.astype(jnp.float32) @ lower,
    )
    return found, jnp.einsum("nbh,n->bh", first, weights.degree)
