"""Environments by name: rooms, classes and episodes of a split, called as in gymnax."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env import TEST_STEP_LIMITS, Environment, dynamics
from tdanet_jax.scenes import SceneTables
from tdanet_jax.splits import make_split
from tdanet_jax.task import make, make_task
from tdanet_jax.vocabulary import Action
from tdanet_jax.words import WordVectors


def config_of(rooms_file: Path, **settings: Any) -> TrainConfig:
    return TrainConfig(data=str(rooms_file), **settings)


@pytest.fixture(scope="module")
def environment(rooms_file: Path) -> Environment:
    return make("ithor-18/4", config=config_of(rooms_file))[0]


@pytest.mark.parametrize("part", ["train", "test"])
def test_it_has_the_rooms_classes_and_words_of_the_task(
    rooms_file: Path, some_rooms: SceneTables, glove: WordVectors, part: Any
) -> None:
    env, params = make("ithor-18/4", part, config_of(rooms_file))
    task = make_task(TrainConfig(), some_rooms, glove)
    training = part == "train"
    rows = task.eval_params.max_detections
    chex.assert_trees_all_equal(
        params, task.train_params.with_rows(rows) if training else task.eval_params
    )
    assert task.train_params.max_detections < rows
    assert env.default_params is params
    assert (env.name, env.class_names, env.num_actions) == ("ithor-18/4", some_rooms.classes, 6)
    hidden = [env.class_names.index(name) for name in make_split("18/4").hidden]
    assert np.asarray(env.words).any(axis=1).sum() == len(env.class_names) - training * len(hidden)
    assert np.asarray(env.words[jnp.array(hidden)]).any() == (not training)
    if not training:
        assert params.step_limit.tolist() == list(TEST_STEP_LIMITS)


def test_reset_and_step_are_those_of_the_dynamics_and_work_in_batches(
    environment: Environment,
) -> None:
    params, keys = environment.default_params, jax.random.split(jax.random.key(0), 5)
    obs, state = jax.jit(jax.vmap(environment.reset))(keys)
    reset = jax.jit(jax.vmap(dynamics.reset, (0, None)))
    chex.assert_trees_all_equal((obs, state), reset(keys, params), strict=True)
    actions = jnp.array([Action.MOVE_AHEAD, Action.DONE, 1, 2, 4])
    found = jax.jit(jax.vmap(environment.step))(keys, state, actions)
    step = jax.jit(jax.vmap(dynamics.step, (0, 0, 0, None)))
    expected = step(keys, state, actions, params)
    chex.assert_trees_all_equal(found, expected, strict=True)
    assert found[3].tolist() == [False, True, False, False, False]  # terminated


def test_other_parameters_take_the_place_of_its_own(environment: Environment) -> None:
    impatient = environment.default_params.replace(step_limit=jnp.ones(4, jnp.int32))
    _, state = environment.reset(jax.random.key(1), impatient)
    for params, truncated in ((None, False), (impatient, True)):
        out = environment.step(jax.random.key(2), state, jnp.int32(Action.LOOK_UP), params)
        assert bool(out[4]) == truncated


def test_the_name_gives_the_split_and_the_configuration_the_rest(rooms_file: Path) -> None:
    config = config_of(
        rooms_file,
        split="14/8",
        learner=LearnerConfig(step_limit=7),
        network=NetworkConfig(odometry=True, rows="class"),
    )
    env, params = make("ithor-Mug,Towel", config=config)
    hidden = [name for i, name in enumerate(env.class_names) if not np.asarray(env.words[i]).any()]
    assert set(hidden) == {"Mug", "Towel"}
    assert params.step_limit.tolist() == [7] * 4
    assert params.spec.rows == "class"
    obs, _ = env.reset(jax.random.key(0))
    assert list(obs.sensors) == ["odometry"]
    env, _ = make(config=config)  # without a name, the configuration has the split, too
    assert env.name == "ithor-14/8"
    hidden = [name for i, name in enumerate(env.class_names) if not np.asarray(env.words[i]).any()]
    assert {"Apple", "Television"} & {*env.class_names} <= {*hidden}
    assert "Television" in hidden or "Apple" in hidden


@pytest.mark.parametrize(
    ("name", "part", "message"),
    [
        ("CartPole-v1", "train", "CartPole-v1: no such environment; try ithor-18/4"),
        ("ithor-17/5", "train", "--split 17/5"),
        ("ithor-18/4", "validation", "split 'validation': must be 'train' or 'test'"),
    ],
)
def test_what_is_no_environment_is_refused_in_one_line(name: str, part: Any, message: str) -> None:
    with pytest.raises(ValueError, match=f"^{message}") as caught:
        tdanet_jax.make(name, part)
    assert "\n" not in str(caught.value)
