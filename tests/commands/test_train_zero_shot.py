"""The training command, as a user types it."""

import json
import os
import re
import shlex
import signal
import socket
import sys
import time
from pathlib import Path

import pytest

import tdanet_jax
from tdanet_jax import config as configs
from tdanet_jax.commands import evaluate, train_zero_shot
from tdanet_jax.commands.running import parse_command
from tdanet_jax.config import TrainConfig
from tdanet_jax.io import files
from tdanet_jax.training import run_file
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.workflows import train as training
from tests.support import command

WRITTEN = {
    "classes.json",
    "config.json", "metrics.jsonl", "checkpoints", "results.json", "results.md", "episodes.jsonl",
    "learning_curve.png", "history", "run.json",
}  # fmt: skip


def wait_for(found, seconds=600):
    deadline = time.monotonic() + seconds
    while not found():
        assert time.monotonic() < deadline
        time.sleep(0.002)


#: Holds a command in the middle of a checkpoint, from the moment when {held} is there until
#: {go_on} is.
HOLD = """
import pathlib, sys, time
def hold(event, given):
    if event == "os.rename" and str(given[1]).endswith("{checkpoint}"):
        pathlib.Path("{held}").touch()
        while not pathlib.Path("{go_on}").exists():
            time.sleep(0.01)
sys.addaudithook(hold)
"""


def start_held(checkpoint, folder, *arguments):
    """Starts training that is held in a checkpoint; and the file to make for it to go on."""
    folder.mkdir()
    held, go_on = folder / "held", folder / "go_on"
    code = HOLD.format(checkpoint=checkpoint, held=held, go_on=go_on)
    (folder / "sitecustomize.py").write_text(code)
    paths = os.pathsep.join((str(folder), os.environ["PYTHONPATH"]))
    process = command.start("train_zero_shot", *arguments, variables={"PYTHONPATH": paths})
    wait_for(lambda: held.exists() or process.poll() is not None)
    return process, go_on


@pytest.mark.slow
def test_it_trains_evaluates_and_goes_on_after_kill_and_term(ithor, tmp_path, capsys):
    """Killed inside a checkpoint, stopped by SIGTERM: --resume ends where it would have anyway."""
    out = tmp_path / "run"
    metrics, checkpoints = out / "metrics.jsonl", out / "checkpoints"
    arguments = ["--split", "14/8", "--steps", "12000", "--checkpoint-minutes", "1e-6"]
    arguments += [*command.TINY, "--out", out]
    process, _ = start_held("checkpoints/20", tmp_path / "first", *arguments)
    assert any(checkpoints.glob(f"{files.PARTIAL}*"))
    process.kill()
    process.communicate()
    assert process.returncode == -signal.SIGKILL

    rows = len(metrics.read_text().splitlines())
    process, go_on = start_held("checkpoints/100", tmp_path / "second", "--resume", out)
    assert len(metrics.read_text().splitlines()) > rows
    with pytest.raises(SystemExit):
        train_zero_shot.main(["--resume", str(out)])
    assert capsys.readouterr().err == f"error: {out}: in use by another process\n"
    process.send_signal(signal.SIGTERM)
    go_on.touch()
    said, _ = process.communicate(timeout=600)
    assert process.returncode == 128 + signal.SIGTERM
    assert "half-written when the run was stopped" in said
    assert f"updates are saved; continue with: tdanet train --resume {out}" in said
    assert not (out / "results.json").exists()

    done = command.run("train_zero_shot", "--resume", out)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert {p.name for p in out.iterdir()} == WRITTEN | {files.LOCK_FILE}
    again = f"tdanet train --resume {out}"
    typed = shlex.join(["tdanet", "train", *map(str, arguments)])
    processes = run_file.read(out)
    assert [process.command for process in processes] == [typed, again, again]
    assert processes[0].commit == json.loads((out / "results.json").read_text())["commit"]
    rows = [json.loads(line) for line in metrics.read_text().splitlines()]
    assert [row["steps"] for row in rows] == list(range(400, 12_001, 400))
    assert len(list((out / "history").iterdir())) == 20
    results = json.loads((out / "results.json").read_text())
    assert results["split"] == "14/8"
    assert results["seen"]["L>=1"]["n"] == results["unseen"]["L>=1"]["n"] == 1000


