"""The interface that every model meets: detections and a target class in, features out.

A model is one file, here or anywhere that Python finds it. It defines an `Encoder` and a function
`make(config, classes, dtype) -> ActorCritic`. `--model` takes its dotted name; those in this folder
have short ones, in `tdanet_jax.config.MODELS`. The environment, the update, the evaluation and
every command then work with it.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, ClassVar, Literal

import jax
from flax import linen as nn

from tdanet_jax.env.dynamics import Observation


class Encoder(nn.Module, kw_only=True):
    """Base class of the encoders; the recurrent actor-critic around it is shared.

    Attributes:
      dropout: share of units that is dropped in training.
      maps: its image is ResNet-18's feature map, `Observation.features`, and not the raster.
      ROWS: the detections that it is made for: one row per "class", or None where the
        configuration decides.
      IMAGE: whether it looks at an image.
      ACTION: how the previous step's action probabilities enter. "embedded": through a layer of
        ten units, into the LSTM. "plain": as they are, into the LSTM. "inside": through the same
        layer, into the encoder alone.
      SHARED: names of its layers that no environment adapts for itself, where the network adapts
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
        """How many units of a frame dropout decides about."""
        return 0

    def prepare(self, words: jax.Array) -> Any:
        """Everything that depends on class names alone, from their word vectors [C', D].

        The first C rows are the classes of the scene tables; an agent on its own may add labels.
        Called once per parameter change.
        """
        raise NotImplementedError

    def __call__(
        self, table: Any, obs: Observation, action: jax.Array, keep: jax.Array | None = None
    ) -> jax.Array:
        """The features of a batch of observations.

        Args:
          table: from `prepare`, with the same parameters.
          obs: observations with leading axes [...].
          action: [..., 10], the embedded action probabilities of the previous step; only where
            `ACTION` is "inside".
          keep: [..., dropout_units] bool, which units dropout keeps; None when not training.

        Returns:
          [..., H] float32.
        """
        raise NotImplementedError

    def view(self, obs: Observation) -> Observation:
        """What of the observations the encoder uses, in shapes that are the same for all frames.

        It says the same of them as of the observations themselves. Only networks that remember
        frames ask for it (`tdanet_jax.models.shared.adaptation`).
        """
        raise NotImplementedError

    def attend(self, table: Any, obs: Observation) -> jax.Array | None:
        """Attention over the detections, [..., K]; None if the model has none."""
        return None

    def published_beside(self, width: int, inputs: int) -> Mapping[str, int]:
        """Parameters that the published code has beside these, by name; negative where it has less.

        Args:
          width: of the word vectors.
          inputs: of the LSTM.
        """
        return {}
