"""The recurrent actor-critic around TDANet's encoder."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.env.types import Observation
from tdanet_jax.models import actor_critic
from tdanet_jax.models.activation_cache import ACTIVATIONS
from tdanet_jax.models.actor_critic import ActorCritic, Output, RecurrentState
from tdanet_jax.models.lstm import Carry
from tdanet_jax.models.tdanet import TDANetEncoder
from tests.support import equations, samples
from tests.support.samples import observations

T, B, H = 3, 2, 6
CLOSE = {"rtol": 5e-5, "atol": 5e-6}  # float32 sums in another order, over three steps
WORDS = jnp.asarray(samples.words())


def network(**encoder: Any) -> ActorCritic:
    return ActorCritic(TDANetEncoder(7, **{"dropout": 0.25, **encoder}), hidden=H, action_width=4)


@functools.cache
def parameters() -> Any:
    return samples.parameters(network(), WORDS)


def inputs(seed: int = 0) -> tuple[Carry, Observation, jax.Array, jax.Array, jax.Array]:
    """A rollout's carry, observations, previous action probabilities, starts and dropout mask."""
    rng = np.random.default_rng(seed)
    is_first = rng.random((T, B)) < 0.3
    prev_action_probs = np.where(is_first[..., None], 0, rng.dirichlet(np.ones(6), (T, B)))
    carry = tuple(jnp.asarray(rng.normal(size=(B, H)), jnp.float32) for _ in range(2))
    dropout_mask = jnp.asarray(rng.random((T, B, 7)) < 0.75)
    obs = observations(T, B, seed=seed)
    return (
        carry,
        obs,
        jnp.asarray(prev_action_probs, jnp.float32),
        jnp.asarray(is_first),
        dropout_mask,
    )


@jax.jit
def forward(params: Any, carry: Carry, obs: Observation, *rest: Any) -> tuple[Carry, Output]:
    module = network()
    class_table = module.apply({"params": params}, WORDS, method="prepare")
    return module.apply({"params": params}, class_table, carry, obs, *rest)


def plain(xp: Any, params: Any, given: Any) -> tuple[Any, Any]:
    """The printed equations on inputs that are NumPy arrays."""
    carry, obs, prev_action_probs, is_first, dropout_mask = given
    frames = [
        [
            (xp.asarray(rows), xp.asarray(word))
            for rows, word in equations.frames(row, np.asarray(WORDS))
        ]
        for row in (jax.tree.map(lambda x, t=t: x[t], obs) for t in range(T))
    ]
    arrays = [xp.asarray(x) for x in (prev_action_probs, *carry, is_first, dropout_mask)]
    return equations.actor_critic(
        xp, params, frames, arrays[0], (arrays[1], arrays[2]), arrays[3], ~arrays[4]
    )


def test_logits_and_values_are_those_of_the_printed_equations() -> None:
    carry, obs, prev_action_probs, is_first, dropout_mask = inputs()
    _, out = forward(parameters(), carry, obs, prev_action_probs, is_first, dropout_mask)
    logits, value = plain(np, equations.in_float64(parameters()), jax.device_get(inputs()))
    assert out.logits.shape == (T, B, 6)
    assert out.value.shape == (T, B)
    np.testing.assert_allclose(out.logits, logits, **CLOSE)
    np.testing.assert_allclose(out.value, value, **CLOSE)


def test_the_gradient_with_a_cache_is_that_of_the_printed_equations() -> None:
    carry, obs, prev_action_probs, is_first, dropout_mask = inputs()
    module, params = network(), parameters()
    rng = np.random.default_rng(1)
    mix = jnp.asarray(rng.normal(size=(T, B, 6)), jnp.float32)
    cache = act_alone(params, carry, obs, prev_action_probs, is_first, dropout_mask)[1]

    def fast(params: Any) -> jax.Array:
        class_table = module.apply({"params": params}, WORDS, method="prepare")
        _, out = module.apply(
            {"params": params, ACTIVATIONS: cache},
            class_table,
            carry,
            obs,
            prev_action_probs,
            is_first,
            dropout_mask,
        )
        return (out.logits * mix).sum() + (out.value * mix[..., 0]).sum()

    given = jax.device_get(inputs())

    def slow(params: Any) -> jax.Array:
        logits, value = plain(jnp, params, given)
        return (logits * mix).sum() + (value * mix[..., 0]).sum()

    chex.assert_trees_all_close(
        jax.jit(jax.grad(fast))(params), jax.jit(jax.grad(slow))(params), rtol=1e-4, atol=2e-5
    )


