"""Policies that were trained elsewhere play the same test episodes."""

from __future__ import annotations

import dataclasses
import importlib
import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax.config import LearnerConfig, TrainConfig
from tdanet_jax.env.environment import FlatObservations
from tdanet_jax.evaluation import policies
from tdanet_jax.task import Task, load_task, make
from tdanet_jax.vocabulary import Action
from tdanet_jax.workflows import evaluate
from tests.support.pages import ROOT


@pytest.fixture(scope="module")
def config(rooms_file: Path) -> TrainConfig:
    return TrainConfig(data=str(rooms_file))


@pytest.fixture(scope="module")
def flat(config: TrainConfig) -> FlatObservations:
    return FlatObservations(make("ithor-18/4", "test", config)[0])


#: Rows that a crowded training room has more than the test rooms.
MORE_ROWS = 3


@pytest.fixture
def crowded_training_rooms(config: TrainConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """An evaluation's task trains in rooms with more objects in view than any test room."""

    def load(config: TrainConfig) -> Task:
        task = load_task(config)
        rows = task.eval_params.max_detections + MORE_ROWS
        return dataclasses.replace(task, train_params=task.train_params.with_rows(rows))

    monkeypatch.setattr(evaluate, "load_task", load)


@pytest.mark.parametrize("custom", [True, False])
def test_added_rooms_are_in_one_pool_as_in_make_or_left_out(
    monkeypatch: pytest.MonkeyPatch, custom: bool
) -> None:
    """Vectors of a policy trained in `make`'s rooms are as long here; others heed no such rooms."""
    loaded: list[TrainConfig] = []

    def load(config: TrainConfig) -> Task:
        loaded.append(config)
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "load_task", load)
    asked = TrainConfig(generated=40, variants=3, pool_rooms=10, extra_targets="Pan")
    policy: Any = (lambda env: None) if custom else "random"
    with pytest.raises(KeyboardInterrupt):
        tdanet_jax.evaluate(policy=policy, config=asked)
    assert (loaded[0].generated, loaded[0].variants) == ((40, 3) if custom else (0, 0))
    assert (loaded[0].pool_rooms > 10_000) == custom
    assert (loaded[0].extra_targets is None) != custom


def says_done(flat: FlatObservations, vector: Any) -> Any:
    """1 where the target's word is that of a row in view, else 0: for one vector."""
    width = flat.env.words.shape[1]
    rows = vector[:-width].reshape(-1, 4 + width)
    return ((rows[:, 4:] == vector[-width:]).all(axis=1) & (rows[:, 0] == 1)).any()


@pytest.mark.usefixtures("few_episodes", "crowded_training_rooms")
def test_on_the_host_and_in_jax_the_same_policy_plays_the_same(
    flat: FlatObservations, config: TrainConfig
) -> None:
    """Done once the target is in view, else it turns; after 12 steps it goes ahead.

    Vectors are as long as in training, where rooms are more crowded.
    """
    turned = {"steps": 0, "begun": []}
    size = flat.observation_space().shape[0] + MORE_ROWS * (4 + flat.env.words.shape[1])

    def begin(batch: int) -> None:
        turned["steps"] = 0
        turned["begun"].append(batch)

    def predict(vectors: np.ndarray) -> np.ndarray:
        assert vectors.shape[1] == size
        done = np.array([says_done(flat, vector) for vector in vectors])
        turned["steps"] += 1
        otherwise = Action.ROTATE_LEFT if turned["steps"] < 12 else Action.MOVE_AHEAD
        return np.where(done, Action.DONE, otherwise)

    def act(memory: Any, key: jax.Array, vectors: jax.Array) -> tuple[Any, jax.Array]:
        done = jax.vmap(lambda vector: says_done(flat, vector))(vectors)
        otherwise = jnp.where(memory + 1 < 12, Action.ROTATE_LEFT, Action.MOVE_AHEAD)
        return memory + 1, jnp.where(done, Action.DONE, otherwise)

    hosted = policies.on_host(predict, begin)
    compiled = policies.on_vectors(lambda batch: jnp.zeros((), jnp.int32), act)
    one, other = (
        tdanet_jax.evaluate(policy=policy, config=config) for policy in (hosted, compiled)
    )
    assert one == other
    assert 0 < one["seen"]["L>=1"]["SR"] < 100
    assert len(turned["begun"]) == 2  # seen and unseen


def test_a_policy_is_made_for_the_environment_that_it_is_evaluated_in(config: TrainConfig) -> None:
    made = []

    def for_env(env: Any) -> policies.Policy:
        made.append(env)
        return policies.random()

    tdanet_jax.evaluate(policy=for_env, config=dataclasses.replace(config, split="14/8"))
    (env,) = made
    expected, params = make("ithor-14/8", "test", config)
    assert env.name == expected.name
    np.testing.assert_array_equal(env.words, expected.words)
    np.testing.assert_array_equal(env.default_params.step_limit, params.step_limit)


