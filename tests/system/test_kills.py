"""A run that is killed again and again ends as one that nobody touched.

Slow: `pytest -m slow tests/system/test_kills.py`, about ten minutes. A run that is stopped
and resumed among the default tests is in tests/training/test_run.py.
"""

from __future__ import annotations

import json
import random
import signal
import subprocess
import time
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

from tdanet_jax.io import files
from tdanet_jax.training import history
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.training.journal import METRICS_FILE, read_metrics
from tests.support import command
from tests.support.checkpoints import arrays_of

KILLS = 24
#: 600 chunks, more than a fast machine gets done between the kills; a checkpoint follows each.
BUDGET = ("--split", "14/8", "--steps", "240000", *command.TINY)
OFTEN = ("--checkpoint-minutes", "1e-6")
TIMES = {"seconds", "steps_per_second"}


def writing(out: Path) -> bool:
    """Whether a checkpoint is being written at this moment."""
    return any((out / "checkpoints").glob(f"{files.PARTIAL}*"))


def wait(process: subprocess.Popen[str], found: Callable[[], bool]) -> None:
    """Until something is found or the process has ended."""
    deadline = time.monotonic() + 180
    while process.poll() is None and not found():
        assert time.monotonic() < deadline
        time.sleep(0.001)


def strike(process: subprocess.Popen[str], out: Path, draw: random.Random, kind: str) -> None:
    """Waits for a random moment of the given kind."""
    metrics = out / METRICS_FILE
    rows = metrics.stat().st_size if metrics.exists() else 0
    if kind == "starting":  # imports, rooms, restoring, compiling
        time.sleep(draw.uniform(0, 12))
        return
    wait(process, lambda: metrics.exists() and metrics.stat().st_size > rows)
    if kind == "writing":
        wait(process, lambda: writing(out))
        time.sleep(draw.uniform(0, 0.1))
    else:
        time.sleep(draw.uniform(0, 1))


def assert_sound(out: Path, before: int) -> int:
    """All complete checkpoints can be read, and none was lost; returns the newest."""
    checkpoints = Checkpoints(out)
    newest = checkpoints.latest()
    if newest is None:
        assert before == -1
        return before
    assert newest >= before
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert checkpoints.snapshot().updates == newest
    return newest


def final_state(out: Path) -> list[np.ndarray]:
    """Everything in the newest checkpoint."""
    return list(arrays_of(out).values())


def without_times(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [{k: v for k, v in row.items() if k not in TIMES} for row in rows]


def assert_equal_runs(one: Path, other: Path) -> None:
    for ours, theirs in zip(final_state(one), final_state(other), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    assert without_times(read_metrics(one)) == without_times(read_metrics(other))
    for name in ("results.json", "episodes.jsonl"):
        assert (one / name).read_bytes() == (other / name).read_bytes()
    points = [[history.read(path) for path in history.points(run)] for run in (one, other)]
    assert [p.updates for p in points[0]] == [p.updates for p in points[1]]
    for ours, theirs in zip(*points, strict=True):
        jax.tree.map(np.testing.assert_array_equal, ours.weights, theirs.weights)


@pytest.mark.slow
def test_killed_at_random_moments_a_run_ends_as_one_that_was_not(tmp_path: Path) -> None:
    out, whole = tmp_path / "killed", tmp_path / "whole"
    draw = random.Random(0)
    newest, struck, hit_writing = -1, [], 0
    for number in range(KILLS):
        kind = ("writing", "starting", "training")[number % 3]
        sent = draw.choice((signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT))
        half = writing(out)
        begun = (out / "config.json").exists()
        again = ("--resume", out) if begun else (*BUDGET, *OFTEN, "--out", out)
        process = command.start("train_zero_shot", *again)
        strike(process, out, draw, kind)
        assert process.poll() is None, process.communicate()
        process.send_signal(sent)
        said, error = process.communicate(timeout=600)
        struck.append((kind, sent.name, process.returncode, newest))
        assert process.returncode in (-sent, 128 + sent), (struck, said, error)
        # "stopped": before the run, while the command line is read.
        if process.returncode == 128 + sent and error != "stopped\n":
            assert "stopped; " in said
            assert error == "" or "Exception ignored" in error  # while collecting garbage
        assert "half-written" in said or not half or kind == "starting"
        hit_writing += writing(out)
        newest = assert_sound(out, newest)
    print("\n".join(map(str, struck)))
    assert hit_writing >= 3, struck
    done = command.run("train_zero_shot", "--resume", out)
    assert done.returncode == 0, done.stderr
    assert command.run("train_zero_shot", *BUDGET, "--out", whole).returncode == 0
    assert_equal_runs(out, whole)
    assert [row["steps"] for row in read_metrics(out)] == list(range(400, 240_001, 400))
    assert json.loads((out / "results.json").read_text())["steps"] == 240_000
    assert not list(out.rglob(f"{files.PARTIAL}*"))
