"""Scene priors against the published network."""

from __future__ import annotations

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.models import sp
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.sp import ScenePriorsEncoder
from tests.support import equations, samples
from tests.support.samples import CLASSES, observations

T, B = 2, 3
CLOSE = {"rtol": 5e-5, "atol": 1e-5}  # float32 sums in another order
WORDS = jnp.asarray(samples.words())
KNOWN = (0, 1, 3, 4, 7)
EDGES = ((0, 3, 1.0), (1, 3, 0.5), (4, 7, 1.0), (0, 4, 0.25))
VOCABULARY = ClassVocabulary(tuple(map(str, range(CLASSES))), KNOWN, EDGES)
ADJACENCY = VOCABULARY.normalised_adjacency()
ENCODER = ScenePriorsEncoder(
    known=KNOWN, adjacency=tuple(map(tuple, ADJACENCY.tolist())), features=6, width=8
)
ACTION = jnp.asarray(np.random.default_rng(0).normal(size=(T, B, 10)), jnp.float32)


def frames() -> Any:
    """Observations of a few classes each."""
    obs = observations(T, B)
    shown = np.random.default_rng(5).random(obs.cells.shape) < 0.04
    return obs.replace(cells=jnp.where(shown, obs.cells, -1))


@functools.cache
def parameters() -> Any:
    def both(module: ScenePriorsEncoder) -> jax.Array:
        obs = jax.tree.map(lambda x: x[0], frames())
        return module(module.prepare(WORDS), obs, ACTION[0])

    initialise = functools.partial(ENCODER.init, method=both)
    params = samples.randomised(jax.eval_shape(initialise, jax.random.key(0))["params"])
    return {**params, "kernel2": abs(params["kernel2"])}  # or the last ReLU lets nothing through


@jax.jit
def features(params: Any, obs: Any, action: jax.Array, words: jax.Array = WORDS) -> jax.Array:
    class_table = ENCODER.apply({"params": params}, words, method="prepare")
    return ENCODER.apply({"params": params}, class_table, obs, action)


def plain(xp: Any, params: Any) -> Any:
    obs, words = jax.device_get(frames()), xp.asarray(np.asarray(WORDS))
    made = [
        xp.concatenate(
            [
                equations.image(
                    xp, params["trunk"], obs.cells[t, b], words, obs.target[t, b],
                    np.asarray(ACTION)[t, b],
                ),
                equations.scene_priors(xp, params, obs.cells[t, b], words, KNOWN, ADJACENCY),
            ]
        )
        for t in range(T) for b in range(B)
    ]  # fmt: skip
    return xp.stack(made).reshape(T, B, -1)


def test_the_fast_forms_equal_the_published_network() -> None:
    expected = plain(np, equations.in_float64(parameters()))
    whole = features(parameters(), frames(), ACTION)
    np.testing.assert_allclose(whole, expected, **CLOSE)
    step = features(parameters(), jax.tree.map(lambda x: x[0], frames()), ACTION[0])
    np.testing.assert_allclose(step, expected[0], **CLOSE)
    assert np.asarray(expected[..., 3136:].std(axis=(0, 1))).max() > 0.1  # the frame matters


@pytest.mark.slow
def test_the_fast_forms_have_the_gradient_of_the_published_network() -> None:
    mix = np.random.default_rng(1).normal(size=(T, B, 3136 + 6)).astype(np.float32)

    def fast(params: Any) -> jax.Array:
        return (features(params, frames(), ACTION) * mix).sum()

    grads = jax.grad(fast)(parameters())
    for path, leaf in jax.tree.leaves_with_path(grads):
        assert np.asarray(leaf).any(), jax.tree_util.keystr(path)
    expected = jax.grad(lambda params: (plain(jnp, params) * mix).sum())(parameters())
    chex.assert_trees_all_close(grads, expected, rtol=2e-4, atol=2e-4)


def test_classes_that_are_not_known_change_nothing_in_the_graph() -> None:
    obs = frames()
    unseen = jnp.asarray([c for c in range(CLASSES) if c not in KNOWN])
    hidden = jnp.isin(obs.cells, unseen)
    without = features(parameters(), obs.replace(cells=jnp.where(hidden, -1, obs.cells)), ACTION)
    assert hidden.any()
    np.testing.assert_array_equal(
        features(parameters(), obs, ACTION)[..., 3136:], without[..., 3136:]
    )


def test_the_published_size() -> None:
    n = 83  # classes of the published graph
    classes = ClassVocabulary(tuple(map(str, range(n))), tuple(range(n)))
    model = sp.make(sp.NetworkConfig(), classes, jnp.float32)
    shapes = jax.eval_shape(model.initialise, jax.random.key(0), jnp.zeros((n, 300)))["encoder"]
    shapes.pop("trunk")
    # 1,000 scores -> 512, words 300 -> 512, 1024 -> 1024 -> 1024 -> 1 without biases, n -> 512.
    layers = [(1001, 512), (301, 512), (1024, 1024), (1024, 1024), (1024, 1), (n + 1, 512)]
    size = sum(np.prod(leaf.shape) for leaf in jax.tree.leaves(shapes))
    assert size == sum(a * b for a, b in layers) - 512 * (1000 - n)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_graph_begins_as_loud_as_the_image(seed: int) -> None:
    """Twenty times as loud, it saturated the LSTM, and a run of a million steps learned nothing."""
    encoder = ENCODER.copy(features=64, width=256)

    def both(module: ScenePriorsEncoder) -> jax.Array:
        return module(module.prepare(WORDS), frames(), ACTION)

    found, _ = encoder.init_with_output(jax.random.key(seed), method=both)
    image, graph = (np.abs(part).mean() for part in (found[..., :-64], found[..., -64:]))
    assert 0.1 < graph / image < 3
