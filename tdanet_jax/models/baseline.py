"""The baseline: an image, the target's word vector and an LSTM (Wortsman et al. 2019).

It is the non-adaptive A3C of SAVN's paper, whose network SAVN adapts.
"""

from __future__ import annotations

from typing import Any

import jax

from tdanet_jax.config import NetworkConfig
from tdanet_jax.env.types import Observation
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.shared.image import ImageEncoder, ImageTable, only_image


class BaselineEncoder(ImageEncoder):
    """The image trunk alone."""

    def prepare(self, words: jax.Array) -> ImageTable:
        """The trunk's table, from word vectors [C, D]."""
        return self.trunk.prepare(words)

    def __call__(
        self,
        class_table: ImageTable,
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> jax.Array:
        """The features of a batch of observations, [..., 3136]."""
        return self.trunk(class_table, obs, action, dropout_mask)

    def view(self, obs: Observation) -> Observation:
        """The image and the target."""
        return only_image(obs, self.maps)


def make(config: NetworkConfig, classes: ClassVocabulary, dtype: Any) -> ActorCritic:
    """The baseline."""
    encoder = BaselineEncoder(dropout=config.dropout, maps=config.image == "features", dtype=dtype)
    return ActorCritic(encoder, hidden=config.hidden, dtype=dtype)
