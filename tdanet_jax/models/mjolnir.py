"""MJOLNIR's encoders (Qiu et al. 2020): graph convolution over the classes that are known.

Every known class is a node. A node's input is the presence of all classes in the frame, one entry
per class, and its own word vector; three graph convolutions turn it into five numbers, the node's
context (present, x, y, S, cosine to the target) joins them, a fourth makes one number of the ten,
and a linear layer maps those of all nodes to the features. The adjacency starts as the class graph
(`tdanet_jax.graph`) and is trained, as in the published code.

MJOLNIR-o adds the context itself. MJOLNIR-r adds the image in its place.

Three equal, cheaper forms are used; a test holds them equal to the published one. All nodes share
the presence, so the first convolution is an outer product of the adjacency's row sums and the sum
of the kernel's rows of the classes present, and its part of word vectors is taken once per update.
A and W are multiplied in the order that makes the smaller product first. The batch lies between
nodes and units, so that either product of a convolution is one of two matrices.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from tdanet_jax import graph
from tdanet_jax.classes import Classes
from tdanet_jax.config import NetworkConfig
from tdanet_jax.env import Observation
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import Linear, not_negative, own_transpose, product, recorded
from tdanet_jax.models.rows import COLUMNS, RowTable, class_rows, make_table, published_beside

#: Matrix units want sizes that this divides; zeros fill up what is missing.
ROUND = 32
#: Units of a node behind the third convolution.
NODE_UNITS = 5


class Nodes(struct.PyTreeNode):
    """What is known of n nodes with h = n + D units before any frame is seen."""

    words: jax.Array  # [n, h], word part of the first convolution, A E W0
    presence: jax.Array  # [n, h], rows of W0 for the presence of a class
    degree: jax.Array  # [n], row sums of A


class GraphTable(struct.PyTreeNode):
    """What the encoders take from word vectors alone."""

    rows: RowTable
    nodes: Nodes


class Convolutions(struct.PyTreeNode):
    """What the first three convolutions are made of, padded with zeros to round sizes n and h."""

    words: jax.Array  # [n, h]
    presence: jax.Array  # [n, h]
    degree: jax.Array  # [n]
    adjacency: jax.Array  # [n, n]
    second: jax.Array  # [h, h], W1
    third: jax.Array  # [h, 5], W2


class Kernel(nn.Module):
    """A matrix whose shape is known when it is used."""

    @nn.compact
    def __call__(self, rows: int, columns: int) -> jax.Array:
        """[rows, columns]."""
        return self.param("kernel", nn.initializers.he_uniform(), (rows, columns))


class GraphEncoder(nn.Module):
    """Presence and context of the known classes in, a vector of features out.

    Attributes:
      classes: the vocabulary; its known classes are the nodes.
      features: units of the result.
      dtype: operands of the large products.
    """

    classes: Classes
    features: int = 512
    dtype: Any = jnp.float32

    def setup(self) -> None:
        start = functools.partial(graph.normalised, self.classes)
        self.adjacency = self.param("adjacency", lambda _: jnp.asarray(start()))
        self.kernels = [Kernel() for _ in range(3)]
        self.last = self.param("last", not_negative, (NODE_UNITS + COLUMNS, 1))
        self.mapping = Linear(self.features)

    def prepare(self, words: jax.Array) -> GraphTable:
        """What depends on class names alone, from their word vectors [C, D]."""
        known = np.array(self.classes.known, np.int32)
        width = len(known) + words.shape[1]
        kernel = self.kernels[0](width, width)
        presence, of_words = kernel[: len(known)], kernel[len(known) :]
        nodes = Nodes(
            words=self.adjacency @ (words[known] @ of_words),
            presence=presence,
            degree=self.adjacency.sum(axis=1),
        )
        return GraphTable(make_table(words, self.classes.known), nodes)

    def __call__(self, table: GraphTable, rows: jax.Array) -> jax.Array:
        """The features [..., H] of the context [..., n, 5]."""
        count, width = table.nodes.words.shape
        more_nodes, more_units = -count % ROUND, -width % ROUND
        weights = Convolutions(
            words=jnp.pad(table.nodes.words, ((0, more_nodes), (0, more_units))),
            presence=jnp.pad(table.nodes.presence, ((0, more_nodes), (0, more_units))),
            degree=jnp.pad(table.nodes.degree, (0, more_nodes)),
            adjacency=jnp.pad(self.adjacency, (0, more_nodes)),
            second=jnp.pad(self.kernels[1](width, width), (0, more_units)),
            third=jnp.pad(self.kernels[2](width, NODE_UNITS), ((0, more_units), (0, 0))),
        )
        present = jnp.pad(rows[..., 0], ((0, 0),) * (rows.ndim - 2) + ((0, more_nodes),))
        found = recorded(
            self, "nodes", lambda: forward(jax.lax.stop_gradient(weights), present, self.dtype)
        )
        nodes = convolve(weights, present, self.dtype, found)[..., :count, :]
        joined = jnp.concatenate([nodes, rows], axis=-1) @ self.last.astype(jnp.float32)
        return self.mapping(nn.relu(joined[..., 0] @ self.adjacency.astype(jnp.float32).T))


class Layers(NamedTuple):
    """The first three convolutions of a batch, layer by layer."""

    first: jax.Array  # [n, B, h], behind A X W0 and ReLU
    mixed: jax.Array  # [n, B, h], first W1
    second: jax.Array  # [n, B, h], behind A mixed and ReLU
    lower: jax.Array  # [n, 5 B], second W2
    last: jax.Array  # [n, 5 B], A lower


def layers_of(weights: Convolutions, present: jax.Array, dtype: Any) -> Layers:
    """All layers of the presence [B, n], the large ones in `dtype`."""
    count = present.shape[-1]
    shared = present @ weights.presence  # [B, h]
    first = nn.relu(weights.degree[:, None, None] * shared + weights.words[:, None]).astype(dtype)
    mixed = product(first, weights.second, dtype).astype(dtype)
    second = product(weights.adjacency, mixed.reshape(count, -1), dtype).reshape(first.shape)
    second = nn.relu(second).astype(dtype)
    lower = product(second, weights.third, dtype).reshape(count, -1)
    return Layers(first, mixed, second, lower, weights.adjacency.astype(jnp.float32) @ lower)


def forward(weights: Convolutions, present: jax.Array, dtype: Any) -> jax.Array:
    """The first three convolutions of the presence [..., n]: [..., n, 5]."""
    *lead, count = present.shape
    last = nn.relu(layers_of(weights, present.reshape(-1, count), dtype).last)
    return last.reshape(count, -1, NODE_UNITS).swapaxes(0, 1).reshape(*lead, count, NODE_UNITS)


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def convolve(weights: Convolutions, present: jax.Array, dtype: Any, found: jax.Array) -> jax.Array:
    """`forward(weights, present, dtype)`, which has given `found`; present [B, n] or [T, B, n].

    The backward pass goes through one step at a time and computes its layers again, so that nothing
    but the results is kept: those of a rollout would fill the memory.
    """
    return found


def _convolve_fwd(
    weights: Convolutions, present: jax.Array, dtype: Any, found: jax.Array
) -> tuple[jax.Array, tuple[Convolutions, jax.Array]]:
    return found, (weights, present)


def _convolve_bwd(
    dtype: Any, saved: tuple[Convolutions, jax.Array], cotangent: jax.Array
) -> tuple[Convolutions, None, None]:
    weights, present = saved
    batch = present.shape[-2:]
    back = own_transpose(weights.adjacency, dtype), own_transpose(weights.second, dtype)

    def body(total: Convolutions, step: tuple) -> tuple[Convolutions, None]:
        present, cotangent = step
        found = gradient(weights, back, present, cotangent, dtype)
        return jax.tree.map(jnp.add, total, found), None

    zeros = jax.tree.map(lambda x: jnp.zeros(x.shape), weights)
    steps = present.reshape(-1, *batch), cotangent.reshape(-1, *batch, NODE_UNITS)
    total = jax.lax.scan(body, zeros, steps)[0]
    return jax.tree.map(lambda x, w: x.astype(w.dtype), total, weights), None, None


convolve.defvjp(_convolve_fwd, _convolve_bwd)


def gradient(
    weights: Convolutions,
    back: tuple[jax.Array, jax.Array],
    present: jax.Array,
    cotangent: jax.Array,
    dtype: Any,
) -> Convolutions:
    """The gradient of `forward` in its weights, of one step.

    Args:
      back: A and W1 transposed, as arrays of their own.
      present: [B, n].
      cotangent: [B, n, 5].
      dtype: operands of the large products.
    """
    count = present.shape[-1]
    at = layers_of(weights, present, dtype)
    width = at.first.shape[-1]
    shared = present @ weights.presence
    last = jnp.where(at.last > 0, cotangent.swapaxes(0, 1).reshape(count, -1), 0.0)
    lower = (weights.adjacency.astype(jnp.float32).T @ last).reshape(-1, NODE_UNITS)
    second = lower @ weights.third.astype(jnp.float32).T
    second = jnp.where(at.second.reshape(-1, width) > 0, second, 0.0).astype(dtype)
    second = second.reshape(count, -1)
    mixed = product(back[0], second, dtype).astype(dtype).reshape(-1, width)
    # The first layer transposed is made anew, unit by unit: large transposed operands are slow.
    turned = shared.T[:, None] * weights.degree[:, None] + weights.words.T[..., None]
    first = product(mixed, back[1], dtype).reshape(at.first.shape)
    first = jnp.where(at.first > 0, first, 0.0)
    of_shared = jnp.einsum("nbh,n->bh", first, weights.degree)
    adjacency = product(second, at.mixed.reshape(count, -1).T, dtype)
    return Convolutions(
        words=first.sum(axis=1),
        presence=present.T @ of_shared,
        degree=jnp.einsum("nbh,bh->n", first, shared),
        adjacency=adjacency + last @ at.lower.T,
        second=product(nn.relu(turned).astype(dtype).reshape(width, -1), mixed, dtype),
        third=at.second.reshape(-1, width).T.astype(jnp.float32) @ lower,
    )


class MjolnirOEncoder(Encoder):
    """MJOLNIR-o: the context of the known classes and the features of their graph.

    Attributes:
      classes: the vocabulary.
      features: units of the graph's features.
      dtype: operands of the large products.
    """

    classes: Classes
    features: int = 512
    dtype: Any = jnp.float32

    ROWS = "class"

    def setup(self) -> None:
        self.graph = GraphEncoder(self.classes, self.features, self.dtype)

    def prepare(self, words: jax.Array) -> GraphTable:
        """The graph's table, from word vectors [C, D]."""
        return self.graph.prepare(words)

    def __call__(
        self, table: GraphTable, obs: Observation, action: jax.Array, keep: jax.Array | None = None
    ) -> jax.Array:
        """The features of a batch of observations, [..., H + 5 n]."""
        rows = class_rows(table.rows, obs)
        context = rows.reshape(*obs.empty.shape, -1)
        return jnp.concatenate([self.graph(table, rows), context], axis=-1)

    def published_beside(self, width: int, inputs: int) -> dict[str, int]:
        """Frozen word vectors and a layer without use; the adjacency is trained, as published."""
        return published_beside(len(self.classes.known), width, inputs)


def make(config: NetworkConfig, classes: Classes, dtype: Any) -> ActorCritic:
    """MJOLNIR-o with a node per class that training may know."""
    encoder = MjolnirOEncoder(classes=classes, features=config.width, dtype=dtype)
    return ActorCritic(encoder, hidden=config.hidden, dtype=dtype)