#: What each example needs besides JAX, and a command that makes a few updates.
EXAMPLES = [
    pytest.param("recurrent_ppo", (), "--num-envs 8 --num-steps 4 --total-timesteps 64"),
    pytest.param("cleanrl_ppo_lstm", ("torch",), "--num-envs 8 --num-steps 4 --total-timesteps 64"),
    *(
        pytest.param(
            "stable_baselines",
            ("stable_baselines3", "sb3_contrib"),
            f"--algorithm {algorithm} --total-timesteps 4096",
        )
        for algorithm in ("PPO", "RecurrentPPO")
    ),
]


@pytest.mark.slow
@pytest.mark.usefixtures("few_episodes")
@pytest.mark.parametrize(("name", "needs", "arguments"), EXAMPLES)
def test_an_example_trains_and_is_scored(
    name: str, needs: tuple[str, ...], arguments: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where what it needs is installed."""
    for module in needs:
        pytest.importorskip(module)
    results = []

    def recorded(**given: Any) -> Any:
        results.append(evaluate.evaluate(**given))
        return results[-1]

    monkeypatch.setattr(tdanet_jax, "evaluate", recorded)
    path = ROOT / "examples" / f"{name}.py"
    monkeypatch.setattr(
        sys, "argv", [str(path), "--split", "14/8", "--validation", *arguments.split()]
    )
    runpy.run_path(str(path), run_name="__main__")
    (found,) = results
    assert found["model"] == "custom"
    assert found["split"] == "14/8-validation"
    assert found["unseen"]["L>=1"]["n"] > 10


def import_example(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(ROOT / "examples")
    return importlib.import_module(name)


def test_the_lstm_of_the_cleanrl_example_begins_anew_with_an_episode(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where PyTorch is installed: a rollout at once gives what single steps gave."""
    torch = pytest.importorskip("torch")
    example = import_example("cleanrl_ppo_lstm", monkeypatch)
    steps, batch = 5, 3
    agent = example.Agent(example.NavigationVectorEnv(batch, config=config), hidden=16)
    x = torch.randn(steps, batch, agent.network[0].in_features)
    done = torch.zeros(steps, batch)
    done[2, 1] = 1.0
    together, _ = agent.get_states(x.flatten(0, 1), agent.initial_state(batch), done)
    state, single = agent.initial_state(batch), []
    for step in range(steps):
        state = tuple(part * (1.0 - done[step])[:, None] for part in state)
        out, state = agent.get_states(x[step], state, torch.zeros(batch))
        single.append(out)
    torch.testing.assert_close(together, torch.cat(single))
    anew, _ = agent.get_states(x[2:, 1], agent.initial_state(1), torch.zeros(steps - 2))
    torch.testing.assert_close(together.reshape(steps, batch, -1)[2:, 1], anew)


def test_stable_baselines_is_told_how_episodes_end(
    config: TrainConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it is installed."""
    for module in ("stable_baselines3", "sb3_contrib"):
        pytest.importorskip(module)
    example = import_example("stable_baselines", monkeypatch)
    brief = dataclasses.replace(config, learner=LearnerConfig(step_limit=2))
    many = example.ManyEpisodes(example.NavigationVectorEnv(3, config=brief))
    many.seed(0)
    first = many.reset()
    many.seed(0)
    np.testing.assert_array_equal(many.reset(), first)
    obs, _, done, about = many.step(np.array([Action.DONE, 1, 1]))
    assert done.tolist() == [True, False, False]
    assert about[0]["TimeLimit.truncated"] is about[0]["is_success"] is False
    np.testing.assert_array_equal(about[0]["terminal_observation"], first[0])
    assert about[1:] == [{}, {}]
    before = obs
    obs, _, done, about = many.step(np.array([1, 1, Action.DONE]))
    assert done.tolist() == [False, True, True]
    assert [one.get("TimeLimit.truncated") for one in about] == [None, True, False]
    assert not np.array_equal(about[1]["terminal_observation"], before[1])
    assert not np.array_equal(about[1]["terminal_observation"], obs[1])


def test_the_wrappers_of_gymnax_fit(flat: FlatObservations) -> None:
    """By hand, where gymnax is installed."""
    wrappers = pytest.importorskip("gymnax.wrappers")
    env, params = wrappers.LogWrapper(flat), flat.default_params
    obs, state = env.reset(jax.random.key(0), params)
    assert obs.shape == env.observation_space(params).shape
    *_, info = env.step(jax.random.key(1), state, jnp.int32(Action.DONE), params)
    assert info["returned_episode"]
    assert info["returned_episode_lengths"] == 1
