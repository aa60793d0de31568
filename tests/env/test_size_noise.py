"""Targets that look larger or smaller than they are, another factor in each training episode."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.env.types import EnvParams, EnvState, Observation
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.task import make_task
from tdanet_jax.words import WordVectors
from tests.support.oracle import ROOMS

BATCH, STEPS, NOISE = 64, 30, 0.5


def params_of(tables: SceneTables, noise: float) -> EnvParams:
    targets = dict.fromkeys(ROOMS, tables.targets)
    spec = ObservationSpec(sensors=("odometry", "triangulation"))
    return make_params(tables, targets, no_parents(tables), (7,) * 4, spec, size_noise=noise)


@jax.jit
def played(params: EnvParams) -> tuple[EnvState, Observation]:
    """States and observations [STEPS, BATCH] of random actions, with automatic resets."""

    def one(carry: tuple, key: jax.Array) -> tuple:
        obs, state = carry
        action = jax.random.randint(key, (BATCH,), 0, 5)
        keys = jax.random.split(key, BATCH)
        after = jax.vmap(dynamics.step, (0, 0, 0, None))(keys, state, action, params)[:2]
        return after, (state, obs)

    keys = jax.random.split(jax.random.key(1), BATCH)
    begun = jax.vmap(dynamics.reset, (0, None))(keys, params)
    return jax.lax.scan(one, begun, jax.random.split(jax.random.key(2), STEPS))[1]


@pytest.fixture(scope="module")
def pairs(some_rooms: SceneTables) -> tuple:
    """The same episodes without and with noise."""
    return played(params_of(some_rooms, 0.0)), played(params_of(some_rooms, NOISE))


def test_the_targets_boxes_alone_grow_and_by_one_factor_an_episode(pairs: tuple) -> None:
    (plain, truth), (state, obs) = pairs
    np.testing.assert_array_equal(state.pose, plain.pose)
    same = obs.replace(boxes=truth.boxes, sensors=truth.sensors)
    chex.assert_trees_all_equal(same, truth)
    is_target = truth.mask & (truth.classes == truth.target[..., None])
    assert is_target.any(-1).sum() > 200
    factor = np.where(is_target, state.area_factor[..., None], 1)
    expected = np.minimum(np.asarray(truth.boxes[..., 2]) * factor, 1)
    np.testing.assert_allclose(obs.boxes[..., 2], expected, rtol=1e-6)
    np.testing.assert_array_equal(obs.boxes[..., :2], truth.boxes[..., :2])


def test_a_factor_lasts_for_an_episode_and_is_spread_over_its_range(pairs: tuple) -> None:
    state = pairs[1][0]
    size, steps = np.asarray(state.area_factor), np.asarray(state.steps)
    goes_on = steps[1:] > 0
    np.testing.assert_array_equal((size[1:] == size[:-1]), goes_on)
    sides = np.log(size[steps == 0]) / 2
    assert np.abs(sides).max() <= NOISE
    low, high = np.quantile(sides, [0.1, 0.9])
    np.testing.assert_allclose([low, high], [-0.8 * NOISE, 0.8 * NOISE], atol=0.05)


def test_what_is_sensed_of_the_target_is_that_of_its_changed_boxes(pairs: tuple) -> None:
    (_, truth), (state, obs) = pairs
    there, seen = (np.asarray(found.sensors["triangulation"]) for found in (truth, obs))
    place, radius = slice(0, 3), 3
    # Two programs: float32 sums in another order.
    np.testing.assert_allclose(seen[..., place], there[..., place], rtol=1e-3, atol=2e-5)
    whole = (there[..., radius] < 0.6) & (seen[..., radius] < 0.6) & (there[..., radius] > 0)
    ratio = seen[..., radius][whole] / there[..., radius][whole]
    np.testing.assert_allclose(ratio, np.sqrt(np.asarray(state.area_factor))[whole], rtol=1e-4)


def test_no_box_exceeds_the_image(some_rooms: SceneTables) -> None:
    params = params_of(some_rooms, NOISE)
    row = int(np.flatnonzero(some_rooms.row_class == int(params.target_class[0]))[0])
    pose = jnp.int32(some_rooms.row_state[row])
    huge = dynamics.start(pose, jnp.int32(0), params, jnp.float32(1e9))
    obs = jax.jit(dynamics.observe)(huge, params)
    of_target = np.asarray(obs.boxes[:, 2])[np.asarray(obs.mask & (obs.classes == obs.target))]
    assert of_target.size
    assert (of_target == 1).all()


def test_without_noise_nothing_is_drawn(some_rooms: SceneTables) -> None:
    assert dynamics.reset_state(jax.random.key(0), params_of(some_rooms, 0.0)).area_factor is None
    start = jax.jit(dynamics.start)(jnp.int32(0), jnp.int32(0), params_of(some_rooms, NOISE))
    assert start.area_factor is None  # a given episode is as it is


def test_training_alone_is_noisy(ithor: Rooms, glove: WordVectors) -> None:
    config = TrainConfig(
        learner=LearnerConfig(size_noise=NOISE), network=NetworkConfig(width=8, hidden=8)
    )
    task = make_task(config, ithor, glove)
    assert (task.train_params.size_noise, task.eval_params.size_noise) == (NOISE, 0.0)
