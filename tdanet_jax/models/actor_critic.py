"""The recurrent actor-critic that every encoder plugs into: features -> LSTM -> policy, value."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.env.types import FEATURES, RASTER, Observation
from tdanet_jax.models.activation_cache import ACTIVATIONS
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import Linear
from tdanet_jax.models.lstm import LSTM, Carry
from tdanet_jax.models.reach import ReachEstimate, mask_done
from tdanet_jax.models.rounding import ROUNDED_TO, rounded
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.sensors import suite
from tdanet_jax.vocabulary import NUM_ACTIONS, Action

#: Units of the layer that embeds the sensors' features.
SENSOR_UNITS = 64


class Output(NamedTuple):
    """Policy and value in a batch of states."""

    logits: jax.Array  # [..., 6], unnormalised log-probabilities of the actions
    value: jax.Array  # [...], expected discounted return
    reach_logit: jax.Array | None = None  # [...], of the target being within reach, if estimated


class RecurrentState(struct.PyTreeNode):
    """What a network carries from step to step in B environments."""

    carry: Any  # of the LSTM: hidden and cell, each [B, H]; adaptive networks carry more
    prev_action_probs: jax.Array  # [B, 6], of the network's own policy one step before; 0 at first
    is_first: jax.Array  # [B] bool, the episode has just begun

    def restarted(self, done: jax.Array) -> RecurrentState:
        """The state with a new episode in the environments that are `done` [B] bool.

        Their `carry` is still the old one: the next step is told `is_first` and starts from zeros.
        """
        probs = jnp.where(done[:, None], 0.0, self.prev_action_probs)
        return self.replace(prev_action_probs=probs, is_first=done)


class ActorCritic(nn.Module):
    """An encoder, the previous step's action probabilities, an LSTM, an actor and a critic.

    Attributes:
      encoder: the model's own part.
      hidden: units of the LSTM.
      action_width: units of the embedding of the previous action probabilities.
      dtype: operands of the LSTM's products.
      spec: what the agent is shown. A layer of `SENSOR_UNITS` adds the sensors' features to the
        encoder's; the paper's agent has no sensors.
      reach_threshold: after training, `Done` is only allowed where the target is in view, and
        within reach with this estimated probability or more; None if there is no estimate.
      temperature: of the policy after training.
      done_bias: added to the logit of `Done` after training.
    """

    encoder: Encoder
    hidden: int = 512
    action_width: int = 10
    dtype: Any = jnp.float32
    spec: ObservationSpec = ObservationSpec()
    reach_threshold: float | None = None
    temperature: float = 1.0
    done_bias: float = 0.0

    def setup(self) -> None:
        if self.spec.sensors:
            # Its name in files enters its initial random values: with another, seeds would change.
            self.sensor_embedding = Linear(SENSOR_UNITS, name="way")
        if self.encoder.ACTION != "plain":
            self.action_embedding = Linear(self.action_width)
        self.lstm = LSTM(self.hidden, self.dtype)
        small = nn.initializers.variance_scaling(1e-4, "fan_in", "truncated_normal")
        self.actor = Linear(NUM_ACTIONS, kernel_init=small)
        self.critic = Linear(1)
        if self.reach_threshold is not None:
            self.reach = ReachEstimate()

    def prepare(self, words: jax.Array) -> Any:
        """What the encoder can say from word vectors [C, D] alone; once per parameter change."""
        return self.encoder.prepare(words)

    def __call__(
        self,
        class_table: Any,
        carry: Carry,
        obs: Observation,
        prev_action_probs: jax.Array,
        is_first: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> tuple[Carry, Output]:
        """One step for a batch [B], or a rollout [T, B].

        Args:
          class_table: from `prepare`.
          carry: recurrent state before the (first) step, each [B, H].
          obs: observations.
          prev_action_probs: [..., 6], of the previous step; zeros where an episode starts.
          is_first: [...] bool, True where an episode starts.
          dropout_mask: [..., units] bool, units that dropout keeps; None when not training.
        """
        features, skip_inputs = self.perceive(class_table, obs, prev_action_probs, dropout_mask)
        if self.is_mutable_collection("intermediates"):
            self.sow("intermediates", "attention", self.encoder.attend(class_table, obs))
        carry, hidden = self.lstm(carry, features, skip_inputs, is_first)
        out = self.decide(hidden)
        if self.reach_threshold is not None:
            out = out._replace(reach_logit=self.reach(obs.sensors[self.spec.tracker]))
        return carry, out

    def perceive(
        self,
        class_table: Any,
        obs: Observation,
        prev_action_probs: jax.Array,
        dropout_mask: jax.Array | None,
    ) -> tuple[jax.Array, jax.Array]:
        """The inputs of the LSTM: features [..., n], and a few `skip_inputs` [..., m]."""
        action = prev_action_probs
        if self.encoder.ACTION != "plain":
            action = nn.relu(self.action_embedding(prev_action_probs))
        features = self.encoder(class_table, obs, action, dropout_mask)
        if self.spec.sensors:
            if missing := [name for name in self.spec.sensors if name not in obs.sensors]:
                raise ValueError(f"the observations lack what the network senses: {missing}")
            sensed = self.sensor_embedding(suite.features(self.spec, obs.sensors))
            features = jnp.concatenate([features, nn.relu(sensed)], axis=-1)
        return features, action[..., :0] if self.encoder.ACTION == "inside" else action

    def decide(self, hidden: jax.Array) -> Output:
        """Policy and value, from hidden states [..., H]."""
        return Output(self.actor(hidden), self.critic(hidden)[..., 0])

    def initial_carry(self, batch: int, weights: Any, training: bool = False) -> Any:
        """The carry at the start of an episode: zeros.

        Args:
          batch: B.
          weights: the parameters; only networks that adapt need them.
          training: whether units will be dropped.
        """
        return jnp.zeros((batch, self.hidden)), jnp.zeros((batch, self.hidden))

    def begin_rollout(self, carry: Any) -> Any:
        """The carry that a rollout begins with, from that after the previous one."""
        return carry

    def blank(self, batch: int) -> Observation:
        """Observations without any detection."""
        return Observation(
            classes=jnp.zeros((batch, 1), jnp.int32),
            boxes=jnp.zeros((batch, 1, self.spec.columns)),
            mask=jnp.zeros((batch, 1), bool),
            target=jnp.zeros(batch, jnp.int32),
            empty=jnp.ones(batch, bool),
            cells=jnp.full((batch, *RASTER), -1, jnp.int32) if self.encoder.IMAGE else None,
            features=jnp.zeros((batch, *FEATURES), jnp.float16) if self.encoder.maps else None,
            sensors=suite.blank(self.spec, batch),
        )

    def initialise(self, key: jax.Array, words: jax.Array) -> Any:
        """Random initial parameters for word vectors [C, D]."""

        def everything(module: ActorCritic) -> Output:
            probs, is_first = jnp.zeros((1, NUM_ACTIONS)), jnp.ones((1,), bool)
            class_table = module.prepare(words)
            carry = jnp.zeros((1, module.hidden)), jnp.zeros((1, module.hidden))
            return module(class_table, carry, module.blank(1), probs, is_first)[1]

        return nn.init(everything, self)(key)["params"]

    def parameter_shapes(self, classes: int, width: int) -> Any:
        """Shapes of the parameters for word vectors [classes, width]; nothing is computed."""
        words = jax.ShapeDtypeStruct((classes, width), jnp.float32)
        return jax.eval_shape(self.initialise, jax.random.key(0), words)


def prepare(model: ActorCritic, weights: Any, words: jax.Array) -> Any:
    """The table of classes of these weights, from word vectors [C, D]."""
    return model.apply({"params": weights}, words, method="prepare")


def round_kernels(model: ActorCritic, weights: Any, words: jax.Array, above: int) -> Any:
    """The parameters, with the kernels rounded that the network's layers round at every step.

    Args:
      words: word vectors [C, D].
      above: only kernels with more numbers than this; for others, it would save nothing.
    """

    def step(module: ActorCritic, words: jax.Array, state: RecurrentState) -> None:
        inputs = state.carry, module.blank(1), state.prev_action_probs, state.is_first
        module(module.prepare(words), *inputs)

    def ask(weights: Any, words: jax.Array) -> Any:
        state = initial_state(model, weights, 1)
        return nn.apply(step, model, mutable=[ROUNDED_TO])({"params": weights}, words, state)[1]

    dtypes = jax.eval_shape(ask, weights, words).get(ROUNDED_TO, {})
    return rounded(weights, dtypes, above)


def initial_state(
    model: ActorCritic, weights: Any, batch: int, training: bool = False
) -> RecurrentState:
    """The recurrent state at the start of `batch` episodes; `training` if units will be dropped."""
    return RecurrentState(
        carry=model.initial_carry(batch, weights, training),
        prev_action_probs=jnp.zeros((batch, NUM_ACTIONS)),
        is_first=jnp.ones(batch, bool),
    )


def act(
    model: ActorCritic,
    weights: Any,
    class_table: Any,
    state: RecurrentState,
    obs: Observation,
    dropout_mask: jax.Array | None = None,
    collections: Collection[str] = (),
    training: bool = False,
) -> tuple[RecurrentState, Output, Any]:
    """One step of a batch of B environments; everything that acts goes through here.

    Args:
      collections: Flax collections to return: `ACTIVATIONS` while training, "intermediates" for the
        attention, its logits and the Siamese difference.
      training: the policy is the network's own; after training, `decision_logits` changes it.

    Returns:
      The state after the step, policy and value, and the collections by name. The state remembers
      the probabilities of the network's own policy, as in training.
    """
    inputs = (class_table, state.carry, obs, state.prev_action_probs, state.is_first, dropout_mask)
    (carry, out), kept = model.apply({"params": weights}, *inputs, mutable=list(collections))
    after = RecurrentState(carry, jax.nn.softmax(out.logits), jnp.zeros_like(state.is_first))
    if not training:
        out = out._replace(logits=decision_logits(model, out, obs.target_in_view))
    return after, out, kept


def decision_logits(model: ActorCritic, out: Output, in_view: jax.Array) -> jax.Array:
    """The logits [..., 6] with which a trained network acts.

    Args:
      out: what the network says.
      in_view: [...] bool, whether the target is in view.
    """
    logits = out.logits.at[..., Action.DONE].add(model.done_bias) / model.temperature
    if model.reach_threshold:
        assert out.reach_logit is not None
        logits = mask_done(logits, out.reach_logit, in_view, model.reach_threshold)
    return logits


def forward(
    model: ActorCritic,
    weights: Any,
    class_table: Any,
    carry: Any,
    obs: Observation,
    prev_action_probs: jax.Array,
    is_first: jax.Array,
    dropout_mask: jax.Array | None = None,
    activations: Any = None,
) -> tuple[Any, Output]:
    """`ActorCritic.__call__` with these weights, for a step or a whole rollout.

    Args:
      activations: the activation cache that `act` filled in the same rollout.
    """
    cache = {} if activations is None else {ACTIVATIONS: activations}
    inputs = (class_table, carry, obs, prev_action_probs, is_first, dropout_mask)
    out: Any = model.apply({"params": weights, **cache}, *inputs)
    return out
