"""The recurrent actor-critic that every encoder plugs into: features -> LSTM -> policy, value."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from tdanet_jax.env.dynamics import FEATURES, RASTER, Observation
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import LSTM, TAPE, Carry, Linear
from tdanet_jax.sensors.odometry import numbers, sensed_at_start
from tdanet_jax.vocabulary import NUM_ACTIONS

#: Units of the layer that reads the odometry.
ODOMETRY_UNITS = 64


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
      odometry: whether the agent senses its own way (`Observation.odometry`), which a layer of
        `ODOMETRY_UNITS` then adds to the features. Not the paper's.
      triangulation: whether it senses its target's place, too (`Odometry.target`).
    """

    encoder: Encoder
    hidden: int = 512
    action_width: int = 10
    dtype: Any = jnp.float32
    odometry: bool = False
    triangulation: bool = False

    def setup(self) -> None:
        if self.triangulation and not self.odometry:
            raise ValueError("a network that senses its target's place senses its way, too")
        if self.odometry:
            self.way = Linear(ODOMETRY_UNITS)
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
        features, aside = self.perceive(table, obs, previous, keep)
        carry, hidden = self.lstm(carry, features, aside, fresh)
        return carry, self.decide(hidden)

    def perceive(
        self, table: Any, obs: Observation, previous: jax.Array, keep: jax.Array | None
    ) -> tuple[jax.Array, jax.Array]:
        """The inputs of the LSTM: features [..., n], and the few `aside` [..., m]."""
        action = previous
        if self.encoder.ACTION != "plain":
            action = nn.relu(self.action_embedding(previous))
        features = self.encoder(table, obs, action, keep)
        if self.odometry:
            if obs.odometry is None:
                raise ValueError("the network senses its way, and the observations do not hold it")
            way = nn.relu(self.way(numbers(obs.odometry)))
            features = jnp.concatenate([features, way], axis=-1)
        return features, action[..., :0] if self.encoder.ACTION == "inside" else action

    def decide(self, hidden: jax.Array) -> Output:
        """Policy and value, from hidden states [..., H]."""
        return Output(self.actor(hidden), self.critic(hidden)[..., 0])

    def attention(self, table: Any, obs: Observation) -> jax.Array | None:
        """The encoder's weights over the detections, [..., K]; None if it has none."""
        return self.encoder.attend(table, obs)

    def initial_carry(self, batch: int, weights: Any, training: bool = False) -> Any:
        """The recurrent state at the start of an episode: zeros.

        Args:
          batch: B.
          weights: the parameters; only networks that adapt need them.
          training: whether units will be dropped.
        """
        return jnp.zeros((batch, self.hidden)), jnp.zeros((batch, self.hidden))

    def begin_rollout(self, carry: Any) -> Any:
        """The recurrent state that a rollout begins with, from that behind the one before."""
        return carry

    def blank(self, batch: int) -> Observation:
        """Observations of nothing."""
        return Observation(
            classes=jnp.zeros((batch, 1), jnp.int32),
            boxes=jnp.zeros((batch, 1, 3)),
            mask=jnp.zeros((batch, 1), bool),
            target=jnp.zeros(batch, jnp.int32),
            empty=jnp.ones(batch, bool),
            cells=jnp.full((batch, *RASTER), -1, jnp.int32) if self.encoder.IMAGE else None,
            features=jnp.zeros((batch, *FEATURES), jnp.float16) if self.encoder.maps else None,
            odometry=sensed_at_start(batch, self.triangulation) if self.odometry else None,
        )

    def initialise(self, key: jax.Array, words: jax.Array) -> Any:
        """Fresh parameters for word vectors [C, D]."""

        def everything(module: ActorCritic) -> Output:
            previous, fresh = jnp.zeros((1, NUM_ACTIONS)), jnp.ones((1,), bool)
            table = module.prepare(words)
            carry = jnp.zeros((1, module.hidden)), jnp.zeros((1, module.hidden))
            return module(table, carry, module.blank(1), previous, fresh)[1]

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
    return after, out, variables.get(TAPE, {})
