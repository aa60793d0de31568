"""TDANet's encoder against the printed equations, and what its attention must not depend on."""

from __future__ import annotations

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.env.types import Observation
from tdanet_jax.models.tdanet import TDANetEncoder
from tests.support import equations, samples
from tests.support.samples import CLASSES, DETECTIONS, WIDTH, observations

H = 7
FRAMES = 12
#: Sums of a few dozen float32 products, in another order.
CLOSE = {"rtol": 3e-5, "atol": 3e-6}
ABLATIONS = [(True, True), (False, True), (True, False), (False, False)]
IDS = ["TA+SA", "SA", "TA", "neither"]


def encoder(attention: bool = True, siamese: bool = True, dropout: float = 0.25) -> TDANetEncoder:
    return TDANetEncoder(H, dropout=dropout, target_attention=attention, siamese=siamese)


@functools.cache
def parameters(attention: bool = True, siamese: bool = True) -> Any:
    """Random parameters, no bias at zero."""
    module = encoder(attention, siamese)

    def both(module: TDANetEncoder, words: jax.Array) -> jax.Array:
        return module(module.prepare(words), observations(2), None)

    initialise = functools.partial(module.init, method=both)
    made = jax.eval_shape(initialise, jax.random.key(0), jnp.asarray(samples.words()))
    return samples.randomised(made["params"])


@functools.partial(jax.jit, static_argnames=("attention", "siamese"))
def features(
    params: Any,
    obs: Observation,
    words: np.ndarray | jax.Array,
    dropout_mask: jax.Array | None = None,
    attention: bool = True,
    siamese: bool = True,
) -> jax.Array:
    module = encoder(attention, siamese)
    class_table = module.apply({"params": params}, jnp.asarray(words), method="prepare")
    return module.apply({"params": params}, class_table, obs, None, dropout_mask)


@functools.partial(jax.jit, static_argnames="attention")
def weights(params: Any, obs: Observation, words: np.ndarray, attention: bool = True) -> jax.Array:
    module = encoder(attention)
    class_table = module.apply({"params": params}, jnp.asarray(words), method="prepare")
    return module.apply({"params": params}, class_table, obs, method="attend")


def random_mask(shape: tuple[int, ...]) -> jax.Array:
    return jnp.asarray(np.random.default_rng(3).random((*shape, H)) < 0.75)


@pytest.mark.parametrize("dropped", [False, True], ids=["evaluating", "training"])
@pytest.mark.parametrize(("attention", "siamese"), ABLATIONS, ids=IDS)
def test_the_fast_forms_equal_the_printed_equations(
    attention: bool, siamese: bool, dropped: bool
) -> None:
    params, words, obs = parameters(attention, siamese), samples.words(), observations(FRAMES)
    dropout_mask = random_mask((FRAMES,)) if dropped else None
    fast = features(params, obs, words, dropout_mask, attention, siamese)
    exact = equations.in_float64(params)
    plain = [
        equations.encode(
            np, exact, rows.astype(float), word.astype(float), target_attention=attention,
            siamese=siamese, dropped=None if dropout_mask is None else ~np.asarray(dropout_mask)[i],
        )
        for i, (rows, word) in enumerate(equations.frames(obs, words))
    ]  # fmt: skip
    assert fast.shape == (FRAMES, H)
    np.testing.assert_allclose(fast, np.stack(plain), **CLOSE)


def test_a_score_is_one_more_number_of_a_detection_and_1_of_the_target() -> None:
    module = TDANetEncoder(H, columns=4)
    words, obs = samples.words(), observations(FRAMES)
    scores = np.random.default_rng(5).random(obs.mask.shape) * obs.mask
    obs = obs.replace(boxes=jnp.concatenate([obs.boxes, scores[..., None]], axis=-1))

    def encode(module: TDANetEncoder) -> jax.Array:
        return module(module.prepare(jnp.asarray(words)), obs, None)

    made = jax.eval_shape(functools.partial(module.init, method=encode), jax.random.key(0))
    params = samples.randomised(made["params"])
    fast = jax.jit(lambda given: module.apply({"params": given}, method=encode))(params)
    exact = equations.in_float64(params)
    plain = [
        equations.encode(np, exact, rows.astype(float), word.astype(float))
        for rows, word in equations.frames(obs, words)
    ]
    np.testing.assert_allclose(fast, np.stack(plain), **CLOSE)


