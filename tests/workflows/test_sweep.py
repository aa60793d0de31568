"""What a sweep plans and how far its runs are, from made-up results."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax.config import LearnerConfig, TrainConfig
from tdanet_jax.evaluation import saved_networks
from tdanet_jax.task import resolve
from tdanet_jax.training import history
from tdanet_jax.training.history import Snapshot
from tdanet_jax.workflows import sweep
from tests.evaluation.test_comparison import result

BASE = TrainConfig(steps=1000)


def test_a_plan_is_every_combination_seeds_together():
    plan = sweep.plan(BASE, ("18/4", "14/8"), ("tdanet", "tdanet-no-ta"), (3, 4))
    assert [configs.run_name(config) for config in plan] == [
        "18-4-tdanet-seed3", "18-4-tdanet-seed4", "18-4-tdanet-no-ta-seed3",
        "18-4-tdanet-no-ta-seed4", "14-8-tdanet-seed3", "14-8-tdanet-seed4",
        "14-8-tdanet-no-ta-seed3", "14-8-tdanet-no-ta-seed4",
    ]  # fmt: skip
    assert all(config.steps == 1000 for config in plan)


def test_a_split_of_ones_own_is_planned_under_its_one_name():
    plan = sweep.plan(BASE, ("18/4", "towel,Mug"), ("tdanet",), (0,))
    assert [config.split for config in plan] == ["18/4", "Mug,Towel"]
    assert [configs.run_name(c) for c in plan] == ["18-4-tdanet-seed0", "Mug-Towel-tdanet-seed0"]
    held_out = dataclasses.replace(plan[1], validation=True)
    assert configs.run_name(held_out) == "Mug-Towel-validation-tdanet-seed0"


def test_a_model_may_have_a_configuration_of_its_own():
    own = dataclasses.replace(BASE, learner=LearnerConfig(num_envs=16))
    plan = sweep.plan(BASE, ("18/4", "14/8"), ("tdanet", "savn"), (3,), {"savn": own})
    assert [(c.split, c.model, c.seed, c.learner.num_envs) for c in plan] == [
        ("18/4", "tdanet", 3, 64), ("18/4", "savn", 3, 16),
        ("14/8", "tdanet", 3, 64), ("14/8", "savn", 3, 16),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("splits", "models", "seeds", "message"),
    [
        (("Mug,CD", "cd,mug"), ("tdanet",), (0,), "--splits: a value is given twice"),
        ((), ("tdanet",), (0,), "--splits: give at least one"),
        (("18/4",), ("tdanet", "tdanet"), (0,), "--models: a value is given twice"),
        (("18/4",), ("tdanet",), (0, 0), "--seeds: a value is given twice"),
        (("18/5",), ("tdanet",), (0,), "--splits 18/5"),
        (("18/4",), ("cnn",), (0,), "--models cnn"),
    ],
)
def test_a_wrong_plan_names_the_flag(splits, models, seeds, message):
    with pytest.raises(ValueError, match=message):
        sweep.plan(BASE, splits, models, seeds)


def made(out, config, results=None):
    """A run's folder with its configuration and, if given, results."""
    folder = out / configs.run_name(config)
    folder.mkdir(parents=True)
    (folder / "config.json").write_text(json.dumps(configs.to_json(config)))
    if results is not None:
        (folder / "results.json").write_text(json.dumps(results))
    return folder


def test_a_run_is_new_begun_or_finished(tmp_path):
    assert sweep.progress(tmp_path / "none", BASE) == "new"
    assert sweep.progress(made(tmp_path, BASE), BASE) == "begun"
    done = dataclasses.replace(BASE, seed=1)
    assert sweep.progress(made(tmp_path, done, result(1)), done) == "finished"


@pytest.mark.parametrize("began", ["float32", "bfloat16"])
def test_a_sweep_goes_on_where_other_products_are_faster(began, tmp_path):
    """What "auto" meant where a run began holds for that run and its other seeds."""
    network = dataclasses.replace(BASE.network, precision=began, image="raster")
    there = dataclasses.replace(BASE, network=network)
    folder = made(tmp_path, there, result())
    assert BASE.network.precision == "auto"
    assert sweep.settled(tmp_path, BASE) == there
    assert sweep.progress(folder, sweep.settled(tmp_path, BASE)) == "finished"
    second, other_model = (dataclasses.replace(BASE, **x) for x in ({"seed": 1}, {"model": "sp"}))
    assert sweep.settled(tmp_path, second).network == network  # seeds are alike
    assert sweep.settled(tmp_path, other_model) == resolve(other_model)
    (other,) = {"float32", "bfloat16"} - {began}
    asked = dataclasses.replace(network, precision=other)
    with pytest.raises(ValueError, match="other values of --precision"):
        sweep.progress(folder, sweep.settled(tmp_path, dataclasses.replace(BASE, network=asked)))


def test_a_run_of_other_flags_is_not_touched(tmp_path):
    folder = made(tmp_path, BASE, result())
    other = dataclasses.replace(BASE, steps=2000, learner=LearnerConfig(num_envs=8))
    with pytest.raises(ValueError, match="other values of --num-envs, --steps; choose another"):
        sweep.progress(folder, other)