def act_alone(
    params: Any,
    carry: Carry,
    obs: Observation,
    prev_action_probs: jax.Array,
    is_first: jax.Array,
    dropout_mask: Any,
) -> tuple[Output, Any]:
    """The outputs of T single steps and their activation cache."""
    module = network()
    class_table = module.apply({"params": params}, WORDS, method="prepare")

    def act(carry: Carry, step: Any) -> Any:
        (carry, out), cache = module.apply(
            {"params": params}, class_table, carry, *step, mutable=[ACTIVATIONS]
        )
        return carry, (out, cache[ACTIVATIONS])

    return jax.lax.scan(act, carry, (obs, prev_action_probs, is_first, dropout_mask))[1]


def test_a_rollout_equals_its_steps() -> None:
    carry, *rest = inputs()
    stepped, _ = act_alone(parameters(), carry, *rest)
    chex.assert_trees_all_close(forward(parameters(), carry, *rest)[1], stepped, **CLOSE)


def test_the_first_step_knows_nothing_of_the_carry() -> None:
    carry, obs, prev_action_probs, _, dropout_mask = inputs()
    row = jax.tree.map(lambda x: x[0], (obs, prev_action_probs))
    is_first = jnp.ones(B, bool)
    zero = network().initial_carry(B, parameters())
    chex.assert_trees_all_equal(
        forward(parameters(), carry, *row, is_first, dropout_mask[0]),
        forward(parameters(), zero, *row, is_first, dropout_mask[0]),
    )
    assert not jnp.concatenate(zero).any()


@pytest.mark.parametrize("part", ["carry", "action"])
def test_the_past_matters(part: str) -> None:
    carry, obs, prev_action_probs, _, dropout_mask = inputs()
    obs, prev_action_probs, dropout_mask = jax.tree.map(
        lambda x: x[0], (obs, prev_action_probs, dropout_mask)
    )
    stale = jnp.zeros(B, bool)
    other_carry = jax.tree.map(lambda x: x + 1, carry) if part == "carry" else carry
    other_probs = (
        jnp.roll(prev_action_probs + 0.1, 1, axis=-1) if part == "action" else prev_action_probs
    )
    first = forward(parameters(), carry, obs, prev_action_probs, stale, dropout_mask)[1]
    second = forward(parameters(), other_carry, obs, other_probs, stale, dropout_mask)[1]
    assert not np.allclose(first.logits, second.logits)


class Steps(NamedTuple):
    """What `actor_critic.act` is given and gives in T steps, [T, ...]."""

    is_first: jax.Array
    prev_action_probs: jax.Array
    out: Output
    activations: Any
    attention: jax.Array


def acted(weights: Any) -> tuple[RecurrentState, RecurrentState, Steps]:
    """T steps, one at a time, of which some begin an episode: the states around them, and they."""
    module = network()
    _, obs, *_, dropout_mask = inputs()
    done = inputs()[3]
    class_table = actor_critic.prepare(module, weights, WORDS)

    def step(state: RecurrentState, given: Any) -> tuple[RecurrentState, Steps]:
        obs, mask, done = given
        after, out, kept = actor_critic.act(
            module, weights, class_table, state, obs, mask, (ACTIVATIONS, "intermediates")
        )
        (attention,) = kept["intermediates"]["attention"]
        steps = Steps(state.is_first, state.prev_action_probs, out, kept[ACTIVATIONS], attention)
        return after.restarted(done), steps

    start = actor_critic.initial_state(module, weights, B)
    after, steps = jax.lax.scan(step, start, (obs, dropout_mask, done))
    return start, after, steps


def test_acting_step_by_step_is_the_forward_pass_over_the_rollout() -> None:
    weights, (_, obs, *_, dropout_mask) = parameters(), inputs()
    start, after, steps = jax.jit(acted)(weights)
    assert steps.is_first[0].all()
    assert not steps.is_first.all()
    assert steps.is_first[1:].any()
    given = (obs, steps.prev_action_probs, steps.is_first, dropout_mask)
    carry, out = forward(weights, start.carry, *given)
    chex.assert_trees_all_close((after.carry, steps.out), (carry, out), **CLOSE)
    class_table = actor_critic.prepare(network(), weights, WORDS)
    cached = actor_critic.forward(
        network(), weights, class_table, start.carry, *given, activations=steps.activations
    )
    chex.assert_trees_all_close(cached, (carry, out), **CLOSE)
    # The next step is given the probabilities of this one, or zeros where an episode begins.
    probs = jnp.where(steps.is_first[1:, :, None], 0.0, jax.nn.softmax(steps.out.logits)[:-1])
    np.testing.assert_allclose(steps.prev_action_probs[1:], probs, rtol=1e-6)
    assert not steps.prev_action_probs[0].any()


