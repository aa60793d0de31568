"""The benchmark command: its figures' names, and wrong arguments."""

import dataclasses
import json

import pytest

from tdanet_jax.commands import benchmark
from tdanet_jax.config import PAPER_INPUTS
from tdanet_jax.tools import benchmarking, quality
from tests.agent.test_agent import OLD_RUN


def test_it_writes_one_json_object_per_figure(ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    benchmark.main(
        ["--parts", "environment", "--environments", "8", "--repeats", "1", "--out", str(out)]
    )
    rows = [json.loads(line) for line in out.read_text().splitlines()]
    assert [row["part"] for row in rows] == ["start", "environment", "environment"]
    assert [row.get("observations") for row in rows] == [None, False, True]
    assert all(row["steps_per_second"] > 0 for row in rows[1:])


@pytest.mark.slow
def test_a_second_start_finds_what_the_first_has_compiled(ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    benchmark.main(["--parts", "startup", "--out", str(out)])
    row = json.loads(out.read_text().splitlines()[-1])
    assert 0 < row["seconds_compiled_before"] < row["seconds_nothing_compiled"]


def test_a_wrong_folder_ends_before_anything_is_measured(tmp_path, capsys):
    out = tmp_path / "figures.jsonl"
    for flags in (
        ["--parts", "machine", "agent", "--checkpoint", "nowhere", "--out", str(out)],
        ["--parts", "machine", "--out", "nowhere/figures.jsonl"],
        ["--parts", "evaluation", "--data", "nowhere.npz", "--out", str(out)],
    ):
        with pytest.raises(SystemExit) as ended:
            benchmark.main(flags)
        assert ended.value.code == 2
        said = capsys.readouterr()
        assert "nowhere" in said.err
        assert "gflops" not in said.out
    assert not out.exists()


@pytest.mark.slow
def test_a_model_that_multiplies_in_float32_alone_is_measured_once(ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    arguments = ["--parts", "rollout", "--models", "savn", "--batches", "2", "--repeats", "1"]
    benchmark.main([*arguments, "--out", str(out)])
    rows = [json.loads(line) for line in out.read_text().splitlines()][1:]
    assert [(row["model"], row["precision"]) for row in rows] == [("savn", "float32")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "flags"), [("ssnet", ["--odometry"]), ("tdanet", ["--odometry", "--triangulation"])]
)
def test_decisions_of_any_model_are_timed(model, flags, ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    arguments = ["--parts", "decision", "--models", model, "--repeats", "1", *flags]
    benchmark.main([*arguments, "--out", str(out)])
    rows = [json.loads(line) for line in out.read_text().splitlines()][1:]
    assert {(row["model"], row["batch"]) for row in rows} == {(model, 1), (model, 1024)}
    assert all(row["odometry"] for row in rows)
    assert {row["triangulation"] for row in rows} == {"--triangulation" in flags}
    least = {"ssnet": 2e6, "tdanet": 1e6}[model]
    assert all(row["milliseconds"] > 0 and row["parameters"] > least for row in rows)


def test_a_presets_network_and_update_are_measured():
    chosen = benchmark.Command(preset="paper-inputs").config("tdanet", "float32")
    assert chosen.learner == PAPER_INPUTS.learner
    assert chosen.network == dataclasses.replace(PAPER_INPUTS.network, precision="float32")
    changed = benchmark.Command(preset="paper-inputs", context=0, units=8, odometry=True)
    expected = dataclasses.replace(
        PAPER_INPUTS.network, context=0, width=8, hidden=8, odometry=True
    )
    assert changed.config("tdanet").network == expected
    best = benchmark.Command(preset="best")
    assert best.config("tdanet").network.triangulation
    assert {run.network for run in best.trained()} == {best.config("tdanet").network}


def test_rows_of_quality_say_what_was_trained(ithor, tmp_path, monkeypatch):
    monkeypatch.setattr(quality, "quality_row", lambda config: {"part": "quality", "seed": 3})
    out = tmp_path / "figures.jsonl"
    flags = ["--preset", "paper-inputs", "--context", "8", "--num-envs", "2", "--odometry"]
    benchmark.main(["--parts", "quality", "--seeds", "3", *flags, "--out", str(out)])
    assert json.loads(out.read_text().splitlines()[-1]) == {
        "part": "quality", "seed": 3, "model": "tdanet", "preset": "paper-inputs", "units": 512,
        "context": 8, "odometry": True, "triangulation": False, "environments": 2,
    }  # fmt: skip


@pytest.mark.slow
def test_an_update_of_a_preset_is_timed(ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    flags = ["--parts", "update", "--batches", "2", "--precisions", "float32", "--repeats", "1"]
    benchmark.main([*flags, "--preset", "paper-inputs", "--units", "8", "--out", str(out)])
    row = json.loads(out.read_text().splitlines()[-1])
    assert (row["preset"], row["units"], row["context"]) == ("paper-inputs", 8, 64)
    assert row["steps_per_second"] > 0


@pytest.mark.parametrize(("preset", "units"), [("paper-inputs", 64), ("default", 0)])
def test_rows_say_context_only_of_models_that_have_it(preset, units, ithor, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "model_rows", lambda *asked: [{"part": "rollout"}])
    out = tmp_path / "figures.jsonl"
    flags = ["--parts", "rollout", "--preset", preset, "--models", "tdanet", "ssnet"]
    benchmark.main([*flags, "--out", str(out)])
    rows = [json.loads(line) for line in out.read_text().splitlines()][1:]
    said = [(row["model"], row.get("context")) for row in rows]
    assert said == [("tdanet", units), ("ssnet", None)]


def test_a_model_that_cannot_triangulate_is_one_line(ithor, tmp_path, capsys):
    flags = ["--models", "ssnet", "--odometry", "--triangulation"]
    with pytest.raises(SystemExit) as ended:
        benchmark.main(["--parts", "decision", *flags, "--out", str(tmp_path / "figures.jsonl")])
    assert ended.value.code == 2
    said = capsys.readouterr().err.splitlines()[-1]
    assert "needs a box of every object, which ssnet does not show" in said


@pytest.mark.slow
def test_a_robots_steps_are_timed_with_jax_and_without(ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    benchmark.main(["--parts", "agent", "--out", str(out)])
    row = json.loads(out.read_text().splitlines()[-1])
    assert row.pop("part") == "agent"
    assert len(row) == 5
    assert all(value > 0 for value in row.values())
    assert row["seconds_to_first_action_without_jax"] < row["seconds_to_first_action"]
    assert row["milliseconds_100_robots"] < 100 * row["milliseconds"]


def test_a_trained_network_plays_in_the_rooms_that_are_given():
    with pytest.raises(ValueError, match=r"nowhere.npz: no such file"):
        benchmarking.evaluation_row(OLD_RUN, None, 1, 1, "nowhere.npz")


@pytest.mark.slow
def test_an_evaluation_plays_the_networks_of_a_run_in_one_call(ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    flags = ["--networks", "2", "--checkpoint", str(OLD_RUN), "--repeats", "1", "--out", str(out)]
    benchmark.main(["--parts", "evaluation", *flags])
    row = json.loads(out.read_text().splitlines()[-1])
    assert (row["networks"], row["trained"], row["episodes"]) == (2, True, 4000)
