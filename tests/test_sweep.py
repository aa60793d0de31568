"""What a sweep plans, how far its runs are, and the report about them, from made-up results."""

import dataclasses
import json

import pytest

from tdanet_jax import config as configs
from tdanet_jax import history, sweep
from tdanet_jax.comparison import curve
from tdanet_jax.config import MODELS, LearnerConfig, TrainConfig
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


def test_an_evaluated_history_counts_while_it_is_that_of_the_run(tmp_path):
    folder = made(tmp_path, BASE, result())
    run = sweep.finished(folder)
    assert sweep.evaluated_history(run, tmp_path) is None
    (tmp_path / "histories").mkdir()
    kept = tmp_path / "histories" / f"{folder.name}.json"
    kept.write_text(json.dumps([result(point=1), result(point=2)]))
    assert sweep.evaluated_history(run, tmp_path) is None  # the run has no such points
    for point in (1, 2):
        weights = {"a": {"b": [1.0]}}
        history.write(folder, Snapshot(weights, 10 * point, 100, 1.0, point, "d"))
    assert len(sweep.evaluated_history(run, tmp_path)) == 2
    kept.write_text("[{")
    assert sweep.evaluated_history(run, tmp_path) is None


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
        costs={"tdanet": Cost(2_968_653, {1: 1.25, 1024: 10.5})},
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
