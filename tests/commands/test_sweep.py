"""The sweep command, as a user types it."""

import contextlib
import dataclasses
import json
import random
import shutil
import signal
import subprocess
import sys
import threading
import time

import pytest

from tdanet_jax import config as configs
from tdanet_jax.commands import evaluate, sweep
from tdanet_jax.config import LearnerConfig
from tdanet_jax.io import files
from tdanet_jax.workflows.sweep import FinishedRun
from tdanet_jax.workflows.sweep_report import Cost
from tests.evaluation.test_comparison import result
from tests.support import command
from tests.workflows.test_sweep import BASE, made

COMMAND = [sys.executable, "-m", "experiments.sweep"]
TINY = [
    "--steps", "800", "--num-envs", "8", "--rollout-steps", "5", "--width", "16", "--hidden", "16",
    "--history", "2", "--precision", "float32",
]  # fmt: skip
RUN_FILES = {
    "config.json", "classes.json", "metrics.jsonl", "checkpoints", "history", "results.json",
    "results.md", "episodes.jsonl", "learning_curve.png", "run.json", ".lock",
}  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "Missing from tdanet sweep: --out"),
        (["--out=x", "--split", "14/8"], "--split: a sweep takes --splits"),
        (["--out=x", "--splits", "17/5"], "--splits 17/5: choose one of"),
        (["--out=x", "--models", "cnn"], "--models cnn: choose one of"),
        (["--out=x", "--seeds=-1"], "--seeds -1: must be between 0 and"),
        (["--out=x", "--seeds", "1", "1"], "--seeds: a value is given twice"),
        (["--out=x", "--stepz", "5"], "Unrecognized options: --stepz"),
        (["--out=x", "--vmap-seeds", "--minutes", "1"], "--vmap-seeds needs a budget in --steps"),
        (
            ["--out=x", "--models", "tdanet", "ssnet", "--preset", "best"],
            "which ssnet does not show",
        ),
        (["--out=x", "--models", "tdanet", "no.such"], "--models no.such: No module named 'no'"),
        (["--out=x", "--per-model", "tdanet --gamma 1"], 'write "MODEL: FLAGS", in quotes'),
        (["--out=x", "--per-model", "tdanett: --gamma 1"], "not one of --models; did you mean tda"),
        (["--out=x", "--per-model", "tdanet:", "tdanet:"], "--per-model tdanet: is given twice"),
        (["--out=x", "--per-model", "tdanet: --gama 1"], "tdanet: Unrecognized options: --gama, 1"),
        (["--out=x", "--per-model", "tdanet: --gamma 2"], "--per-model tdanet: --gamma 2.0: must"),
        (["--out=x", "--per-model", "tdanet: --gamma '1"], "--per-model tdanet: No closing quot"),
        (["--out=x", "--per-model", "tdanet: --seed 1"], "tdanet: --seed: a sweep takes --seeds"),
        (["--out=x", "--per-model", "tdanet: --no-validation"], "must be the same for all models"),
        (["--out=x", "--shard", "3/2"], "--shard 3/2: must be I/N, I from 1 to N"),
        (["--out=x", "--shard", "0/2"], "--shard 0/2: must be I/N, I from 1 to N"),
        (["--out=x", "--shard", "2"], "--shard 2: must be I/N, I from 1 to N"),
        (["--out=x", "--report-only", "--shard", "1/2"], "--shard: --report-only trains nothing"),
        (["--out=x", "--report-only", "--steps", "5"], "--report-only trains nothing"),
        (["--out=x", "--report-only"], "x: no finished run"),
        (["--out=x", "--report-only", "--include", "y"], "y/config.json: no such file"),
    ],
)
def test_wrong_arguments_give_one_line_and_write_nothing(
    tmp_path, monkeypatch, capsys, arguments, message
):
    monkeypatch.chdir(tmp_path)
    budget = [] if "--report-only" in arguments else ["--steps", "1"]  # if a check is missing
    with pytest.raises(SystemExit) as stop:
        sweep.main([*budget, *arguments])
    assert stop.value.code == 2
    said = capsys.readouterr().err
    assert message in said
    assert len(said.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("ithor", "few_episodes")
def test_a_small_sweep_trains_evaluates_the_history_and_reports(tmp_path, monkeypatch, capsys):
    """What it compares with, and times, are made up here."""
    others = [result(model=name) for name in ("random", "shortest_path")]
    cost = {"tdanet": Cost("tdanet", 1000, {1: 0.5, 1024: 2.0})}
    monkeypatch.setattr(sweep.sweep, "untrained", lambda runs, seed: others)
    monkeypatch.setattr(sweep, "costs", lambda runs: cost)
    out = tmp_path / "sweep"
    arguments = ["--splits", "14/8", "--seeds", "3", "--steps", "800", "--history", "2"]
    sweep.main([*arguments, *command.TINY, "--out", str(out)])
    run = out / "14-8-tdanet-seed3"
    assert {path.name for path in run.iterdir()} == RUN_FILES
    report = json.loads((out / "report.json").read_text())
    trained = report["comparison"]["14/8"]["tdanet"]["seen"]["L>=1"]["SR"]["mean"]
    assert trained == json.loads((run / "results.json").read_text())["seen"]["L>=1"]["SR"]
    assert len(report["learning_curves"]["14/8"]["tdanet"]["episodes"]) == 2
    assert capsys.readouterr().err == ""


@pytest.mark.slow
def test_a_sweep_trains_evaluates_the_history_and_reports(ithor, few_episodes, tmp_path, capsys):
    out = tmp_path / "sweep"
    (out / "random").mkdir(parents=True)
    (out / "random" / "results.json").write_text(json.dumps(result(model="random")))
    arguments = ["--seeds", "3", *TINY, "--out", str(out)]
    sweep.main(arguments)
    assert capsys.readouterr().err == (
        f"warning: {out / 'random'}: no run (it has no config.json); left out\n"
    )
    run = out / "18-4-tdanet-seed3"
    assert {path.name for path in run.iterdir()} == RUN_FILES
    written = {"report.md", "report.json", "learning_curve-18-4.png", "histories", run.name}
    assert {path.name for path in out.iterdir()} == written | {".lock", "random"}
    report = json.loads((out / "report.json").read_text())
    models = report["comparison"]["18/4"]
    assert models["shortest_path"]["unseen"]["L>=1"]["SPL"] == {"mean": 100.0, "sd": None}
    assert 5 < models["random"]["seen"]["L>=1"]["SR"]["mean"] < 20
    assert len(report["learning_curves"]["18/4"]["tdanet"]["episodes"]) == 2
    assert set(report["costs"]["tdanet"]["milliseconds"]) == {"1", "1024"}
    assert "Split 14/8: nothing was trained." in (out / "report.md").read_text()
    # The end of the curve, and an evaluation of the run, are its results again.
    curve = report["learning_curves"]["18/4"]["tdanet"]
    for group in ("seen", "unseen"):
        assert curve[f"{group} SR"][-1] == models["tdanet"][group]["L>=1"]["SR"]
    evaluate.main(["--checkpoint", str(run), "--out", str(tmp_path / "again")])
    for name in ("episodes.jsonl", "results.json"):
        assert (tmp_path / "again" / name).read_text() == (run / name).read_text()

    with pytest.raises(SystemExit):
        sweep.main([*arguments, "--step-limit", "7"])
    assert "trained with other values of --step-limit" in capsys.readouterr().err


def test_what_cannot_stand_in_one_report_shows_before_anything_is_trained(tmp_path, capsys):
    out, elsewhere = tmp_path / "sweep", made(tmp_path / "other", BASE, result())
    with pytest.raises(SystemExit):
        sweep.main(["--seeds", "0", "--steps", "1", "--out", str(out), "--include", str(elsewhere)])
    assert "two runs are called 18-4-tdanet-seed0: rename one" in capsys.readouterr().err
    made(out, dataclasses.replace(BASE, seed=1), result(1) | {"data_version": "e"})
    with pytest.raises(SystemExit):
        sweep.main(["--seeds", "2", "--steps", "1", "--out", str(out), "--include", str(elsewhere)])
    assert "evaluated on other scene tables than" in capsys.readouterr().err
    run = out / "18-4-tdanet-seed1"
    (run / "results.json").write_text(json.dumps(result(1) | {"targets": "Mug,Vase"}))
    with pytest.raises(SystemExit):
        sweep.main(["--seeds", "2", "--steps", "1", "--out", str(out), "--include", str(elsewhere)])
    assert "evaluated on other targets than" in capsys.readouterr().err
    assert [path.name for path in out.iterdir()] == ["18-4-tdanet-seed1"]


def test_the_open_split_has_tables_of_its_own_and_stands_in_one_report_with_others(
    tmp_path, capsys
):
    runs = []
    for split, seed, version in (("18/4", 0, "d"), ("open", 0, "e"), ("open", 1, "e")):
        config = dataclasses.replace(BASE, split=split, seed=seed)
        results = result(seed) | {"split": split, "data_version": version}
        folder = made(tmp_path / "runs", config, results)
        runs.append(FinishedRun(folder, config, results, seconds=1.0))
    sweep.check_alike(runs)
    other = dataclasses.replace(runs[2], results=runs[2].results | {"data_version": "f"})
    with pytest.raises(SystemExit):
        sweep.check_alike([*runs[:2], other])
    assert "open-tdanet-seed1: was evaluated on other scene tables" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("variable", "message"),
    [
        ("JAX_COORDINATOR_ADDRESS", "a sweep is one process; JAX_COORDINATOR_ADDRESS is set"),
        ("SLURM_STEP_NUM_TASKS", "several were started: give each its --shard"),
    ],
)
def test_several_processes_without_shares_are_refused(
    tmp_path, monkeypatch, capsys, variable, message
):
    monkeypatch.setenv(variable, "2")
    with pytest.raises(SystemExit):
        sweep.main(["--steps", "1", "--out", str(tmp_path / "sweep")])
    assert message in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        "--splits 14/8",
        "--models ssnet",
        "--seeds 5",
        "--per-model tdanet:--steps=1",
        "--vmap-seeds",
    ],
)
def test_a_report_alone_takes_no_flag_of_what_to_train(tmp_path, capsys, words):
    with pytest.raises(SystemExit):
        sweep.main(["--report-only", *words.split(), "--out", str(tmp_path)])
    assert (
        f"--report-only trains nothing and takes no {words.split()[0]}" in capsys.readouterr().err
    )


