"""The page of a sweep's report, line by line, from made-up runs in which no number occurs twice."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from tdanet_jax.config import TrainConfig
from tdanet_jax.evaluation import comparison, paper
from tdanet_jax.evaluation.paper import WORLDS_DIFFER
from tdanet_jax.registry import MODELS
from tdanet_jax.workflows import sweep_report
from tdanet_jax.workflows.sweep import FinishedRun
from tdanet_jax.workflows.sweep_report import Cost, Report
from tests.evaluation.test_reported_figures import COLUMNS, PUBLISHED, distinct, made_up, numbers


def run(
    seed: int, model: str, start: float, seconds: float | None, split: str = "18/4"
) -> FinishedRun:
    config = TrainConfig(seed=seed, model=model, split=split, steps=1000)
    results = made_up(seed, start, split=split) | {"model": model}
    results["settings"] = comparison.settings(config)
    return FinishedRun(Path(f"run{seed}"), config, results, seconds)


@pytest.fixture
def report() -> Report:
    """Two seeds of TDANet and one of an ablation on 18/4, one of TDANet on 14/8."""
    runs = [
        run(0, "tdanet", 10.0, 600.0), run(1, "tdanet", 14.0, 90.0),
        run(2, "tdanet-no-ta", 25.0, None),
        run(7, "tdanet", 33.0, 333.0, split="14/8"),
    ]  # fmt: skip
    random: dict[str, Any] = made_up(8, 3.0, policy="random") | {"model": "random"}
    optimum = made_up(9, 85.0, policy="shortest_path") | {"model": "shortest_path"}
    costs = {
        "tdanet": Cost("tdanet", 2_968_653, {1: 1.25, 1024: 10.5}),
        "tdanet-no-ta": Cost("tdanet-no-ta", 1_572_864, {1: 0.75, 1024: 9.25}),
    }
    return Report(runs, [random, optimum], costs, {}, "a machine", "abc")


def test_the_page_line_by_line(report: Report, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "RATES", PUBLISHED)
    pages = sweep_report.markdown(report, {"18/4": "curve.png"})
    both = "{:.1f} ± 2.8"  # of 10 and 14
    others = [name for name in MODELS if name not in ("tdanet", "tdanet-no-ta")]

    def rule(count: int) -> str:
        return f"|{'---|' * (count + 16)}"

    def by_room(label: str, start: float, text: str = "{:.1f}") -> dict[str, str]:
        return {
            room: f"| {room} | {label} | {numbers(start + more, text)} |"
            for room, more in (("kitchen", 20), ("bedroom", 40))
        }

    rooms = [by_room("random", 3.0), by_room("tdanet", 12.0, both), by_room("tdanet-no-ta", 25.0)]
    assert [line for line in pages.splitlines() if line] == [
        "# 4 runs",
        "SR and SPL in percent, test rooms, sampled actions; mean ± standard deviation over the "
        "seeds of a configuration. Code abc.",
        "## Split 18/4: comparison of models (the paper's Table III)",
        f"| Model | Seeds | Training episodes | {COLUMNS} |",
        rule(3),
        f"| random (ours) | 1 | 3,008 | {numbers(3.0)} |",
        f"| shortest_path (ours) | 1 | 3,009 | {numbers(85.0)} |",
        f"| tdanet (ours) | 2 | 3,000 | {numbers(12.0, both)} |",
        f"| tdanet-no-ta (ours) | 1 | 3,002 | {numbers(25.0)} |",
        f"| Random (paper) |  |  | 9.5 | 3.3 {'| - ' * 14}|",
        f"| TDANet (paper) |  |  | 74.7 | 29.7 {'| - ' * 6}"
        "| 62.5 | 25.3 | - | - | 47.4 | 23.8 | - | - |",
        WORLDS_DIFFER,
        "![Learning curve, split 18/4](curve.png)",
        "### Split 18/4, by room type",
        f"| Room | Model | {COLUMNS} |",
        rule(2),
        *(labelled[room] for room in ("kitchen", "bedroom") for labelled in rooms),
        "## Split 14/8: comparison of models (the paper's Table III)",
        f"| Model | Seeds | Training episodes | {COLUMNS} |",
        rule(3),
        f"| tdanet (ours) | 1 | 3,007 | {numbers(33.0)} |",
        "### Split 14/8, by room type",
        f"| Room | Model | {COLUMNS} |",
        rule(2),
        *by_room("tdanet", 33.0).values(),
        "## Ablations (the paper's Tables IV and V)",
        f"| Split | Model | Target attention | Siamese comparison | {COLUMNS} |",
        rule(4),
        f"| 18/4 | tdanet | yes | yes | {numbers(12.0, both)} |",
        f"| 18/4 | tdanet-no-ta | no | yes | {numbers(25.0)} |",
        "## Parameters and inference time",
        "| Model | Parameters | in 2^20 | in 2^20, paper | ms, batch 1 | ms, batch 1,024 "
        "| ms, paper |",
        f"|{'---|' * 7}",
        "| tdanet | 2,968,653 | 2.83 | 3.08 | 1.25 | 10.50 | 0.6 |",
        "| tdanet-no-ta | 1,572,864 | 1.50 | - | 0.75 | 9.25 | - |",
        "Time of one decision for a batch of agents, on a machine.",
        "The paper's time is that of one decision on an NVIDIA GeForce RTX 3060.",
        "The paper's word vectors have 300 dimensions; here, the input layers fit the run's.",
        "## Runs",
        f"| Run | Seed | Training episodes | Steps | Training minutes | {COLUMNS} |",
        rule(5),
        f"| run0 | 0 | 3,000 | 5,000 | 10.0 | {numbers(10.0)} |",
        f"| run1 | 1 | 3,001 | 5,001 | 1.5 | {numbers(14.0)} |",
        f"| run2 | 2 | 3,002 | 5,002 | - | {numbers(25.0)} |",
        f"| run7 | 7 | 3,007 | 5,007 | 5.5 | {numbers(33.0)} |",
        "## Left out",
        "- Split 22/0: nothing was trained.",
        f"- Split 18/4: not trained: {', '.join(others)}.",
        f"- Split 14/8: not trained: {', '.join(['tdanet-no-ta', *others])}.",
        "- Learning curve: no history of run0, run1, run2, run7.",
    ]


def test_the_json_has_each_figure_in_its_place(report: Report) -> None:
    out = json.loads(json.dumps(sweep_report.to_json(report)))
    found = out["comparison"]["18/4"]["tdanet"]
    expected = {"by_room": {"kitchen": distinct(32.0), "bedroom": distinct(52.0)}, **distinct(12.0)}

    def check(found: Any, expected: Any) -> None:
        for name, value in expected.items():
            if isinstance(value, dict):
                check(found[name], value)
            elif name != "n":
                assert found[name] == {"mean": value, "sd": 2.828}

    check(found, expected)
    assert found["seeds"] == [0, 1]
    assert found["episodes_trained"] == {"mean": 3000.5, "sd": 0.707}
    assert [row["training_seconds"] for row in out["runs"]] == [600.0, 90.0, None, 333.0]
    assert [row["steps"] for row in out["runs"]] == [5000, 5001, 5002, 5007]
    assert out["costs"] == {label: dataclasses.asdict(c) | {"milliseconds": {
        str(batch): ms for batch, ms in c.milliseconds.items()}}
        for label, c in report.costs.items()}  # fmt: skip
