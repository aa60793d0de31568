"""What else is in view: all detections of a frame, pooled, and the name of the target.

TDANet's attention shows the LSTM one mixture of the detections, compared with the target. From that
it can hardly tell where in the room it is, or what it looks for while that is out of view. This
branch tells it both, from the same inputs. Not in the paper.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.env.types import Observation
from tdanet_jax.models.layers import Linear, by_part, look_up
from tdanet_jax.models.pooling import RowTable, maximum_and_sum


class ContextTable(struct.PyTreeNode):
    """The products with word vectors, by class."""

    detections: RowTable  # of U units
    targets: jax.Array  # [C, U // 2], of the target's name, after its ReLU


class SceneContext(nn.Module):
    """From detections and a target class to 2 U + U // 2 features.

    A layer of U units with ReLU sees each detection; its maximum and its mean over the frame are
    the first 2 U features, 0 in a frame without detections. A layer of U // 2 units with ReLU sees
    the target's name.

    Attributes:
      units: U.
      columns: F, numbers of each detection: 3, or 4 with scores.
    """

    units: int
    columns: int = 3

    def setup(self) -> None:
        self.detection = Linear(self.units)
        self.target = Linear(self.units // 2)

    def prepare(self, words: jax.Array) -> ContextTable:
        """What depends on class names alone, from their word vectors [C, D]."""
        names, boxes = by_part(self.detection, words, self.columns)
        return ContextTable(RowTable(names, boxes), targets=nn.relu(self.target(words)))

    def __call__(self, table: ContextTable, obs: Observation) -> jax.Array:
        """The features of a batch of observations, [..., 2 U + U // 2]."""
        most, total = maximum_and_sum(table.detections, obs)
        mean = total / jnp.maximum(obs.mask.sum(-1, keepdims=True), 1)
        return jnp.concatenate([most, mean, look_up(table.targets, obs.target)], axis=-1)
