"""A run that is loaded again knows all that it knew: every attribute, not its arrays alone."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.evaluation import report as report_module
from tdanet_jax.evaluation import rollout
from tdanet_jax.io import files
from tdanet_jax.scenes import SceneTables
from tdanet_jax.task import Task, make_task
from tdanet_jax.training.callbacks import Callbacks
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.training.journal import read_metrics
from tdanet_jax.training.learner import TrainState
from tdanet_jax.training.run import _UPDATE_MEANS, Run
from tdanet_jax.vocabulary import ACTION_NAMES
from tdanet_jax.words import WordVectors
from tdanet_jax.workflows.train import _check_longer as check_longer
from tdanet_jax.workflows.train import _prepare as prepare
from tdanet_jax.workflows.train import _report as evaluate_finished
from tdanet_jax.workflows.train import resumed

CONFIG = TrainConfig(
    minutes=10.0,
    max_skipped=3,
    learner=LearnerConfig(num_envs=2, rollout_steps=5, step_limit=6),
    network=NetworkConfig(width=4, hidden=4, precision="float32"),
)
#: Attributes of a run that a checkpoint need not hold, and why.
NOT_KEPT = {
    "checkpoints": "an open folder",
    "_journal": "an open file; its rows are compared",
    "pools": "those of the task; their tables are compared",
    "_begin_again": "a function",
    "_skipped_before": "counts from each start; compared below",
}


@pytest.fixture(scope="module")
def task(some_rooms: SceneTables, glove: WordVectors) -> Task:
    return make_task(CONFIG, some_rooms, glove)


@pytest.fixture(autouse=True)
def begins_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new run has made-up arrays: nothing is compiled, and no two leaves agree."""

    def begin(run: Run) -> TrainState:
        shapes = jax.eval_shape(run._init, jax.random.key(0), run._words, run.pools.params)
        leaves, tree = jax.tree.flatten(shapes.replace(key=jnp.zeros(2, jnp.uint32)))
        made = [jnp.full(x.shape, 1 + i % 100, x.dtype) for i, x in enumerate(leaves)]
        state: TrainState = jax.tree.unflatten(tree, made)
        return state.replace(key=jax.random.wrap_key_data(state.key))

    monkeypatch.setattr(Run, "_begin", begin)


def saved(folder: Path, task: Task, **counts: int) -> Run:
    """A run after 30 updates and 6 of its 10 minutes, saved."""
    run = Run(folder, CONFIG, task)
    counters = {"updates": 30, "episodes": 77, "skipped": 5} | counts
    run.state = run.state.replace(**{k: jnp.int32(v) for k, v in counters.items()})
    run.seconds = 360.25
    run.save()
    return run


def plain(value: Any) -> Any:
    """Something that compares by `==`."""
    if isinstance(value, jax.Array | np.ndarray):
        if jnp.issubdtype(value.dtype, jax.dtypes.prng_key):
            value = jax.random.key_data(value)
        return str(value.dtype), value.shape, np.asarray(value).tolist()
    leaves, tree = jax.tree.flatten(value)
    return value if leaves == [value] else (str(tree), [plain(leaf) for leaf in leaves])


def test_every_attribute_is_as_it_was(task: Task, tmp_path: Path) -> None:
    run = saved(tmp_path, task)
    again = Run(tmp_path, CONFIG, task)
    assert vars(again).keys() == vars(run).keys()
    for name, value in vars(run).items():
        if name not in NOT_KEPT:
            assert plain(getattr(again, name)) == plain(value), name
    assert again._skipped_before == 5
    chex.assert_trees_all_equal(again.pools.params, run.pools.params)
    for name in ("title", "steps", "progress"):
        assert getattr(again, name) == getattr(run, name)
    assert plain(again._shares()) == plain(run._shares())
    assert plain(vars(again.snapshot(3))) == plain(vars(run.snapshot(3)))
    assert plain(vars(Checkpoints(tmp_path).snapshot())) == plain(vars(run.snapshot()))


def test_time_and_rows_continue(task: Task, tmp_path: Path) -> None:
    saved(tmp_path, task)
    again = Run(tmp_path, CONFIG, task)
    assert again.progress == pytest.approx(360.25 / 600)
    again._open_journal()
    metrics = {name: np.ones(1) for name in (*_UPDATE_MEANS, "bootstrap_only_steps", "reward_sum")}
    metrics |= {name: np.full(1, 2.0) for name in ("success_sum", "spl_sum", "length_sum")}
    metrics["episodes"] = np.array([4])
    metrics["actions"] = np.array([[6, 3, 1, 2, 0, 4]])
    row = again._record(again.state, metrics, again.progress, took=239.0)
    assert row["seconds"] == 599.25
    shares = [row[f"actions/{name}"] for name in ACTION_NAMES]
    assert shares == [0.375, 0.1875, 0.0625, 0.125, 0.0, 0.25]
    assert read_metrics(tmp_path) == [row]
    assert again.progress < 1.0
    again._record(again.state, metrics, again.progress, took=0.75)
    assert list(again.chunks()) == []  # ten minutes in all: the budget is spent


