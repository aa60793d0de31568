"""What else is in view: against loops, and what it must not depend on."""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.env.types import Observation
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.context import SceneContext
from tdanet_jax.models.factory import make_model, unused_flags
from tests.support import samples
from tests.support.samples import CLASSES, DETECTIONS, WIDTH, observations

U, FRAMES = 6, 12
MODULE = SceneContext(U)


def encode(module: SceneContext, obs: Observation) -> jax.Array:
    return module(module.prepare(jnp.asarray(samples.words())), obs)


@functools.cache
def parameters() -> Any:
    made = jax.eval_shape(
        functools.partial(MODULE.init, method=encode), jax.random.key(0), observations(2)
    )
    return samples.randomised(made["params"])


def features(obs: Observation) -> jax.Array:
    return jax.jit(lambda given: MODULE.apply({"params": parameters()}, given, method=encode))(obs)


@pytest.mark.parametrize("backend", ["cpu", "gpu"], indirect=True)
def test_it_is_a_layer_of_each_detection_its_maximum_and_mean_and_a_layer_of_the_name(
    backend: None,
) -> None:
    words, obs, params = samples.words(), observations(FRAMES), parameters()
    detection, target = (jax.tree.map(np.asarray, params[name]) for name in ("detection", "target"))
    found = features(obs)
    assert found.shape == (FRAMES, 2 * U + U // 2)
    for i in range(FRAMES):
        rows = [
            np.maximum(
                np.concatenate([obs.boxes[i, k], words[int(obs.classes[i, k])]])
                @ detection["kernel"]
                + detection["bias"],
                0,
            )
            for k in range(DETECTIONS)
            if obs.mask[i, k]
        ] or [np.zeros(U)]
        name = words[int(obs.target[i])] @ target["kernel"] + target["bias"]
        right = np.concatenate([np.max(rows, 0), np.mean(rows, 0), np.maximum(name, 0)])
        np.testing.assert_allclose(found[i], right, rtol=3e-5, atol=3e-6)


def test_it_is_blind_to_padding_and_to_the_order_of_detections() -> None:
    obs, rng = observations(FRAMES), np.random.default_rng(5)
    noise = jnp.asarray(rng.integers(0, CLASSES, obs.classes.shape), jnp.int32)
    boxes = jnp.asarray(rng.normal(size=obs.boxes.shape), jnp.float32)
    dirty = obs.replace(
        classes=jnp.where(obs.mask, obs.classes, noise),
        boxes=jnp.where(obs.mask[..., None], obs.boxes, boxes),
    )
    np.testing.assert_array_equal(features(obs), features(dirty))
    order = np.stack([rng.permutation(DETECTIONS) for _ in range(FRAMES)])
    rows = np.arange(FRAMES)[:, None]
    shuffled = obs.replace(
        classes=obs.classes[rows, order], boxes=obs.boxes[rows, order], mask=obs.mask[rows, order]
    )
    np.testing.assert_allclose(features(obs), features(shuffled), rtol=3e-5, atol=3e-6)


def test_the_target_is_known_while_it_is_out_of_view() -> None:
    obs = observations(FRAMES)
    empty = obs.replace(mask=jnp.zeros_like(obs.mask))
    other = empty.replace(target=(obs.target + 1) % CLASSES)
    found, theirs = features(empty), features(other)
    assert not found[:, : 2 * U].any()
    assert all(np.abs(found - theirs).max(axis=1) > 0.1)


def network(context: int, model: str = "tdanet") -> TrainConfig:
    size = NetworkConfig(width=8, hidden=8, context=context, precision="float32")
    return TrainConfig(model=model, network=size)


@pytest.mark.parametrize("model", ["tdanet", "tdanet-no-ta-sa"])
def test_its_features_enter_the_lstm_and_without_it_the_network_is_the_papers(model: str) -> None:
    classes = ClassVocabulary(("Mug", "Sink"))
    shapes = {
        context: make_model(network(context, model), classes).parameter_shapes(2, WIDTH)
        for context in (0, 4)
    }
    assert "scene_context" not in shapes[0]["encoder"]
    extra = shapes[4]["encoder"].pop("scene_context")
    assert jax.tree.map(jnp.shape, extra) == {
        "detection": {"kernel": (3 + WIDTH, 4), "bias": (4,)},
        "target": {"kernel": (WIDTH, 2), "bias": (2,)},
    }
    kernels = [shapes[context]["lstm"].pop("kernel").shape for context in (0, 4)]
    assert kernels[1] == (kernels[0][0] + 10, kernels[0][1])
    assert shapes[0] == shapes[4]


def test_models_without_it_say_so() -> None:
    classes = ClassVocabulary(("Mug", "Sink"))
    assert "--context" in unused_flags(network(4, "ssnet"), classes)
    assert "--context" not in unused_flags(network(4), classes)


@pytest.mark.parametrize("context", [1, -2, 10000])
def test_units_out_of_range_are_refused(context: int) -> None:
    with pytest.raises(ValueError, match=r"^--context .*: must be 0, or from 2 to 8192$"):
        network(context).check()
