"""The image trunk of the models that look at an image (Wortsman et al. 2019).

The published input is a frozen network's: ResNet-18's feature map of the frame, 512 x 7 x 7. Where
the rooms were imported with it, that is the image (`maps`). Elsewhere the image is the raster of
the frame, the class in each of 7 x 7 cells, and a cell's 512 features are its class's word vector,
padded with zeros; all of them are zero in a cell without a class. The convolution's weights for the
padding would never be used and are left out.

Behind it stands the published network: a 1 x 1 convolution to 64 channels, joined in every cell by
an embedding of the target (64) and of the previous action probabilities (10), and a second 1 x 1
convolution to 64 channels. ReLU follows each.

Two equal, cheaper forms are used; a test holds them equal to the printed one. A cell's features
depend on its class alone, so they are taken once per class (`prepare`) and looked up. A convolution
of joined channels is the sum of the convolutions of its parts, and the parts that are the same in
every cell are taken once per frame.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.env.dynamics import RASTER, Observation
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import Linear, look_up

#: Cells of an image.
CELLS = RASTER[0] * RASTER[1]
#: Channels of the convolutions and of the target's embedding.
CHANNELS = 64
#: Units of a frame that dropout decides about: the outputs of both convolutions.
DROPOUT_UNITS = 2 * CELLS * CHANNELS


class ImageTable(struct.PyTreeNode):
    """What is known of a class before any frame is seen; the last row is a cell without a class."""

    words: jax.Array  # [C + 1, D], word vectors
    target: jax.Array  # [C, 64], embedding of the class as target, before ReLU
    # Of rasters alone:
    cell: jax.Array | None = None  # [C + 1, 64], a cell behind the first convolution, before ReLU
    mixed: jax.Array | None = None  # [C + 1, 64], the second convolution's product with it


class ImageTrunk(nn.Module):
    """An image, a target and the previous action in, 49 x 64 features out.

    Attributes:
      maps: the image is a feature map, and not the raster.
      dropout: share of units that is dropped in training, behind each convolution.
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
        # part starts with half the variance that ReLU asks for.
        fan_in = nn.initializers.variance_scaling(1.0, "fan_in", "uniform")
        self.pointwise = Linear(CHANNELS, self.dtype, fan_in, use_bias=False)
        self.context = Linear(CHANNELS, kernel_init=fan_in)

    def prepare(self, words: jax.Array) -> ImageTable:
        """What depends on class names alone, from their word vectors [C, D]."""
        padded, target = jnp.pad(words, ((0, 1), (0, 0))), self.target(words)
        if self.maps:
            return ImageTable(padded, target)
        cell = self.convolution(padded)
        return ImageTable(padded, target, cell, self.pointwise(nn.relu(cell)))

    def __call__(
        self, table: ImageTable, obs: Observation, action: jax.Array, keep: jax.Array | None
    ) -> jax.Array:
        """Features [..., 3136] of a batch of observations with leading axes [...].

        Args:
          table: from `prepare`.
          obs: observations with `cells`, or `features` of maps.
          action: [..., 10], embedding of the previous action probabilities.
          keep: [..., DROPOUT_UNITS] bool, units that dropout keeps; None when not training.
        """
        lead = obs.target.shape
        target = look_up(table.target, obs.target) + self.target.own(table.words[obs.target])
        context = self.context(jnp.concatenate([nn.relu(target), action], axis=-1))[..., None, :]
        drops = keep is not None and self.dropout > 0
        if not self.maps and not drops and not self.convolution.adapted:
            return nn.relu(self._look(table, obs, table.mixed) + context).reshape(*lead, -1)
        if self.maps:
            assert obs.features is not None
            cells = self.convolution(obs.features)
        else:
            words = table.words[self._index(table, obs)]
            cells = self._look(table, obs, table.cell) + self.convolution.own(words)
        cells = self._drop(nn.relu(cells), keep, 0)
        out = nn.relu(self.pointwise(cells) + context)
        return self._drop(out, keep, 1).reshape(*lead, -1)

    def _index(self, table: ImageTable, obs: Observation) -> jax.Array:
        """The table's row of each cell, [..., 49]; -1 is the last."""
        assert obs.cells is not None
        return obs.cells.reshape(*obs.target.shape, CELLS) % len(table.words)

    def _look(self, table: ImageTable, obs: Observation, rows: jax.Array | None) -> jax.Array:
        """What the table says of each cell, [..., 49, 64]."""
        assert rows is not None
        return lookup(rows, self._index(table, obs), self.dtype)

    def _drop(self, x: jax.Array, keep: jax.Array | None, layer: int) -> jax.Array:
        """Dropout behind one of the two convolutions, on [..., 49, 64]."""
        if keep is None or not self.dropout:
            return x
        kept = keep.reshape(*keep.shape[:-1], 2, CELLS, CHANNELS)[..., layer, :, :]
        return jnp.where(kept, x / (1 - self.dropout), 0.0)


class ImageEncoder(Encoder):
    """An encoder with an image trunk, into which the previous action goes."""

    IMAGE = True
    ACTION = "inside"

    @property
    def dropout_units(self) -> int:
        """The units of the trunk."""
        return DROPOUT_UNITS


def image_alone(obs: Observation, maps: bool) -> Observation:
    """The observations' image and target, with one blank row for detections."""
    return obs.replace(
        classes=jnp.zeros_like(obs.classes[..., :1]),
        boxes=jnp.zeros_like(obs.boxes[..., :1, :]),
        mask=jnp.zeros_like(obs.mask[..., :1]),
        cells=None if maps else obs.cells,
        features=obs.features if maps else None,
    )


@functools.partial(jax.custom_vjp, nondiff_argnums=(2,))
def lookup(table: jax.Array, index: jax.Array, dtype: Any) -> jax.Array:
    """Rows of a table: [C, n] at index [...] -> [..., n].

    Its gradient is a product with one-hot rows, operands in `dtype`, which is faster than adding
    row by row where there are many more indices than rows.
    """
    return table[index]


def _lookup_fwd(table: jax.Array, index: jax.Array, dtype: Any) -> tuple[jax.Array, tuple]:
    return lookup(table, index, dtype), (index, jnp.arange(table.shape[0]))


def _lookup_bwd(dtype: Any, saved: tuple, cotangent: jax.Array) -> tuple[jax.Array, None]:
    index, rows = saved
    width = cotangent.shape[-1]

    def add(total: jax.Array, part: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, None]:
        index, cotangent = part
        chosen = (index.reshape(-1) == rows[:, None]).astype(dtype)
        values = cotangent.reshape(-1, width).astype(dtype)
        return total + jnp.dot(chosen, values, preferred_element_type=jnp.float32), None

    nothing = jnp.zeros((rows.shape[0], width))
    if index.ndim <= 2:  # a single step
        return add(nothing, (index, cotangent))[0], None
    # One step at a time: the one-hot rows of a whole rollout would not fit the processor's cache.
    return jax.lax.scan(add, nothing, (index, cotangent))[0], None


lookup.defvjp(_lookup_fwd, _lookup_bwd)
