"""The names of `tdanet_jax`: light to import, complete, and the old ones with a warning."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

import tdanet_jax
from tdanet_jax import Callbacks, TrainConfig, _moved
from tdanet_jax.config import LearnerConfig, NetworkConfig
from tdanet_jax.evaluation import policies
from tdanet_jax.training import run_file
from tdanet_jax.training.journal import read_metrics

TINY = TrainConfig(
    steps=120,
    chunk_updates=2,
    learner=LearnerConfig(num_envs=4, rollout_steps=5),
    network=NetworkConfig(width=8, hidden=8, precision="float32"),
)


def loaded(code: str) -> list[str]:
    """The modules that a program loads in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-c", f"import sys\n{code}\nprint(*sys.modules)"],
        capture_output=True,
        text=True,
        check=True,
    )
    return done.stdout.split()


def test_the_import_is_light() -> None:
    modules = loaded("import tdanet_jax")
    assert not {"jax", "numpy", "flax", "rich", "tyro"} & set(modules)


def test_a_configuration_needs_no_jax() -> None:
    assert "jax" not in loaded(
        "from tdanet_jax.config import BEST, TrainConfig; TrainConfig().check(); BEST.check()"
    )


def test_an_agent_needs_no_rooms() -> None:
    modules = loaded(
        "import tdanet_jax, tdanet_jax.agent.ai2thor\ntdanet_jax.load('agents/18-4-best')"
    )
    assert "tdanet_jax.agent" in modules
    assert not [name for name in modules if name.startswith("tdanet_jax.scenes")]


def test_every_public_name_is_there() -> None:
    for name in tdanet_jax.__all__:
        assert getattr(tdanet_jax, name) is not None
        assert name in dir(tdanet_jax)
    with pytest.raises(AttributeError, match="no_such"):
        _ = tdanet_jax.no_such


class Stopper(Callbacks):
    """Stops after some chunks, and remembers what it was told."""

    def __init__(self, chunks: int) -> None:
        self.left = chunks
        self.notes: list[str] = []

    def on_rows(self, runs: Any, rows: Any) -> None:
        self.left -= 1

    def on_note(self, text: str) -> None:
        self.notes.append(text)

    def should_stop(self) -> bool:
        return self.left == 0


@pytest.mark.slow
@pytest.mark.usefixtures("ithor")
def test_a_run_from_python_is_stopped(tmp_path: Path) -> None:
    folder, stopper = tmp_path / "run", Stopper(2)
    # What tests/system/test_faults.py trains, so that it is compiled once.
    config = TrainConfig(
        split="14/8",
        steps=1200,
        learner=LearnerConfig(num_envs=8, rollout_steps=5),
        network=NetworkConfig(width=16, hidden=16),
    )
    assert tdanet_jax.train(config, folder, callbacks=stopper) is None
    assert stopper.notes[0] == f"tdanet, split 14/8, seed 0 -> {folder}"
    assert [row["steps"] for row in read_metrics(folder)] == [400, 800]
    assert [process.command for process in run_file.read(folder)] == [None]
    with pytest.raises(ValueError, match="exists and is not empty"):
        tdanet_jax.train(config, folder)
    with pytest.raises(ValueError, match="needs a configuration"):
        tdanet_jax.train(None, tmp_path / "other")
    with pytest.raises(ValueError, match="sampled or greedy"):
        tdanet_jax.evaluate(folder, "random")


