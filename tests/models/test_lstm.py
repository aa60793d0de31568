"""The LSTM against NumPy, and where episodes start. Its gradient: `test_activation_cache`."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.models.lstm import LSTM
from tests.support import equations
from tests.support.samples import normal, randomised

#: Sums of a few dozen float32 products, in another order.
CLOSE = {"rtol": 2e-5, "atol": 2e-6}
T, B, N, M, H = 7, 4, 8, 2, 5


def example(seed: int, first_share: float = 0.3) -> tuple[Any, tuple[Any, ...]]:
    """Parameters; a carry, inputs, skip inputs and episode starts of a rollout."""
    is_first = jnp.asarray(np.random.default_rng(seed).random((T, B)) < first_share)
    carry = normal(B, H, seed=seed + 1), normal(B, H, seed=seed + 2)
    inputs = carry, normal(T, B, N, seed=seed + 3), normal(T, B, M, seed=seed + 4), is_first
    made = jax.eval_shape(LSTM(H).init, jax.random.key(0), *inputs)
    return randomised(made["params"], seed), inputs


@settings(max_examples=10)
@given(st.integers(0, 10**6), st.sampled_from((0.0, 0.3, 1.0)))
def test_the_lstm_is_the_numpy_lstm(seed: int, first_share: float) -> None:
    weights, (carry, *inputs) = example(seed, first_share)
    (h, c), out = LSTM(H).apply({"params": weights}, carry, *inputs)
    arrays = (np.asarray(x) for x in (*carry, *inputs))
    expected, last = equations.lstm_rollout(np, equations.in_float64(weights), *arrays)
    for found, plain in zip((out, h, c), (expected, *last), strict=True):
        np.testing.assert_allclose(found, plain, **CLOSE)


def test_a_rollout_equals_its_steps() -> None:
    weights, (carry, *inputs) = example(seed=1)
    variables = {"params": weights}
    steps = jax.lax.scan(lambda c, step: LSTM(H).apply(variables, c, *step), carry, tuple(inputs))
    chex.assert_trees_all_close(LSTM(H).apply(variables, carry, *inputs), steps, **CLOSE)


def test_the_first_steps_of_episodes_know_nothing_of_the_past() -> None:
    weights, (carry, x, skip_inputs, is_first) = example(seed=2)
    is_first = is_first.at[3].set(True)
    other = jax.tree.map(lambda v: v + 1.0, carry)
    first = LSTM(H).apply({"params": weights}, carry, x, skip_inputs, is_first)
    second = LSTM(H).apply({"params": weights}, other, x.at[:3].add(1.0), skip_inputs, is_first)
    chex.assert_trees_all_equal((first[0], first[1][3:]), (second[0], second[1][3:]))
    assert not np.allclose(first[1][:3], second[1][:3])
