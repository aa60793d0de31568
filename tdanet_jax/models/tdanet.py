"""TDANet's encoder (Lian and Zhang 2024): target attention and a Siamese comparison.

Target attention (TA): the target and every detection go through one linear map W_L; the logits are
inner products (Eq. 1), the weights their masked softmax (Eq. 2), and V_L1 = V_att M_L1. Siamese
architecture (SA): the same layers on the attended detection and on the target, and the absolute
difference of the two.

Three equal but cheaper forms are used; a test compares them with the printed ones. All class names
are known in training, so the products of word vectors are computed once per update for all classes
(`prepare`) and looked up per detection. No ReLU comes between Linear1 and V_L1 = V_att M_L1, so
detections are pooled before they are projected. The target's branch is equal for all frames.
"""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.config import NetworkConfig
from tdanet_jax.env.types import Observation
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.context import ContextTable, SceneContext
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import Linear, by_part, look_up, look_up_in_rows

#: Centre, area and score in the target's row, before its word vector.
TARGET_BOX = (0.5, 0.5, 0.25, 1.0)


class ClassTable(struct.PyTreeNode):
    """The products with word vectors, by class. First axis C_t: the class as target."""

    words: jax.Array  # [C, D], word vector of each class
    class_logits: jax.Array  # [C_t, C], attention logit of a class's word vector
    box_logits: jax.Array  # [C_t, F], attention logit of a unit of x, y, S and the score
    reference: jax.Array  # [C_t, H], the target's branch of the Siamese comparison
    context: ContextTable | None = None


class TDANetEncoder(Encoder):
    """From detections and a target class to H features, and those of the context.

    Attributes:
      width: H, units of every layer.
      dropout: share of the absolute difference that is dropped in training; 0.25 in the reference
        code.
      target_attention: False replaces TA by the mean of the detections (the paper's Table IV).
      siamese: False replaces SA by the attended feature alone (Table IV). With neither, nothing
        would depend on the target, so its word vector is appended to the features.
      dtype: operands of the products; parameters and sums stay float32.
      columns: F, numbers of each detection: 3, or 4 with scores.
      context: units of the `SceneContext`, whose features are appended; 0 as in the paper.
    """

    width: int = 512
    target_attention: bool = True
    siamese: bool = True
    dtype: Any = jnp.float32
    columns: int = 3
    context: int = 0

    @property
    def dropout_units(self) -> int:
        """H: dropout acts on the absolute difference."""
        return self.width

    def setup(self) -> None:
        def linear() -> Linear:
            return Linear(self.width, self.dtype, nn.initializers.he_uniform())

        if self.target_attention:
            self.attention = Linear(self.width)
        if self.context:
            self.scene_context = SceneContext(self.context, self.columns)
        self.linear1, self.linear2, self.linear3, self.linear4 = (linear() for _ in range(4))

    def prepare(self, words: jax.Array) -> ClassTable:
        """Everything that depends on class names alone, from their word vectors [C, D]."""
        chex.assert_rank(words, 2)
        count, columns = words.shape[0], self.columns
        box = jnp.broadcast_to(jnp.asarray(TARGET_BOX[:columns], words.dtype), (count, columns))
        targets = jnp.concatenate([box, words], axis=-1)  # [C, F + D]
        class_logits, box_logits = jnp.zeros((count, count)), jnp.zeros((count, columns))
        if self.target_attention:
            queries = self.attention(targets)  # [C, H]
            # W_L of a row is the sum over its parts, and so are the logits.
            names, units = by_part(self.attention, words, columns)
            class_logits, box_logits = queries @ names.T, queries @ units.T
        context = self.scene_context.prepare(words) if self.context else None
        return ClassTable(words, class_logits, box_logits, self.branch(targets), context)

    def branch(self, rows: jax.Array) -> jax.Array:
        """Linear1 and Linear2, shared by the attended detection and the target."""
        return nn.relu(self.linear2(nn.relu(self.linear1(rows))))

    def attend(self, class_table: ClassTable, obs: Observation) -> jax.Array:
        """Attention over the detections (Eq. 2): [..., K], 0 in padding, summing to 1.

        In a frame without detections the first row, all zero, has weight 1.
        """
        first = jnp.arange(obs.mask.shape[-1]) == 0
        mask = obs.mask | (obs.empty[..., None] & first)
        if not self.target_attention:
            return mask / mask.sum(-1, keepdims=True)
        logits = look_up_in_rows(class_table.class_logits, obs.target, obs.classes)
        units = look_up(class_table.box_logits, obs.target)
        logits += jnp.einsum("...i,...ki->...k", units, obs.boxes)
        self.sow("intermediates", "correspondence", logits)
        return nn.softmax(logits, axis=-1, where=mask)

    def __call__(
        self,
        class_table: ClassTable,
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> jax.Array:
        """The features of a batch of observations, [..., H], and those of the context."""
        weights = self.attend(class_table, obs)
        chex.assert_equal_shape([weights, obs.mask, obs.classes])
        # The all-zero row of an empty frame has no word vector.
        word_weights = jnp.where(obs.mask, weights, 0.0)
        boxes = jnp.einsum("...k,...ki->...i", weights, obs.boxes)
        names = pool(word_weights, obs.classes, class_table.words)
        features = self.branch(jnp.concatenate([boxes, names], axis=-1))
        if self.siamese:
            features = jnp.abs(features - look_up(class_table.reference, obs.target))
            self.sow("intermediates", "difference", features)
        if dropout_mask is not None and self.dropout > 0:
            features = jnp.where(dropout_mask, features / (1 - self.dropout), 0.0)
        if not self.siamese and not self.target_attention:
            features = jnp.concatenate([features, class_table.words[obs.target]], axis=-1)
        features = nn.relu(self.linear4(nn.relu(self.linear3(features))))
        if class_table.context is None:
            return features
        seen = self.scene_context(class_table.context, obs)
        return jnp.concatenate([features, seen], axis=-1)


def make(
    config: NetworkConfig,
    classes: ClassVocabulary,
    dtype: Any,
    target_attention: bool = True,
    siamese: bool = True,
) -> ActorCritic:
    """TDANet, or one of its ablations."""
    encoder = TDANetEncoder(
        dropout=config.dropout,
        width=config.width,
        target_attention=target_attention,
        siamese=siamese,
        dtype=dtype,
        columns=config.spec.columns,
        context=config.context,
    )
    return ActorCritic(encoder, hidden=config.hidden, dtype=dtype)


def pool(weights: jax.Array, classes: jax.Array, words: jax.Array) -> jax.Array:
    """The weighted sum of the word vectors of the detections' classes.

    Args:
      weights: [..., K].
      classes: [..., K] int32.
      words: [C, D].

    Returns:
      [..., D].
    """
    return jnp.einsum("...k,...kd->...d", weights, words[classes])