@pytest.mark.parametrize(
    ("backend", "attention", "siamese"),
    [
        ("cpu", True, True), ("cpu", False, True), ("gpu", True, True),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in (
                ("cpu", True, False), ("cpu", False, False), ("gpu", False, True),
                ("gpu", True, False), ("gpu", False, False),
            )
        ),
    ],
    indirect=["backend"],
)  # fmt: skip
def test_the_fast_forms_have_the_gradient_of_the_printed_equations(
    attention: bool, siamese: bool, backend: None
) -> None:
    params, words, obs = parameters(attention, siamese), samples.words(), observations(FRAMES)
    dropout_mask = random_mask((FRAMES,))
    mix = np.random.default_rng(4).normal(size=(FRAMES, H)).astype(np.float32)
    frames = equations.frames(obs, words)

    def plain(params: Any) -> jax.Array:
        total = jnp.float32(0)
        for i, (rows, word) in enumerate(frames):
            found = equations.encode(
                jnp, params, jnp.asarray(rows, jnp.float32), jnp.asarray(word),
                target_attention=attention, siamese=siamese, dropped=~dropout_mask[i],
            )  # fmt: skip
            total += (found * mix[i]).sum()
        return total

    def fast(params: Any) -> jax.Array:
        return (features(params, obs, words, dropout_mask, attention, siamese) * mix).sum()

    chex.assert_trees_all_close(
        jax.jit(jax.grad(fast))(params), jax.jit(jax.grad(plain))(params), rtol=1e-4, atol=1e-5
    )


@pytest.mark.parametrize("attention", [True, False])
def test_attention_sums_to_one_over_valid_detections_and_is_zero_elsewhere(attention: bool) -> None:
    obs = observations(4, FRAMES)
    found = np.asarray(weights(parameters(attention), obs, samples.words(), attention))
    assert found.shape == obs.mask.shape
    # An empty frame has one row, all zero, that gets all of it.
    valid = np.asarray(obs.mask).copy()
    valid[..., 0] |= np.asarray(obs.empty)
    np.testing.assert_allclose(found.sum(-1), 1.0, rtol=1e-6)
    assert (found[~valid] == 0).all()
    assert (found[valid] > 0).all()


def test_attention_equals_the_printed_one() -> None:
    params, words, obs = parameters(), samples.words(), observations(FRAMES)
    found = np.asarray(weights(params, obs, words))
    exact = equations.in_float64(params)
    for i, (rows, word) in enumerate(equations.frames(obs, words)):
        target = np.concatenate([equations.TARGET_BOX, word])
        plain = equations.attention(np, exact, rows.astype(float), target)
        np.testing.assert_allclose(found[i, : len(plain)], plain, **CLOSE)


def test_without_attention_all_detections_weigh_the_same() -> None:
    obs = observations(FRAMES)
    found = np.asarray(weights(parameters(False), obs, samples.words(), attention=False))
    for row, mask in zip(found, np.asarray(obs.mask), strict=True):
        if mask.any():
            np.testing.assert_allclose(row[mask], 1 / mask.sum(), rtol=1e-6)


@pytest.mark.parametrize("attention", [True, False])
def test_blind_to_what_stands_in_padding(attention: bool) -> None:
    params, words, obs = parameters(attention), samples.words(), observations(FRAMES)
    rng = np.random.default_rng(5)
    # The one row of an empty frame is defined by the padding being blank: left out here.
    padding = ~obs.mask & ~obs.empty[:, None]
    noise = jnp.asarray(rng.integers(0, CLASSES, obs.classes.shape), jnp.int32)
    boxes = jnp.asarray(rng.normal(size=obs.boxes.shape), jnp.float32)
    dirty = obs.replace(
        classes=jnp.where(padding, noise, obs.classes),
        boxes=jnp.where(padding[..., None], boxes, obs.boxes),
    )
    chex.assert_trees_all_equal(
        features(params, obs, words, attention=attention),
        features(params, dirty, words, attention=attention),
    )


@pytest.mark.parametrize("extra", [1, 7])
def test_adding_masked_rows_changes_nothing(extra: int) -> None:
    params, words, obs = parameters(), samples.words(), observations(FRAMES)
    wider = obs.replace(
        classes=jnp.pad(obs.classes, ((0, 0), (0, extra))),
        boxes=jnp.pad(obs.boxes, ((0, 0), (0, extra), (0, 0))),
        mask=jnp.pad(obs.mask, ((0, 0), (0, extra))),
    )
    np.testing.assert_allclose(
        features(params, obs, words), features(params, wider, words), **CLOSE
    )


def test_blind_to_the_order_of_detections() -> None:
    params, words, obs = parameters(), samples.words(), observations(FRAMES)
    order = np.stack([np.random.default_rng(i).permutation(DETECTIONS) for i in range(FRAMES)])
    rows = np.arange(FRAMES)[:, None]
    shuffled = obs.replace(
        classes=obs.classes[rows, order], boxes=obs.boxes[rows, order], mask=obs.mask[rows, order]
    )
    assert not np.array_equal(shuffled.mask, obs.mask)
    np.testing.assert_allclose(
        features(params, obs, words), features(params, shuffled, words), **CLOSE
    )


def test_a_permutation_of_classes_with_their_words_changes_nothing() -> None:
    params, words, obs = parameters(), samples.words(), observations(FRAMES)
    order = np.random.default_rng(6).permutation(CLASSES)
    place = jnp.asarray(np.argsort(order), jnp.int32)  # old index -> new index
    renamed = obs.replace(
        classes=jnp.where(obs.mask, place[obs.classes], 0), target=place[obs.target]
    )
    np.testing.assert_allclose(
        features(params, obs, words), features(params, renamed, words[order]), **CLOSE
    )


