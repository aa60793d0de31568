"""Graph convolutions against relu(A X W) written out, with nodes and units of zeros and without."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.models.shared.graph_convolutions import Convolutions, convolve, forward

N, H, U, T, B = 5, 7, 2, 3, 4


def example() -> tuple[Convolutions, jax.Array]:
    rng = np.random.default_rng(0)

    def positive(*shape: int) -> jax.Array:  # some units stay above zero in every layer
        return jnp.asarray(rng.normal(0.2, 1.0, shape), jnp.float32)

    weights = Convolutions(
        words=positive(N, H),
        degree=positive(N),
        adjacency=positive(N, N),
        second=positive(H, H),
        third=positive(H, U),
    )
    return weights, positive(T, B, H)


def written_out(weights: Convolutions, shared: jax.Array) -> jax.Array:
    """[T, B, N, U], one frame after another."""

    def of_frame(shared: jax.Array) -> jax.Array:
        x = jax.nn.relu(weights.degree[:, None] * shared + weights.words)
        x = jax.nn.relu(weights.adjacency @ x @ weights.second)
        return jax.nn.relu(weights.adjacency @ x @ weights.third)

    return jax.vmap(jax.vmap(of_frame))(shared)


@pytest.mark.parametrize(("nodes", "units"), [(0, 0), (3, 0), (0, 4), (3, 4)])
def test_zeros_change_neither_value_nor_gradient(nodes: int, units: int) -> None:
    weights, shared = example()
    mix = jnp.asarray(np.random.default_rng(1).normal(size=(T, B, N, U)), jnp.float32)

    def fast(weights: Convolutions, shared: jax.Array) -> jax.Array:
        padded = weights.padded(nodes, units)
        shared = jnp.pad(shared, ((0, 0), (0, 0), (0, units)))
        value = jax.lax.stop_gradient(forward(padded, shared, jnp.float32))
        return (convolve(padded, shared, jnp.float32, value)[..., :N, :] * mix).sum()

    def slow(weights: Convolutions, shared: jax.Array) -> jax.Array:
        return (written_out(weights, shared) * mix).sum()

    found = jax.jit(jax.value_and_grad(fast, (0, 1)))(weights, shared)
    expected = jax.jit(jax.value_and_grad(slow, (0, 1)))(weights, shared)
    chex.assert_trees_all_close(found, expected, rtol=1e-4, atol=1e-3)
    assert all(jnp.abs(leaf).max() > 1 for leaf in jax.tree.leaves(expected[1]))
