"""The environment as Gymnasium's users know one, and its spaces."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.environment import FlatObservations
from tdanet_jax.env.gymnasium import NavigationEnv, NavigationVectorEnv
from tdanet_jax.task import make
from tdanet_jax.vocabulary import Action

N = 3


@pytest.fixture(scope="module")
def config(rooms_file: Path) -> TrainConfig:
    learner = LearnerConfig(step_limit=4)
    return TrainConfig(data=str(rooms_file), learner=learner, network=NetworkConfig(odometry=True))


@pytest.mark.parametrize("flat", [True, False])
@pytest.mark.filterwarnings("ignore:.*A Box observation space (max|min)imum value is:UserWarning")
@pytest.mark.filterwarnings("ignore:.*not have a render:UserWarning")
def test_it_passes_the_check_of_gymnasium(config: TrainConfig, flat: bool) -> None:
    check_env(NavigationEnv(flat=flat, config=config), skip_render_check=True)


def test_the_registered_name_makes_it(config: TrainConfig) -> None:
    name = "tdanet_jax.env.gymnasium:tdanet/iTHOR-14-8-v1"
    env = gymnasium.make(name, config=config, split="test")
    _, info = env.reset(seed=0)
    assert info["target"] in env.unwrapped.class_names
    many = gymnasium.make_vec(name, num_envs=2, vectorization_mode="vector_entry_point",
                              config=config)  # fmt: skip
    assert isinstance(many, NavigationVectorEnv)
    assert many.num_envs == 2
    assert many.spec.id == "tdanet/iTHOR-14-8-v1"


def test_an_episode_is_that_of_the_dynamics(config: TrainConfig) -> None:
    env, again = (NavigationEnv(flat=False, config=config) for _ in range(2))
    _, params = make("ithor-18/4", config=config)
    first, _ = env.reset(seed=5)
    same, _ = again.reset(seed=5)
    assert all(np.array_equal(first[name], same[name]) for name in first)
    other, _ = again.reset()
    assert any(not np.array_equal(first[name], other[name]) for name in first)
    key = jax.random.key(int(np.random.Generator(np.random.PCG64(5)).integers(2**31)))
    _, state = dynamics.reset(key, params)
    for action in (Action.ROTATE_LEFT, Action.MOVE_AHEAD, Action.LOOK_DOWN, Action.ROTATE_LEFT):
        obs, reward, terminated, truncated, info = env.step(int(action))
        expected = dynamics.transition(state, jnp.int32(action), params)
        state = expected.state
        seen = dynamics.observe(state, params)
        np.testing.assert_array_equal(obs["classes"], seen.classes)
        assert (reward, terminated) == (float(expected.reward), False)
        assert info["length"] == int(state.steps)
        assert info["shortest"] == int(state.shortest)
    assert truncated
    _, _, terminated, truncated, info = env.step(int(Action.DONE))
    assert (terminated, truncated) == (True, False)
    assert not info["success"]


def test_many_episodes_end_and_begin_within_a_step(config: TrainConfig) -> None:
    env = NavigationVectorEnv(N, config=config)
    obs, _ = env.reset(seed=1)
    assert obs in env.observation_space
    for step in range(4):
        before = obs
        actions = np.array([Action.DONE if step == 1 else Action.ROTATE_LEFT, 1, 1])
        obs, reward, terminated, truncated, info = env.step(actions)
        assert obs.shape == (N, *env.single_observation_space.shape)
        assert reward.shape == (N,)
        assert terminated.tolist() == [step == 1, False, False]
        assert truncated.tolist() == [False, step == 3, step == 3]
        np.testing.assert_array_equal(info["_final_obs"], terminated | truncated)
        running = ~info["_final_obs"]
        np.testing.assert_array_equal(info["final_obs"][running], obs[running])
        assert (info["final_obs"][~running] != obs[~running]).any(axis=-1).all()
    assert info["length"].tolist() == [2, 4, 4]
    assert not np.array_equal(before, obs)


def test_a_vector_holds_rows_words_target_and_sensors(config: TrainConfig) -> None:
    plain, params = make("ithor-18/4", config=config)
    env = FlatObservations(plain)
    key = jax.random.key(3)
    obs, _ = plain.reset(key)
    flat, state = env.reset(key)
    rows, width = params.max_detections, plain.words.shape[1]
    assert flat.shape == env.observation_space().shape == env.observation_space(params).shape
    table = np.asarray(flat[: rows * (4 + width)]).reshape(rows, 4 + width)
    shown = np.asarray(obs.mask)
    np.testing.assert_array_equal(table[:, 0], shown)
    np.testing.assert_array_equal(table[:, 1:4], obs.boxes)
    words = np.asarray(plain.words)
    np.testing.assert_array_equal(table[shown, 4:], words[np.asarray(obs.classes)[shown]])
    assert not table[~shown].any()
    rest = np.asarray(flat[rows * (4 + width) :])
    np.testing.assert_array_equal(rest[:width], words[int(obs.target)])
    assert rest[width : width + 12].any()
    # The last observation of an episode, not the first of the next.
    after, _, _, terminated, _, info = env.step(key, state, jnp.int32(Action.DONE))
    assert terminated
    assert not np.array_equal(after, info["final_observation"])
    np.testing.assert_array_equal(info["final_observation"][: rows * 54], flat[: rows * 54])


@pytest.mark.parametrize("noise", ["none", "mix"])
def test_a_network_for_training_rooms_fits_the_test_rooms(config: TrainConfig, noise: str) -> None:
    learner = dataclasses.replace(config.learner, noise=noise)
    config = dataclasses.replace(config, learner=learner)
    sizes = [
        FlatObservations(make("ithor-18/4", split, config)[0]).observation_space().shape
        for split in ("train", "test")
    ]
    assert sizes[0] == sizes[1]


def test_spaces_hold_what_is_observed(config: TrainConfig) -> None:
    env, _ = make("ithor-18/4", config=config)
    space, actions = env.observation_space(), env.action_space()
    obs, _ = env.reset(jax.random.key(0))
    assert space.contains(obs)
    assert not space.contains(obs.replace(target=jnp.int32(len(env.class_names))))
    drawn = space.sample(jax.random.key(1))
    assert space.contains(drawn)
    assert {*np.asarray(drawn["mask"]).tolist()} == {True, False}
    assert {name: part.shape for name, part in drawn.items()} == {
        name: getattr(obs, name).shape for name in drawn
    }
    assert [bool(actions.contains(a)) for a in (-1, 0, 5, 6)] == [False, True, True, False]
    assert actions.sample(jax.random.key(2)) in range(6)


@pytest.mark.parametrize("action", [-1, 6, 1.5])
def test_actions_out_of_range_are_refused(config: TrainConfig, action: Any) -> None:
    one, many = NavigationEnv(config=config), NavigationVectorEnv(2, config=config)
    for env, given in ((one, action), (many, np.array([0, action]))):
        with pytest.raises(gymnasium.error.ResetNeeded):
            env.step(given)
        env.reset(seed=0)
        with pytest.raises(ValueError, match=f"^action {action}: must be a whole number from 0 to"):
            env.step(given)


def test_there_must_be_one_action_for_each_episode(config: TrainConfig) -> None:
    one, many = NavigationEnv(config=config), NavigationVectorEnv(2, config=config)
    one.reset(seed=0)
    many.reset(seed=0)
    for env, given in ((one, [1]), (many, [1]), (many, [[1], [1]]), (many, 1)):
        with pytest.raises(ValueError, match=r"^actions of shape \(.*\): must have shape \(.*\)$"):
            env.step(given)  # type: ignore[arg-type]
    assert many.step(np.array([1.0, 2.0]))[1].shape == (2,)
