"""Runs of format 1, from before the names of today: they load, evaluate and resume.

`expected.json` holds an agent's second decision by the code that wrote the runs. What else it holds
was recorded in the rooms of version 0.2, which have changed since.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import config as configs
from tdanet_jax.agent.detection import Detection
from tdanet_jax.config import CONFIG_FILE
from tdanet_jax.evaluation import episodes, policies, rollout
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.scenes import SceneTables
from tdanet_jax.task import Task, make_task
from tdanet_jax.training.checkpoint import FORMAT, newest
from tdanet_jax.training.renames import renamed
from tdanet_jax.training.run import Run
from tdanet_jax.vocabulary import Action
from tdanet_jax.words import WordVectors
from tests.support import samples
from tests.support.checkpoints import arrays_of

DATA = Path(__file__).parents[1] / "data"
#: With odometry and triangulation; and a network that adapts, in the middle of its episodes.
NAMES = ("run_format_1_best", "run_format_1_savn")


@pytest.fixture(params=[NAMES[0], pytest.param(NAMES[1], marks=pytest.mark.slow)])
def run(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return shutil.copytree(DATA / request.param, tmp_path / request.param)


@pytest.fixture
def task(run: Path, ithor: SceneTables, glove: WordVectors) -> Task:
    """In today's rooms, which are taken for those of the run."""
    [meta] = run.glob("checkpoints/*/meta/metadata")
    tables = samples.as_version(ithor, json.loads(meta.read_text())["data_version"])
    return make_task(configs.load(run / CONFIG_FILE), tables, glove)


def expected(run: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((run / "expected.json").read_text())
    return content


def test_all_its_arrays_are_known_by_the_names_of_today(run: Path, task: Task) -> None:
    """A run takes every array of the file into its state."""
    state = Run(run, configs.load(run / CONFIG_FILE), task).state
    known = {jax.tree_util.keystr(path, simple=True, separator="/"): leaf
             for path, leaf in jax.tree_util.tree_leaves_with_path(state)}  # fmt: skip
    for name, leaf in arrays_of(run).items():
        if name != "key":
            np.testing.assert_array_equal(known[name], leaf, err_msg=name)


@pytest.mark.slow
def test_it_resumes_and_is_saved_with_the_names_of_today(run: Path, task: Task) -> None:
    again = Run(run, configs.load(run / CONFIG_FILE), task)
    updates = int(again.state.updates)
    [row] = again.chunks()
    assert row["updates"] == updates + 1
    again.save()
    leaves = {name: leaf.astype(np.float64) for name, leaf in arrays_of(run).items()}
    assert all(np.isfinite(leaf).all() for leaf in leaves.values())
    assert leaves.keys() == renamed(expected(run)["norms"], 1).keys()
    meta = json.loads((run / f"checkpoints/{row['updates']}/meta.json").read_text())
    assert meta["format"] == FORMAT == 3


@pytest.mark.slow
def test_it_plays(run: Path, task: Task, ithor: SceneTables) -> None:
    lists = episodes.load(ithor, task.split)
    few = {name: Episodes(found.pose[::250], found.target[::250]) for name, found in lists.items()}
    policy = policies.network(task.model, task.words)
    played = rollout.evaluate_lists(policy, newest(run).weights, task.eval_params, few, 0)
    for group, (_, records) in played.items():
        assert len(records.length) == len(few[group].pose)
        assert (records.length >= 1).all()


def test_its_agent_decides_as_in_the_old_code(tmp_path: Path) -> None:
    run = shutil.copytree(DATA / NAMES[0], tmp_path / "run")
    agent = tdanet_jax.load(run)
    seen = [Detection("sink", 0.1, 0.2, 0.4, 0.5), Detection("coffee machine", 0.5, 0.5, 0.75, 1.0)]
    state = agent.start(rotation=45)
    for _ in range(2):
        state, decision = agent.act(state, seen, "sink", blocked=False)
        state = state._replace(action=np.int32(Action.MOVE_AHEAD))
    there = expected(run)["second_decision"]
    np.testing.assert_allclose(decision.probabilities, there["probabilities"], atol=1e-6)
    np.testing.assert_allclose(decision.value, there["value"], atol=1e-6)


def test_new_names_stay_as_they_are() -> None:
    names = renamed(expected(DATA / NAMES[1])["norms"], 1)
    assert renamed(names, 1) == renamed(names, 2) == names
