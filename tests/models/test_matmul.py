"""Matrix products: value, gradient and rounding."""

from __future__ import annotations

from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.models.matmul import product, product_with_transpose
from tests.support.samples import normal

#: Sums of a few dozen float32 products, in another order.
CLOSE = {"rtol": 2e-5, "atol": 2e-6}


@pytest.mark.parametrize("lead", [(), (6,), (2, 6), (2, 3, 2)])
def test_product_is_a_matrix_product_with_the_plain_gradient(
    lead: tuple[int, ...], backend: None
) -> None:
    x, kernel, weight = normal(*lead, 4), normal(4, 3, seed=1), normal(*lead, 3, seed=2)
    fast = jax.value_and_grad(lambda x, k: (product(x, k, jnp.float32) * weight).sum(), (0, 1))
    plain = jax.value_and_grad(lambda x, k: ((x @ k) * weight).sum(), (0, 1))
    chex.assert_trees_all_close(fast(x, kernel), plain(x, kernel), **CLOSE)


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
def test_a_product_with_a_transpose_is_a_product(dtype: Any) -> None:
    x, kernel, weight = normal(6, 4), normal(4, 3, seed=1), normal(6, 3, seed=2)
    fast = jax.value_and_grad(
        lambda x, k: (product_with_transpose(x, k, kernel.T, dtype) * weight).sum(), (0, 1)
    )
    plain = jax.value_and_grad(lambda x, k: (product(x, k, dtype) * weight).sum(), (0, 1))
    chex.assert_trees_all_close(fast(x, kernel), plain(x, kernel), **CLOSE)
