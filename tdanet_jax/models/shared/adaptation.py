"""Meta-learned adaptation (Wortsman et al. 2019): the agent learns while it acts, in tests as well.

After every k steps of an episode, at most `limit` times, each environment takes a step of gradient
descent on a learned loss of its last k hidden states and action probabilities. The loss has no
labels; it is trained so that the steps help: the gradient of the actor-critic's loss goes through
the inner steps, to the parameters that they start from and to the learned loss.

The adapted parameters of the LSTM, 7.5 million per environment, are never formed. The gradient of a
product x W over k steps is a sum of k outer products x_t^T d_t, where d_t is the gradient with
respect to the product, so that

    x (W - rate * sum_t x_t^T d_t) = x W - rate * sum_t (x . x_t) d_t

and an environment keeps the pairs (x_t, d_t) of its inner steps instead of a matrix. For the small
dense layers around the LSTM it keeps its own part of the parameters as it is (`layers.OWN`).
What an encoder takes once for all environments (`prepare`), layers that it shares among them
(`Encoder.SHARED`), dense layers of over 65,536 weights, and the layer that reads the odometry, are
not adapted; SAVN as published has none of the latter three. A test compares with plain
per-environment parameters, in value and in gradient.

In training, all environments take their inner steps together, after every k steps of a rollout: an
episode adapts for the first time where such a stretch of k steps first lies within it, and a
stretch never crosses the border of two rollouts. In tests all episodes begin together, and the
inner steps come after 6, 12, 18 and 24 steps, as published.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.env.dynamics import Observation
from tdanet_jax.models.actor_critic import ActorCritic, Output
from tdanet_jax.models.layers import OWN, clear, lstm_cell, paired_product, product
from tdanet_jax.vocabulary import NUM_ACTIONS

#: The parts of the network, beside the LSTM, that are adapted.
PARTS = ("action_embedding", "encoder", "actor")
#: Most weights of a dense layer that every environment adapts for itself.
SMALL = 2**16


class LearnedLoss(nn.Module):
    """A temporal convolution over k steps, and the norm of what it gives (SAVN's published code).

    The k steps are channels, the units of hidden state and action probabilities the axis of two
    causal convolutions of width 2, dilated by 1 and 2, to 10 channels and to 1.
    """

    channels: tuple[int, ...] = (10, 1)

    @nn.compact
    def __call__(self, record: jax.Array) -> jax.Array:
        """[B, k, H + 6] -> [B]."""
        x = record
        for level, features in enumerate(self.channels):
            bound = (2 * x.shape[1]) ** -0.5  # as torch.nn.Conv1d begins

            def uniform(key: jax.Array, shape: tuple[int, ...], bound: float = bound) -> jax.Array:
                return jax.random.uniform(key, shape, minval=-bound, maxval=bound)

            kernel = self.param(f"kernel{level}", uniform, (2, x.shape[1], features))
            bias = self.param(f"bias{level}", uniform, (features,))
            gap = 2**level
            before = jnp.pad(x, ((0, 0), (0, 0), (gap, 0)))[..., :-gap]
            x = jnp.einsum("tbcu,tcf->bfu", jnp.stack([before, x]), kernel)
            x = nn.leaky_relu(x + bias[:, None], 0.01)
        # The norm's gradient at zero, which only blank records reach, must be finite.
        return jnp.sqrt(jnp.sum(x[:, 0] ** 2, axis=-1) + 1e-12)


class Pairs(NamedTuple):
    """The LSTM's part of the inner steps, M = limit * k pairs for each environment."""

    inputs: jax.Array  # [B, M, n + H + m], what the LSTM's product was taken of
    changes: jax.Array  # [B, M, 4 H], -rate * gradient with respect to the product

    def add(self, inputs: jax.Array, mask: jax.Array) -> jax.Array:
        """What the inner steps add to the product of `inputs` [B, n + H + m]: [B, 4 H].

        Both biases of the LSTM are adapted, hence the 2.
        """
        similarity = jnp.einsum("bi,bmi->bm", inputs, self.inputs) + 2.0
        return jnp.einsum("bm,bmg->bg", jnp.where(mask, similarity, 0.0), self.changes)

    def pull(self, grad: jax.Array, mask: jax.Array) -> jax.Array:
        """The gradient with respect to `inputs` from that with respect to `add`'s result."""
        similarity = jnp.einsum("bg,bmg->bm", grad, self.changes)
        return jnp.einsum("bm,bmi->bi", jnp.where(mask, similarity, 0.0), self.inputs)


class Given(NamedTuple):
    """What the network is shown in a step, or in k steps with a leading axis."""

    obs: Observation  # as the encoder's `view` shows it
    previous: jax.Array
    fresh: jax.Array
    keep: jax.Array | None


class Steps(NamedTuple):
    """What an inner step needs to know of k steps; every field is [k, B, ...]."""

    given: Given
    inputs: jax.Array  # [k, B, n + H + m], of the LSTM's product
    gates: jax.Array  # [k, B, 4 H], the product
    cell: jax.Array  # [k, B, H], before the step


class Memory(struct.PyTreeNode):
    """The recurrent state of an adaptive network."""

    hidden: jax.Array  # [B, H]
    cell: jax.Array  # [B, H]
    count: jax.Array  # [B] int32, inner steps taken in the episode
    own: Any  # per-environment part of the small parts' parameters; valid if count > 0
    pairs: Pairs  # those of inner step i are valid if count > i
    steps: Steps  # [B, k, ...] in place of [k, B, ...], since the last inner step
    phase: jax.Array  # [B] int32, how many of these steps are filled; the same in all environments


class AdaptiveActorCritic(ActorCritic):
    """A recurrent actor-critic that adapts, in training and in tests.

    Attributes:
      rate: size of the inner steps; published: 1e-4.
      stretch: k, steps from one inner step to the next; published: 6.
      limit: inner steps in an episode; published: 4.
      first_order: takes the inner gradient for a constant, except that it depends on the learned
        loss. Cheaper, and the parameters do not learn to be adapted.
    """

    rate: float = 1e-4
    stretch: int = 6
    limit: int = 4
    first_order: bool = False

    def setup(self) -> None:
        super().setup()
        self.learned_loss = LearnedLoss()

    def __call__(
        self,
        table: Any,
        carry: Any,
        obs: Observation,
        previous: jax.Array,
        fresh: jax.Array,
        keep: jax.Array | None = None,
    ) -> tuple[Any, Output]:
        """`ActorCritic.__call__`; `carry` is a `Memory`, and nothing is read from a tape."""
        if self.is_initializing():
            self.learned_loss(jnp.zeros((1, self.stretch, self.hidden + NUM_ACTIONS)))
            return super().__call__(table, carry, obs, previous, fresh, keep)
        network = Network(self.clone(parent=None), self.variables["params"], table)
        given = Given(self.view(obs), previous, fresh, keep)
        if fresh.ndim == 1:
            return network.act(carry, given)
        return network.play(carry, given)

    def view(self, obs: Observation) -> Observation:
        """What of the observations the network uses, in shapes that are the same for all frames."""
        return self.encoder.view(obs).replace(odometry=obs.odometry if self.odometry else None)

    def recall(self, hidden: jax.Array) -> jax.Array:
        """The learned loss [B] of k hidden states [B, k, H]."""
        record = jnp.concatenate([hidden, nn.softmax(self.actor(hidden))], axis=-1)
        return self.learned_loss(record)

    def begin_rollout(self, carry: Memory) -> Memory:
        """Stretches of k steps begin anew with a rollout."""
        return carry.replace(phase=jnp.zeros_like(carry.phase))

    def initial_carry(self, batch: int, weights: Any, training: bool = False) -> Memory:
        """The recurrent state at the start of an episode: nothing adapted yet."""
        k, pairs = self.stretch, self.limit * self.stretch
        gates = 4 * self.hidden
        kernel = weights["lstm"]["kernel"].shape[0] + aside_kernel(weights["lstm"]).shape[0]
        given = Given(
            obs=self.view(self.blank(batch)),
            previous=jnp.zeros((batch, NUM_ACTIONS)),
            fresh=jnp.zeros(batch, bool),
            keep=jnp.zeros((batch, self.encoder.dropout_units), bool)
            if training and self.encoder.dropout
            else None,
        )
        return Memory(
            hidden=jnp.zeros((batch, self.hidden)),
            cell=jnp.zeros((batch, self.hidden)),
            count=jnp.zeros(batch, jnp.int32),
            own=jax.tree.map(
                lambda x: jnp.zeros((batch, *x.shape)),
                small(
                    {name: weights[name] for name in PARTS if name in weights}, self.encoder.SHARED
                ),
            ),
            pairs=Pairs(jnp.zeros((batch, pairs, kernel)), jnp.zeros((batch, pairs, gates))),
            steps=Steps(
                given=jax.tree.map(lambda x: jnp.zeros((batch, k, *x.shape[1:]), x.dtype), given),
                inputs=jnp.zeros((batch, k, kernel)),
                gates=jnp.zeros((batch, k, gates)),
                cell=jnp.zeros((batch, k, self.hidden)),
            ),
            phase=jnp.zeros(batch, jnp.int32),
        )


@dataclasses.dataclass(frozen=True)
class Network:
    """An adaptive network with its parameters, as plain functions of a `Memory`."""

    model: AdaptiveActorCritic
    weights: Any
    table: Any

    def apply(self, method: str, own: Any, *arguments: Any) -> Any:
        """A method of the model, with what the environments add to its parameters."""
        return self.model.apply({"params": self.weights, OWN: own}, *arguments, method=method)

    def perceive(self, own: Any, given: Given) -> tuple[jax.Array, jax.Array]:
        """The LSTM's inputs of one step: features [B, n] and `aside` [B, m]."""
        found: Any = self.apply("perceive", own, self.table, given.obs, given.previous, given.keep)
        return found

    def back(self) -> jax.Array:
        """The LSTM's kernel, transposed: an array of its own.

        The processor's matrix units do not take a transposed operand, and without the barrier XLA
        would make one of it.
        """
        return jax.lax.optimization_barrier(self.weights["lstm"]["kernel"].T)

    def product(
        self, pairs: Pairs, inputs: jax.Array, count: jax.Array, back: jax.Array
    ) -> jax.Array:
        """The LSTM's product [B, 4 H] of [features, hidden, aside] in environments with `count`."""
        lstm = self.weights["lstm"]
        rows = lstm["kernel"].shape[0]
        z = paired_product(inputs[:, :rows], lstm["kernel"], back, self.model.dtype)
        z += product(inputs[:, rows:], aside_kernel(lstm), jnp.float32)
        return z + lstm["bias_ih"] + lstm["bias_hh"] + pairs.add(inputs, self.valid(count))

    def valid(self, count: jax.Array) -> jax.Array:
        """Which pairs belong to the first `count` inner steps, [B, M] bool."""
        model = self.model
        return jnp.arange(model.limit * model.stretch) // model.stretch < count[:, None]

    def act(self, memory: Memory, given: Given) -> tuple[Memory, Output]:
        """One step of every environment, and an inner step where k steps are full."""
        phase, past = memory.phase[0], memory.steps
        if given.keep is None:
            past = past._replace(given=past.given._replace(keep=None))
        memory, out, steps = self.run(memory, jax.tree.map(lambda x: x[None], given))
        past = jax.tree.map(
            lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, phase, 1),
            past,
            swapped(steps),
        )
        full = phase + 1 == self.model.stretch
        own, pairs, count = jax.lax.cond(
            full,
            lambda memory, past: self.adapt(memory, swapped(past)),
            lambda memory, past: (memory.own, memory.pairs, memory.count),
            memory,
            past,
        )
        memory = memory.replace(
            own=own,
            pairs=pairs,
            count=count,
            steps=past,
            phase=jnp.where(full, 0, memory.phase + 1),
        )
        return memory, jax.tree.map(lambda x: x[0], out)

    def play(self, memory: Memory, given: Given) -> tuple[Memory, Output]:
        """A rollout of T steps; stretches of k steps begin with it."""
        k, length = self.model.stretch, given.fresh.shape[0]
        whole = length // k * k
        stretches = jax.tree.map(lambda x: x[:whole].reshape(whole // k, k, *x.shape[1:]), given)

        def body(memory: Memory, given: Given) -> tuple[Memory, Output]:
            memory, out, steps = self.run(memory, given)
            own, pairs, count = self.adapt(memory, steps)
            return memory.replace(own=own, pairs=pairs, count=count), out

        memory, out = jax.lax.scan(body, memory, stretches)
        out = jax.tree.map(lambda x: x.reshape(whole, *x.shape[2:]), out)
        memory, last, steps = self.run(memory, jax.tree.map(lambda x: x[whole:], given))
        memory = memory.replace(
            phase=jnp.full_like(memory.phase, length - whole),
            steps=jax.tree.map(
                lambda all, new: all.at[:, : length - whole].set(new), memory.steps, swapped(steps)
            ),
        )
        return memory, jax.tree.map(lambda *x: jnp.concatenate(x), out, last)

    def run(self, memory: Memory, given: Given) -> tuple[Memory, Output, Steps]:
        """Some steps [t, B, ...] without an inner step between them."""
        began = jnp.cumsum(given.fresh, axis=0) > 0
        count = jnp.where(began, 0, memory.count)  # [t, B]
        features, aside = jax.vmap(
            lambda count, given: self.perceive(gated(memory.own, count > 0), given)
        )(count, given)

        back = self.back()

        def body(carry: tuple, step: tuple) -> tuple[tuple, tuple]:
            features, aside, fresh, count = step
            hidden, cell = clear(carry, fresh)
            inputs = jnp.concatenate([features, hidden, aside], axis=-1)
            z = self.product(memory.pairs, inputs, count, back)
            after, _ = lstm_cell(z, cell)
            return after, (after[0], inputs, z, cell)

        (hidden, cell), (states, inputs, z, cells) = jax.lax.scan(
            body, (memory.hidden, memory.cell), (features, aside, given.fresh, count)
        )
        out = jax.vmap(
            lambda count, hidden: self.apply("decide", gated(memory.own, count > 0), hidden)
        )(count, states)
        last = jnp.where(began.any(axis=0), 0, memory.count)
        memory = memory.replace(hidden=hidden, cell=cell, count=last)
        return memory, out, Steps(given, inputs, z, cells)

    def adapt(self, memory: Memory, steps: Steps) -> tuple[Any, Pairs, jax.Array]:
        """An inner step in the environments whose last k `steps` lie within one episode.

        Returns:
          The new `own`, `pairs` and `count` of the memory.
        """
        model, count = self.model, memory.count
        due = (count < model.limit) & ~steps.given.fresh[1:].any(axis=0)  # [B]

        def chosen(mask: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(mask.reshape(*mask.shape, *(1,) * (new.ndim - mask.ndim)), new, old)

        start = jax.tree.map(lambda x: chosen(count > 0, x, jnp.zeros_like(x)), memory.own)
        network, at, pairs = self, start, memory.pairs
        if model.first_order:
            network, at, pairs, steps = self.held(), *jax.lax.stop_gradient((at, pairs, steps))
        own_grad, product_grad = network.inner_gradient(at, pairs, count, steps)
        own = jax.tree.map(
            lambda new, grad, old: chosen(due, new - model.rate * grad, old),
            start, own_grad, memory.own,
        )  # fmt: skip
        changed = due[:, None] & self.valid(count + 1) & ~self.valid(count)  # [B, M]

        def written(new: jax.Array, old: jax.Array) -> jax.Array:
            repeated = jnp.tile(jnp.moveaxis(new, 0, 1), (1, model.limit, 1))
            return chosen(changed, repeated, old)

        pairs = Pairs(
            written(steps.inputs, memory.pairs.inputs),
            written(-model.rate * product_grad, memory.pairs.changes),
        )
        return own, pairs, count + due

    def held(self) -> Network:
        """The network with constant parameters, but for the learned loss."""
        weights, table = jax.lax.stop_gradient((self.weights, self.table))
        weights = {**weights, "learned_loss": self.weights["learned_loss"]}
        return dataclasses.replace(self, weights=weights, table=table)

    def inner_gradient(
        self, own: Any, pairs: Pairs, count: jax.Array, steps: Steps
    ) -> tuple[Any, jax.Array]:
        """The gradient of the learned loss of the last k steps.

        Args:
          own: the small parts' per-environment parameters that the k steps were taken with.
          pairs: the LSTM's pairs, of which each environment's first `count` inner steps count.
          count: [B].
          steps: the k steps.

        Returns:
          The gradient with respect to `own`, and to the LSTM's products, [k, B, 4 H].
        """
        valid = self.valid(count)
        (states, _), _ = lstm_cell(steps.gates, steps.cell)  # [k, B, H]

        def learned(own: Any, states: jax.Array) -> jax.Array:
            return self.apply("recall", own, jnp.moveaxis(states, 0, 1)).sum()

        actor_grad, states_grad = jax.grad(learned, (0, 1))({"actor": own["actor"]}, states)
        lstm = self.weights["lstm"]
        rows, width = lstm["kernel"].shape[0], self.model.hidden
        back = self.back()

        def body(later: tuple, step: tuple) -> tuple[tuple, tuple]:
            gates, cell, state_grad = step
            _, pull = jax.vjp(lambda gates, cell: lstm_cell(gates, cell)[0], gates, cell)
            gates_grad, cell_grad = pull((later[0] + state_grad, later[1]))
            grad = jnp.concatenate(
                [
                    paired_product(gates_grad, back, lstm["kernel"], self.model.dtype),
                    product(gates_grad, aside_kernel(lstm).T, jnp.float32),
                ],
                axis=-1,
            ) + pairs.pull(gates_grad, valid)
            features, hidden, aside = jnp.split(grad, (rows - width, rows), axis=-1)
            return (hidden, cell_grad), (gates_grad, features, aside)

        zero = jnp.zeros_like(steps.cell[0])
        _, (gates_grad, *features_grad) = jax.lax.scan(
            body, (zero, zero), (steps.gates, steps.cell, states_grad), reverse=True
        )
        before = {name: value for name, value in own.items() if name != "actor"}
        _, pull = jax.vjp(
            lambda own: jax.vmap(lambda given: self.perceive(own, given))(steps.given), before
        )
        (before_grad,) = pull(tuple(features_grad))
        return {**before_grad, **actor_grad}, gates_grad


def aside_kernel(lstm: Any) -> jax.Array:
    """The LSTM's kernel for its inputs `aside` [m, 4 H]; m is 0 where there are none."""
    kernel: jax.Array = lstm.get("kernel_aside", lstm["kernel"][:0])
    return kernel


def small(weights: Any, shared: tuple[str, ...]) -> Any:
    """The dense layers among these that are small enough for every environment to have its own.

    Args:
      weights: parameters by name.
      shared: names of layers that are left out.
    """
    if "kernel" in weights:
        return weights if weights["kernel"].size <= SMALL else {}
    layers = {name: w for name, w in weights.items() if isinstance(w, Mapping)}
    parts = {name: small(w, shared) for name, w in layers.items() if name not in shared}
    return {name: part for name, part in parts.items() if part}


def swapped(steps: Steps) -> Steps:
    """[B, k, ...] for [k, B, ...], and the other way."""
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), steps)


def gated(own: Any, gate: jax.Array) -> Any:
    """The environments' own parameters, to be used where `gate` [B] is True."""
    if "kernel" in own:
        return {**own, "gate": gate}
    return {name: gated(value, gate) for name, value in own.items()}