@pytest.mark.slow
def test_a_split_of_ones_own_is_trained_evaluated_and_gone_on_with(
    ithor, few_episodes, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    arguments = ["--split", "towel,mug,CD", "--steps", "4e2", "--precision", "float32"]
    reader, writer = os.pipe()
    os.close(reader)  # as `| head` does
    with monkeypatch.context() as patch, os.fdopen(writer, "w") as broken:
        patch.setattr(training, "_report", lambda *_: None)  # to save time
        patch.setattr(sys, "stdout", broken)
        train_zero_shot.main([*arguments, *command.TINY])
    assert "output cannot be written (Broken pipe)" in capsys.readouterr().err
    [run] = (tmp_path / "runs").iterdir()
    assert Checkpoints(run).latest() == 10
    assert re.fullmatch(r"Mug-CD-Towel-tdanet-seed0-\d{8}-\d{6}", run.name)
    left = run / "checkpoints" / f"{files.PARTIAL}{2**22 + 1}-20"  # of no process
    left.mkdir()
    with files.locked(run), pytest.raises(SystemExit):
        train_zero_shot.main(["--resume", str(run)])
    assert f"error: {run}: in use by another process\n" == capsys.readouterr().err
    before = (run / "config.json").read_text()
    with pytest.raises(SystemExit):
        train_zero_shot.main(["--resume", str(run), "--steps", "300"])
    done = f"{run} has already trained as long, 400 steps, "
    assert capsys.readouterr().err.startswith(f"error: --steps 300: {done}")
    assert (run / "config.json").read_text() == before
    assert left.exists()
    train_zero_shot.main(["--resume", str(run), "--steps", "600"])
    assert f"removed {left}: half-written when the run was stopped" in capsys.readouterr().out
    assert {p.name for p in run.iterdir()} == WRITTEN | {files.LOCK_FILE}
    results = json.loads((run / "results.json").read_text())
    assert (results["split"], results["steps"]) == ("Mug,CD,Towel", 800)
    # No room type without an unseen class has unseen episodes.
    assert (results["seen"]["L>=1"]["n"], results["unseen"]["L>=1"]["n"]) == (100, 75)
    unseen = {name for name, groups in results["by_target"].items() if "unseen" in groups}
    assert unseen == {"Mug", "CD", "Towel"}
    assert not any("seen" in results["by_target"][name] for name in unseen)

    evaluate.main(["--checkpoint", str(run), "--out", "again"])
    for name in ("episodes.jsonl", "results.json"):
        assert Path("again", name).read_text() == (run / name).read_text()
    agent = tdanet_jax.load(run)
    assert agent.config.split == "Mug,CD,Towel"
    known = {agent.classes.names[i] for i in agent.classes.known}
    assert set(agent.classes.names) - known == unseen


def test_the_advice_for_word_vectors_that_were_moved_can_be_followed(tmp_path):
    run, vectors = tmp_path / "run", tmp_path / "vectors.npz"
    run.mkdir()
    configs.save(TrainConfig(word_vectors="gone.npz"), run / "config.json")
    arguments = ["--resume", str(run), "--word-vectors", str(vectors)]
    assert train_zero_shot.check(parse_command(arguments)).word_vectors == str(vectors)


#: All that an agent may sense beyond the paper.
SENSES = ("--odometry", "--triangulation")


def own_variables():
    """Who is who, for two processes on this machine: how process `number` hears of it."""
    port = free_port()
    return lambda number: {
        "JAX_COORDINATOR_ADDRESS": f"localhost:{port}",
        "JAX_NUM_PROCESSES": "2",
        "JAX_PROCESS_ID": str(number),
    }


def slurms_variables():
    """The same as a step of a SLURM job hears it; JAX takes a port from the job's number."""
    job = next(n for n in range(4096) if is_free(61440 + n))
    return lambda number: {
        "SLURM_JOB_ID": str(job), "SLURM_STEP_NODELIST": "localhost", "SLURM_NTASKS": "2",
        "SLURM_STEP_NUM_TASKS": "2", "SLURM_PROCID": str(number), "SLURM_LOCALID": str(number),
    }  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("who_is_who", [own_variables, slurms_variables])
def test_two_processes_train_together_and_one_goes_on_alone(who_is_who, ithor, tmp_path):
    """Two processes share a run's environments, stop, and resume it; then one resumes it alone.

    With odometry and triangulation: every environment has a map of its own.
    """
    out = tmp_path / "run"
    new = ["--devices", "2", *SENSES, *command.TINY, "--out", out]
    for arguments, steps in ((new, 2400), (["--devices", "2", "--resume", out], 2800)):
        variables = who_is_who()
        both = [
            command.start(
                "train_zero_shot", *arguments, "--steps", str(steps), variables=variables(number)
            )
            for number in (0, 1)
        ]
        said = [process.communicate(timeout=600) for process in both]
        assert [process.returncode for process in both] == [0, 0], said
        assert "wrote" in said[0][0]
        assert "steps/s" not in said[1][0]
        rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
        assert [row["steps"] for row in rows] == list(range(400, steps + 1, 400))

    done = command.run("train_zero_shot", "--resume", out, "--steps", "3200")
    assert done.returncode == 0, done.stderr
    config = json.loads((out / "config.json").read_text())
    assert config["steps"] == 3200
    assert config["network"]["odometry"]
    assert config["network"]["triangulation"]
    assert set(tdanet_jax.load(out).start(45).sensors) == {"odometry", "triangulation"}
    page = (out / "results.md").read_text()
    assert page.startswith("# tdanet, --odometry, --triangulation, split")
    assert len((out / "metrics.jsonl").read_text().splitlines()) == 8


def is_free(port):
    with socket.socket() as listener:
        return listener.connect_ex(("localhost", port)) != 0


def free_port():
    with socket.socket() as listener:
        listener.bind(("localhost", 0))
        return listener.getsockname()[1]


def test_who_stops_a_run_learns_how_to_continue_as_it_was_started(tmp_path, monkeypatch, capsys):
    """In this folder, with these devices and logs: none of them is in the run."""
    out = tmp_path / "my runs"

    def train(config, folder, **options):
        folder.mkdir()
        (folder / "config.json").touch()
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr("tdanet_jax.workflows.train.train", train)
    with pytest.raises(SystemExit):
        train_zero_shot.main(["--out", str(out), "--devices", "2", "--log", "csv"])
    said = capsys.readouterr().out
    assert f"continue with: tdanet train --resume '{out}' --devices 2 --log csv\n" in said
    with pytest.raises(SystemExit):
        train_zero_shot.main(["--out", str(out)])
    assert f"(to continue there: --resume '{out}')" in capsys.readouterr().err
