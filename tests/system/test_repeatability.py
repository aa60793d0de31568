"""Equal seeds give equal results in processes of their own; see docs/reliability.md."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tdanet_jax import scenes
from tdanet_jax.scenes import SceneTables
from tests.support import command
from tests.system.test_kills import assert_equal_runs, final_state

#: Names of classes and rooms go through sets and dictionaries: their order must not matter.
BUILDER = """
import numpy as np
from tdanet_jax.scenes import tabulation
from tests.support import toy
draw = np.random.default_rng(0)
print(tabulation.build([toy.random_room(draw, name=f"Room{i}") for i in range(4)]).data_version)
"""


def in_process(code: str, **environment: str) -> str:
    """What a program prints in a process of its own."""
    variables = os.environ | environment
    done = subprocess.run(
        [sys.executable, "-c", code], env=variables, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_tables_do_not_depend_on_the_process() -> None:
    versions = {in_process(BUILDER, PYTHONHASHSEED=seed) for seed in ("1", "2")}
    assert len(versions) == 1


@pytest.mark.slow
def test_the_rooms_are_rebuilt_bit_by_bit(
    ithor: SceneTables, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TDANET_CACHE", str(tmp_path))
    assert scenes.load_tables().data_version == ithor.data_version


@pytest.mark.slow
def test_training_and_evaluation_repeat_bit_by_bit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    budget = ("--split", "14/8", "--steps", "8000", "--dropout", "0.25", *command.TINY)
    runs = []
    for name, seed in (("one", "3"), ("two", "3"), ("other", "4")):
        monkeypatch.setenv("PYTHONHASHSEED", str(len(runs)))
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / name / "compiled"))
        out = tmp_path / name / "run"
        done = command.run("train_zero_shot", *budget, "--seed", seed, "--out", out)
        assert done.returncode == 0, done.stderr
        runs.append(out)
    assert_equal_runs(runs[0], runs[1])
    assert any((a != b).any() for a, b in zip(*map(final_state, runs[::2]), strict=True))
    records = []
    for run, seed in ((runs[0], "0"), (runs[1], "0"), (runs[1], "1")):
        out = tmp_path / f"evaluated-{len(records)}"
        done = command.run("evaluate", "--checkpoint", run, "--seed", seed, "--out", out)
        assert done.returncode == 0, done.stderr
        records.append((out / "episodes.jsonl").read_bytes())
    assert records[0] == records[1] != records[2]
