"""How many parameters a model has: those that are trained, and as its published code counts them.

The tables of the papers count in units of 2^20, and include everything that their code registers as
a parameter: also frozen word vectors and unused layers.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax

from tdanet_jax.config import TrainConfig
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.factory import make_model

#: The unit of the papers' tables.
UNIT = 2**20
#: Width of the published word vectors.
PUBLISHED_WIDTH = 300
#: Known classes of the published data: all of them, and those of split 18/4, which SSNet counts.
PUBLISHED_CLASSES, SSNET_CLASSES = 101, 97


@dataclasses.dataclass(frozen=True)
class Count:
    """The parameters of a network.

    Attributes:
      trained: all that an optimiser changes.
      extra: what the published code has in addition (fewer, if negative), by name.
    """

    trained: int
    extra: Mapping[str, int]

    @property
    def published(self) -> int:
        """The count of the published code."""
        return self.trained + sum(self.extra.values())


def count(model: ActorCritic, classes: int, width: int) -> Count:
    """The parameters of a network for a number of classes with word vectors of a `width`."""
    shapes = model.parameter_shapes(classes, width)
    trained = sum(leaf.size for leaf in jax.tree.leaves(shapes))
    rows = (w.shape[0] for name, w in shapes["lstm"].items() if name.startswith("kernel"))
    return Count(trained, model.encoder.published_extra(width, sum(rows) - model.hidden))


def as_published(name: str) -> Count:
    """The parameters of a named model at the published sizes: 300-d words, 101 or 97 classes."""
    number = SSNET_CLASSES if name == "ssnet" else PUBLISHED_CLASSES
    names = tuple(f"Class{i}" for i in range(number))
    model = make_model(TrainConfig(model=name), ClassVocabulary(names, tuple(range(number))))
    return count(model, number, PUBLISHED_WIDTH)
