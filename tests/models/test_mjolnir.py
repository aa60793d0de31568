"""MJOLNIR's encoders against the published equations, and where their graph comes from."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import linen as nn

from tdanet_jax.env.types import Observation
from tdanet_jax.models.activation_cache import ACTIVATIONS
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.mjolnir import MjolnirOEncoder, MjolnirREncoder
from tdanet_jax.models.shared.image import CELLS, CHANNELS, DROPOUT_UNITS
from tests.support import class_equations, equations, samples
from tests.support.samples import CLASSES, WIDTH

KNOWN = (0, 1, 3, 4, 6, 8)
VOCABULARY = ClassVocabulary(
    tuple(f"Class{i}" for i in range(CLASSES)), KNOWN, ((0, 3, 1.0), (1, 3, 1.0), (4, 8, 0.5))
)
T, B, H = 3, 4, 7
WORDS = jnp.asarray(samples.words())
#: Sums of a few dozen float32 products, in another order.
CLOSE = {"rtol": 1e-4, "atol": 1e-5}

encoder = MjolnirOEncoder(classes=VOCABULARY, features=H)


def observations(*shape: int, seed: int = 1) -> Observation:
    return samples.one_per_class(samples.observations(*shape, seed=seed))


def both(module: MjolnirOEncoder, words: jax.Array, obs: Observation) -> jax.Array:
    return module(module.prepare(words), obs, None)


@functools.cache
def initial_parameters() -> Any:
    return encoder.init(jax.random.key(0), WORDS, observations(2), method=both)["params"]


def parameters() -> Any:
    """Random ones; the adjacency is not symmetric, as it may become by training."""
    return samples.randomised(initial_parameters())


@jax.jit
def features(params: Any, obs: Observation, words: jax.Array = WORDS, cache: Any = None) -> Any:
    variables = {"params": params} if cache is None else {"params": params, ACTIVATIONS: cache}
    return encoder.apply(variables, words, obs, method=both)


def rows_of(obs: Observation) -> list[np.ndarray]:
    words = np.asarray(WORDS, np.float64)
    return [
        class_equations.context(*frame, words, KNOWN)
        for frame in class_equations.frames(obs, words)
    ]


def test_the_features_are_those_of_the_published_equations() -> None:
    obs = observations(12)
    found = features(parameters(), obs)
    assert found.shape == (12, H + 5 * len(KNOWN))
    exact, words = equations.in_float64(parameters()), np.asarray(WORDS, np.float64)
    expected = [class_equations.mjolnir_o(np, exact, rows, words, KNOWN) for rows in rows_of(obs)]
    np.testing.assert_allclose(found, np.stack(expected), **CLOSE)


@pytest.mark.slow
@pytest.mark.parametrize("from_cache", [False, True], ids=["computed", "from the cache"])
def test_the_gradient_is_that_of_the_published_equations(from_cache: bool) -> None:
    obs = observations(T, B)
    mix = np.random.default_rng(4).normal(size=(T, B, H + 5 * len(KNOWN))).astype(np.float32)
    contexts = [jnp.asarray(rows, jnp.float32) for rows in rows_of(samples.flat(obs))]
    cache = None
    if from_cache:

        def act(obs: Observation) -> Any:
            variables = {"params": parameters()}
            return encoder.apply(variables, WORDS, obs, method=both, mutable=[ACTIVATIONS])[1][
                ACTIVATIONS
            ]

        cache = jax.jit(jax.vmap(act))(obs)

    def fast(params: Any) -> jax.Array:
        return (features(params, obs, WORDS, cache) * mix).sum()

    def slow(params: Any) -> jax.Array:
        found = [class_equations.mjolnir_o(jnp, params, rows, WORDS, KNOWN) for rows in contexts]
        return (jnp.stack(found) * mix.reshape(T * B, -1)).sum()

    found, expected = jax.grad(fast)(parameters()), jax.jit(jax.grad(slow))(parameters())
    chex.assert_trees_all_close(found, expected, rtol=1e-3, atol=1e-3)


def test_layers_and_their_sizes_and_the_graph_at_the_start() -> None:
    n, h = len(KNOWN), len(KNOWN) + WIDTH
    assert jax.tree.map(jnp.shape, initial_parameters()) == {
        "graph": {
            "adjacency": (n, n),
            "kernels_0": {"kernel": (h, h)},
            "kernels_1": {"kernel": (h, h)},
            "kernels_2": {"kernel": (h, 5)},
            "last": (10, 1),
            "mapping": {"kernel": (n, H), "bias": (H,)},
        }
    }
    adjacency = initial_parameters()["graph"]["adjacency"]
    np.testing.assert_array_equal(adjacency, VOCABULARY.normalised_adjacency())


def test_a_bfloat16_encoder_is_close_and_returns_float32() -> None:
    obs, params = observations(12), parameters()
    half = MjolnirOEncoder(classes=VOCABULARY, features=H, dtype=jnp.bfloat16)
    found = half.apply({"params": params}, WORDS, obs, method=both)
    assert found.dtype == jnp.float32
    full = features(params, obs)
    np.testing.assert_allclose(found, full, atol=0.05 * float(jnp.abs(full).max()))
    assert not np.array_equal(found, full)


def test_blind_to_classes_that_it_does_not_know() -> None:
    obs = observations(12)
    unknown = ~np.isin(obs.classes, KNOWN)
    noise = jnp.asarray(np.random.default_rng(5).random(obs.boxes.shape), jnp.float32)
    other = obs.replace(boxes=jnp.where(unknown[..., None], noise, obs.boxes))
    assert (np.asarray(other.boxes) != obs.boxes).any()
    chex.assert_trees_all_equal(features(parameters(), obs), features(parameters(), other))


class Case(NamedTuple):
    """MJOLNIR-r with random parameters, and frames [2, 2] for it."""

    encoder: MjolnirREncoder
    params: Any
    obs: Observation
    action: jax.Array
    dropout_mask: jax.Array | None


def image_case(maps: bool, training: bool) -> Case:
    module = MjolnirREncoder(classes=VOCABULARY, features=H, dropout=0.25, maps=maps)
    rng, obs = np.random.default_rng(7), observations(2, 2)
    action = jnp.asarray(rng.normal(size=(2, 2, 10)), jnp.float32)
    dropout_mask = jnp.asarray(rng.random((2, 2, DROPOUT_UNITS)) < 0.75) if training else None

    def both(module: MjolnirREncoder) -> jax.Array:
        return module(module.prepare(WORDS), *jax.tree.map(lambda x: x[0], (obs, action)))

    params = samples.randomised(jax.jit(nn.init(both, module))(jax.random.key(0))["params"])
    return Case(module, params, obs, action, dropout_mask)


def published(xp: Any, case: Case, params: Any, words: Any) -> Any:
    """The features of the published equations, one frame at a time: [4, 3136 + H]."""
    obs, found = samples.flat(case.obs), []
    action = np.asarray(case.action).reshape(4, -1)
    for i, rows in enumerate(rows_of(obs)):
        maps, masks = None, None
        if case.encoder.maps:
            maps = xp.asarray(np.asarray(obs.features)[i], words.dtype)
        if case.dropout_mask is not None:
            masks = np.reshape(case.dropout_mask, (4, 2, CELLS, CHANNELS))[i]
        image = equations.image(
            xp, params["trunk"], np.asarray(obs.cells)[i], words, int(obs.target[i]), action[i],
            masks, maps=maps,
        )  # fmt: skip
        rows = xp.asarray(rows, words.dtype)
        found.append(class_equations.mjolnir_r(xp, params, rows, words, KNOWN, image))
    return xp.stack(found)


@pytest.mark.parametrize(
    ("maps", "training"),
    [(False, False), (True, True)],
    ids=["evaluating on rasters", "training on feature maps"],
)
@pytest.mark.slow
def test_with_an_image_it_is_the_published_encoder_and_has_its_gradient(
    maps: bool, training: bool
) -> None:
    case = image_case(maps, training)
    mix = np.random.default_rng(4).normal(size=(4, 3136 + H)).astype(np.float32)

    def fast(params: Any) -> tuple[jax.Array, jax.Array]:
        variables = {"params": params}
        class_table = case.encoder.apply(variables, WORDS, method="prepare")
        out: Any = case.encoder.apply(
            variables, class_table, case.obs, case.action, case.dropout_mask
        )
        out = out.reshape(4, -1)
        return (out * mix).sum(), out

    def slow(params: Any) -> jax.Array:
        return (published(jnp, case, params, WORDS) * mix).sum()

    grad, found = jax.jit(jax.grad(fast, has_aux=True))(case.params)
    expected = published(np, case, equations.in_float64(case.params), np.asarray(WORDS, np.float64))
    np.testing.assert_allclose(found, expected, **CLOSE)
    for path, leaf in jax.tree.leaves_with_path(grad):
        assert np.asarray(leaf).any(), jax.tree_util.keystr(path)
    chex.assert_trees_all_close(grad, jax.grad(slow)(case.params), rtol=1e-3, atol=2e-3)