@pytest.fixture
def trained(monkeypatch):
    """What is trained without training: the folders, in order; the reports have made-up results."""
    folders = []

    def train(config, folder, **options):
        with files.locked(folder):
            folders.append(folder.name)
            (folder / "config.json").write_text(json.dumps(configs.to_json(config)))
            content = result(config.seed, model=config.model)
            (folder / "results.json").write_text(json.dumps(content))

    def train_together(members, reports):
        with contextlib.ExitStack() as locks:
            for _, folder in members:
                locks.enter_context(files.locked(folder))
        for member in members:
            train(*member)

    monkeypatch.setattr("tdanet_jax.workflows.train.train", train)
    monkeypatch.setattr("tdanet_jax.workflows.train.train_together", train_together)
    monkeypatch.setattr(sweep.sweep, "untrained", lambda runs, seed: [])
    monkeypatch.setattr(sweep, "costs", lambda runs: {})
    return folders


@pytest.mark.parametrize("together", [[], ["--vmap-seeds"]])
def test_shares_train_every_run_once_in_folders_that_are_merged(
    tmp_path, monkeypatch, capsys, trained, together
):
    models = ("tdanet", "tdanet-no-ta", "ssnet")
    arguments = ["--models", *models, "--seeds", "0", "1", "--steps", "1", *together]
    for shard in ("1/2", "2/2"):
        monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")  # no process joins the other
        out = tmp_path / shard.replace("/", " of ")
        sweep.main([*arguments, "--shard", shard, "--out", str(out)])
        assert f"tdanet sweep --out '{out}' --report-only" in capsys.readouterr().out
        assert not (out / "report.json").exists()
        shutil.copytree(out, tmp_path / "all", dirs_exist_ok=True)
    runs = [f"18-4-{model}-seed{seed}" for model in models for seed in (0, 1)]
    first = [*runs[:2], *runs[4:]] if together else runs[::2]  # seeds that train together
    assert trained == [*first, *sorted(set(runs) - set(first), key=runs.index)]
    sweep.main(["--report-only", "--out", str(tmp_path / "all")])
    comparison = json.loads((tmp_path / "all" / "report.json").read_text())["comparison"]
    assert {*comparison["18/4"]} == {*models}


