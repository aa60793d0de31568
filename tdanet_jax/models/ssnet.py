"""SSNet's encoder (Zhao et al. 2023): self-attention over a row per known class.

A frame is a row per class that training may know: (present, x, y, S, cosine of the word vectors of
class and target). A single head of self-attention (Eq. 3) maps the rows to as many rows of five;
flattened, they are the LSTM's input, together with the previous action probabilities as they are.
Classes are told apart by the index of their row and by their cosine alone, so what the network
learns of a target it learns through the cosines: that is how it finds unseen targets.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.config import NetworkConfig
from tdanet_jax.env.types import Observation
from tdanet_jax.models.activation_cache import cached
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.shared.class_rows import (
    COLUMNS,
    RowTable,
    class_rows,
    make_row_table,
    published_extra,
)
from tdanet_jax.vocabulary import NUM_ACTIONS

#: W_Q and W_K start as the identity times SHARP, W_V as the identity times LARGE, each with noise.
#: From torch's small random start a row's attention is even over a hundred rows, all outputs are
#: alike, and a million steps teach nothing; from a sharp start, rows attend to similar rows.
SHARP, LARGE, NOISE = 6.0, 4.0, 0.1
#: Columns i <= j of the products of two columns of a row.
PAIRS = np.triu_indices(COLUMNS)


class SSNetEncoder(Encoder):
    """From detections per class and a target class to 5 n features.

    Attributes:
      known: the n classes that have a row.
    """

    known: tuple[int, ...]

    ROWS = "class"
    ACTION = "plain"

    def setup(self) -> None:
        def matrix(name: str, scale: float) -> jax.Array:
            return self.param(name, lambda key: near_identity(key, scale))

        self.query, self.key = matrix("query", SHARP), matrix("key", SHARP)
        self.value = matrix("value", LARGE)

    def prepare(self, words: jax.Array) -> RowTable:
        """Rows and cosines, from word vectors [C, D]."""
        return make_row_table(words, self.known)

    def __call__(
        self,
        class_table: RowTable,
        obs: Observation,
        action: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> jax.Array:
        """The features of a batch of observations, [..., 5 n]."""
        rows = class_rows(class_table, obs)
        mixing = self.query @ self.key.T
        found = cached(self, "moments", lambda: moments(jax.lax.stop_gradient(mixing), rows))
        out = attend(mixing, rows, found) @ self.value
        return out.reshape(*obs.empty.shape, -1)

    def published_extra(self, width: int, inputs: int) -> dict[str, int]:
        """Frozen word vectors, and two unused layers."""
        embedding = (NUM_ACTIONS + 1) * 10
        return {
            **published_extra(len(self.known), width, inputs),
            "an embedding of actions, unused": embedding,
        }


def near_identity(key: jax.Array, scale: float) -> jax.Array:
    """The identity matrix [5, 5], scaled, with noise."""
    return scale * jnp.eye(COLUMNS) + NOISE * jax.random.normal(key, (COLUMNS, COLUMNS))


def moments(mixing: jax.Array, rows: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Mean and covariance of the rows under each row's attention weights.

    The weights of row i are softmax_j(r_i W_Q W_K^T r_j), without scaling.

    Args:
      mixing: [5, 5], W_Q W_K^T.
      rows: [..., n, 5].

    Returns:
      [..., n, 5] and the 15 entries on and above the diagonal, [..., n, 15].
    """
    left, right = PAIRS
    logits = jnp.einsum("...ic,...jc->...ij", rows @ mixing, rows)
    weights = jnp.exp(logits - logits.max(axis=-1, keepdims=True))
    ones = jnp.ones_like(rows[..., :1])
    columns = jnp.concatenate([ones, rows, rows[..., left] * rows[..., right]], axis=-1)
    sums = jnp.einsum("...ij,...jc->...ic", weights, columns)
    mean, square = jnp.split(sums[..., 1:] / sums[..., :1], [COLUMNS], axis=-1)
    return mean, square - mean[..., left] * mean[..., right]


@jax.custom_vjp
def attend(mixing: jax.Array, rows: jax.Array, found: tuple[jax.Array, jax.Array]) -> jax.Array:
    """The mean of the rows under each row's attention, [..., n, 5], given `found` from `moments`.

    The derivative of a softmax is a covariance: the mean of row i changes by its covariance times
    the change of r_i W_Q W_K^T. So the backward pass needs no weights of pairs of rows.
    """
    return found[0]


def _attend_fwd(
    mixing: jax.Array, rows: jax.Array, found: tuple[jax.Array, jax.Array]
) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
    return found[0], (rows, found[1])


def _attend_bwd(
    saved: tuple[jax.Array, jax.Array], cotangent: jax.Array
) -> tuple[jax.Array, None, None]:
    rows, upper = saved
    square = np.zeros((COLUMNS, COLUMNS), np.int32)
    square[PAIRS] = square.T[PAIRS] = np.arange(len(PAIRS[0]))
    change = jnp.einsum("...cd,...d->...c", upper[..., square], cotangent)
    return rows.reshape(-1, COLUMNS).T @ change.reshape(-1, COLUMNS), None, None


attend.defvjp(_attend_fwd, _attend_bwd)


def make(config: NetworkConfig, classes: ClassVocabulary, dtype: Any) -> ActorCritic:
    """SSNet with a row per class that training may know."""
    return ActorCritic(SSNetEncoder(known=classes.known), hidden=config.hidden, dtype=dtype)
