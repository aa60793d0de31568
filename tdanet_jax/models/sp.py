"""Scene priors: the baseline with a graph convolution over classes (Yang et al. 2019).

As in the published code, a node of the class graph has two inputs: what the frame shows, the same
for all nodes, and its class's word vector. Three graph convolutions give one number per node, and a
linear layer of these joins the image's features. What the frame shows are a frozen ResNet's scores
of 1,000 classes there, and here which of the known classes the raster holds.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import linen as nn
from flax import struct

from tdanet_jax.config import NetworkConfig
from tdanet_jax.env.types import Observation
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.layers import Linear
from tdanet_jax.models.shared import graph_convolutions
from tdanet_jax.models.shared.graph_convolutions import Convolutions
from tdanet_jax.models.shared.image import ImageEncoder, ImageTable


def _mean_init(key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """A non-negative kernel that begins near the mean of its inputs.

    Inputs are non-negative, too, and do not cancel out: hundreds of them with the weights of
    `nonnegative_init` give twenty times as much, which saturates the LSTM.
    """
    return jax.random.uniform(key, shape, maxval=2.0 / shape[0])


class ScenePriorsTable(struct.PyTreeNode):
    """What the encoder computes from word vectors alone."""

    image: ImageTable
    nodes: jax.Array  # [n, width], the word vectors' part of the first graph convolution
    node: jax.Array  # [C + 1] int32, node of a class; n if it has none


class ScenePriorsEncoder(ImageEncoder):
    """The image trunk and the class graph.

    Attributes:
      known: the n classes that are nodes.
      adjacency: [n, n] as nested tuples, normalised.
      features: units of either part of a node's input, and of the graph's output.
      width: units of a node's hidden layers.
    """

    known: tuple[int, ...]
    adjacency: tuple[tuple[float, ...], ...]
    features: int = 512
    width: int = 1024

    def setup(self) -> None:
        super().setup()
        init = nn.initializers.he_uniform()
        self.seen = Linear(self.features)
        self.words = Linear(self.features)
        self.convolution_seen = Linear(self.width, kernel_init=init, use_bias=False)
        self.convolution_words = Linear(self.width, kernel_init=init, use_bias=False)
        self.kernel1 = self.param("kernel1", init, (self.width, self.width))
        self.kernel2 = self.param("kernel2", _mean_init, (self.width, 1))
        self.mapping = Linear(self.features)

    def prepare(self, words: jax.Array) -> ScenePriorsTable:
        """The trunk's table and the nodes' words, from word vectors [C, D]."""
        known = np.array(self.known)
        nodes = self.convolution_words(jnp.asarray(self.adjacency) @ self.words(words[known]))
        node = jnp.full(len(words) + 1, len(known)).at[known].set(jnp.arange(len(known)))
        return ScenePriorsTable(self.trunk.prepare(words), nodes, node)

    def __call__(
        self,
        class_table: ScenePriorsTable,
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> jax.Array:
        """The features of a batch of observations, [..., 3136 + features]."""
        assert obs.cells is not None
        image = self.trunk(class_table.image, obs, action, dropout_mask)
        nodes = class_table.node[obs.cells]  # a cell without a class, -1, has no node
        nodes = nodes.reshape(*obs.cells.shape[:-2], -1)
        seen = (nodes[..., None] == jnp.arange(len(self.known))).any(axis=-2)
        frame = self.convolution_seen(self.seen(seen.astype(jnp.float32)))  # [..., width]
        adjacency = jnp.asarray(self.adjacency)
        weights = Convolutions(
            words=class_table.nodes,
            degree=adjacency.sum(axis=1),
            adjacency=adjacency,
            second=self.kernel1,
            third=self.kernel2,
        )
        scores = graph_convolutions.apply(self, weights, frame, self.dtype)[..., 0]
        return jnp.concatenate([image, self.mapping(scores)], axis=-1)


def make(
    config: NetworkConfig, classes: ClassVocabulary, dtype: Any, width: int = 1024
) -> ActorCritic:
    """Scene priors, with `width` units in a node's hidden layers."""
    encoder = ScenePriorsEncoder(
        known=classes.known,
        adjacency=tuple(map(tuple, classes.normalised_adjacency().tolist())),
        features=config.width,
        width=width,
        dropout=config.dropout,
        maps=config.image == "features",
        dtype=dtype,
    )
    return ActorCritic(encoder, hidden=config.hidden, dtype=dtype)
