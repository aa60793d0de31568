"""Random observations and parameters for the networks' tests."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.env.types import FEATURES, RASTER, Observation
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sensors.odometry import OdometryReading

CLASSES, WIDTH, DETECTIONS = 9, 5, 6  # C, D, K


def normal(*shape: int, seed: int = 0) -> jax.Array:
    """Normally distributed numbers."""
    return jnp.asarray(np.random.default_rng(seed).normal(size=shape), jnp.float32)


def words(seed: int = 0) -> np.ndarray:
    """Word vectors [C, D]."""
    return np.random.default_rng(seed).normal(size=(CLASSES, WIDTH)).astype(np.float32)


def observations(*shape: int, seed: int = 1) -> Observation:
    """Frames with 0 to K detections, in [*shape]; the first is empty, the last full."""
    rng = np.random.default_rng(seed)
    count = rng.integers(0, DETECTIONS + 1, shape)
    count.flat[0], count.flat[-1] = 0, DETECTIONS
    mask = np.arange(DETECTIONS) < count[..., None]
    boxes = rng.random((*shape, DETECTIONS, 3)).astype(np.float32)
    classes = rng.integers(0, CLASSES, (*shape, DETECTIONS))
    return Observation(
        classes=jnp.asarray(np.where(mask, classes, 0), jnp.int32),
        boxes=jnp.asarray(np.where(mask[..., None], boxes, 0)),
        mask=jnp.asarray(mask),
        target=jnp.asarray(rng.integers(0, CLASSES, shape), jnp.int32),
        empty=jnp.asarray(count == 0),
        cells=jnp.asarray(rng.integers(-1, CLASSES, (*shape, *RASTER)), jnp.int32),
        features=jnp.asarray(rng.random((*shape, *FEATURES)), jnp.float16),
    )


def one_per_class(obs: Observation, seed: int = 3) -> Observation:
    """The same frames with classes that differ within a frame, and cells of an image."""
    rng = np.random.default_rng(seed)
    lead = obs.empty.shape
    classes = rng.permuted(np.broadcast_to(np.arange(CLASSES), (*lead, CLASSES)), axis=-1)
    cells = rng.integers(-1, CLASSES, (*lead, *RASTER))
    return obs.replace(
        classes=jnp.asarray(np.where(obs.mask, classes[..., :DETECTIONS], 0), jnp.int32),
        cells=jnp.asarray(cells, jnp.int32),
    )


def readings(*shape: int, seed: int = 4, triangulation: bool = False) -> dict[str, Any]:
    """Random readings of the sensors in [*shape]: odometry, and perhaps triangulation."""
    rng = np.random.default_rng(seed)
    bits = rng.random((*shape, 9, 9, 9)) < 0.1
    odometry = OdometryReading(
        motion=jnp.asarray(rng.normal(size=(*shape, 12)), jnp.float32),
        window=jnp.asarray((bits << np.arange(9)).sum(-1), jnp.uint16),
    )
    if not triangulation:
        return {"odometry": odometry}
    target = jnp.asarray(rng.normal(size=(*shape, 9)), jnp.float32)
    return {"odometry": odometry, "triangulation": target}


def parameters(model: ActorCritic, words: Any, seed: int = 2) -> Any:
    """Random parameters of a network; its own initialisers take seconds to compile."""
    return randomised(jax.eval_shape(model.initialise, jax.random.key(0), words), seed)


def moving_by_odometry(model: ActorCritic, words: Any) -> Any:
    """Random parameters of a network with odometry that mostly moves ahead and rarely ends."""
    weights = parameters(model, words)
    weights["way"]["kernel"] *= 5.0  # most of its inputs are zero
    weights["actor"]["bias"] = jnp.array([2.0, 0.0, 0.0, 0.0, 0.0, -1.0])
    return weights


def randomised(params: Any, seed: int = 2) -> Any:
    """Parameters of the same shapes (arrays, or shapes alone) with nothing at zero, biases too."""
    leaves, tree = jax.tree.flatten(params)
    rng = np.random.default_rng(seed)
    inputs = [max((*x.shape, 1)[0], 1) for x in leaves]
    new = [
        rng.normal(size=x.shape).astype(np.float32) / np.sqrt(n)
        for x, n in zip(leaves, inputs, strict=True)
    ]
    return jax.tree.unflatten(tree, [jnp.asarray(x) for x in new])


def flat(obs: Observation) -> Observation:
    """The observations of a rollout [T, B, ...] as one batch [T B, ...]."""
    lead = obs.empty.ndim
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[lead:]), obs)


def as_version(tables: SceneTables, data_version: str) -> SceneTables:
    """The tables under another version's name: for runs of rooms that have changed since."""
    renamed = dataclasses.replace(tables)
    vars(renamed)["data_version"] = data_version
    return renamed
