"""What the commands print: each figure is its own, in rows in which no two agree."""

from __future__ import annotations

import contextlib
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tdanet_jax.analysis.trace import Trace
from tdanet_jax.commands import benchmark, console, one_episode, running
from tdanet_jax.commands.signals import StopRequest
from tdanet_jax.vocabulary import Action

ROW: dict[str, Any] = {
    "updates": 11, "steps": 22, "episodes": 3456, "success": 0.125, "spl": 0.0625, "length": 7.5,
    "reward": 0.375, "policy_loss": 0.75, "value_loss": 0.8125, "entropy": 1.625,
    "explained_variance": 0.9375, "grad_norm": 0.6875, "learning_rate": 0.5,
    "bootstrap_only_steps": 13, "skipped": 17, "seconds": 19.5, "steps_per_second": 2468.3,
}  # fmt: skip
FIGURES = "2,468 steps/s  SR 12.5  SPL 6.2  entropy 1.62"


def test_the_figures_of_training() -> None:
    assert running.figures_of(ROW) == f"{FIGURES}  17 updates skipped"
    empty = ROW | {"success": None, "spl": None, "entropy": None, "skipped": 0}
    assert running.figures_of(empty) == "2,468 steps/s  SR -  SPL -  entropy -"


def test_progress_is_the_runs_own(capsys: pytest.CaptureFixture[str]) -> None:
    runs: list[Any] = [SimpleNamespace(progress=share) for share in (0.25, 0.75)]
    other = ROW | {"episodes": 1}
    for count, seeds in ((1, ""), (2, "2 seeds, each: ")):
        with contextlib.ExitStack() as shown:
            reports = running.Reports(StopRequest(), shown)
            reports.on_rows(runs[:count], [ROW, other][:count])
        assert (
            capsys.readouterr().out == f"training  25.0 %  {seeds}{FIGURES}  17 updates skipped\n"
        )


def test_the_summary_of_an_evaluation(capsys: pytest.CaptureFixture[str]) -> None:
    def group(start: float, count: int) -> dict[str, Any]:
        return {
            bucket: {
                "SR": first, "SPL": first + 1, "SR_ci": [first - 4, first + 5],
                "SPL_ci": [first - 2, first + 3], "n": count + more,
            }
            for bucket, first, more in (("L>=1", start, 0), ("L>=5", start + 30, 1))
        }  # fmt: skip

    results = {"departures": None, "seen": group(20.0, 1000), "unseen": group(40.0, 500)}
    console.print_summary(results)
    lines = [
        "seen targets, 1000 episodes: SR 20.0 (16.0 to 25.0), SPL 21.0 (18.0 to 23.0)",
        "unseen targets, 500 episodes: SR 40.0 (36.0 to 45.0), SPL 41.0 (38.0 to 43.0)",
    ]
    assert capsys.readouterr().out.splitlines() == lines
    console.print_summary(results | {"unseen": None})
    assert capsys.readouterr().out.splitlines() == lines[:1]


def test_the_outcomes_of_an_episode(capsys: pytest.CaptureFixture[str]) -> None:
    traces = [
        Trace(name, "FloorPlan7", "Mug", np.zeros(1, int), np.array(actions), success, shortest)
        for name, actions, success, shortest in (
            ("one", [0, 0, Action.DONE], True, 2),
            ("two", [0, Action.DONE], False, 5),
            ("three", [0, 0, 0, 0], False, 6),
        )
    ]
    one_episode.print_outcomes(traces, Path("page.html"))
    assert capsys.readouterr().out.splitlines() == [
        "Mug in FloorPlan7",
        "  one: success, 3 actions, shortest 2",
        "  two: failure (Done without the target), 2 actions, shortest 5",
        "  three: failure (step limit), 4 actions, shortest 6",
        "wrote page.html",
    ]


def test_the_table_of_benchmarks() -> None:
    rows = [
        {"part": "rollout", "environments": 3, "model": "tdanet", "steps": 5.5, "batch": 7},
        {"part": "startup", "seconds_help": 0.25},
    ]  # fmt: skip
    cells = [list(column.cells) for column in benchmark.as_table(rows).columns]
    assert cells == [
        ["rollout", "startup"],
        ["environments 3, model tdanet, batch 7", ""],
        ["steps 5.5", "seconds_help 0.25"],
    ]