def test_a_budget_that_is_spent_already_is_refused(task: Task, tmp_path: Path) -> None:
    run = saved(tmp_path, task)
    configs.save(CONFIG, tmp_path / CONFIG_FILE)
    check_longer(run)  # to evaluate it again
    run.config = dataclasses.replace(CONFIG, minutes=20.0)
    check_longer(run)
    assert run.progress == pytest.approx(360.25 / 1200)
    run.config = dataclasses.replace(CONFIG, minutes=5.0)
    with pytest.raises(ValueError, match=r"--minutes 5.0: .* has already trained as long"):
        check_longer(run)


RESULTS = ("results.json", "results.md", "episodes.jsonl")


@pytest.mark.parametrize("steps", [10, 20])
def test_results_of_a_former_budget_are_not_those_of_a_longer_run(
    task: Task, tmp_path: Path, steps: int
) -> None:
    """A sweep takes a run with results for finished, and `share` passes them on."""
    run = Run(tmp_path, dataclasses.replace(CONFIG, minutes=None, steps=10), task)
    run.state = run.state.replace(updates=jnp.int32(1))  # 10 steps
    for name in RESULTS:
        (tmp_path / name).write_text("of 10 steps")
    run.config = dataclasses.replace(run.config, steps=steps)
    prepare(run, Callbacks())
    assert [name for name in RESULTS if (tmp_path / name).exists()] == [
        name for name in RESULTS if steps == 10
    ]


def test_a_run_is_resumed_with_the_new_places_of_its_files(tmp_path: Path) -> None:
    own = dataclasses.replace(CONFIG, data=None, word_vectors=str(tmp_path / "moved.npz"))
    configs.save(own, tmp_path / CONFIG_FILE)
    new = TrainConfig(steps=5, word_vectors=str(tmp_path / "here.npz"), seed=7)
    budget = {"minutes": None, "steps": 5}
    expected = dataclasses.replace(own, **budget, word_vectors=new.word_vectors)  # type: ignore[arg-type]
    assert resumed(tmp_path, new) == expected
    assert resumed(tmp_path, TrainConfig()) == own
    configs.save(CONFIG, tmp_path / CONFIG_FILE)
    with pytest.raises(ValueError, match=r"here.npz: .* was trained with the bundled ones"):
        resumed(tmp_path, new)


class Shielding(Callbacks):
    """Knows whether a signal would have to wait."""

    shielded = False

    @contextlib.contextmanager
    def shield(self) -> Iterator[None]:
        self.shielded = True
        yield
        self.shielded = False


@pytest.mark.parametrize("written", range(4))
def test_a_start_that_is_cut_short_leaves_a_new_folder_or_a_run_to_resume(
    task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, written: int
) -> None:
    """Killed after each of the files; only a kill can do so, as signals wait."""
    run = Run(tmp_path, dataclasses.replace(CONFIG, word_vectors="there.txt"), task)
    callbacks, replacing, writes = Shielding(), files.replacing, itertools.count()

    def cut(path: Path) -> Any:
        assert callbacks.shielded
        if next(writes) == written:
            raise KeyboardInterrupt
        return replacing(path)

    monkeypatch.setattr(files, "replacing", cut)
    with pytest.raises(KeyboardInterrupt):
        prepare(run, callbacks)
    if written:
        assert resumed(tmp_path) == run.config
    else:
        files.check_empty(tmp_path)


def test_a_run_without_its_metrics_is_evaluated_all_the_same(
    task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[str] = []

    class Noting(Callbacks):
        def on_note(self, text: str) -> None:
            said.append(text)

    monkeypatch.setattr(rollout, "evaluate_lists", lambda *_: {})
    monkeypatch.setattr(report_module, "results", lambda *_: {"found": True})
    found = evaluate_finished(Run(tmp_path, CONFIG, task), {}, Noting())
    assert found == {"found": True}
    assert said[0] == "note: no metrics.jsonl, and so no learning curve"
    assert not (tmp_path / "learning_curve.png").exists()
