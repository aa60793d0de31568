"""Look-ups and dense layers: equal to the plain form in value and in gradient."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.models.layers import PER_ENVIRONMENT, Linear, look_up, look_up_in_rows
from tests.support.samples import normal, randomised

CLOSE = {"rtol": 2e-5, "atol": 2e-6}  # float32 sums in another order


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


def test_per_environment_weights_are_added_where_their_gate_is_open() -> None:
    layer, x = Linear(2), normal(3, 5, 4)  # [B, rows, n]
    params = randomised(layer.init(jax.random.key(0), x)["params"])
    own = {"kernel": normal(3, 4, 2, seed=1), "bias": normal(3, 2, seed=2)}
    gate = jnp.asarray([True, False, True])
    found = layer.apply({"params": params, PER_ENVIRONMENT: {**own, "gate": gate}}, x)
    for b in range(3):
        kernel = params["kernel"] + gate[b] * own["kernel"][b]
        bias = params["bias"] + gate[b] * own["bias"][b]
        np.testing.assert_allclose(found[b], x[b] @ kernel + bias, **CLOSE)