@pytest.mark.parametrize("together", [[], ["--vmap-seeds"]])
def test_a_run_of_another_process_is_left_to_it_and_the_sweep_goes_on(
    tmp_path, capsys, trained, together
):
    out = tmp_path / "sweep"
    arguments = ["--seeds", "0", "1", "2", "--steps", "1", "--out", str(out), *together]
    with files.locked(out / "18-4-tdanet-seed1"):
        with pytest.raises(SystemExit) as ended:
            sweep.main(arguments)
        assert ended.value.code == sweep.INCOMPLETE
        assert trained == ["18-4-tdanet-seed0", "18-4-tdanet-seed2"]
        said = capsys.readouterr().out
        assert f"{out / '18-4-tdanet-seed1'}: another process trains it; skipped\n" in said
        assert said.endswith(
            "left to other processes: 18-4-tdanet-seed1\nnot finished: 18-4-tdanet-seed1\n"
        )
        left_out = json.loads((out / "report.json").read_text())["left_out"]
        assert "Not finished: 18-4-tdanet-seed1." in left_out
    sweep.main(arguments)
    assert trained[2:] == ["18-4-tdanet-seed1"]
    left_out = json.loads((out / "report.json").read_text())["left_out"]
    assert not any(line.startswith("Not finished") for line in left_out)
    (out / "18-4-tdanet-seed2" / "results.json").unlink()  # begun, by another machine
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        sweep.main(["--report-only", "--out", str(out)])
    assert ended.value.code == sweep.INCOMPLETE
    assert capsys.readouterr().out.endswith("not finished: 18-4-tdanet-seed2\n")


