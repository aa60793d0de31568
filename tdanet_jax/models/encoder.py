"""The interface that every model meets: detections and a target class in, features out.

A model is one file, here or anywhere that Python finds it. It defines an `Encoder` and a function
`make(config, classes, dtype) -> ActorCritic`. `--model` takes its dotted name; those in this folder
have short ones, in `tdanet_jax.registry.MODELS`. The environment, the update, the evaluation
and every command then work with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import jax
from flax import linen as nn

from tdanet_jax.env.types import Observation


class Encoder(nn.Module, kw_only=True):
    """Base class of the encoders; the recurrent actor-critic around it is shared.

    Attributes:
      dropout: share of units that is dropped in training.
      maps: its image is ResNet-18's feature map, `Observation.features`, instead of the raster.
      ROWS: the detections that it is made for: one row per "class", or None if the configuration
        decides.
      IMAGE: whether it is shown an image.
      ACTION: where the previous step's action probabilities enter. "embedded": into the LSTM,
        through a layer of ten units. "plain": into the LSTM as they are. "inside": into the encoder
        alone, through the same layer.
      SHARED: names of its layers that are shared by all environments in networks that adapt
        (`tdanet_jax.models.shared.adaptation`).
    """

    dropout: float = 0.0
    maps: bool = False

    ROWS: ClassVar[Literal["class"] | None] = None
    IMAGE: ClassVar[bool] = False
    ACTION: ClassVar[Literal["embedded", "plain", "inside"]] = "embedded"
    SHARED: ClassVar[tuple[str, ...]] = ()

    @property
    def dropout_units(self) -> int:
        """How many units of a frame dropout acts on."""
        return 0

    def prepare(self, words: jax.Array) -> Any:
        """Everything that depends on class names alone, from their word vectors [C', D].

        The first C rows are the classes of the scene tables; an agent on its own may add labels.
        Called once per parameter change.
        """
        raise NotImplementedError

    def __call__(
        self,
        class_table: Any,
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> jax.Array:
        """The features of a batch of observations.

        Args:
          class_table: from `prepare`, with the same parameters.
          obs: observations with leading axes [...].
          action: [..., 10], the embedded action probabilities of the previous step; only where
            `ACTION` is "inside".
          dropout_mask: [..., dropout_units] bool, the units that dropout keeps; None when not
            training.

        Returns:
          [..., H] float32.
        """
        raise NotImplementedError

    def view(self, obs: Observation) -> Observation:
        """The part of the observations that the encoder uses, in shapes equal for all frames.

        The encoder gives equal features for `view(obs)` and `obs`. Only networks that store frames
        need it (`tdanet_jax.models.shared.adaptation`).
        """
        raise NotImplementedError

    def attend(self, class_table: Any, obs: Observation) -> jax.Array | None:
        """Attention over the detections, [..., K]; None if the model has none."""
        return None

    def published_extra(self, width: int, inputs: int) -> Mapping[str, int]:
        """Parameters that the published code has in addition, by name; negative where it has fewer.

        Args:
          width: of the word vectors.
          inputs: of the LSTM.
        """
        return {}
