"""Meta-learned adaptation (Wortsman et al. 2019): the agent keeps learning while it acts.

After every k steps of an episode, at most `limit` times, each environment takes an inner step:
gradient descent on a learned loss of its last k hidden states and action probabilities. This loss
needs no labels, so the agent adapts in tests, too. It is trained so that the inner steps help: the
gradient of the actor-critic loss flows through them, to the parameters that they start from and to
the learned loss.

The adapted parameters of the LSTM, 7.5 million per environment, are never formed. The gradient of a
product x W over k steps is a sum of k outer products x_t^T d_t, where d_t is the gradient with
respect to the product, so that

    x (W - rate * sum_t x_t^T d_t) = x W - rate * sum_t (x . x_t) d_t

and an environment stores the pairs (x_t, d_t) of its inner steps instead of a matrix. For the small
dense layers around the LSTM it stores its own weights (`layers.PER_ENVIRONMENT`). Not adapted are
what an encoder computes once for all environments (`prepare`), layers that it shares among them
(`Encoder.SHARED`), dense layers of more than 65,536 weights, and the embedding of the sensors; SAVN
as published has none of the last three. A test compares values and gradients with those of plain
per-environment parameters.

In training, all environments take their inner steps together, after every k steps of a rollout: an
episode first adapts after the first such interval that lies within it, and no interval spans two
rollouts. The gradient ends with the rollout: an inner step is trained by the later steps of its
rollout alone, where the published code differentiates through whole episodes. In tests all episodes
begin together, and the inner steps come after 6, 12, 18 and 24 steps, as published.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn
from flax import struct

from tdanet_jax.config import NetworkConfig
from tdanet_jax.env.types import Observation
from tdanet_jax.models.actor_critic import ActorCritic, Output
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.models.layers import PER_ENVIRONMENT
from tdanet_jax.models.lstm import lstm_cell, reset_carry
from tdanet_jax.models.matmul import product, product_with_transpose
from tdanet_jax.vocabulary import NUM_ACTIONS

#: The parts of the network, in addition to the LSTM, that are adapted.
PARTS = ("action_embedding", "encoder", "actor")
#: Most weights of a dense layer with per-environment weights.
SMALL = 2**16


class LearnedLoss(nn.Module):
    """The norm of a temporal convolution over k steps (SAVN's published code).

    The k steps are channels; two causal convolutions of width 2, dilated by 1 and 2, to 10 channels
    and to 1, run along the units of hidden state and action probabilities.
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


class OuterProducts(NamedTuple):
    """The LSTM's part of the inner steps: M = limit * k outer products for each environment."""

    inputs: jax.Array  # [B, M, n + H + m], left factors: inputs of the LSTM's product
    changes: jax.Array  # [B, M, 4 H], right factors: -rate * gradient with respect to the product

    def product(self, inputs: jax.Array, mask: jax.Array) -> jax.Array:
        """`inputs` [B, n + H + m] times the sum of those in `mask` [B, M]: [B, 4 H].

        Both biases of the LSTM are adapted, hence the 2.
        """
        similarity = jnp.einsum("bi,bmi->bm", inputs, self.inputs) + 2.0
        return jnp.einsum("bm,bmg->bg", jnp.where(mask, similarity, 0.0), self.changes)

    def product_vjp(self, grad: jax.Array, mask: jax.Array) -> jax.Array:
        """The gradient with respect to `inputs`, from that with respect to `product`'s result."""
        similarity = jnp.einsum("bg,bmg->bm", grad, self.changes)
        return jnp.einsum("bm,bmi->bi", jnp.where(mask, similarity, 0.0), self.inputs)


class StepInputs(NamedTuple):
    """The inputs of the network in a step, or in k steps with a leading axis."""

    obs: Observation  # the encoder's `view`
    prev_action_probs: jax.Array
    is_first: jax.Array
    dropout_mask: jax.Array | None


class InnerSteps(NamedTuple):
    """The k steps that an inner step looks back at; every field is [k, B, ...]."""

    step_inputs: StepInputs
    lstm_inputs: jax.Array  # [k, B, n + H + m], of the LSTM's product
    gate_inputs: jax.Array  # [k, B, 4 H], the LSTM's product and biases
    cell: jax.Array  # [k, B, H], before the step


class AdaptiveState(struct.PyTreeNode):
    """The recurrent state of an adaptive network."""

    hidden: jax.Array  # [B, H]
    cell: jax.Array  # [B, H]
    count: jax.Array  # [B] int32, inner steps taken in the episode
    per_environment: Any  # weights of the small dense layers, [B, ...]; valid if count > 0
    outer_products: OuterProducts  # those of inner step i are valid if count > i
    steps: InnerSteps  # since the last inner step, [B, k, ...] instead of [k, B, ...]
    phase: jax.Array  # [B] int32, how many of these steps are filled; equal in all environments


class AdaptiveActorCritic(ActorCritic):
    """A recurrent actor-critic that adapts, in training and in tests.

    Attributes:
      rate: size of the inner steps; published: 1e-4.
      interval: k, steps from one inner step to the next; published: 6.
      limit: inner steps in an episode; published: 4.
      first_order: takes the inner gradient as constant, except that it depends on the learned loss.
        Cheaper, but the parameters are not trained to be adapted.
    """

    rate: float = 1e-4
    interval: int = 6
    limit: int = 4
    first_order: bool = False

    def setup(self) -> None:
        super().setup()
        self.learned_loss = LearnedLoss()

    def __call__(
        self,
        class_table: Any,
        carry: Any,
        obs: Observation,
        prev_action_probs: jax.Array,
        is_first: jax.Array,
        dropout_mask: jax.Array | None = None,
    ) -> tuple[Any, Output]:
        """`ActorCritic.__call__`; `carry` is an `AdaptiveState`. There is no activation cache."""
        if self.is_initializing():
            self.learned_loss(jnp.zeros((1, self.interval, self.hidden + NUM_ACTIONS)))
            return super().__call__(
                class_table, carry, obs, prev_action_probs, is_first, dropout_mask
            )
        if self.is_mutable_collection("intermediates"):
            self.sow("intermediates", "attention", self.encoder.attend(class_table, obs))
        network = Network(self.clone(parent=None), self.variables["params"], class_table)
        inputs = StepInputs(self.view(obs), prev_action_probs, is_first, dropout_mask)
        return (network.act if is_first.ndim == 1 else network.rollout)(carry, inputs)

    def view(self, obs: Observation) -> Observation:
        """The part of the observations that the network uses, in shapes equal for all frames."""
        names = self.spec.sensors
        sensors = {name: reading for name, reading in obs.sensors.items() if name in names}
        return self.encoder.view(obs).replace(sensors=sensors)

    def inner_loss(self, hidden: jax.Array) -> jax.Array:
        """The learned loss [B] of k hidden states [B, k, H]."""
        record = jnp.concatenate([hidden, nn.softmax(self.actor(hidden))], axis=-1)
        return self.learned_loss(record)

    def begin_rollout(self, carry: AdaptiveState) -> AdaptiveState:
        """The carry with a new interval of k steps."""
        return carry.replace(phase=jnp.zeros_like(carry.phase))

    def initial_carry(self, batch: int, weights: Any, training: bool = False) -> AdaptiveState:
        """The carry at the start of an episode: nothing adapted yet."""
        k, products = self.interval, self.limit * self.interval
        gates = 4 * self.hidden
        width = weights["lstm"]["kernel"].shape[0] + skip_kernel(weights["lstm"]).shape[0]
        drops = training and self.encoder.dropout
        inputs = StepInputs(
            obs=self.view(self.blank(batch)),
            prev_action_probs=jnp.zeros((batch, NUM_ACTIONS)),
            is_first=jnp.zeros(batch, bool),
            dropout_mask=jnp.zeros((batch, self.encoder.dropout_units), bool) if drops else None,
        )
        parts = {name: weights[name] for name in PARTS if name in weights}
        return AdaptiveState(
            hidden=jnp.zeros((batch, self.hidden)),
            cell=jnp.zeros((batch, self.hidden)),
            count=jnp.zeros(batch, jnp.int32),
            per_environment=jax.tree.map(
                lambda x: jnp.zeros((batch, *x.shape)), small_layers(parts, self.encoder.SHARED)
            ),
            outer_products=OuterProducts(
                jnp.zeros((batch, products, width)), jnp.zeros((batch, products, gates))
            ),
            steps=InnerSteps(
                step_inputs=jax.tree.map(
                    lambda x: jnp.zeros((batch, k, *x.shape[1:]), x.dtype), inputs
                ),
                lstm_inputs=jnp.zeros((batch, k, width)),
                gate_inputs=jnp.zeros((batch, k, gates)),
                cell=jnp.zeros((batch, k, self.hidden)),
            ),
            phase=jnp.zeros(batch, jnp.int32),
        )


def make_adaptive(config: NetworkConfig, encoder: Encoder) -> AdaptiveActorCritic:
    """The adaptive network around an encoder. It multiplies in float32.

    At some sizes XLA's CPU backend compiles its bfloat16 products and then refuses to run them.
    """
    return AdaptiveActorCritic(
        encoder, hidden=config.hidden, rate=config.inner_rate, first_order=config.first_order
    )


@dataclasses.dataclass(frozen=True)
class Network:
    """An adaptive network with its parameters, as pure functions of an `AdaptiveState`."""

    model: AdaptiveActorCritic
    weights: Any
    class_table: Any

    def apply(self, method: str, per_environment: Any, *arguments: Any) -> Any:
        """A method of the model, with per-environment weights."""
        variables = {"params": self.weights, PER_ENVIRONMENT: per_environment}
        return self.model.apply(variables, *arguments, method=method)

    def perceive(self, per_environment: Any, inputs: StepInputs) -> tuple[jax.Array, jax.Array]:
        """The LSTM's inputs of one step: features [B, n] and `skip_inputs` [B, m]."""
        arguments = self.class_table, inputs.obs, inputs.prev_action_probs, inputs.dropout_mask
        found: Any = self.apply("perceive", per_environment, *arguments)
        return found

    def kernel_transposed(self) -> jax.Array:
        """The LSTM's kernel, transposed and materialized.

        The processor's matrix units do not take a transposed operand, and without the barrier XLA
        would fuse the transpose into the product.
        """
        return jax.lax.optimization_barrier(self.weights["lstm"]["kernel"].T)

    def product(
        self, products: OuterProducts, inputs: jax.Array, count: jax.Array, transposed: jax.Array
    ) -> jax.Array:
        """The LSTM's product and biases [B, 4 H] of [features, hidden, skip_inputs].

        Args:
          products: of all inner steps.
          inputs: [B, n + H + m].
          count: [B], inner steps that each environment has taken.
          transposed: `kernel_transposed`.
        """
        lstm = self.weights["lstm"]
        rows = lstm["kernel"].shape[0]
        z = product_with_transpose(inputs[:, :rows], lstm["kernel"], transposed, self.model.dtype)
        z += product(inputs[:, rows:], skip_kernel(lstm), jnp.float32)
        adapted = products.product(inputs, self.valid(count))
        return z + lstm["bias_ih"] + lstm["bias_hh"] + adapted

    def valid(self, count: jax.Array) -> jax.Array:
        """Which outer products belong to the first `count` inner steps, [B, M] bool."""
        model = self.model
        return jnp.arange(model.limit * model.interval) // model.interval < count[:, None]

    def act(self, state: AdaptiveState, inputs: StepInputs) -> tuple[AdaptiveState, Output]:
        """One step of every environment, and an inner step if it completes an interval."""
        phase, past = state.phase[0], state.steps
        if inputs.dropout_mask is None:
            past = past._replace(step_inputs=past.step_inputs._replace(dropout_mask=None))
        state, out, steps = self.unroll(state, jax.tree.map(lambda x: x[None], inputs))
        past = jax.tree.map(
            lambda all, new: jax.lax.dynamic_update_slice_in_dim(all, new, phase, 1),
            past,
            swap_axes(steps),
        )
        full = phase + 1 == self.model.interval
        state = jax.lax.cond(
            full,
            lambda state, past: self.adapt(state, swap_axes(past)),
            lambda state, past: state,
            state.replace(steps=None),
            past,
        )
        state = state.replace(steps=past, phase=jnp.where(full, 0, state.phase + 1))
        return state, jax.tree.map(lambda x: x[0], out)

    def rollout(self, state: AdaptiveState, inputs: StepInputs) -> tuple[AdaptiveState, Output]:
        """A rollout of T steps; its first interval of k steps begins with it."""
        k, length = self.model.interval, inputs.is_first.shape[0]
        whole = length // k * k
        intervals = jax.tree.map(lambda x: x[:whole].reshape(whole // k, k, *x.shape[1:]), inputs)

        def body(state: AdaptiveState, inputs: StepInputs) -> tuple[AdaptiveState, Output]:
            state, out, steps = self.unroll(state, inputs)
            return self.adapt(state, steps), out

        state, out = jax.lax.scan(body, state, intervals)
        out = jax.tree.map(lambda x: x.reshape(whole, *x.shape[2:]), out)
        state, last, steps = self.unroll(state, jax.tree.map(lambda x: x[whole:], inputs))
        state = state.replace(
            phase=jnp.full_like(state.phase, length - whole),
            steps=jax.tree.map(
                lambda all, new: all.at[:, : length - whole].set(new), state.steps, swap_axes(steps)
            ),
        )
        return state, jax.tree.map(lambda *x: jnp.concatenate(x), out, last)

    def unroll(
        self, state: AdaptiveState, inputs: StepInputs
    ) -> tuple[AdaptiveState, Output, InnerSteps]:
        """Some steps [t, B, ...] without an inner step between them."""
        began = jnp.cumsum(inputs.is_first, axis=0) > 0
        count = jnp.where(began, 0, state.count)  # [t, B]
        features, skip_inputs = jax.vmap(
            lambda count, inputs: self.perceive(gated(state.per_environment, count > 0), inputs)
        )(count, inputs)
        transposed = self.kernel_transposed()

        def body(carry: tuple, step: tuple) -> tuple[tuple, tuple]:
            features, skip_inputs, is_first, count = step
            hidden, cell = reset_carry(carry, is_first)
            lstm_inputs = jnp.concatenate([features, hidden, skip_inputs], axis=-1)
            z = self.product(state.outer_products, lstm_inputs, count, transposed)
            carry, _ = lstm_cell(z, cell)
            return carry, (carry[0], lstm_inputs, z, cell)

        (hidden, cell), (states, lstm_inputs, z, cells) = jax.lax.scan(
            body, (state.hidden, state.cell), (features, skip_inputs, inputs.is_first, count)
        )
        out = jax.vmap(
            lambda count, hidden: self.apply(
                "decide", gated(state.per_environment, count > 0), hidden
            )
        )(count, states)
        last = jnp.where(began.any(axis=0), 0, state.count)
        after = state.replace(hidden=hidden, cell=cell, count=last)
        return after, out, InnerSteps(inputs, lstm_inputs, z, cells)

    def adapt(self, state: AdaptiveState, steps: InnerSteps) -> AdaptiveState:
        """The state after an inner step, in environments whose k `steps` lie within one episode."""
        model, count = self.model, state.count
        due = (count < model.limit) & ~steps.step_inputs.is_first[1:].any(axis=0)  # [B]

        def chosen(mask: jax.Array, new: jax.Array, old: jax.Array) -> jax.Array:
            return jnp.where(mask.reshape(*mask.shape, *(1,) * (new.ndim - mask.ndim)), new, old)

        start = jax.tree.map(
            lambda x: chosen(count > 0, x, jnp.zeros_like(x)), state.per_environment
        )
        network, at, products = self, start, state.outer_products
        if model.first_order:
            network = self.frozen()
            at, products, steps = jax.lax.stop_gradient((at, products, steps))
        grad, product_grad = network.inner_gradient(at, products, count, steps)
        per_environment = jax.tree.map(
            lambda new, grad, old: chosen(due, new - model.rate * grad, old),
            start, grad, state.per_environment,
        )  # fmt: skip
        changed = due[:, None] & self.valid(count + 1) & ~self.valid(count)  # [B, M]

        def written(new: jax.Array, old: jax.Array) -> jax.Array:
            repeated = jnp.tile(jnp.moveaxis(new, 0, 1), (1, model.limit, 1))
            return chosen(changed, repeated, old)

        products = OuterProducts(
            written(steps.lstm_inputs, state.outer_products.inputs),
            written(-model.rate * product_grad, state.outer_products.changes),
        )
        return state.replace(
            per_environment=per_environment, outer_products=products, count=count + due
        )

    def frozen(self) -> Network:
        """The network with constant parameters, except for the learned loss."""
        weights, class_table = jax.lax.stop_gradient((self.weights, self.class_table))
        weights = {**weights, "learned_loss": self.weights["learned_loss"]}
        return dataclasses.replace(self, weights=weights, class_table=class_table)

    def inner_gradient(
        self, per_environment: Any, products: OuterProducts, count: jax.Array, steps: InnerSteps
    ) -> tuple[Any, jax.Array]:
        """The gradient of the learned loss of the last k steps.

        Args:
          per_environment: the per-environment weights in these k steps.
          products: the LSTM's outer products, of which each environment's first `count` inner steps
            are valid.
          count: [B].
          steps: the k steps.

        Returns:
          The gradient with respect to `per_environment`, and to the LSTM's products, [k, B, 4 H].
        """
        valid = self.valid(count)
        (states, _), _ = lstm_cell(steps.gate_inputs, steps.cell)  # [k, B, H]

        def loss(per_environment: Any, states: jax.Array) -> jax.Array:
            return self.apply("inner_loss", per_environment, jnp.moveaxis(states, 0, 1)).sum()

        actor = {"actor": per_environment["actor"]}
        actor_grad, states_grad = jax.grad(loss, (0, 1))(actor, states)
        lstm = self.weights["lstm"]
        rows, width = lstm["kernel"].shape[0], self.model.hidden
        transposed = self.kernel_transposed()

        def body(later: tuple, step: tuple) -> tuple[tuple, tuple]:
            gate_inputs, cell, state_grad = step
            _, vjp = jax.vjp(lambda z, cell: lstm_cell(z, cell)[0], gate_inputs, cell)
            z_grad, cell_grad = vjp((later[0] + state_grad, later[1]))
            grad = jnp.concatenate(
                [
                    product_with_transpose(z_grad, transposed, lstm["kernel"], self.model.dtype),
                    product(z_grad, skip_kernel(lstm).T, jnp.float32),
                ],
                axis=-1,
            ) + products.product_vjp(z_grad, valid)
            features, hidden, skip_inputs = jnp.split(grad, (rows - width, rows), axis=-1)
            return (hidden, cell_grad), (z_grad, features, skip_inputs)

        zero = jnp.zeros_like(steps.cell[0])
        _, (z_grad, *features_grad) = jax.lax.scan(
            body, (zero, zero), (steps.gate_inputs, steps.cell, states_grad), reverse=True
        )
        before = {name: value for name, value in per_environment.items() if name != "actor"}
        _, vjp = jax.vjp(
            lambda before: jax.vmap(lambda inputs: self.perceive(before, inputs))(
                steps.step_inputs
            ),
            before,
        )
        (before_grad,) = vjp(tuple(features_grad))
        return {**before_grad, **actor_grad}, z_grad


def skip_kernel(lstm: Any) -> jax.Array:
    """The LSTM's kernel for its skip inputs [m, 4 H]; m is 0 if there are none."""
    kernel: jax.Array = lstm.get("kernel_skip", lstm["kernel"][:0])
    return kernel


def small_layers(weights: Any, shared: tuple[str, ...]) -> Any:
    """The dense layers that are small enough for per-environment weights.

    Args:
      weights: parameters by name.
      shared: names of layers that are left out.
    """
    if "kernel" in weights:
        return weights if weights["kernel"].size <= SMALL else {}
    layers = {name: w for name, w in weights.items() if isinstance(w, Mapping)}
    parts = {name: small_layers(w, shared) for name, w in layers.items() if name not in shared}
    return {name: part for name, part in parts.items() if part}


def swap_axes(steps: InnerSteps) -> InnerSteps:
    """[B, k, ...] for [k, B, ...], and the reverse."""
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), steps)


def gated(per_environment: Any, gate: jax.Array) -> Any:
    """Per-environment weights that are added where `gate` [B] is True."""
    if "kernel" in per_environment:
        return {**per_environment, "gate": gate}
    return {name: gated(value, gate) for name, value in per_environment.items()}
