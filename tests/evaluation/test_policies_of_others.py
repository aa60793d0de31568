"""Policies that were trained elsewhere play the same test episodes."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax.config import TrainConfig
from tdanet_jax.env.environment import FlatObservations
from tdanet_jax.evaluation import policies
from tdanet_jax.task import make
from tdanet_jax.vocabulary import Action
from tests.support.pages import ROOT


@pytest.fixture(scope="module")
def config(rooms_file: Path) -> TrainConfig:
    return TrainConfig(data=str(rooms_file))


@pytest.fixture(scope="module")
def flat(config: TrainConfig) -> FlatObservations:
    return FlatObservations(make("ithor-18/4", "test", config)[0])


def says_done(flat: FlatObservations, vector: Any) -> Any:
    """1 where the target's word is that of a row in view, else 0: for one vector."""
    width = flat.env.words.shape[1]
    rows = vector[:-width].reshape(-1, 4 + width)
    return ((rows[:, 4:] == vector[-width:]).all(axis=1) & (rows[:, 0] == 1)).any()


@pytest.mark.usefixtures("few_episodes")
def test_on_the_host_and_in_jax_the_same_policy_plays_the_same(
    flat: FlatObservations, config: TrainConfig
) -> None:
    """Done once the target is in view, else it turns; after 12 steps it goes ahead."""
    turned = {"steps": 0, "begun": []}

    def begin(batch: int) -> None:
        turned["steps"] = 0
        turned["begun"].append(batch)

    def predict(vectors: np.ndarray) -> np.ndarray:
        done = np.array([says_done(flat, vector) for vector in vectors])
        turned["steps"] += 1
        otherwise = Action.ROTATE_LEFT if turned["steps"] < 12 else Action.MOVE_AHEAD
        return np.where(done, Action.DONE, otherwise)

    def act(memory: Any, key: jax.Array, vectors: jax.Array) -> tuple[Any, jax.Array]:
        done = jax.vmap(lambda vector: says_done(flat, vector))(vectors)
        otherwise = jnp.where(memory + 1 < 12, Action.ROTATE_LEFT, Action.MOVE_AHEAD)
        return memory + 1, jnp.where(done, Action.DONE, otherwise)

    hosted = policies.on_host(flat, predict, begin)
    compiled = policies.on_vectors(flat, lambda batch: jnp.zeros((), jnp.int32), act)
    one, other = (
        tdanet_jax.evaluate(policy=policy, config=config) for policy in (hosted, compiled)
    )
    assert one == other
    assert 0 < one["seen"]["L>=1"]["SR"] < 100
    assert len(turned["begun"]) == 2  # seen and unseen


@pytest.fixture
def example(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "examples")
    return importlib.import_module("recurrent_ppo")


@pytest.mark.slow
@pytest.mark.usefixtures("few_episodes")
def test_the_example_trains_and_is_scored(
    example: ModuleType, flat: FlatObservations, config: TrainConfig
) -> None:
    small = example.Config(num_envs=8, num_steps=4, total_steps=64, hidden=16)
    env, params = make("ithor-18/4", config=config)
    weights, success = jax.jit(example.make_train(small, FlatObservations(env), params))(
        jax.random.key(0)
    )
    assert success.shape == (2,)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(weights))
    results = tdanet_jax.evaluate(policy=example.policy(small, flat, weights), config=config)
    assert results["model"] == "custom"
    assert results["unseen"]["L>=1"]["n"] > 10


@pytest.mark.usefixtures("few_episodes")
@pytest.mark.parametrize("name", ["PPO", "RecurrentPPO"])
def test_stable_baselines_trains_and_is_scored(
    name: str, config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By hand, where it is installed: it needs PyTorch."""
    stable_baselines3 = pytest.importorskip("stable_baselines3")
    contrib = pytest.importorskip("sb3_contrib")
    monkeypatch.syspath_prepend(ROOT / "examples")
    example = importlib.import_module("stable_baselines")
    algorithm = {"PPO": stable_baselines3.PPO, "RecurrentPPO": contrib.RecurrentPPO}[name]
    policy = "MlpPolicy" if name == "PPO" else "MlpLstmPolicy"
    many = example.make_vec_env(example.NavigationEnv, n_envs=2, env_kwargs={"config": config})
    model = algorithm(policy, many, n_steps=8, batch_size=16, n_epochs=1)
    model.learn(32)
    results = example.score(model, config)
    assert results["unseen"]["L>=1"]["n"] > 10


def test_the_wrappers_of_gymnax_fit(flat: FlatObservations) -> None:
    """By hand, where gymnax is installed."""
    wrappers = pytest.importorskip("gymnax.wrappers")
    env, params = wrappers.LogWrapper(flat), flat.default_params
    obs, state = env.reset(jax.random.key(0), params)
    assert obs.shape == env.observation_space(params).shape
    *_, info = env.step(jax.random.key(1), state, jnp.int32(Action.DONE), params)
    assert info["returned_episode"]
    assert info["returned_episode_lengths"] == 1
