"""What a sweep plans, how far its runs are, and the report about them, from made-up results."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax import history, saved, sweep
from tdanet_jax.comparison import curve
from tdanet_jax.config import MODELS, LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.history import Snapshot
from tdanet_jax.sweep import Cost, Report
from tests.test_comparison import result

BASE = TrainConfig(steps=1000)


def test_a_plan_is_every_combination_seeds_together():
    plan = sweep.plan(BASE, ("18/4", "14/8"), ("tdanet", "tdanet-no-ta"), (3, 4))
    assert [sweep.run_name(config) for config in plan] == [
        "18-4-tdanet-seed3", "18-4-tdanet-seed4", "18-4-tdanet-no-ta-seed3",
        "18-4-tdanet-no-ta-seed4", "14-8-tdanet-seed3", "14-8-tdanet-seed4",
        "14-8-tdanet-no-ta-seed3", "14-8-tdanet-no-ta-seed4",
    ]  # fmt: skip
    assert all(config.steps == 1000 for config in plan)


@pytest.mark.parametrize(
    ("splits", "models", "seeds", "message"),
    [
        ((), ("tdanet",), (0,), "--splits: give at least one"),
        (("18/4",), ("tdanet", "tdanet"), (0,), "--models: a value is given twice"),
        (("18/4",), ("tdanet",), (0, 0), "--seeds: a value is given twice"),
        (("18/5",), ("tdanet",), (0,), "--split 18/5"),
        (("18/4",), ("cnn",), (0,), "--model cnn"),
    ],
)
def test_a_wrong_plan_names_the_flag(splits, models, seeds, message):
    with pytest.raises(ValueError, match=message):
        sweep.plan(BASE, splits, models, seeds)


def made(out, config, results=None):
    """A run's folder with its configuration and, if given, results."""
    folder = out / sweep.run_name(config)
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
    with pytest.raises(ValueError, match=r"results\.json: not the results of a run"):
        sweep.find(tmp_path)
    with pytest.raises(ValueError, match="the run is not finished"):
        sweep.finished(tmp_path / sweep.run_name(BASE))


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

    monkeypatch.setattr(saved, "evaluate", play)
    done = [points for _, points in sweep.histories([run], out)]
    assert len(sweep.evaluated_history(run, out)) == 2
    return done == [1, 2]


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


@pytest.fixture
def report(tmp_path):
    """Two seeds of TDANet and one of an ablation on 18/4; no history of the ablation."""
    runs = []
    for seed, model, sr in ((0, "tdanet", 70.0), (1, "tdanet", 74.0), (0, "tdanet-no-ta", 50.0)):
        config = dataclasses.replace(BASE, seed=seed, model=model)
        runs.append(sweep.finished(made(tmp_path, config, result(seed, sr, model=model))))
    points = [[result(seed, 20.0 * k, point=k) for k in (1, 2)] for seed in (0, 1)]
    return Report(
        runs=runs,
        untrained=[result(sr=11.0, model="random")],
        costs={"tdanet": Cost("tdanet", 2_968_653, {1: 1.25, 1024: 10.5})},
        curves={"18/4": [curve("tdanet", points)]},
        machine="a machine",
        code="abc",
    )


def test_the_page_holds_means_over_seeds_beside_the_paper(report):
    page = sweep.markdown(report, {"18/4": "curve.png"})
    assert "| tdanet (ours) | 2 | 100 | 72.0 ± 2.8 | 36.0 ± 1.4 |" in page
    assert "| TDANet (paper) |  |  | 74.7 | 29.7 |" in page
    assert page.index("random (ours)") < page.index("tdanet (ours)")
    assert "The worlds differ" in page
    assert "| kitchen | tdanet | 72.0 ± 2.8 |" in page
    assert "![Learning curve, split 18/4](curve.png)" in page
    assert "| 18/4 | tdanet-no-ta | no | yes | 50.0 |" in page
    assert "| tdanet | 2,968,653 | 2.83 | 3.08 | 1.25 | 10.50 |" in page
    assert "on a machine" in page
    assert "| 18-4-tdanet-seed1 | 1 | 101 | 5,120 | - | 74.0 |" in page