def test_the_target_and_each_part_of_a_detection_matter() -> None:
    params, words, obs = parameters(), samples.words(), observations(FRAMES, seed=7)
    several = np.asarray(obs.mask.sum(-1) > 1)
    base = np.asarray(features(params, obs, words))
    changes = [obs.replace(target=(obs.target + 1) % CLASSES)]
    changes += [obs.replace(boxes=obs.boxes.at[:, 0, part].add(0.3)) for part in range(3)]
    changes += [obs.replace(classes=obs.classes.at[:, 0].set((obs.classes[:, 0] + 1) % CLASSES))]
    for changed in changes:
        found = np.asarray(features(params, changed, words))
        assert (found[several] != base[several]).any(axis=-1).mean() > 0.9


@pytest.mark.parametrize(("attention", "siamese"), ABLATIONS, ids=IDS)
def test_empty_frames_give_finite_features_and_gradients(attention: bool, siamese: bool) -> None:
    blank = jax.tree.map(jnp.zeros_like, observations(3)).replace(empty=jnp.ones(3, bool))
    params, words = parameters(attention, siamese), samples.words()

    def loss(params: Any, words: jax.Array) -> jax.Array:
        return features(params, blank, words, None, attention, siamese).sum()

    value, grads = jax.value_and_grad(loss, (0, 1))(params, jnp.asarray(words))
    chex.assert_tree_all_finite((value, grads))


def test_an_empty_frame_is_one_all_zero_row_and_not_a_row_of_the_first_class() -> None:
    params, words = parameters(), samples.words()
    blank = jax.tree.map(lambda x: x[:1], observations(2)).replace(target=jnp.ones(1, jnp.int32))
    assert bool(blank.empty[0])
    other = words.copy()
    other[0] += 1.0  # the class that padding happens to name
    chex.assert_trees_all_equal(features(params, blank, words), features(params, blank, other))


@pytest.mark.parametrize("shape", [(4,), (3, 2)])
def test_dropout_is_the_mask_that_is_given(shape: tuple[int, ...]) -> None:
    params, words, obs = parameters(), samples.words(), observations(*shape)
    dropout_mask = random_mask(shape)
    first, second = (features(params, obs, words, dropout_mask) for _ in range(2))
    chex.assert_trees_all_equal(first, second)
    assert not np.allclose(first, features(params, obs, words))
    assert not np.allclose(first, features(params, obs, words, ~dropout_mask))


def test_dropout_scales_what_it_keeps() -> None:
    # With nothing dropped the features are those of a difference that is 4/3 as large.
    params, words, obs = parameters(), samples.words(), observations(4)
    larger = dict(params)
    larger["linear3"] = {**params["linear3"], "kernel": params["linear3"]["kernel"] / 0.75}
    np.testing.assert_allclose(
        features(params, obs, words, jnp.ones((4, H), bool)), features(larger, obs, words), **CLOSE
    )


def test_a_frame_does_not_depend_on_the_others_of_its_batch() -> None:
    params, words, obs = parameters(), samples.words(), observations(5, 3)
    together = features(params, obs, words).reshape(15, H)
    alone = [
        features(params, jax.tree.map(lambda x, i=i: x[i : i + 1], samples.flat(obs)), words)[0]
        for i in range(15)
    ]
    np.testing.assert_allclose(together, np.stack(alone), **CLOSE)


@pytest.mark.parametrize(("attention", "siamese"), ABLATIONS, ids=IDS)
def test_the_target_is_known_in_every_ablation(attention: bool, siamese: bool) -> None:
    params, words, obs = parameters(attention, siamese), samples.words(), observations(8)
    other = obs.replace(target=(obs.target + 1) % CLASSES)
    first = features(params, obs, words, None, attention, siamese)
    second = features(params, other, words, None, attention, siamese)
    assert not np.allclose(first, second)


def test_layers_and_their_sizes() -> None:
    shapes = jax.tree.map(jnp.shape, parameters())
    row = 3 + WIDTH
    assert shapes == {
        "attention": {"kernel": (row, H), "bias": (H,)},
        "linear1": {"kernel": (row, H), "bias": (H,)},
        "linear2": {"kernel": (H, H), "bias": (H,)},
        "linear3": {"kernel": (H, H), "bias": (H,)},
        "linear4": {"kernel": (H, H), "bias": (H,)},
    }
    assert "attention" not in parameters(attention=False)
    neither = jax.tree.map(jnp.shape, parameters(False, False))
    assert neither["linear3"]["kernel"] == (H + WIDTH, H)


def test_a_bfloat16_encoder_is_close_and_returns_float32() -> None:
    params, words, obs = parameters(), jnp.asarray(samples.words()), observations(FRAMES)
    module = TDANetEncoder(H, dtype=jnp.bfloat16)
    class_table = module.apply({"params": params}, words, method="prepare")
    half = module.apply({"params": params}, class_table, obs, None)
    full = features(params, obs, words)
    assert half.dtype == jnp.float32
    # Eight bits of mantissa through four layers.
    np.testing.assert_allclose(half, full, atol=0.05 * float(full.max()))
    assert not np.array_equal(half, full)
