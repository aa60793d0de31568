"""A row per known class: what models with a fixed set of classes see of a frame.

As in MJOLNIR (Qiu et al. 2020, the "context vector") and SSNet (Zhao et al. 2023) a row is
(present, x, y, S, cosine of the class's word vector and the target's). A class that is not in view
has zeros before the cosine. Objects of other classes are not seen.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from tdanet_jax.env.types import Observation
from tdanet_jax.vocabulary import NUM_ACTIONS

#: present, x, y, S, cosine.
COLUMNS = 5


class RowTable(struct.PyTreeNode):
    """The row of each class, and the similarity of the rows' classes to a target."""

    row: jax.Array  # [C] int32, the class's row; n if it has none
    cosine: jax.Array  # [C, n], of a target's word vector and each row's; 0 without a word vector


def make_row_table(words: jax.Array, known: tuple[int, ...]) -> RowTable:
    """The table of word vectors [C, D]; the n classes in `known` have the rows."""
    row = np.full(words.shape[0], len(known), np.int32)
    row[list(known)] = np.arange(len(known))
    length = jnp.linalg.norm(words, axis=-1, keepdims=True)
    unit = words / jnp.where(length > 0, length, 1.0)
    return RowTable(jnp.asarray(row), unit @ unit[np.array(known, np.int32)].T)


def class_rows(class_table: RowTable, obs: Observation) -> jax.Array:
    """The rows of a batch of observations with one detection per class: [..., n, 5]."""
    lead, slots = obs.empty.shape, obs.mask.shape[-1]
    n = class_table.cosine.shape[1]
    row = jnp.where(obs.mask, class_table.row[obs.classes], n).reshape(-1, slots)
    seen = jnp.pad(obs.boxes, ((0, 0),) * len(lead) + ((0, 0), (1, 0)), constant_values=1.0)
    frame = jnp.arange(row.shape[0])[:, None]
    blank = jnp.zeros((row.shape[0], n, COLUMNS - 1), obs.boxes.dtype)
    boxes = blank.at[frame, row].set(seen.reshape(-1, slots, COLUMNS - 1), mode="drop")
    cosine = class_table.cosine[obs.target][..., None]
    return jnp.concatenate([boxes.reshape(*lead, n, COLUMNS - 1), cosine], axis=-1)


def only_rows(obs: Observation, known: tuple[int, ...]) -> Observation:
    """The observations' target and a slot per known class, of one detection per class.

    A class has its slot whether it is in view or not, so that all frames have equal shapes.
    """
    classes = jnp.array(known, jnp.int32)
    here = obs.mask[..., None, :] & (obs.classes[..., None, :] == classes[:, None])  # [..., n, K]
    return obs.replace(
        classes=jnp.broadcast_to(classes, here.shape[:-1]),
        boxes=jnp.where(here[..., None], obs.boxes[..., None, :, :], 0.0).sum(axis=-2),
        mask=here.any(axis=-1),
        cells=None,
        features=None,
    )


def published_extra(classes: int, width: int, inputs: int) -> dict[str, int]:
    """Parameters that the published code of MJOLNIR and SSNet has in addition.

    Args:
      classes: n.
      width: of the word vectors.
      inputs: of the LSTM.
    """
    return {
        "word vectors, frozen": classes * width,
        "a layer for pairs of states, unused": (2 * inputs + 1) * NUM_ACTIONS,
    }
