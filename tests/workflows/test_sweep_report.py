"""The report on a sweep, from made-up results."""

import dataclasses
import json

import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig
from tdanet_jax.evaluation.comparison import curve
from tdanet_jax.registry import MODELS
from tdanet_jax.workflows import sweep, sweep_report
from tdanet_jax.workflows.sweep_report import Cost, Report
from tests.evaluation.test_comparison import result
from tests.workflows.test_sweep import BASE, evaluate_history, keep_history, made


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
    page = sweep_report.markdown(report, {"18/4": "curve.png"})
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


def test_runs_of_other_flags_are_apart(tmp_path):
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
    page = sweep_report.markdown(report, {})
    assert "| tdanet, --width 512 (ours) | 2 | 100 | 72.0 ± 2.8 |" in page
    assert "| tdanet, --width 16 (ours) | 1 | 100 | 20.0 |" in page
    assert "| tdanet, --width 16 | 3,145,728 | 3.00 | 3.08 |" in page
    assert "Split 18/4: not trained: tdanet-no-ta, " in page
    assert list(report.results("18/4")) == ["random", *dict.fromkeys(found)]


def test_what_each_model_was_trained_with_is_told_where_it_differs(tmp_path, report):
    own = dataclasses.replace(BASE, model="savn", learner=LearnerConfig(num_envs=16))
    run = sweep.finished(made(tmp_path, own, result(model="savn")))
    assert "Settings that differ" not in sweep_report.markdown(report, {})
    costs = {**report.costs, "savn": Cost("savn", 1000, {1: 1.0, 1024: 2.0})}
    report = dataclasses.replace(report, runs=[*report.runs, run], costs=costs)
    page = sweep_report.markdown(report, {})
    table = page[page.index("| Model | --num-envs |") :].splitlines()
    assert table[2:6] == ["| tdanet | 64 |", "| tdanet-no-ta | 64 |", "| savn | 16 |", ""]
    used = {
        run["model"]: run["settings"]["--num-envs"] for run in sweep_report.to_json(report)["runs"]
    }
    assert used == {"tdanet": 64, "tdanet-no-ta": 64, "savn": 16}


def test_runs_that_are_not_finished_are_named(report):
    report = dataclasses.replace(report, unfinished=["18-4-savn-seed0"])
    assert "Not finished: 18-4-savn-seed0." in sweep_report.left_out(report)


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
    [first, second] = sweep_report.make_curves(runs, tmp_path)["18/4"]
    assert (first.label, second.label) == ("tdanet, no --minutes", "tdanet, --minutes 5.0")
    seeds = [curve.values["seen", "SR"][0].sd for curve in (first, second)]
    assert seeds == [0.0, None]


def test_what_was_not_trained_is_left_out_and_named(report):
    lines = sweep_report.left_out(report)
    rest = [model for model in MODELS if model not in ("tdanet", "tdanet-no-ta")]
    assert lines == [
        "Split 22/0: nothing was trained.",
        f"Split 18/4: not trained: {', '.join(rest)}.",
        "Split 14/8: nothing was trained.",
        "Learning curve: no history of 18-4-tdanet-no-ta-seed0.",
    ]
    page = sweep_report.markdown(report, {})
    assert all(f"- {line}" in page for line in lines)
    assert "tdanet-no-sa |" not in page
    runs = [
        dataclasses.replace(run, config=dataclasses.replace(run.config, history=points))
        for run, points in zip(report.runs, (20, 7, 20), strict=True)
    ]
    assert sweep_report.left_out(dataclasses.replace(report, runs=runs))[-1] == (
        "Learning curve: of 18-4-tdanet-seed0, 18-4-tdanet-seed1, only the points that all have."
    )


def test_the_json_holds_what_the_page_shows(report):
    out = json.loads(json.dumps(sweep_report.to_json(report)))
    tdanet = out["comparison"]["18/4"]["tdanet"]
    assert tdanet["seeds"] == [0, 1]
    assert tdanet["seen"]["L>=1"]["SR"] == {"mean": 72.0, "sd": 2.828}
    assert out["learning_curves"]["18/4"]["tdanet"]["seen SR"][1]["mean"] == 40.0
    assert out["costs"]["tdanet"]["milliseconds"] == {"1": 1.25, "1024": 10.5}
    assert len(out["runs"]) == 3
    assert out["left_out"] == sweep_report.left_out(report)


def test_a_split_of_ones_own_stands_behind_those_of_the_paper(report, tmp_path):
    config = dataclasses.replace(BASE, split="Mug,Vase")
    run = sweep.finished(made(tmp_path / "own", config, result(split="Mug,Vase")))
    both = dataclasses.replace(report, runs=[run, *report.runs])
    assert both.splits == ["18/4", "Mug,Vase"]
    page = sweep_report.markdown(both, {})
    assert "## Split 18/4: comparison of models (the paper's Table III)" in page
    assert "## Split Mug,Vase: comparison of models\n" in page
    assert "| Mug-Vase-tdanet-seed0 | 0 |" in page


def test_a_report_on_one_model_has_no_ablations(report):
    alone = dataclasses.replace(report, runs=report.runs[:2])
    assert "Ablations" not in sweep_report.markdown(alone, {})
