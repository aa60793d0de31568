"""Trains an agent on the iTHOR training rooms and reports SR and SPL in the test rooms.

    python -m experiments.train_zero_shot --split 18/4

Writes config.json, classes.json, metrics.jsonl, checkpoints, results.json, results.md,
episodes.jsonl and learning_curve.png into --out (by default
runs/<split>-<model>-seed<seed>-<time>).
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from experiments.console import (
    StopRequest,
    console,
    fail,
    one_line_errors,
    parse,
    print_summary,
    reporter,
)
from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, PRESETS, TrainConfig

if TYPE_CHECKING:
    from tdanet_jax.training import Row


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains an agent on the iTHOR training rooms and reports SR and SPL in the test rooms."""

    run: tyro.conf.OmitArgPrefixes[TrainConfig]
    preset: Literal["default", "paper"] = "default"
    """paper: the reference's constants and its budget of 6 M episodes; other flags still apply."""
    out: Path | None = None
    """Folder for everything that the run writes; must be new or empty."""
    resume: Path | None = None
    """Folder of a run to go on with, to its original budget; takes no other flag."""
    tensorboard: bool = False
    """Also write TensorBoard events (needs tensorboardX)."""


def parse_command(arguments: list[str]) -> Command:
    """The command line; `--preset` chooses the defaults of the flags beside it."""
    preset = "default"
    for i, word in enumerate(arguments):
        if word.startswith("--preset"):
            preset = word.partition("=")[2] or "".join(arguments[i + 1 : i + 2])
    default = Command(run=PRESETS.get(preset, PRESETS["default"]))
    return parse(Command, arguments, default=default, prog="train_zero_shot")


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    words = sys.argv[1:] if arguments is None else arguments
    with one_line_errors():
        command = parse_command(words)
        if command.resume is not None:
            if len(words) > 2:
                fail("--resume goes on to the original budget and takes no other flag")
            folder, config = command.resume, configs.load(command.resume / CONFIG_FILE)
        else:
            config = command.run
            config.check()
            config = config.with_absolute_paths()
            folder = command.out or default_folder(config)
            if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
                fail(f"--out {folder}: exists and is not empty (to go on there: --resume {folder})")
        train(config, folder, command.tensorboard)


def default_folder(config: TrainConfig) -> Path:
    """runs/18-4-tdanet-seed0-20260131-120000."""
    split = config.split.replace("/", "-") + ("-validation" if config.validation else "")
    stamp = time.strftime("%Y%m%d-%H%M%S")
    return Path("runs") / f"{split}-{config.model}-seed{config.seed}-{stamp}"


def train(config: TrainConfig, folder: Path, tensorboard: bool) -> None:
    """Trains to the end of the budget, then evaluates and reports."""
    from tdanet_jax import episodes, evaluation, figures, policies, report
    from tdanet_jax.task import load_task, resolve_precision
    from tdanet_jax.training import Run, read_metrics

    with reporter("rooms", every=30, transient=True) as report_rooms:
        task = load_task(config, lambda done, total: report_rooms(done / total, "rebuilt"))
    lists = episodes.load(task.tables, task.split, task.extras)
    # What `auto` means here is part of the run: it goes on with the same products elsewhere.
    config = dataclasses.replace(config, network=resolve_precision(config.network))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG_FILE).write_text(json.dumps(configs.to_json(config), indent=2) + "\n")
    task.classes.save(folder)
    run = Run(folder, config, task)
    console.print(f"{config.model}, split {task.split.name}, seed {config.seed} -> {folder}")
    console.print("compiling ...")
    saved = run.seconds
    with (
        StopRequest() as stop,
        reporter("training", every=10) as show,
        metrics_sink(folder, tensorboard) as sink,
    ):
        for row in run.chunks():
            show(
                run.progress,
                f"{row['steps_per_second']:,.0f} steps/s  {row['episodes']:,} episodes  "
                f"SR {100 * row['success']:.1f}  SPL {100 * row['spl']:.1f}  "
                f"entropy {row['entropy']:.2f}",
            )
            sink(row)
            if run.seconds - saved > 60 * config.checkpoint_minutes:
                run.save()
                saved = run.seconds
            if stop.signal is not None:
                run.save()
                console.print(
                    f"stopped and saved; go on with: "
                    f"python -m experiments.train_zero_shot --resume {folder}"
                )
                raise SystemExit(128 + stop.signal)
    run.save()
    title = f"{config.model}, split {task.split.name}, seed {config.seed}"
    figures.learning_curve(read_metrics(folder), title, folder / "learning_curve.png")
    console.print("evaluating ...")
    policy = policies.network(run.model, task.words)
    played = evaluation.evaluate_lists(
        policy, run.state.params, task.eval_params, lists, config.seed
    )
    provenance = report.Provenance(
        split=task.split.name,
        model=config.model,
        policy="sample",
        episodes_trained=int(run.state.episodes),
        seed=config.seed,
        steps=run.steps,
        data_version=task.tables.data_version,
        data=config.data,
    )
    print_summary(report.write(folder, provenance, task.tables, played))
    console.print(f"wrote {folder / 'results.md'}")


@contextlib.contextmanager
def metrics_sink(folder: Path, tensorboard: bool) -> Iterator[Callable[[Row], None]]:
    """Where rows of metrics go beside `metrics.jsonl`: TensorBoard, or nowhere."""
    if not tensorboard:
        yield lambda row: None
        return
    try:
        from tensorboardX import SummaryWriter
    except ImportError:
        fail("--tensorboard needs tensorboardX: pip install 'tdanet-jax[tensorboard]'")
    with SummaryWriter(str(folder / "tensorboard")) as writer:

        def write(row: Row) -> None:
            for name, value in row.items():
                if name != "steps":
                    writer.add_scalar(f"train/{name}", value, row["steps"])

        yield write


if __name__ == "__main__":
    main()