def test_the_attention_of_a_step_is_the_encoders() -> None:
    weights, (_, obs, *_) = parameters(), inputs()
    *_, steps = acted(weights)
    module = network()
    class_table = actor_critic.prepare(module, weights, WORDS)
    encoder = {"params": weights["encoder"]}
    expected = module.encoder.apply(encoder, class_table, obs, method="attend")
    assert steps.attention.shape == obs.mask.shape
    np.testing.assert_allclose(steps.attention, expected, **CLOSE)
    np.testing.assert_allclose(steps.attention.sum(-1), 1, rtol=1e-5)


def test_a_step_gives_only_the_collections_that_it_is_asked_for() -> None:
    weights, (_, obs, *_) = parameters(), inputs()
    module, obs = network(), jax.tree.map(lambda x: x[0], obs)
    class_table = actor_critic.prepare(module, weights, WORDS)
    state = actor_critic.initial_state(module, weights, B)
    found = [
        actor_critic.act(module, weights, class_table, state, obs, collections=names)
        for names in ((), (ACTIVATIONS,), ("intermediates",))
    ]
    assert [set(kept) for *_, kept in found] == [set(), {ACTIVATIONS}, {"intermediates"}]
    for after, out, _ in found[1:]:
        chex.assert_trees_all_equal((after, out), found[0][:2])


def test_a_new_episode_begins_without_a_previous_action_and_others_continue() -> None:
    carry, _, prev_action_probs, *_ = inputs()
    state = RecurrentState(carry, prev_action_probs[0] + 0.1, jnp.zeros(B, bool))
    after = state.restarted(jnp.array([True, False]))
    assert after.is_first.tolist() == [True, False]
    assert not after.prev_action_probs[0].any()
    np.testing.assert_array_equal(after.prev_action_probs[1], state.prev_action_probs[1])
    chex.assert_trees_all_equal(after.carry, carry)  # the LSTM clears it by `is_first`


def test_the_published_size() -> None:
    # W_L and Linear1 303 x 512, three 512 x 512 layers, 6 -> 10, LSTM 522 -> 512 with two biases,
    # actor and critic, every layer with its bias.
    module = ActorCritic(TDANetEncoder())
    shapes = jax.eval_shape(module.initialise, jax.random.key(0), jnp.zeros((22, 300)))
    assert sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(shapes)) == 3_224_653


def test_the_number_of_classes_does_not_change_the_size() -> None:
    sizes = [
        jax.tree.map(jnp.shape, jax.eval_shape(network().initialise, jax.random.key(0), words))
        for words in (jnp.zeros((5, 50)), jnp.zeros((118, 50)))
    ]
    assert sizes[0] == sizes[1]


def test_a_new_policy_is_nearly_uniform_and_keys_decide_the_parameters() -> None:
    initialise = jax.jit(network().initialise)
    params = [initialise(jax.random.key(k), WORDS) for k in (0, 0, 1)]
    chex.assert_trees_all_equal(params[0], params[1])
    assert not np.array_equal(
        params[0]["encoder"]["linear1"]["kernel"], params[2]["encoder"]["linear1"]["kernel"]
    )
    carry, *rest = inputs()
    probabilities = jax.nn.softmax(forward(params[0], carry, *rest)[1].logits)
    np.testing.assert_allclose(probabilities, 1 / 6, atol=0.01)


def test_all_parameters_get_a_gradient() -> None:
    carry, *rest = inputs()

    def loss(params: Any) -> jax.Array:
        out = forward(params, carry, *rest)[1]
        return (out.logits**2).sum() + (out.value**2).sum()

    for path, leaf in jax.tree.leaves_with_path(jax.jit(jax.grad(loss))(parameters())):
        assert np.asarray(leaf).any(), jax.tree_util.keystr(path)


def test_a_bfloat16_network_is_close() -> None:
    carry, *rest = inputs()
    half = ActorCritic(
        TDANetEncoder(7, dtype=jnp.bfloat16), hidden=H, action_width=4, dtype=jnp.bfloat16
    )
    class_table = half.apply({"params": parameters()}, WORDS, method="prepare")
    _, out = jax.jit(half.apply)({"params": parameters()}, class_table, carry, *rest)
    _, full = forward(parameters(), carry, *rest)
    for one, two in ((out.logits, full.logits), (out.value, full.value)):
        assert one.dtype == jnp.float32
        # Eight bits of mantissa through the encoder and three steps of the LSTM.
        np.testing.assert_allclose(one, two, atol=0.05 * float(jnp.abs(two).max()))
