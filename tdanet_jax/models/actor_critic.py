"""The recurrent actor-critic that every encoder plugs into: features -> LSTM -> policy, value."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from tdanet_jax.env import RASTER, Observation
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import LSTM, TAPE, Carry, Linear
from tdanet_jax.vocabulary import NUM_ACTIONS


class Output(NamedTuple):
    """What the network says about a batch of states."""

    logits: jax.Array  # [..., 6], unnormalised log-probabilities of the actions
    value: jax.Array  # [...], expected discounted return


class ActorCritic(nn.Module):
    """An encoder, the previous step's action probabilities, an LSTM, an actor and a critic.

    Attributes:
      encoder: the model's own part.
      hidden: units of the LSTM.
      action_width: units of the embedding of the previous action probabilities.
      dtype: operands of the LSTM's products.
    """

    encoder: Encoder
    hidden: int = 512
    action_width: int = 10
    dtype: Any = jnp.float32

    def setup(self) -> None:
        if self.encoder.ACTION != "plain":
            self.action_embedding = Linear(self.action_width)
        self.lstm = LSTM(self.hidden, self.dtype)
        small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
        self.actor = Linear(NUM_ACTIONS, kernel_init=small)
        self.critic = Linear(1)

    def prepare(self, words: jax.Array) -> Any:
        """What the encoder can say from word vectors [C, D] alone; once per parameter change."""
        return self.encoder.prepare(words)

    def __call__(
        self,
        table: Any,
        carry: Carry,
        obs: Observation,
        previous: jax.Array,
        fresh: jax.Array,
        keep: jax.Array | None = None,
    ) -> tuple[Carry, Output]:
        """One step for a batch [B], or a rollout [T, B].

        Args:
          table: from `prepare`.
          carry: recurrent state before the (first) step, each [B, H].
          obs: observations.
          previous: [..., 6] action probabilities of the previous step; zeros where fresh.
          fresh: [...] bool, True where an episode starts.
          keep: [..., units] bool, units that dropout keeps; None when not training.
        """
        action = previous
        if self.encoder.ACTION != "plain":
            action = nn.relu(self.action_embedding(previous))
        features = self.encoder(table, obs, action, keep)
        aside = action[..., :0] if self.encoder.ACTION == "inside" else action
        carry, hidden = self.lstm(carry, features, aside, fresh)
        return carry, Output(self.actor(hidden), self.critic(hidden)[..., 0])

    def attention(self, table: Any, obs: Observation) -> jax.Array | None:
        """The encoder's weights over the detections, [..., K]; None if it has none."""
        return self.encoder.attend(table, obs)

    def initial_carry(self, batch: int) -> Carry:
        """The recurrent state at the start of an episode: zeros."""
        return jnp.zeros((batch, self.hidden)), jnp.zeros((batch, self.hidden))

    def initialise(self, key: jax.Array, words: jax.Array) -> Any:
        """Fresh parameters for word vectors [C, D]."""

        def everything(module: ActorCritic) -> Output:
            blank = Observation(
                classes=jnp.zeros((1, 1), jnp.int32),
                boxes=jnp.zeros((1, 1, 3)),
                mask=jnp.zeros((1, 1), bool),
                target=jnp.zeros((1,), jnp.int32),
                empty=jnp.ones((1,), bool),
                cells=jnp.full((1, *RASTER), -1, jnp.int32) if self.encoder.IMAGE else None,
            )
            previous, fresh = jnp.zeros((1, NUM_ACTIONS)), jnp.ones((1,), bool)
            table = module.prepare(words)
            return module(table, module.initial_carry(1), blank, previous, fresh)[1]

        return nn.init(everything, self)(key)["params"]


def prepare(model: ActorCritic, weights: Any, words: jax.Array) -> Any:
    """The table of classes of these weights, from word vectors [C, D]."""
    return model.apply({"params": weights}, words, method="prepare")


def forward(
    model: ActorCritic,
    weights: Any,
    table: Any,
    carry: Carry,
    obs: Observation,
    previous: jax.Array,
    fresh: jax.Array,
    keep: jax.Array | None = None,
    tape: Any = None,
) -> tuple[Carry, Output]:
    """`ActorCritic.__call__` with these weights; with a `tape`, products are taken from there."""
    variables = {"params": weights} if tape is None else {"params": weights, TAPE: tape}
    out: Any = model.apply(variables, table, carry, obs, previous, fresh, keep)
    return out


def record(
    model: ActorCritic,
    weights: Any,
    table: Any,
    carry: Carry,
    obs: Observation,
    previous: jax.Array,
    fresh: jax.Array,
    keep: jax.Array | None = None,
) -> tuple[Carry, Output, Any]:
    """`forward` of one step, and the tape that it recorded."""
    arguments = (table, carry, obs, previous, fresh, keep)
    (after, out), variables = model.apply({"params": weights}, *arguments, mutable=[TAPE])
    return after, out, variables[TAPE]
