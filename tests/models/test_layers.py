"""Products, the tape and the LSTM: equal to the plain form in value and in gradient."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.models.layers import (
    LSTM,
    TAPE,
    Linear,
    look_up,
    look_up_in_rows,
    paired_product,
    product,
)
from tests.support import equations
from tests.support.samples import randomised

#: Sums of a few dozen float32 products, in another order.
CLOSE = {"rtol": 2e-5, "atol": 2e-6}
T, B, N, H = 7, 4, 3, 5


def normal(*shape: int, seed: int = 0) -> jax.Array:
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


@pytest.mark.parametrize("lead", [(), (6,), (2, 6), (2, 3, 2)])
def test_product_is_a_matrix_product_with_the_plain_gradient(
    lead: tuple[int, ...], backend: None
) -> None:
    x, kernel, weight = normal(*lead, 4), normal(4, 3, seed=1), normal(*lead, 3, seed=2)
    fast = jax.value_and_grad(lambda x, k: (product(x, k, jnp.float32) * weight).sum(), (0, 1))
    plain = jax.value_and_grad(lambda x, k: ((x @ k) * weight).sum(), (0, 1))
    chex.assert_trees_all_close(fast(x, kernel), plain(x, kernel), **CLOSE)


def test_look_ups_have_the_value_and_gradient_of_plain_indexing(backend: None) -> None:
    table, wide = normal(5, 3), normal(5, 6, seed=1)
    row, column = jnp.asarray([[0, 4], [2, 4]]), jnp.asarray([[[1, 1, 0], [5, 2, 5]]] * 2)
    mix, more = normal(2, 2, 3, seed=2), normal(2, 2, 3, seed=3)

    def fast(table: jax.Array, wide: jax.Array) -> jax.Array:
        entries = look_up_in_rows(wide, row, column)
        return (look_up(table, row) * mix).sum() + (entries * more).sum()

    def plain(table: jax.Array, wide: jax.Array) -> jax.Array:
        return (table[row] * mix).sum() + (wide[row[..., None], column] * more).sum()

    first, second = (jax.value_and_grad(f, (0, 1))(table, wide) for f in (fast, plain))
    chex.assert_trees_all_close(first, second, **CLOSE)


def test_product_rounds_its_operands_only() -> None:
    x, kernel = normal(64, 32), normal(32, 8, seed=1)
    rounded = product(x, kernel, jnp.bfloat16)
    exact = np.asarray(x.astype(jnp.bfloat16), np.float64) @ np.asarray(
        kernel.astype(jnp.bfloat16), np.float64
    )
    assert rounded.dtype == jnp.float32
    np.testing.assert_allclose(rounded, exact, **CLOSE)
    assert not np.allclose(rounded, x @ kernel, **CLOSE)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_a_paired_product_is_a_product(dtype: Any) -> None:
    x, kernel, weight = normal(6, 4), normal(4, 3, seed=1), normal(6, 3, seed=2)
    paired = jax.value_and_grad(
        lambda x, k: (paired_product(x, k, kernel.T, dtype) * weight).sum(), (0, 1)
    )
    plain = jax.value_and_grad(lambda x, k: (product(x, k, dtype) * weight).sum(), (0, 1))
    chex.assert_trees_all_close(paired(x, kernel), plain(x, kernel), **CLOSE)


class Stack(nn.Module):
    """Two dense layers and an LSTM, which all write to the tape."""

    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, carry: Any, x: jax.Array, fresh: jax.Array) -> Any:
        x, aside = nn.relu(Linear(8, self.dtype)(x)), x[..., 1:]
        carry, hidden = LSTM(H, self.dtype)(carry, x, aside, fresh)
        return carry, Linear(2, self.dtype)(hidden)


def example(seed: int, fresh_share: float = 0.3) -> tuple[Any, ...]:
    """Parameters, a carry, inputs and episode starts of a rollout."""
    rng = np.random.default_rng(seed)
    carry = (normal(B, H, seed=seed + 1), normal(B, H, seed=seed + 2))
    x, fresh = normal(T, B, N, seed=seed + 3), jnp.asarray(rng.random((T, B)) < fresh_share)
    made = jax.eval_shape(Stack().init, jax.random.key(0), carry, x[0], fresh[0])
    return randomised(made["params"], seed), carry, x, fresh


def recorded(
    params: Any, carry: Any, x: jax.Array, fresh: jax.Array, dtype: Any = jnp.float32
) -> Any:
    """The outputs of T single steps and their tape."""

    def act(carry: Any, inputs: Any) -> Any:
        (carry, out), tape = Stack(dtype).apply({"params": params}, carry, *inputs, mutable=[TAPE])
        return carry, (out, tape[TAPE])

    return jax.lax.scan(act, carry, (x, fresh))


@settings(max_examples=10)
@given(st.integers(0, 10**6), st.sampled_from((0.0, 0.3, 1.0)))
def test_the_lstm_is_the_numpy_lstm(seed: int, fresh_share: float) -> None:
    params, carry, _, fresh = example(seed, fresh_share)
    weights = params["LSTM_0"]
    x, aside = normal(T, B, 8, seed=seed), normal(T, B, N - 1, seed=seed + 1)
    (h, c), out = LSTM(H).apply({"params": weights}, carry, x, aside, fresh)
    given = (np.asarray(a) for a in (*carry, x, aside, fresh))
    expected, (last_h, last_c) = equations.lstm_rollout(np, equations.in_float64(weights), *given)
    np.testing.assert_allclose(out, expected, **CLOSE)
    np.testing.assert_allclose(h, last_h, **CLOSE)
    np.testing.assert_allclose(c, last_c, **CLOSE)


def test_a_rollout_equals_its_steps() -> None:
    params, carry, x, fresh = example(seed=1)
    last, (out, _) = recorded(params, carry, x, fresh)
    chex.assert_trees_all_close(
        Stack().apply({"params": params}, carry, x, fresh), (last, out), **CLOSE
    )


def test_fresh_steps_know_nothing_of_the_past() -> None:
    params, carry, x, fresh = example(seed=2)
    fresh = fresh.at[3].set(True)
    other = jax.tree.map(lambda v: v + 1.0, carry)
    first = Stack().apply({"params": params}, carry, x, fresh)
    second = Stack().apply({"params": params}, other, x.at[:3].add(1.0), fresh)
    chex.assert_trees_all_equal((first[0], first[1][3:]), (second[0], second[1][3:]))
    assert not np.allclose(first[1][:3], second[1][:3])


@pytest.mark.parametrize("seed", range(3))
def test_the_tape_gives_the_recorded_values_and_the_plain_gradient(seed: int) -> None:
    params, carry, x, fresh = example(seed=10 + seed)
    last, (out, tape) = recorded(params, carry, x, fresh)
    weight = normal(T, B, 2, seed=seed)
    tail = (normal(B, H, seed=seed + 5), normal(B, H, seed=seed + 6))

    def loss(params: Any, carry: Any, x: jax.Array, tape: Any) -> Any:
        after, y = Stack().apply({"params": params, TAPE: tape}, carry, x, fresh)
        total = (y * weight).sum() + sum((a * b).sum() for a, b in zip(after, tail, strict=True))
        return total, (after, y)

    def plain(params: Any, carry: Any, x: jax.Array) -> jax.Array:
        h = jnp.maximum(equations.linear(params["Linear_0"], x), 0)
        hidden, after = equations.lstm_rollout(jnp, params["LSTM_0"], *carry, h, x[..., 1:], fresh)
        y = equations.linear(params["Linear_1"], hidden)
        return (y * weight).sum() + sum((a * b).sum() for a, b in zip(after, tail, strict=True))

    (_, (after, y)), fast = jax.value_and_grad(loss, (0, 1, 2), has_aux=True)(
        params, carry, x, tape
    )
    chex.assert_trees_all_close((after, y), (last, out), rtol=1e-6, atol=1e-6)
    chex.assert_trees_all_close(fast, jax.grad(plain, (0, 1, 2))(params, carry, x), **CLOSE)


class Twice(nn.Module):
    """One dense layer of two inputs, of a table without environments, and of rows."""

    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, a: jax.Array, b: jax.Array, table: jax.Array) -> jax.Array:
        layer, other, third = Linear(2, self.dtype), Linear(2, self.dtype), Linear(2, self.dtype)
        rows = third(jnp.stack([a, b], axis=-2)).sum(axis=-2)
        return abs(layer(a) - layer(b)) + other(table).sum(axis=0) + rows * third(a)


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.bfloat16])
def test_layers_that_are_called_twice_have_the_plain_gradient(dtype: Any) -> None:
    a, b, table = normal(T, B, N), normal(T, B, N, seed=1), normal(6, N, seed=2)
    params = randomised(
        jax.eval_shape(Twice().init, jax.random.key(0), a[0], b[0], table)["params"], seed=3
    )
    model, weight = Twice(dtype), normal(T, B, 2, seed=4)

    def act(carry: None, inputs: Any) -> Any:
        out, tape = model.apply({"params": params}, *inputs, table, mutable=[TAPE])
        return None, (out, tape[TAPE])

    _, (out, tape) = jax.lax.scan(act, None, (a, b))

    def loss(params: Any, tape: Any) -> Any:
        y = model.apply({"params": params, **tape}, a, b, table)
        return (y * weight).sum(), y

    (_, y), fast = jax.value_and_grad(loss, has_aux=True)(params, {TAPE: tape})
    (_, z), plain = jax.value_and_grad(loss, has_aux=True)(params, {})
    close = CLOSE if dtype == jnp.float32 else {"rtol": 2e-2, "atol": 1e-2}
    chex.assert_trees_all_close((y, y), (out, z), **close)
    chex.assert_trees_all_close(fast, plain, **close)


def test_values_come_from_the_tape_and_not_from_new_work() -> None:
    params, carry, x, fresh = example(seed=20)
    _, (out, tape) = recorded(params, carry, x, fresh)
    changed = jax.tree.map(lambda v: v, tape)
    changed["Linear_1"] = jax.tree.map(lambda v: v + 1.0, tape["Linear_1"])
    _, y = Stack().apply({"params": params, TAPE: changed}, carry, x, fresh)
    np.testing.assert_allclose(y, out + 1.0, **CLOSE)


def test_without_a_tape_or_while_recording_values_are_computed() -> None:
    params, carry, x, fresh = example(seed=21)
    _, (out, tape) = recorded(params, carry, x, fresh)
    stale = jax.tree.map(lambda v: v[0] + 100.0, tape)
    (_, y), _ = Stack().apply(
        {"params": params, TAPE: stale}, carry, x[0], fresh[0], mutable=[TAPE]
    )
    np.testing.assert_allclose(y, out[0], **CLOSE)


def test_the_tape_of_a_bfloat16_network_gives_close_gradients(backend: None) -> None:
    params, carry, x, fresh = example(seed=22)
    weight = normal(T, B, 2, seed=1)

    def gradient(dtype: Any) -> Any:
        _, (_, tape) = recorded(params, carry, x, fresh, dtype)

        def loss(params: Any) -> jax.Array:
            module = Stack(dtype)
            return (module.apply({"params": params, TAPE: tape}, carry, x, fresh)[1] * weight).sum()

        return jax.grad(loss)(params)

    full, half = gradient(jnp.float32), gradient(jnp.bfloat16)
    for one, two in zip(jax.tree.leaves(full), jax.tree.leaves(half), strict=True):
        assert two.dtype == jnp.float32
        # bfloat16 keeps eight bits: a per cent of the largest entry, over seven steps.
        np.testing.assert_allclose(two, one, atol=0.05 * float(jnp.abs(one).max()))
    assert not np.array_equal(jax.tree.leaves(full)[0], jax.tree.leaves(half)[0])
