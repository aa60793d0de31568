"""The baseline: an image, the target's word vector and an LSTM (Wortsman et al. 2019).

It is the non-adaptive A3C of SAVN's paper, whose network SAVN adapts.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax.config import NetworkConfig
from tdanet_jax.env.dynamics import Observation
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import Classes
from tdanet_jax.models.shared.image import ImageEncoder, ImageTable, ImageTrunk, image_alone


class BaselineEncoder(ImageEncoder):
    """The image trunk and nothing else.

    Attributes:
      dropout: share of units that is dropped in training; published: 0.25.
      dtype: operands of the large products.
    """

    dtype: Any = jnp.float32

    def setup(self) -> None:
        self.trunk = ImageTrunk(self.maps, self.dropout, self.dtype)

    def prepare(self, words: jax.Array) -> ImageTable:
        """The trunk's table, from word vectors [C, D]."""
        return self.trunk.prepare(words)

    def __call__(
        self, table: ImageTable, obs: Observation, action: jax.Array, keep: jax.Array | None = None
    ) -> jax.Array:
        """The features of a batch of observations, [..., 3136]."""
        return self.trunk(table, obs, action, keep)

    def view(self, obs: Observation) -> Observation:
        """The image and the target."""
        return image_alone(obs, self.maps)


def make(config: NetworkConfig, classes: Classes, dtype: Any) -> ActorCritic:
    """The baseline."""
    encoder = BaselineEncoder(dropout=config.dropout, maps=config.image == "features", dtype=dtype)
    return ActorCritic(encoder, hidden=config.hidden, dtype=dtype)