def test_a_sweep_whose_runs_are_all_in_other_processes_says_so(tmp_path, capsys, trained):
    with files.locked(tmp_path / "18-4-tdanet-seed0"), pytest.raises(SystemExit) as ended:
        sweep.main(["--seeds", "0", "--steps", "1", "--out", str(tmp_path)])
    assert ended.value.code == sweep.INCOMPLETE
    assert "no finished run to report on yet" in capsys.readouterr().out


@pytest.mark.usefixtures("trained")
def test_a_bundled_agent_is_included_by_its_name(tmp_path):
    sweep.main(["--report-only", "--include", "18-4-best", "--out", str(tmp_path)])
    report = json.loads((tmp_path / "report.json").read_text())
    assert [run["run"].rpartition("/")[2] for run in report["runs"]] == ["18-4-best"]


def test_a_run_that_another_process_has_finished_meanwhile_is_not_trained_again(
    tmp_path, monkeypatch, trained
):
    from tdanet_jax.workflows import train as workflow

    train = workflow.train

    def train_all_in_another_process(config, folder, **options):
        for seed in (0, 1):
            other = dataclasses.replace(config, seed=seed)
            train(other, folder.parent / configs.run_name(other))

    monkeypatch.setattr(workflow, "train", train_all_in_another_process)
    sweep.main(["--seeds", "0", "1", "--steps", "1", "--out", str(tmp_path)])
    assert trained == ["18-4-tdanet-seed0", "18-4-tdanet-seed1"]


def test_a_sweep_continues_only_with_the_same_flags_of_each_model(tmp_path, capsys, trained):
    arguments = ["--models", "tdanet", "savn", "--seeds", "0", "--steps", "9", "--out"]
    own = ["--per-model", "savn: --num-envs 64 --learning-rate 1e-3"]
    sweep.main([*arguments, str(tmp_path), *own])
    used = configs.load(tmp_path / "18-4-savn-seed0" / "config.json")
    assert (used.steps, used.learner.num_envs, used.learner.learning_rate) == (9, 64, 1e-3)
    assert configs.load(tmp_path / "18-4-tdanet-seed0" / "config.json").learner == LearnerConfig()
    sweep.main([*arguments, str(tmp_path), *own])
    assert len(trained) == 2
    with pytest.raises(SystemExit):
        sweep.main([*arguments, str(tmp_path), "--per-model", "savn: --num-envs 64"])
    said = capsys.readouterr().err
    assert "18-4-savn-seed0: trained with other values of --learning-rate" in said