def test_only_finished_runs_are_found_and_damaged_results_are_named(tmp_path):
    made(tmp_path, BASE)
    done = dataclasses.replace(BASE, seed=1)
    folder = made(tmp_path, done, result(1))
    found = sweep.find(tmp_path)
    assert [(run.folder, run.config, run.seconds) for run in found] == [(folder, done, None)]
    (folder / "results.json").write_text("{")
    with pytest.raises(ValueError, match=r"results\.json: not JSON"):
        sweep.find(tmp_path)
    with pytest.raises(ValueError, match="the run is not finished"):
        sweep.finished(tmp_path / configs.run_name(BASE))


def keep_history(folder, weight=1.0, points=(1, 2)):
    """Points of a history, of a network with one weight."""
    for point in points:
        weights = {"a": {"b": np.array([weight])}}
        history.write(folder, Snapshot(weights, 10 * point, 100, 1.0, point, "d"))


def evaluate_history(monkeypatch, run, out):
    """`sweep.histories` of one run, with made-up results; True if it evaluated anything."""

    class Played:
        def __init__(self, network):
            self.saved = network

        def results(self):
            return result(point=history.read(self.saved.point).point)

    def play(networks, greedy):
        return map(Played, networks)

    monkeypatch.setattr(saved_networks, "evaluate", play)
    shares = [share for _, share in sweep.histories([run], out)]
    assert len(sweep.evaluated_history(run, out)) == 2
    return shares == [0.5, 1.0]


def test_an_evaluated_history_counts_while_it_is_that_of_the_run(tmp_path, monkeypatch):
    folder = made(tmp_path, BASE, result())
    run = sweep.finished(folder)
    assert sweep.evaluated_history(run, tmp_path) is None
    keep_history(folder)
    assert evaluate_history(monkeypatch, run, tmp_path)
    assert not evaluate_history(monkeypatch, run, tmp_path)  # once is enough
    kept = tmp_path / "histories" / f"{folder.name}.json"
    for damaged in ("[{", "[]", "{}", json.dumps([result(point=1), result(point=2)])):
        kept.write_text(damaged)
        assert sweep.evaluated_history(run, tmp_path) is None
    assert evaluate_history(monkeypatch, run, tmp_path)
    keep_history(folder, points=(3,))
    assert sweep.evaluated_history(run, tmp_path) is None


def test_the_history_of_a_run_that_was_trained_anew_is_evaluated_anew(tmp_path, monkeypatch):
    """The same name and the same updates, but another configuration, network or rooms."""
    run = sweep.finished(made(tmp_path, BASE, result()))
    keep_history(run.folder)
    assert evaluate_history(monkeypatch, run, tmp_path)
    keep_history(run.folder, weight=2.0)  # of the same size
    assert evaluate_history(monkeypatch, run, tmp_path)
    other = dataclasses.replace(BASE, learner=LearnerConfig(learning_rate=1e-3))
    shutil.rmtree(run.folder)
    again = sweep.finished(made(tmp_path, other, result()))
    assert again.folder == run.folder
    keep_history(run.folder, weight=2.0)
    assert evaluate_history(monkeypatch, again, tmp_path)
    assert not evaluate_history(monkeypatch, again, tmp_path)
    (run.folder / "results.json").write_text(json.dumps(result() | {"data_version": "e"}))
    assert evaluate_history(monkeypatch, sweep.finished(run.folder), tmp_path)


def test_a_copied_run_has_the_same_history(tmp_path, monkeypatch):
    folder = made(tmp_path, BASE, result())
    keep_history(folder)
    assert evaluate_history(monkeypatch, sweep.finished(folder), tmp_path)
    copy = shutil.copytree(folder, tmp_path / "elsewhere" / folder.name)
    assert not evaluate_history(monkeypatch, sweep.finished(copy), tmp_path)


def test_results_that_are_no_run_are_told_apart(tmp_path):
    run = made(tmp_path, BASE, result())
    (tmp_path / "random").mkdir()
    (tmp_path / "random" / "results.json").write_text(json.dumps(result(model="random")))
    assert [found.folder for found in sweep.find(tmp_path)] == [run]
    assert sweep.find_others(tmp_path) == [tmp_path / "random"]


def test_runs_of_the_same_seed_are_called_by_their_folders(tmp_path):
    seeds = BASE, dataclasses.replace(BASE, seed=1)
    runs = [sweep.finished(made(tmp_path, config, result(config.seed))) for config in seeds]
    assert sweep.labels(runs) == ["tdanet", "tdanet"]
    again = sweep.finished(made(tmp_path / "again", BASE, result(0, 80.0)))
    again = dataclasses.replace(again, folder=again.folder.rename(tmp_path / "again" / "again"))
    assert sweep.labels([*runs, again]) == [
        "tdanet, 18-4-tdanet-seed0", "tdanet, 18-4-tdanet-seed1", "tdanet, again"
    ]  # fmt: skip