def test_runs_of_other_flags_or_of_the_same_seed_are_apart(tmp_path):
    wide = dataclasses.replace(BASE, network=NetworkConfig(width=16))
    runs = [
        sweep.finished(made(tmp_path / name, config, result(config.seed, sr)))
        for name, config, sr in (
            ("a", BASE, 70.0), ("a", dataclasses.replace(BASE, seed=1), 74.0), ("wide", wide, 20.0)
        )
    ]  # fmt: skip
    for run in runs:
        keep_history(run.folder)
    found = sweep.labels(runs)
    assert found == ["tdanet, --width 512"] * 2 + ["tdanet, --width 16"]
    costs = {label: Cost("tdanet", 1_048_576 * (1 + i), {1: 1.0}) for i, label in enumerate(found)}
    report = Report(runs, [result(sr=11.0, model="random")], costs, {}, "a machine", "abc")
    page = sweep.markdown(report, {})
    assert "| tdanet, --width 512 (ours) | 2 | 100 | 72.0 ± 2.8 |" in page
    assert "| tdanet, --width 16 (ours) | 1 | 100 | 20.0 |" in page
    assert "| tdanet, --width 16 | 3,145,728 | 3.00 | 3.08 |" in page
    assert "Split 18/4: not trained: tdanet-no-ta, " in page
    assert list(report.results("18/4")) == ["random", *dict.fromkeys(found)]

    again = sweep.finished(made(tmp_path / "again", BASE, result(0, 80.0)))
    again = dataclasses.replace(again, folder=again.folder.rename(tmp_path / "again" / "again"))
    assert sweep.labels([*runs[:2], again]) == [
        "tdanet, 18-4-tdanet-seed0", "tdanet, 18-4-tdanet-seed1", "tdanet, again"
    ]  # fmt: skip


def test_there_is_a_curve_for_every_configuration(tmp_path, monkeypatch):
    configs_ = [BASE, dataclasses.replace(BASE, seed=1), dataclasses.replace(BASE, minutes=5.0)]
    runs = [
        sweep.finished(made(tmp_path / str(i), config, result(config.seed)))
        for i, config in enumerate(configs_)
    ]
    runs[2] = dataclasses.replace(runs[2], folder=runs[2].folder.rename(tmp_path / "2" / "other"))
    for run in runs:
        keep_history(run.folder)
        evaluate_history(monkeypatch, run, tmp_path)
    [first, second] = sweep.make_curves(runs, tmp_path)["18/4"]
    assert (first.label, second.label) == ("tdanet, no --minutes", "tdanet, --minutes 5.0")
    seeds = [curve.values["seen", "SR"][0].sd for curve in (first, second)]
    assert seeds == [0.0, None]


def test_what_was_not_trained_is_left_out_and_named(report):
    lines = sweep.left_out(report)
    rest = [model for model in MODELS if model not in ("tdanet", "tdanet-no-ta")]
    assert lines == [
        f"Split 18/4: not trained: {', '.join(rest)}.",
        "Split 14/8: nothing was trained.",
        "Learning curve: no history of 18-4-tdanet-no-ta-seed0.",
    ]
    page = sweep.markdown(report, {})
    assert all(f"- {line}" in page for line in lines)
    assert "tdanet-no-sa |" not in page


def test_the_json_holds_what_the_page_shows(report):
    out = json.loads(json.dumps(sweep.to_json(report)))
    tdanet = out["comparison"]["18/4"]["tdanet"]
    assert tdanet["seeds"] == [0, 1]
    assert tdanet["seen"]["L>=1"]["SR"] == {"mean": 72.0, "sd": 2.828}
    assert out["learning_curves"]["18/4"]["tdanet"]["seen SR"][1]["mean"] == 40.0
    assert out["costs"]["tdanet"]["milliseconds"] == {"1": 1.25, "1024": 10.5}
    assert len(out["runs"]) == 3
    assert out["left_out"] == sweep.left_out(report)


def test_a_report_on_one_model_has_no_ablations(report):
    alone = dataclasses.replace(report, runs=report.runs[:2])
    assert "Ablations" not in sweep.markdown(alone, {})
