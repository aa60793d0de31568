"""The image trunk of the models that are shown an image (Wortsman et al. 2019).

The published input is the feature map of a frozen ResNet-18, 512 x 7 x 7. If the rooms were
imported with it, that is the image (`maps`). Otherwise the image is the raster of the frame, the
class in each of 7 x 7 cells, and a cell's 512 features are its class's word vector, padded with
zeros; a cell without a class has zeros only. The convolution's weights for the padding would never
be used and are left out.

The published network follows: a 1 x 1 convolution to 64 channels, joined in every cell by an
embedding of the target (64) and of the previous action probabilities (10), and a second 1 x 1
convolution to 64 channels, each with a ReLU.

Two equal but cheaper forms are used; a test compares them with the published network. A cell's
features depend on its class alone, so they are computed once per class (`prepare`) and looked up. A
convolution of joined channels is the sum of the convolutions of its parts, and the parts that are
equal in every cell are computed once per frame.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.env.types import RASTER, Observation
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import Linear, look_up

#: Cells of an image.
CELLS = RASTER[0] * RASTER[1]
#: Channels of the convolutions and of the target's embedding.
CHANNELS = 64
#: Units of a frame that dropout acts on: the outputs of both convolutions.
DROPOUT_UNITS = 2 * CELLS * CHANNELS


class ImageTable(struct.PyTreeNode):
    """The products with word vectors, by class; the last row is a cell without a class."""

    words: jax.Array  # [C + 1, D], word vectors
    target: jax.Array  # [C, 64], embedding of the class as target, before ReLU
    # Of rasters alone:
    cell: jax.Array | None = None  # [C + 1, 64], a cell after the first convolution, before ReLU
    mixed: jax.Array | None = None  # [C + 1, 64], the second convolution's product with it


class ImageTrunk(nn.Module):
    """From an image, a target and the previous action to 49 x 64 features.

    Attributes:
      maps: the image is a feature map instead of the raster.
      dropout: share of units that is dropped in training, after each convolution.
      dtype: operands of the products.
    """

    maps: bool = False
    dropout: float = 0.0
    dtype: Any = jnp.float32

    def setup(self) -> None:
        init = nn.initializers.he_uniform()
        # The convolution of maps is a large product, that of words is not.
        dtype = self.dtype if self.maps else jnp.float32
        self.convolution = Linear(CHANNELS, dtype, kernel_init=init)
        self.target = Linear(CHANNELS, kernel_init=init)
        # The second convolution, split by its inputs: channels of the cell, target and action. Each
        # part begins with half the variance that a ReLU needs.
        fan_in = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")
        self.pointwise = Linear(CHANNELS, self.dtype, fan_in, use_bias=False)
        self.context = Linear(CHANNELS, kernel_init=fan_in)

    def prepare(self, words: jax.Array) -> ImageTable:
        """Everything that depends on class names alone, from their word vectors [C, D]."""
        padded, target = jnp.pad(words, ((0, 1), (0, 0))), self.target(words)
        if self.maps:
            return ImageTable(padded, target)
        cell = self.convolution(padded)
        return ImageTable(padded, target, cell, self.pointwise(nn.relu(cell)))

    def __call__(
        self,
        class_table: ImageTable,
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None,
    ) -> jax.Array:
        """Features [..., 3136] of a batch of observations with leading axes [...].

        Args:
          class_table: from `prepare`.
          obs: observations with `cells`, or with `features` if the image is a map.
          action: [..., 10], embedding of the previous action probabilities.
          dropout_mask: [..., DROPOUT_UNITS] bool, units that dropout keeps; None when not training.
        """
        lead = obs.target.shape
        target = look_up(class_table.target, obs.target)
        target = target + self.target.per_environment(class_table.words[obs.target])
        context = self.context(jnp.concatenate([nn.relu(target), action], axis=-1))[..., None, :]
        drops = dropout_mask is not None and self.dropout > 0
        if self.maps:
            assert obs.features is not None
            cells = self.convolution(obs.features)
        else:
            cell, mixed = class_table.cell, class_table.mixed
            assert obs.cells is not None
            assert cell is not None
            assert mixed is not None
            # The table's row of each cell, [..., 49]; -1 is the last.
            index = obs.cells.reshape(*lead, CELLS) % len(class_table.words)
            if not drops and not self.convolution.adapted:
                out = one_hot_look_up(mixed, index, self.dtype) + context
                return nn.relu(out).reshape(*lead, -1)
            cells = one_hot_look_up(cell, index, self.dtype)
            cells = cells + self.convolution.per_environment(class_table.words[index])
        cells = self._drop(nn.relu(cells), dropout_mask, 0)
        out = nn.relu(self.pointwise(cells) + context)
        return self._drop(out, dropout_mask, 1).reshape(*lead, -1)

    def _drop(self, x: jax.Array, dropout_mask: jax.Array | None, layer: int) -> jax.Array:
        """Dropout after one of the two convolutions, on [..., 49, 64]."""
        if dropout_mask is None or not self.dropout:
            return x
        mask = dropout_mask.reshape(*dropout_mask.shape[:-1], 2, CELLS, CHANNELS)
        return jnp.where(mask[..., layer, :, :], x / (1 - self.dropout), 0.0)


class ImageEncoder(Encoder, kw_only=True):
    """An encoder with an image trunk, which the previous action enters.

    Attributes:
      dropout: share of units that is dropped in training, in the trunk; published: 0.25.
      dtype: operands of the large products.
    """

    dtype: Any = jnp.float32

    IMAGE = True
    ACTION = "inside"

    def setup(self) -> None:
        self.trunk = ImageTrunk(self.maps, self.dropout, self.dtype)

    @property
    def dropout_units(self) -> int:
        """The units of the trunk."""
        return DROPOUT_UNITS


def only_image(obs: Observation, maps: bool) -> Observation:
    """The observations' image and target, with one blank row for detections."""
    return obs.replace(
        classes=jnp.zeros_like(obs.classes[..., :1]),
        boxes=jnp.zeros_like(obs.boxes[..., :1, :]),
        mask=jnp.zeros_like(obs.mask[..., :1]),
        cells=None if maps else obs.cells,
        features=obs.features if maps else None,
    )


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def one_hot_look_up(table: jax.Array, index: jax.Array, dtype: Any) -> jax.Array:
    """Rows of a table: [C, n] at index [...] -> [..., n].

    Its gradient is a product with one-hot rows, operands in `dtype`. With many more indices than
    rows this is faster than adding row by row.
    """
    return table[index]


def _one_hot_look_up_fwd(table: jax.Array, index: jax.Array, dtype: Any) -> tuple[jax.Array, tuple]:
    return one_hot_look_up(table, index, dtype), (index, jnp.arange(table.shape[0]))


def _one_hot_look_up_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple[jax.Array, None]:
    index, rows = saved
    width = cotangent.shape[-1]

    def add(total: jax.Array, part: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        index, cotangent = part
        chosen = (index.reshape(-1) == rows[:, None]).astype(dtype)
        values = cotangent.reshape(-1, width).astype(dtype)
        return total + jnp.dot(chosen, values, preferred_element_type=jnp.float32), None

    zeros = jnp.zeros((rows.shape[0], width))
    if index.ndim <= 2:  # a single step
        return add(zeros, (index, cotangent))[0], None
    # One step at a time: the one-hot rows of a whole rollout would not fit the processor's cache.
    return jax.lax.scan(add, zeros, (index, cotangent))[0], None


one_hot_look_up.defvjp(_one_hot_look_up_fwd, _one_hot_look_up_bwd)