def test_seeds_of_a_model_that_adapts_are_trained_one_by_one(
    tmp_path, monkeypatch, capsys, trained
):
    from tdanet_jax.workflows import train as workflow

    groups, together = [], workflow.train_together

    def train_together(members, reports):
        groups.append([folder.name for _, folder in members])
        together(members, reports)

    monkeypatch.setattr(workflow, "train_together", train_together)
    arguments = ["--models", "savn", "tdanet", "--seeds", "0", "1", "2", "--steps", "9"]
    with files.locked(tmp_path / "18-4-savn-seed1"), pytest.raises(SystemExit):
        sweep.main([*arguments, "--vmap-seeds", "--out", str(tmp_path)])
    seeds = [f"18-4-tdanet-seed{seed}" for seed in (0, 1, 2)]
    assert groups == [seeds]
    assert trained == ["18-4-savn-seed0", "18-4-savn-seed2", *seeds]
    said = capsys.readouterr().out
    assert said.count("note: seeds of savn, which adapts, are trained one by one\n") == 1


def test_a_model_that_would_never_be_trained_to_adapt_is_refused(tmp_path, capsys, trained):
    with pytest.raises(SystemExit):
        sweep.main(["--models", "savn", "--rollout-steps", "6", "--out", str(tmp_path)])
    assert "error: --rollout-steps 6: must be above 6 for savn" in capsys.readouterr().err
    assert trained == []


def test_a_report_waits_for_one_in_another_process(tmp_path, monkeypatch):
    order, said, waiting = [], [], threading.Event()
    monkeypatch.setattr(sweep.console, "print", lambda text: (said.append(text), waiting.set()))

    def report():
        with sweep.alone(tmp_path):
            order.append("second")

    with files.locked(tmp_path):
        second = threading.Thread(target=report)
        second.start()
        assert waiting.wait(timeout=600)
        order.append("first")
    second.join(timeout=600)
    assert order == ["first", "second"]
    assert "another process reports; waiting for it" in said[0]


@pytest.mark.slow
def test_a_sweep_skips_what_is_finished_and_reports_on_runs_elsewhere(ithor, tmp_path, capsys):
    out = tmp_path / "sweep"
    arguments = ["--seeds", "0", *TINY, "--out", str(out)]
    sweep.main(arguments)
    run = out / "18-4-tdanet-seed0"
    results = (run / "results.json").read_text()
    (run / "results.json").unlink()  # as if it had been killed in its evaluation
    sweep.main(arguments)
    assert "1 runs, 0 finished, 1 to train" in capsys.readouterr().out
    assert json.loads((run / "results.json").read_text()) == json.loads(results)
    (run / "checkpoints").rename(tmp_path / "gone")  # a finished run needs none
    sweep.main([*arguments[:1], "0", "1", *arguments[2:], "--vmap-seeds"])
    assert "2 runs, 1 finished, 1 to train" in capsys.readouterr().out
    assert len(json.loads((out / "report.json").read_text())["runs"]) == 2
    sweep.main(["--report-only", "--out", str(tmp_path / "other"), "--include", str(run)])
    assert f"| {run.name} | 0 |" in (tmp_path / "other" / "report.md").read_text()


@pytest.mark.slow
def test_a_sweep_that_is_killed_again_and_again_ends_as_one_that_was_not(ithor, tmp_path):
    """SIGKILL at random moments; then the runs and the report are those of a sweep in peace."""
    arguments = ["--seeds", "0", "1", "--models", "tdanet", "tdanet-no-ta", *TINY]
    peaceful, killed = tmp_path / "peaceful", tmp_path / "killed"
    subprocess.run([*COMMAND, *arguments, "--out", str(peaceful)], check=True)
    draw = random.Random(0)
    for _ in range(12):
        process = subprocess.Popen([*COMMAND, *arguments, "--out", str(killed)])
        time.sleep(draw.uniform(4, 40))
        process.send_signal(signal.SIGKILL)
        process.wait()
    subprocess.run([*COMMAND, *arguments, "--out", str(killed)], check=True)
    ours, theirs = (json.loads((out / "report.json").read_text()) for out in (killed, peaceful))
    for part in ("comparison", "learning_curves", "left_out"):
        assert ours[part] == theirs[part]
