"""The activation cache: cached values, and the gradient of the plain form."""

from __future__ import annotations

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from tdanet_jax.models.activation_cache import ACTIVATIONS
from tdanet_jax.models.layers import Linear
from tdanet_jax.models.lstm import LSTM
from tests.support import equations
from tests.support.samples import normal, randomised

#: Sums of a few dozen float32 products, in another order.
CLOSE = {"rtol": 2e-5, "atol": 2e-6}
T, B, N, H = 7, 4, 3, 5


class Stack(nn.Module):
    """Two dense layers and an LSTM, all of them cached."""

    dtype: Any = jnp.float32

    @nn.compact
    def __call__(self, carry: Any, x: jax.Array, is_first: jax.Array) -> Any:
        x, skip_inputs = nn.relu(Linear(8, self.dtype)(x)), x[..., 1:]
        carry, hidden = LSTM(H, self.dtype)(carry, x, skip_inputs, is_first)
        return carry, Linear(2, self.dtype)(hidden)


def example(seed: int) -> tuple[Any, ...]:
    """Parameters, a carry, inputs and episode starts of a rollout."""
    rng = np.random.default_rng(seed)
    carry = (normal(B, H, seed=seed + 1), normal(B, H, seed=seed + 2))
    x, is_first = normal(T, B, N, seed=seed + 3), jnp.asarray(rng.random((T, B)) < 0.3)
    made = jax.eval_shape(Stack().init, jax.random.key(0), carry, x[0], is_first[0])
    return randomised(made["params"], seed), carry, x, is_first


@functools.partial(jax.jit, static_argnames="dtype")
def acted(
    params: Any, carry: Any, x: jax.Array, is_first: jax.Array, dtype: Any = jnp.float32
) -> Any:
    """The outputs of T single steps and their cache."""

    def act(carry: Any, inputs: Any) -> Any:
        (carry, out), filled = Stack(dtype).apply(
            {"params": params}, carry, *inputs, mutable=[ACTIVATIONS]
        )
        return carry, (out, filled[ACTIVATIONS])

    return jax.lax.scan(act, carry, (x, is_first))


@pytest.mark.parametrize("seed", range(2))
def test_the_cache_gives_the_values_of_acting_and_the_plain_gradient(seed: int) -> None:
    params, carry, x, is_first = example(seed=10 + seed)
    last, (out, cache) = acted(params, carry, x, is_first)
    weight = normal(T, B, 2, seed=seed)
    tail = (normal(B, H, seed=seed + 5), normal(B, H, seed=seed + 6))

    def loss(params: Any, carry: Any, x: jax.Array, cache: Any) -> Any:
        after, y = Stack().apply({"params": params, ACTIVATIONS: cache}, carry, x, is_first)
        total = (y * weight).sum() + sum((a * b).sum() for a, b in zip(after, tail, strict=True))
        return total, (after, y)

    def plain(params: Any, carry: Any, x: jax.Array) -> jax.Array:
        h = jnp.maximum(equations.linear(params["Linear_0"], x), 0)
        hidden, after = equations.lstm_rollout(
            jnp, params["LSTM_0"], *carry, h, x[..., 1:], is_first
        )
        y = equations.linear(params["Linear_1"], hidden)
        return (y * weight).sum() + sum((a * b).sum() for a, b in zip(after, tail, strict=True))

    gradient = jax.jit(jax.value_and_grad(loss, (0, 1, 2), has_aux=True))
    (_, (after, y)), fast = gradient(params, carry, x, cache)
    chex.assert_trees_all_close((after, y), (last, out), rtol=1e-6, atol=1e-6)
    chex.assert_trees_all_close(
        fast, jax.jit(jax.grad(plain, (0, 1, 2)))(params, carry, x), **CLOSE
    )


class Twice(nn.Module):
    """Dense layers of two inputs, of a table without environments, and of rows."""

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
        out, filled = model.apply({"params": params}, *inputs, table, mutable=[ACTIVATIONS])
        return None, (out, filled[ACTIVATIONS])

    _, (out, cache) = jax.jit(lambda given: jax.lax.scan(act, None, given))((a, b))

    @jax.jit
    @functools.partial(jax.value_and_grad, has_aux=True)
    def gradient(params: Any, variables: Any) -> Any:
        y = model.apply({"params": params, **variables}, a, b, table)
        return (y * weight).sum(), y

    (_, y), fast = gradient(params, {ACTIVATIONS: cache})
    (_, z), plain = gradient(params, {})
    close = CLOSE if dtype == jnp.float32 else {"rtol": 2e-2, "atol": 1e-2}
    chex.assert_trees_all_close((y, y), (out, z), **close)
    chex.assert_trees_all_close(fast, plain, **close)


def test_products_of_more_than_one_row_per_environment_are_not_cached() -> None:
    layer = Linear(4)
    x = normal(2, B, 5, 3)  # [T, B, rows, n]
    params = randomised(layer.init(jax.random.key(1), x)["params"])
    y, filled = layer.apply({"params": params}, x[0], mutable=[ACTIVATIONS])
    assert not filled.get(ACTIVATIONS)
    np.testing.assert_allclose(y, x[0] @ params["kernel"] + params["bias"], rtol=1e-5)

    def total(params: Any) -> jax.Array:
        return (layer.apply({"params": params, ACTIVATIONS: {}}, x) ** 2).sum()

    def plain(params: Any) -> jax.Array:
        return ((x @ params["kernel"] + params["bias"]) ** 2).sum()

    grads = jax.grad(total)(params), jax.grad(plain)(params)
    chex.assert_trees_all_close(*grads, rtol=1e-4, atol=1e-5)


def test_values_come_from_the_cache_and_not_from_new_products() -> None:
    params, carry, x, is_first = example(seed=20)
    _, (out, cache) = acted(params, carry, x, is_first)
    changed = {**cache, "Linear_1": jax.tree.map(lambda v: v + 1.0, cache["Linear_1"])}
    _, y = Stack().apply({"params": params, ACTIVATIONS: changed}, carry, x, is_first)
    np.testing.assert_allclose(y, out + 1.0, **CLOSE)


def test_while_acting_values_are_computed() -> None:
    params, carry, x, is_first = example(seed=21)
    _, (out, cache) = acted(params, carry, x, is_first)
    stale = jax.tree.map(lambda v: v[0] + 100.0, cache)
    (_, y), _ = Stack().apply(
        {"params": params, ACTIVATIONS: stale}, carry, x[0], is_first[0], mutable=[ACTIVATIONS]
    )
    np.testing.assert_allclose(y, out[0], **CLOSE)


def test_the_cache_of_a_bfloat16_network_gives_close_gradients(backend: None) -> None:
    params, carry, x, is_first = example(seed=22)
    weight = normal(T, B, 2, seed=1)

    def gradient(dtype: Any) -> Any:
        _, (_, cache) = acted(params, carry, x, is_first, dtype)

        def loss(params: Any) -> jax.Array:
            variables = {"params": params, ACTIVATIONS: cache}
            return (Stack(dtype).apply(variables, carry, x, is_first)[1] * weight).sum()

        return jax.jit(jax.grad(loss))(params)

    full, half = gradient(jnp.float32), gradient(jnp.bfloat16)
    for one, two in zip(jax.tree.leaves(full), jax.tree.leaves(half), strict=True):
        assert two.dtype == jnp.float32
        # bfloat16 has eight bits: a per cent of the largest entry, over seven steps.
        np.testing.assert_allclose(two, one, atol=0.05 * float(jnp.abs(one).max()))
    assert not np.array_equal(jax.tree.leaves(full)[0], jax.tree.leaves(half)[0])