@pytest.mark.slow
@pytest.mark.usefixtures("ithor", "few_episodes")
def test_a_run_from_python_is_stopped_resumed_and_evaluated(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    assert tdanet_jax.train(TINY, folder, callbacks=Stopper(2)) is None
    results = tdanet_jax.train(None, folder, resume=True)
    assert results is not None
    assert (results["steps"], results["seen"]["L>=1"]["n"]) == (120, 100)
    assert tdanet_jax.evaluate(folder) == results
    longer = tdanet_jax.train(TrainConfig(steps=160), folder, resume=True)
    assert longer is not None
    assert longer["steps"] == 160

    several = tdanet_jax.evaluate([folder], "greedy")
    assert [one["policy"] for one in several] == ["greedy"]


@pytest.mark.slow
@pytest.mark.usefixtures("ithor", "few_episodes")
def test_policies_without_a_checkpoint(tmp_path: Path) -> None:
    random = policies.random()
    again = tdanet_jax.evaluate(policy=random, out=tmp_path / "random")
    assert (tmp_path / "random" / "results.md").exists()
    seeds = [again, *(tdanet_jax.evaluate(policy=random, seed=seed) for seed in (0, 1))]
    assert seeds[0]["policy"] == seeds[0]["model"] == "custom"
    assert seeds[0] == seeds[1] != seeds[2]
    with pytest.raises(ValueError, match="policy greedy: needs a checkpoint"):
        tdanet_jax.evaluate(policy="greedy")


@pytest.mark.parametrize("old", _moved.MOVED)
def test_an_old_name_is_the_new_thing_with_a_warning(old: str) -> None:
    package, _, name = f"tdanet_jax.{old}".rpartition(".")
    sys.modules.pop(f"{package}.{name}", None)  # what another test has imported
    vars(importlib.import_module(package)).pop(name, None)
    found: dict[str, Any] = {}
    line = compile(f"from {package} import {name}", __file__, "exec")
    with pytest.warns(DeprecationWarning, match=f"tdanet_jax.{_moved.MOVED[old]}") as caught:
        exec(line, found)
    assert {warning.filename for warning in caught} == {__file__}
    assert found[name] is pkgutil.resolve_name(f"tdanet_jax.{_moved.MOVED[old]}")


@pytest.mark.filterwarnings("ignore:tdanet_jax:DeprecationWarning")
def test_an_old_module_is_imported_in_any_form() -> None:
    found: dict[str, Any] = {}
    exec("import tdanet_jax.policies as one", found)
    exec("from tdanet_jax.policies import Policy as other", found)
    assert found["one"] is policies
    assert found["other"] is policies.Policy


#: The example of the environment and of a policy in the documentation of version 0.1.
OLD_EXAMPLE = """
import jax
import jax.numpy as jnp
from tdanet_jax import env, episodes, evaluation, metrics, report, scenes, words
from tdanet_jax.config import TrainConfig
from tdanet_jax.policies import Policy
from tdanet_jax.task import make_task

task = make_task(TrainConfig(split="18/4"), scenes.load_tables(), words.load_bundled())
params = task.train_params
reset = jax.jit(jax.vmap(env.reset, (0, None)))
step = jax.jit(jax.vmap(env.step, (0, 0, 0, None)))
keys = jax.random.split(jax.random.key(0), 8)
obs, state = reset(keys, params)
obs, state, reward, terminated, truncated, info = step(keys, state, jnp.zeros(8, int), params)

def act(weights, memory, key, state, params):
    obs = jax.vmap(env.observe, (0, None))(state, params)
    in_view = (obs.mask & (obs.classes == obs.target[:, None])).any(axis=1)
    return memory, jnp.where(in_view, 5, jax.random.randint(key, in_view.shape, 0, 5))

policy = Policy(start=lambda weights, batch: (), act=act)
lists = episodes.load(task.tables, task.split, task.extras)
played = evaluation.evaluate_lists(policy, None, task.eval_params, lists, seed=0)
for group, pair in played.items():
    column = report.columns(task.tables, *pair)
    named = (column[name] for name in ("success", "shortest", "length", "cluster"))
    print(group, metrics.summarise(*named)["L>=1"])
"""


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:tdanet_jax:DeprecationWarning")
@pytest.mark.usefixtures("ithor", "few_episodes")
def test_the_examples_of_the_last_version_run(capsys: pytest.CaptureFixture[str]) -> None:
    exec(OLD_EXAMPLE, {})
    assert capsys.readouterr().out.startswith("seen {'SR': ")
