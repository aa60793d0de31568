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
from typing import Any

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
from tdanet_jax.models.layers import Linear, product, recall, recorded
from tdanet_jax.models.rows import COLUMNS, RowTable, class_rows, make_table, published_beside

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
    """What the first three convolutions are made of."""

    nodes: Nodes
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
        self.kernels = [Kernel() for _ in range(4)]
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
        width = table.nodes.words.shape[1]
        weights = Convolutions(
            nodes=table.nodes,
            adjacency=self.adjacency,
            second=self.kernels[1](width, width),
            third=self.kernels[2](width, NODE_UNITS),
        )
        present = rows[..., 0]
        function = functools.partial(convolve, self.dtype)
        nodes = recorded(self, "nodes", lambda: function(weights, present))
        if present.ndim == 3:  # a rollout
            nodes = recall(function, weights, present, nodes)
        last = self.kernels[3](NODE_UNITS + COLUMNS, 1)
        joined = jnp.concatenate([nodes, rows], axis=-1) @ last.astype(jnp.float32)
        return self.mapping(nn.relu(joined[..., 0] @ self.adjacency.astype(jnp.float32).T))


def convolve(dtype: Any, weights: Convolutions, present: jax.Array) -> jax.Array:
    """The first three convolutions of the presence [..., n]: [..., n, 5].

    Args:
      dtype: operands of the large products.
    """
    nodes, count = weights.nodes, present.shape[-1]
    lead, batch = present.shape[:-1], present.reshape(-1, count)
    shared = batch @ nodes.presence  # [B, h]
    x = nn.relu(nodes.degree[:, None, None] * shared + nodes.words[:, None])  # [n, B, h]
    x = product(x, weights.second, dtype)
    x = nn.relu(product(weights.adjacency, x.reshape(count, -1), dtype).reshape(x.shape))
    x = product(x, weights.third, dtype)  # [n, B, 5]
    x = nn.relu(weights.adjacency.astype(jnp.float32) @ x.reshape(count, -1))
    return x.reshape(count, -1, NODE_UNITS).swapaxes(0, 1).reshape(*lead, count, NODE_UNITS)


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
