"""The training command, as a user types it."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

COMMAND = [sys.executable, "-m", "experiments.train_zero_shot"]
TINY = ["--num-envs", "8", "--rollout-steps", "5", "--width", "16", "--hidden", "16"]
WRITTEN = {
    "classes.json",
    "config.json", "metrics.jsonl", "checkpoints", "results.json", "results.md", "episodes.jsonl",
    "learning_curve.png", "history",
}  # fmt: skip


def run(*arguments, cwd=None):
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, cwd=cwd, env=environment
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--split", "17/5"], "--split 17/5: choose one of 22/0, 18/4, 14/8"),
        (["--model", "cnn"], "--model cnn: choose one of"),
        (["--steps", "-5"], "--steps -5: must be positive"),
        (["--history", "-1"], "--history -1: must not be negative"),
        (["--steps", "many"], "invalid literal for int() with base 10: 'many'"),
        (["--stepz", "5"], "Unrecognized options: --stepz, 5"),
        (["--rows", "all"], "invalid choice 'all' for argument '--rows'. Expected one of ('class'"),
        (["--preset", "fast"], "invalid choice 'fast' for argument '--preset'"),
        (["--resume", "nowhere"], "nowhere/config.json: no such file"),
        (["--resume", "nowhere", "--steps", "5"], "--resume goes on to the original budget"),
        (["--out", "full"], "--out full: exists and is not empty"),
    ],
)
def test_wrong_arguments_give_one_line_and_write_nothing(tmp_path, arguments, message):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "precious").write_text("kept")
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert [p.name for p in tmp_path.rglob("*")] == ["full", "precious"]
    assert (tmp_path / "full" / "precious").read_text() == "kept"


def test_it_trains_evaluates_and_resumes_after_a_signal(ithor, tmp_path):
    """SIGTERM saves and says how to go on; --resume ends where an unstopped run would."""
    out = tmp_path / "run"
    arguments = ["--split", "14/8", "--steps", "160000", *TINY, "--out", str(out)]
    environment = os.environ | {"PYTHONUNBUFFERED": "1"}
    process = subprocess.Popen(
        [*COMMAND, *arguments], stdout=subprocess.PIPE, text=True, env=environment
    )
    metrics = out / "metrics.jsonl"
    deadline = time.monotonic() + 240
    while not (metrics.exists() and metrics.stat().st_size) and time.monotonic() < deadline:
        time.sleep(0.05)
    process.send_signal(signal.SIGTERM)
    said, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + signal.SIGTERM
    assert f"--resume {out}" in said
    assert not (out / "results.json").exists()

    done = run("--resume", str(out))
    assert done.returncode == 0, done.stderr
    assert {p.name for p in out.iterdir()} == WRITTEN
    rows = [json.loads(line) for line in metrics.read_text().splitlines()]
    assert [row["steps"] for row in rows] == list(range(400, 160_001, 400))
    assert len(list((out / "history").iterdir())) == 20
    results = json.loads((out / "results.json").read_text())
    assert results["split"] == "14/8"
    assert results["seen"]["L>=1"]["n"] == results["unseen"]["L>=1"]["n"] == 1000
