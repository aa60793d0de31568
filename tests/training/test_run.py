"""A run on disk: budget, metrics, checkpoints, and going on bit for bit after a stop."""

import collections
import dataclasses
import json
import shutil

import chex
import jax
import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.models.factory import make_model
from tdanet_jax.task import make_task
from tdanet_jax.training import history
from tdanet_jax.training.checkpoint import Checkpoints, newest
from tdanet_jax.training.journal import METRICS_FILE, Journal, read_metrics
from tdanet_jax.training.run import Run, chunks_together
from tests.agent.test_agent import OLD_RUN
from tests.support import samples

#: Eight chunks of two updates of 8 x 5 steps.
TINY = TrainConfig(
    steps=640,
    history=8,
    chunk_updates=2,
    learner=LearnerConfig(num_envs=8, rollout_steps=5, step_limit=6),
    network=NetworkConfig(width=16, hidden=16),
)
TIMES = {"seconds", "steps_per_second"}


@pytest.fixture(scope="module")
def task(ithor):
    return make_task(TINY, ithor, words.load_bundled())


def leaves(state):
    plain = state.replace(key=jax.random.key_data(state.key))
    return [np.asarray(leaf) for leaf in jax.tree.leaves(plain)]


def without_times(rows):
    return [{k: v for k, v in row.items() if k not in TIMES} for row in rows]


@pytest.fixture(scope="module")
def whole(task, tmp_path_factory):
    """A run that nothing interrupted."""
    return run_whole(tmp_path_factory.mktemp("whole"), TINY, task)


def run_whole(folder, config, task):
    run = Run(folder, config, task)
    rows = list(run.chunks())
    run.save()
    return folder, run, rows


@pytest.fixture(scope="module")
def sensing_whole(ithor, tmp_path_factory):
    """The same, of an agent with sensors that estimates reach and imitates shortest paths."""
    network = dataclasses.replace(
        TINY.network, odometry=True, triangulation=True, reach_threshold=0.5
    )
    learning = dataclasses.replace(TINY.learner, imitation_weight=0.3)
    config = dataclasses.replace(TINY, network=network, learner=learning)
    task = make_task(config, ithor, words.load_bundled())
    return run_whole(tmp_path_factory.mktemp("sensing"), config, task)


def test_the_budget_in_steps_is_kept_and_every_chunk_has_a_row(whole):
    folder, run, rows = whole
    assert run.steps == 640
    assert [row["steps"] for row in rows] == list(range(80, 641, 80))
    assert read_metrics(folder) == rows
    assert rows[-1]["episodes"] == int(run.state.episodes) > 0


