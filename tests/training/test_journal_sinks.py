"""Metrics in a table, and at Weights & Biases."""

from __future__ import annotations

import csv
import json
import re
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.training import journal as journal_module
from tdanet_jax.training import run_file
from tdanet_jax.training.journal import SINKS, Journal, csv_sink, wandb_sink
from tdanet_jax.training.run_file import Process
from tdanet_jax.workflows.train import train


def row(number: int, success: float | None = 0.5) -> dict[str, Any]:
    return {"updates": number, "steps": 40 * number, "episodes": number, "success": success}


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "metrics.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_a_table_has_every_row_once_even_if_the_run_continues(tmp_path: Path) -> None:
    journal, sink = Journal(tmp_path / "metrics.jsonl", 0), csv_sink(tmp_path)
    for number in (1, 2, 3):
        for write in (journal.write, sink):
            write(row(number, None if number == 1 else 0.25))
    expected = [{"updates": "1", "steps": "40", "episodes": "1", "success": ""}]
    expected += [
        {"updates": str(n), "steps": str(40 * n), "episodes": str(n), "success": "0.25"}
        for n in (2, 3)
    ]
    assert table(tmp_path) == expected
    journal = Journal(tmp_path / "metrics.jsonl", 2)  # its checkpoint is older than the last row
    csv_sink(tmp_path)(row(3, 0.75))
    assert table(tmp_path) == [*expected[:2], expected[2] | {"success": "0.75"}]


def test_a_table_has_the_columns_of_rows_that_an_earlier_version_wrote(tmp_path: Path) -> None:
    Journal(tmp_path / "metrics.jsonl", 0).write(row(1, 0.5))
    sink = csv_sink(tmp_path)
    for number in (2, 3):  # with a column more, in between
        sink({"updates": number, "share": 0.25, **row(number, 0.75)})
    assert table(tmp_path) == [
        {"updates": str(n), "steps": str(40 * n), "episodes": str(n), "success": s, "share": more}
        for n, s, more in ((1, "0.5", ""), (2, "0.75", "0.25"), (3, "0.75", "0.25"))
    ]


def test_a_table_has_no_rows_of_a_killed_run_after_its_checkpoint(tmp_path: Path) -> None:
    """A run makes its tables before it drops these rows."""
    journal = Journal(tmp_path / "metrics.jsonl", 0)
    for number in (1, 2, 3, 4):
        journal.write(row(number, 0.25))
    sink = csv_sink(tmp_path)
    for number in (3, 4):  # its checkpoint is that of row 2
        sink(row(number, 0.75))
    assert [(r["updates"], r["success"]) for r in table(tmp_path)] == [
        ("1", "0.25"), ("2", "0.25"), ("3", "0.75"), ("4", "0.75"),
    ]  # fmt: skip


def test_training_goes_on_without_a_table(tmp_path: Path) -> None:
    sink = csv_sink(tmp_path)
    (tmp_path / "metrics.csv").unlink()
    (tmp_path / "metrics.csv").mkdir()
    with pytest.warns(UserWarning, match="metrics.csv: given up"):
        sink(row(1))
    sink(row(2))  # without a further warning


class Wandb(ModuleType):
    """Weights & Biases' part that is used."""

    class Error(Exception):
        pass

    def __init__(self, refuses: str = "") -> None:
        super().__init__("wandb")
        self.begun: dict[str, Any] = {}
        self.logged: list[tuple[int, dict[str, float]]] = []
        self.refuses = refuses

    def init(self, **options: Any) -> SimpleNamespace:
        if self.refuses:
            raise self.Error(self.refuses)
        self.begun = options
        return SimpleNamespace(log=lambda figures, step: self.logged.append((step, figures)))


def test_weights_and_biases_get_the_run_and_every_figure(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "my run"
    folder.mkdir()
    configs.save(TrainConfig(seed=7), folder / CONFIG_FILE)
    fake = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.delenv("WANDB_PROJECT", raising=False)
    sink = wandb_sink(folder)
    sink(row(2, None))
    assert fake.logged == [(80, {"train/updates": 2, "train/steps": 80, "train/episodes": 2})]
    name = fake.begun.pop("id")
    assert re.fullmatch(r"my-run-[0-9a-f]{8}", name)
    assert fake.begun == {
        "project": "tdanet_jax", "name": "my run", "dir": str(folder),
        "config": json.loads((folder / CONFIG_FILE).read_text()), "resume": "allow",
    }  # fmt: skip
    assert fake.begun["config"]["seed"] == 7


def test_weights_and_biases_go_on_with_a_run_and_tell_apart_those_of_one_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fake = Wandb()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    names = []
    for folder, started in (("a/mine", "1"), ("b/mine", "2"), ("b/mine", "3")):
        (tmp_path / folder).mkdir(parents=True, exist_ok=True)
        configs.save(TrainConfig(), tmp_path / folder / CONFIG_FILE)
        run_file.add(tmp_path / folder, Process(started=started))  # of b/mine, the second resumes
        wandb_sink(tmp_path / folder)
        names.append(fake.begun["id"])
    assert names[0] != names[1] == names[2]


@pytest.mark.parametrize(
    ("names", "error"),
    [
        (["tensorbord"], "--log tensorbord: choose tensorboard, wandb, csv"),
        (
            ["csv", "wandb"],
            "--log wandb needs nowhere: pip install nowhere",
        ),
    ],
)
def test_what_a_run_cannot_be_logged_in_is_one_line_before_it_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, names: list[str], error: str
) -> None:
    missing = {**SINKS, "wandb": ("nowhere", wandb_sink)}
    monkeypatch.setattr(journal_module, "SINKS", missing)
    with pytest.raises(ValueError, match=f"^{error}$"):
        train(TrainConfig(), tmp_path / "run", log=names)
    assert not (tmp_path / "run").exists()


def test_what_weights_and_biases_refuse_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    configs.save(TrainConfig(), tmp_path / CONFIG_FILE)
    monkeypatch.setitem(sys.modules, "wandb", Wandb("no API key\n  configured"))
    with pytest.raises(ValueError, match=r"^--log wandb: no API key configured$"):
        wandb_sink(tmp_path)
