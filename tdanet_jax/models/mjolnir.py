"""MJOLNIR's encoders (Qiu et al. 2020): graph convolutions over the known classes.

Every known class is a node. A node's input is the presence of all classes in the frame, one entry
per class, and its own word vector; three graph convolutions turn it into five numbers, the node's
context (present, x, y, S, cosine to the target) is appended, a fourth makes one number of the ten,
and a linear layer maps those of all nodes to the features. The adjacency starts as the class graph
(`ClassVocabulary.edges`) and is trained, as in the published code.

MJOLNIR-o appends the context itself. MJOLNIR-r instead appends the baseline's features of the
image, which the previous action probabilities enter; its context enters through the graph alone.

The first three convolutions are those of `shared.graph_convolutions`: what the nodes share is the
presence, the sum of the first kernel's rows for the classes in the frame.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from tdanet_jax.config import NetworkConfig
from tdanet_jax.env.types import FEATURES, Observation
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import Linear, nonnegative_init
from tdanet_jax.models.shared import graph_convolutions
from tdanet_jax.models.shared.class_rows import (
    COLUMNS,
    RowTable,
    class_rows,
    make_row_table,
    only_rows,
    published_extra,
)
from tdanet_jax.models.shared.graph_convolutions import Convolutions
from tdanet_jax.models.shared.image import CHANNELS, ImageEncoder, ImageTable

#: Units of a node after the third convolution.
NODE_UNITS = 5
#: The names of the first three convolutions' kernels, which all environments share.
KERNELS = ("kernels_0", "kernels_1", "kernels_2")
#: Classes that ResNet-18 scores.
RESNET_CLASSES = 1000


class GraphTable(struct.PyTreeNode):
    """What the graph computes from word vectors alone, for n nodes with h = n + D units."""

    rows: RowTable
    words: jax.Array  # [n, h], word part of the first convolution, A E W0
    presence: jax.Array  # [n, h], rows of W0 for the presence of a class
    degree: jax.Array  # [n], row sums of A


class Kernel(nn.Module):
    """A matrix whose shape is known when it is used."""

    @nn.compact
    def __call__(self, rows: int, columns: int) -> jax.Array:
        """[rows, columns]."""
        return self.param("kernel", nn.initializers.he_uniform(), (rows, columns))


class GraphEncoder(nn.Module):
    """From presence and context of the known classes to a vector of features.

    Attributes:
      classes: the vocabulary; its known classes are the nodes.
      features: units of the result.
      dtype: operands of the large products.
    """

    classes: ClassVocabulary
    features: int = 512
    dtype: Any = jnp.float32

    def setup(self) -> None:
        start = self.classes.normalised_adjacency
        self.adjacency = self.param("adjacency", lambda _: jnp.asarray(start()))
        self.kernels = [Kernel() for _ in range(3)]
        self.last = self.param("last", nonnegative_init, (NODE_UNITS + COLUMNS, 1))
        self.mapping = Linear(self.features)

    def prepare(self, words: jax.Array) -> GraphTable:
        """Everything that depends on class names alone, from their word vectors [C, D]."""
        known = np.array(self.classes.known, np.int32)
        width = len(known) + words.shape[1]
        kernel = self.kernels[0](width, width)
        presence, of_words = kernel[: len(known)], kernel[len(known) :]
        return GraphTable(
            rows=make_row_table(words, self.classes.known),
            words=self.adjacency @ (words[known] @ of_words),
            presence=presence,
            degree=self.adjacency.sum(axis=1),
        )

    def __call__(self, class_table: GraphTable, rows: jax.Array) -> jax.Array:
        """The features [..., H] of the context [..., n, 5]."""
        width = class_table.words.shape[1]
        weights = Convolutions(
            words=class_table.words,
            degree=class_table.degree,
            adjacency=self.adjacency,
            second=self.kernels[1](width, width),
            third=self.kernels[2](width, NODE_UNITS),
        )
        present = rows[..., 0] @ class_table.presence
        nodes = graph_convolutions.apply(self, weights, present, self.dtype)
        joined = jnp.concatenate([nodes, rows], axis=-1) @ self.last.astype(jnp.float32)
        return self.mapping(nn.relu(joined[..., 0] @ self.adjacency.astype(jnp.float32).T))


class MjolnirOEncoder(Encoder):
    """MJOLNIR-o: the context of the known classes and the features of their graph.

    Attributes:
      classes: the vocabulary.
      features: units of the graph's features.
      dtype: operands of the large products.
    """

    classes: ClassVocabulary
    features: int = 512
    dtype: Any = jnp.float32

    ROWS = "class"
    SHARED = KERNELS

    def setup(self) -> None:
        self.graph = GraphEncoder(self.classes, self.features, self.dtype)

    def prepare(self, words: jax.Array) -> GraphTable:
        """The graph's table, from word vectors [C, D]."""
        return self.graph.prepare(words)

    def __call__(
        self,
        class_table: GraphTable,
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> jax.Array:
        """The features of a batch of observations, [..., H + 5 n]."""
        rows = class_rows(class_table.rows, obs)
        context = rows.reshape(*obs.empty.shape, -1)
        return jnp.concatenate([self.graph(class_table, rows), context], axis=-1)

    def published_extra(self, width: int, inputs: int) -> dict[str, int]:
        """Frozen word vectors and an unused layer; the adjacency is trained, as published."""
        return published_extra(len(self.classes.known), width, inputs)

    def view(self, obs: Observation) -> Observation:
        """The known classes and the target."""
        return only_rows(obs, self.classes.known)


class MjolnirREncoder(ImageEncoder):
    """MJOLNIR-r: the features of the image and of the graph.

    Attributes:
      classes: the vocabulary.
      features: units of the graph's features.
    """

    classes: ClassVocabulary
    features: int = 512

    ROWS = "class"

    def setup(self) -> None:
        super().setup()
        self.graph = GraphEncoder(self.classes, self.features, self.dtype)

    def prepare(self, words: jax.Array) -> tuple[ImageTable, GraphTable]:
        """The tables of trunk and graph, from word vectors [C, D]."""
        return self.trunk.prepare(words), self.graph.prepare(words)

    def __call__(
        self,
        class_table: tuple[ImageTable, GraphTable],
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> jax.Array:
        """The features of a batch of observations, [..., 3136 + H]."""
        image_table, graph_table = class_table
        image = self.trunk(image_table, obs, action, dropout_mask)
        graph = self.graph(graph_table, class_rows(graph_table.rows, obs))
        return jnp.concatenate([image, graph], axis=-1)

    def published_extra(self, width: int, inputs: int) -> dict[str, int]:
        """As MJOLNIR-o, and a layer of ResNet-18 and the channels of zeros."""
        channels = FEATURES[-1]
        return {
            **published_extra(len(self.classes.known), width, inputs),
            "ResNet-18's scores, unused": (channels + 1) * RESNET_CLASSES,
            "the convolution's zero channels": 0 if self.maps else (channels - width) * CHANNELS,
        }


def make(
    config: NetworkConfig, classes: ClassVocabulary, dtype: Any, image: bool = False
) -> ActorCritic:
    """MJOLNIR with a node per class that training may know: MJOLNIR-r with `image`, else -o."""
    if image:
        encoder: Encoder = MjolnirREncoder(
            classes=classes,
            features=config.width,
            dropout=config.dropout,
            maps=config.image == "features",
            dtype=dtype,
        )
    else:
        encoder = MjolnirOEncoder(classes=classes, features=config.width, dtype=dtype)
    return ActorCritic(encoder, hidden=config.hidden, dtype=dtype)