@pytest.mark.parametrize("which", ["whole", pytest.param("sensing_whole", marks=pytest.mark.slow)])
def test_a_stopped_run_goes_on_bit_for_bit(which, tmp_path, request):
    whole = request.getfixturevalue(which)
    config, task = whole[1].config, whole[1].task
    stopped = Run(tmp_path, config, task)
    for count, _ in enumerate(stopped.chunks(), start=1):
        if count == 3:
            stopped.save()
        if count == 5:  # two chunks after the checkpoint are lost
            break
    again = Run(tmp_path, config, task)
    assert again.steps == 240
    sensors = again.state.env_state.sensors
    assert bool(sensors) == (which == "sensing_whole")
    assert not sensors or sensors["triangulation"].normal.any()
    for loss in ("reach_loss", "imitation_loss"):
        assert {loss in row for row in whole[2]} == {which == "sensing_whole"}
    list(again.chunks())
    for ours, theirs in zip(leaves(again.state), leaves(whole[1].state), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert without_times(read_metrics(tmp_path)) == without_times(whole[2])
    assert_same_history(tmp_path, whole[0])


def assert_same_history(ours, theirs):
    names = [[path.name for path in history.points(run)] for run in (ours, theirs)]
    assert names[0] == names[1]
    for mine, other in zip(history.points(ours), history.points(theirs), strict=True):
        mine, other = history.read(mine), history.read(other)
        for field in ("updates", "episodes", "point", "data_version"):
            assert getattr(mine, field) == getattr(other, field)
        chex.assert_trees_all_equal(mine.weights, other.weights)


def test_a_run_goes_on_in_the_variants_that_it_began_in(whole, tmp_path):
    _, run, _ = whole
    varied = dataclasses.replace(run.task, variants_version="abc")
    Run(tmp_path, run.config, varied).save()
    Run(tmp_path, run.config, varied)
    with pytest.raises(ValueError, match="trained with the added rooms abc, these are None"):
        Run(tmp_path, run.config, run.task)


def test_the_history_holds_the_parameters_at_each_point(whole):
    folder, run, rows = whole
    kept = [history.read(path) for path in history.points(folder)]
    # Eight chunks pass the eight points of the budget's eighths.
    assert [(point.point, point.updates) for point in kept] == [(k, 2 * k) for k in range(1, 9)]
    assert [point.episodes for point in kept] == [row["episodes"] for row in rows]
    chex.assert_trees_all_equal(kept[-1].weights, jax.device_get(run.state.params))
    assert not np.array_equal(*(point.weights["actor"]["kernel"] for point in kept[-2:]))


@pytest.mark.slow
def test_seeds_trained_together_go_the_way_of_each_alone(whole, task, tmp_path):
    """One seed stands two chunks ahead, as after an interruption; the other catches up alone."""
    configs = [dataclasses.replace(TINY, seed=seed) for seed in (0, 1)]
    ahead, behind = (Run(tmp_path / f"seed{c.seed}", c, task) for c in configs)
    ahead.folder.mkdir(exist_ok=True)
    behind.folder.mkdir(exist_ok=True)
    list(ahead.chunks(until=4))
    assert int(ahead.state.updates) == 4
    widths = [len(rows) for rows in chunks_together([ahead, behind])]
    assert widths == [1, 1] + [2] * 6
    for run in (ahead, behind):
        run.save()
        assert [row["steps"] for row in read_metrics(run.folder)] == list(range(80, 641, 80))
        assert [history.read(p).point for p in history.points(run.folder)] == list(range(1, 9))
        assert int(Run(run.folder, run.config, task).state.updates) == 16
    # Each has its own network.
    ours, theirs = (run.state.params["lstm"]["kernel"] for run in (ahead, behind))
    assert not np.array_equal(ours, theirs)
    # The first chunk in common: equal but for the rounding of batched products.
    alone, together = whole[2][2], read_metrics(ahead.folder)[2]
    for name in ("episodes", "success", "length", "policy_loss", "value_loss", "entropy"):
        assert together[name] == pytest.approx(alone[name], rel=0.02, abs=0.002), name
    assert without_times(read_metrics(behind.folder)) != without_times(read_metrics(ahead.folder))


def test_the_weights_of_a_run_are_read_alone(whole):
    folder, run, _ = whole
    weights = Checkpoints(folder).snapshot().weights
    for ours, theirs in zip(
        jax.tree.leaves(weights), jax.tree.leaves(run.state.params), strict=True
    ):
        np.testing.assert_array_equal(ours, theirs)


def test_a_finished_run_has_nothing_left_to_do(whole, task):
    again = Run(whole[0], TINY, task)
    assert list(again.chunks()) == []
    assert again.progress >= 1


def test_another_seed_gives_another_run(whole, task, tmp_path):
    other = Run(tmp_path, dataclasses.replace(TINY, seed=1), task)
    rows = [next(other.chunks())]
    assert without_times(rows) != without_times(whole[2][:1])


@pytest.mark.slow
def test_the_budget_in_episodes_ends_the_run(task, tmp_path):
    run = Run(tmp_path, dataclasses.replace(TINY, episodes=5), task)
    list(run.chunks())
    assert int(run.state.episodes) >= 5
    assert run.steps < 640
    last = history.read(history.points(tmp_path)[-1])
    assert (last.point, last.episodes) == (8, int(run.state.episodes))


@pytest.mark.slow
def test_a_run_that_is_no_longer_finite_stops_with_its_state_saved(task, tmp_path):
    run = Run(tmp_path, dataclasses.replace(TINY, max_skipped=4, history=0), task)
    broken = jax.tree.map(lambda leaf: leaf * np.nan, run.state.params)
    run.state = run.state.replace(params=broken)
    with pytest.raises(ValueError, match="4 updates skipped") as caught:
        list(run.chunks())
    assert "\n" not in str(caught.value)
    assert run.steps == 160  # two chunks of two updates, all skipped
    again = Run(tmp_path, dataclasses.replace(TINY, max_skipped=4, history=0), task)
    assert again.steps == 160
    row = next(again.chunks())  # it may skip as many again
    assert (row["policy_loss"], row["entropy"], row["skipped"]) == (None, None, 6)
    assert not (tmp_path / "history").exists()  # none was asked for


def test_seeds_trained_together_are_all_saved_when_one_is_no_longer_finite(task, tmp_path):
    config = dataclasses.replace(TINY, max_skipped=4, history=0)
    runs = []
    for seed in (0, 1):
        (tmp_path / str(seed)).mkdir()
        own, shared = dataclasses.replace(config, seed=seed), runs[0].pools if runs else None
        runs.append(Run(tmp_path / str(seed), own, task, pools=shared))
    broken = jax.tree.map(lambda leaf: leaf * np.nan, runs[0].state.params)
    runs[0].state = runs[0].state.replace(params=broken)
    with pytest.raises(ValueError, match="4 updates skipped"):
        list(chunks_together(runs))
    assert [run.checkpoints.latest() for run in runs] == [4, 4]


def test_the_learning_rate_falls_linearly_from_the_first_update_on(whole):
    """A row has the mean of its two updates, at 0 and 1, 2 and 3, ... of 16 in all."""
    shares = (np.arange(0, 16, 2) + 0.5) / 16
    rates = [row["learning_rate"] for row in whole[2]]
    np.testing.assert_allclose(rates, TINY.learner.learning_rate * (1 - shares), rtol=1e-5)


def test_a_chunk_in_which_no_episode_ended_has_no_success(whole, tmp_path):
    metrics = collections.defaultdict(lambda: np.zeros(2)) | {"actions": np.zeros((2, 6), int)}
    row = whole[1]._row(metrics, took=1.0)
    assert (row["success"], row["spl"], row["length"]) == (None, None, None)
    assert row.keys() == whole[2][-1].keys()
    Journal(tmp_path / METRICS_FILE, 0).write(row)
    assert read_metrics(tmp_path) == [row]


def test_a_finished_run_goes_on_with_a_larger_budget(whole, task, tmp_path):
    folder = shutil.copytree(whole[0], tmp_path / "longer")
    longer = Run(folder, TINY.with_budget(TrainConfig(steps=960)), task)
    assert longer.progress == pytest.approx(640 / 960)
    rows = list(longer.chunks())
    assert longer.steps == 960
    assert [row["steps"] for row in read_metrics(folder)] == list(range(80, 961, 80))
    assert rows[-1]["learning_rate"] < rows[0]["learning_rate"]


def test_a_damaged_checkpoint_is_one_clear_line(whole, task, tmp_path):
    run = Run(tmp_path, TINY, task)
    next(run.chunks())
    run.save()
    for file in (tmp_path / "checkpoints").rglob("*"):
        if file.is_file() and file.stat().st_size > 1000:
            file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(ValueError, match="damaged checkpoint") as caught:
        Run(tmp_path, TINY, task)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_of_another_network_is_refused(whole, task):
    wider = dataclasses.replace(TINY, network=NetworkConfig(width=24, hidden=16))
    other = dataclasses.replace(task, model=make_model(wider, task.classes))
    with pytest.raises(ValueError, match="unreadable checkpoint"):
        Run(whole[0], wider, other)


@pytest.mark.parametrize(
    "name", ["run_format_2", pytest.param("run_format_1", marks=pytest.mark.slow)]
)
def test_a_run_of_an_old_version_goes_on(ithor, tmp_path, name):
    """Its state lacks what was added since; all that was in it is still there."""
    folder = shutil.copytree(OLD_RUN.parent / name, tmp_path / "run")
    config = configs.load(folder / "config.json")
    read = newest(folder)
    tables = samples.as_version(ithor, read.data_version)  # the rooms have changed since
    run = Run(folder, config, make_task(config, tables, words.load_bundled()))
    assert (int(run.state.updates), int(run.state.episodes), run.steps) == (2, 1, 16)
    chex.assert_trees_all_equal(run.state.params, read.weights)
    moments = jax.tree.leaves(run.state.opt_state)
    assert any(np.asarray(leaf).any() for leaf in moments)
    run._saved = None
    run.save()  # in the format of today, in place of the old one
    assert not list(folder.rglob("meta/metadata"))
    again = Run(folder, config, run.task)
    for ours, theirs in zip(leaves(again.state), leaves(run.state), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_a_checkpoint_of_other_tables_is_refused(whole, task, ithor):
    moved = dataclasses.replace(ithor, camera_height=ithor.camera_height + 0.1)
    with pytest.raises(ValueError, match="trained on scene tables"):
        Run(whole[0], TINY, dataclasses.replace(task, tables=moved))


def test_a_last_line_that_was_cut_short_is_left_out(tmp_path):
    row = {"updates": 1, "steps": 40, "episodes": 3}
    (tmp_path / "metrics.jsonl").write_text(json.dumps(row) + '\n{"upda')
    assert read_metrics(tmp_path) == [row]
