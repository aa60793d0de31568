"""Trains several splits, models and seeds, and reports them in the form of the paper's tables.

    python -m experiments.sweep --splits 18/4 14/8 --seeds 0 1 2 --minutes 10 --out runs/sweep

Every further flag is one of the training command and holds for all runs. After an interruption run
the same command again: finished runs are skipped, the one that was begun continues. Writes a folder
for each run, report.md, report.json and the learning curves into --out.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import json
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import tyro

from experiments.console import (
    check_positive,
    console,
    fail,
    one_line_errors,
    one_line_usage,
    reporter,
)
from experiments.running import Command as TrainingCommand
from experiments.running import Reports, how_to_continue, parse_command
from experiments.signals import stoppable
from tdanet_jax.config import CONFIG_FILE, TrainConfig, run_name
from tdanet_jax.evaluation import sweep, sweep_report
from tdanet_jax.evaluation.sweep import FinishedRun
from tdanet_jax.evaluation.sweep_report import Cost
from tdanet_jax.splits import file_name

#: Batches whose inference time is reported.
BATCHES = (1, 1024)
#: Seed of the random actions that runs are compared with.
UNTRAINED_SEED = 0
#: Exit statuses above this one mean that a signal stopped the program.
SIGNALLED = 128
#: Flags of the training command that a sweep sets itself.
OWN = {
    "--split": "--splits",
    "--model": "--models",
    "--seed": "--seeds",
    "--resume": "the same command again in its place",
    "--tensorboard": "none",
}


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains several splits, models and seeds; every further flag is one of train_zero_shot."""

    out: Path
    """Folder of the sweep: a folder for each run, and the report."""
    splits: tuple[str, ...] = ("18/4",)
    """Splits to train on: 22/0, 18/4, 14/8, or unseen classes with commas (Mug,Vase,CD,Towel)."""
    models: tuple[str, ...] = ("tdanet",)
    """Models to train, ablations included; see --model of train_zero_shot."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of each."""
    vmap_seeds: bool = False
    """Train the seeds of a split and model in one vmapped call; needs a budget in steps. Made for
    accelerators: on two cores it is slower than one after the other, unless networks are small."""
    report_only: bool = False
    """Train nothing; report on the runs in --out that are finished, and on --include."""
    include: tuple[Path, ...] = ()
    """FinishedRun runs elsewhere that the report takes in."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    words = sys.argv[1:] if arguments is None else arguments
    with one_line_errors():
        with one_line_usage():
            command, rest = tyro.cli(
                Command, args=words, return_unknown_args=True, prog="sweep", description=__doc__
            )
        if command.report_only and rest:
            fail(f"--report-only trains nothing and takes no {rest[0]}")
        for word in rest:
            if word.partition("=")[0] in OWN:
                fail(f"{word}: a sweep takes {OWN[word.partition('=')[0]]}")
        training = parse_command(rest)
        base = training.run.normalised()
        configs = sweep.plan(base, command.splits, command.models, command.seeds)
        if command.vmap_seeds and (base.episodes is not None or base.minutes is not None):
            fail("--vmap-seeds needs a budget in --steps: seeds that end apart cannot share a call")
        if command.vmap_seeds and training.devices > 1:
            fail("--vmap-seeds and --devices: choose one")
        if os.environ.get("JAX_COORDINATOR_ADDRESS"):
            fail("a sweep is one process; JAX_COORDINATOR_ADDRESS is set")
        check_positive(devices=training.devices)
        included = [sweep.finished(folder) for folder in command.include]
        planned = [] if command.report_only else [command.out / run_name(c) for c in configs]
        # What cannot stand in one report shows at once, not after hours of training.
        check_alike([*sweep.find(command.out), *included], planned)
        try:
            if not command.report_only:
                train_all(command, training, configs)
            with stoppable(lambda: "what is evaluated is kept"):
                write_report(command.out, included)
        except SystemExit as stop:
            if isinstance(stop.code, int) and stop.code > SIGNALLED:
                console.print("the sweep goes on with the same command")
            raise


def train_all(command: Command, training: TrainingCommand, configs: Sequence[TrainConfig]) -> None:
    """Trains what is not finished.

    Args:
      training: the flags of the training command.
      configs: what to train.
    """
    from tdanet_jax.models.classes import ClassVocabulary
    from tdanet_jax.models.factory import make_model
    from tdanet_jax.task import resolve
    from tdanet_jax.training import devices

    devices.connect(training.devices)
    devices.keep_compiled()
    configs = [resolve(config) for config in configs]
    folders = [command.out / run_name(config) for config in configs]
    # All are looked at before the first trains: a clash shows at once, not after hours, and so does
    # a model that cannot be made.
    for config in configs:
        make_model(config, ClassVocabulary())
    states = [sweep.progress(*pair) for pair in zip(folders, configs, strict=True)]
    todo = [
        (config, folder)
        for config, folder, state in zip(configs, folders, states, strict=True)
        if state != "finished"
    ]
    console.print(f"{len(configs)} runs, {len(configs) - len(todo)} finished, {len(todo)} to train")
    from tdanet_jax import runs

    if command.vmap_seeds:
        together: dict[tuple[str, str], list[tuple[TrainConfig, Path]]] = {}
        for config, folder in todo:
            together.setdefault((config.split, config.model), []).append((config, folder))
        for members in together.values():
            with stoppable(lambda: "every seed is saved") as stop, Reports(stop) as reports:
                runs.train_together(members, reports)
        return
    for config, folder in todo:
        advice = functools.partial(how_to_continue, folder, config)
        with stoppable(advice) as stop, Reports(stop) as reports:
            runs.train(
                config,
                folder,
                resume=(folder / CONFIG_FILE).exists(),
                device_count=training.devices,
                callbacks=reports,
            )


@contextlib.contextmanager
def alone(out: Path) -> Iterator[None]:
    """Inside, no other process reports in `out`; waits for one that does."""
    from tdanet_jax.io import files

    with contextlib.ExitStack() as locks:
        try:
            locks.enter_context(files.locked(out))
        except BlockingIOError:
            console.print(f"{out}: another process reports; waiting for it ...")
            locks.enter_context(files.locked(out, wait=True))
        yield


def write_report(out: Path, included: Sequence[FinishedRun]) -> None:
    """Evaluates what is missing, and writes the report on the runs in `out` and on others."""
    from tdanet_jax.analysis import figures
    from tdanet_jax.evaluation import report
    from tdanet_jax.io import files
    from tdanet_jax.tools import benchmarking

    if not (sweep.find(out) or included):
        fail(f"{out}: no finished run")
    for folder in sweep.find_others(out):
        warnings.warn(f"{folder}: no run (it has no {CONFIG_FILE}); left out", stacklevel=2)
    with alone(out):
        runs = [*sweep.find(out), *included]  # another process may have finished some meanwhile
        check_alike(runs)
        with reporter("histories") as show:
            for run, points in sweep.histories(runs, out):
                show(points / max(run.config.history, points), run.folder.name)
        curves = sweep_report.make_curves(runs, out)
        console.print("measuring inference ...")
        found = sweep_report.Report(
            runs=runs,
            untrained=sweep.untrained(runs, UNTRAINED_SEED),
            costs=costs(runs),
            curves=curves,
            machine=benchmarking.processor(),
            code=report.code_version(),
        )
        names = {split: f"learning_curve-{file_name(split)}.png" for split in curves}
        for split, name in names.items():
            figures.evaluated_curves(curves[split], f"Split {split}, test rooms", out / name)
        content = json.dumps(sweep_report.to_json(found), indent=2)
        files.write_text(out / "report.json", content + "\n")
        files.write_text(out / "report.md", sweep_report.markdown(found, names))
    console.print(f"wrote {out / 'report.md'}")


def check_alike(runs: Sequence[FinishedRun], planned: Sequence[Path] = ()) -> None:
    """Fails if the runs, and those in folders where they will be, cannot stand in one table."""
    folders = [run.folder for run in runs]
    names = [folder.name for folder in (*folders, *(set(planned) - set(folders)))]
    for name in names:
        if names.count(name) > 1:
            fail(f"two runs are called {name}: rename one of the folders")
    for run in runs:
        if run.results["data_version"] != runs[0].results["data_version"]:
            fail(f"{run.folder}: was evaluated on other scene tables than {runs[0].folder}")


def costs(runs: Sequence[FinishedRun]) -> dict[str, Cost]:
    """Parameters and inference time of every network among the runs, on this machine, by label."""
    from tdanet_jax.task import load_task
    from tdanet_jax.tools import benchmarking

    measured: dict[object, Cost] = {}
    out: dict[str, Cost] = {}
    for label, run in zip(sweep.labels(runs), runs, strict=True):
        config = run.config
        network = config.model, config.network, config.data, config.word_vectors
        if network not in measured:
            task = load_task(config)
            rows = {batch: benchmarking.decision_row(task, batch, repeats=5) for batch in BATCHES}
            measured[network] = Cost(
                model=config.model,
                parameters=rows[BATCHES[0]]["parameters"],
                milliseconds={batch: row["milliseconds"] for batch, row in rows.items()},
            )
        out.setdefault(label, measured[network])
    return out


if __name__ == "__main__":
    main()
