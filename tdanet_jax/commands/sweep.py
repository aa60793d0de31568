"""Trains several splits, models and seeds, and reports them in the form of the paper's tables.

    tdanet sweep --splits 18/4 14/8 --seeds 0 1 2 --minutes 10 --out runs/sweep

Every other flag is one of the training command and applies to all runs. After an interruption, run
the same command again: it skips the finished runs and continues the unfinished one. Writes a folder
for each run, report.md, report.json and the learning curves into --out.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import itertools
import json
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

import tyro

from tdanet_jax.commands.console import (
    check_folder,
    check_positive,
    console,
    fail,
    one_line_errors,
    one_line_usage,
    reporter,
)
from tdanet_jax.commands.running import Command as TrainingCommand
from tdanet_jax.commands.running import how_to_continue, parse_command, stoppable
from tdanet_jax.commands.streams import output_may_break
from tdanet_jax.config import CONFIG_FILE, OWN_TASK, TrainConfig, run_name
from tdanet_jax.io import files
from tdanet_jax.splits import file_name
from tdanet_jax.workflows import sweep, sweep_report
from tdanet_jax.workflows.sweep import FinishedRun
from tdanet_jax.workflows.sweep_report import Cost

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
    "--resume": "the same command again instead",
    "--log": "none",
    "--tensorboard": "none",
}


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains several splits, models and seeds; every other flag is one of `tdanet train`."""

    out: Path
    """Folder of the sweep: a folder for each run, and the report."""
    splits: tuple[str, ...] = ("18/4",)
    """Splits to train on: 22/0, 18/4, 14/8, or comma-separated unseen classes
    (Mug,Vase,CD,Towel)."""
    models: tuple[str, ...] = ("tdanet",)
    """Models to train, ablations included; see --model of `tdanet train`."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of each."""
    vmap_seeds: bool = False
    """Train the seeds of a split and model in one vmapped call; needs a budget in steps. For
    accelerators: on a CPU it is slower than one seed after the other, unless networks are small."""
    report_only: bool = False
    """Train nothing; report on the finished runs in --out and on --include."""
    include: tuple[Path, ...] = ()
    """Finished runs elsewhere to include in the report."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    words = sys.argv[1:] if arguments is None else arguments
    with one_line_errors():
        with one_line_usage():
            command, rest = tyro.cli(
                Command,
                args=words,
                return_unknown_args=True,
                prog="tdanet sweep",
                description=__doc__,
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
            fail("--vmap-seeds needs a budget in --steps: all seeds must end together")
        if command.vmap_seeds and training.devices > 1:
            fail("--vmap-seeds and --devices: choose one")
        if os.environ.get("JAX_COORDINATOR_ADDRESS"):
            fail("a sweep is one process; JAX_COORDINATOR_ADDRESS is set")
        check_positive(devices=training.devices)
        included = [sweep.finished(folder) for folder in command.include]
        planned = [] if command.report_only else [command.out / run_name(c) for c in configs]
        # Runs that do not fit into one report are refused now, not after hours of training.
        check_alike([*sweep.find(command.out), *included], planned)
        check_folder(command.out)
        with output_may_break():
            run(command, training, configs, included)


def run(
    command: Command,
    training: TrainingCommand,
    configs: Sequence[TrainConfig],
    included: Sequence[FinishedRun],
) -> None:
    """Trains and reports; says how to continue if a signal stops it."""
    try:
        if not command.report_only:
            train_all(command, training, configs)
        with stoppable(lambda: "finished evaluations are kept"):
            write_report(command.out, included)
    except SystemExit as stop:
        if isinstance(stop.code, int) and stop.code > SIGNALLED:
            console.print("run the same command again to continue the sweep")
        raise


def train_all(command: Command, training: TrainingCommand, configs: Sequence[TrainConfig]) -> None:
    """Trains the runs that are not finished.

    Args:
      training: the flags of the training command.
      configs: all runs.
    """
    from tdanet_jax.models.classes import ClassVocabulary
    from tdanet_jax.models.factory import make_model
    from tdanet_jax.task import resolve
    from tdanet_jax.training import devices
    from tdanet_jax.workflows.train import train, train_together

    devices.connect(training.devices)
    devices.keep_compiled()
    todo = []
    # A clash, or a model that cannot be made, shows before anything trains.
    for config in map(resolve, configs):
        make_model(config, ClassVocabulary())
        folder = command.out / run_name(config)
        if sweep.progress(folder, config) != "finished":
            todo.append((config, folder))
    console.print(f"{len(configs)} runs, {len(configs) - len(todo)} finished, {len(todo)} to train")
    if command.vmap_seeds:
        for _, members in itertools.groupby(todo, lambda run: (run[0].split, run[0].model)):
            with stoppable(lambda: "every seed is saved") as reports:
                train_together([*members], reports)
        return
    for config, folder in todo:
        advice = functools.partial(how_to_continue, folder, config)
        resume, count = (folder / CONFIG_FILE).exists(), training.devices
        with stoppable(advice) as reports:
            train(config, folder, resume=resume, device_count=count, callbacks=reports)


@contextlib.contextmanager
def alone(out: Path) -> Iterator[None]:
    """Inside, no other process reports in `out`; waits for one that does."""
    with contextlib.ExitStack() as locks:
        try:
            locks.enter_context(files.locked(out))
        except BlockingIOError:
            console.print(f"{out}: another process reports; waiting for it ...")
            locks.enter_context(files.locked(out, wait=True))
        yield


def write_report(out: Path, included: Sequence[FinishedRun]) -> None:
    """Evaluates what is missing, and reports on the runs in `out` and on those included."""
    from tdanet_jax.analysis import figures
    from tdanet_jax.evaluation import report
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
    """Fails if the runs, and those planned, do not fit into one table."""
    folders = [run.folder for run in runs]
    names = [folder.name for folder in (*folders, *(set(planned) - set(folders)))]
    for name in names:
        if names.count(name) > 1:
            fail(f"two runs are called {name}: rename one of the folders")
    for run in runs:
        if run.results["data_version"] != runs[0].results["data_version"]:
            fail(f"{run.folder}: was evaluated on other scene tables than {runs[0].folder}")


def costs(runs: Sequence[FinishedRun]) -> dict[str, Cost]:
    """Parameters and inference time on this machine of every network among the runs, by label."""
    from tdanet_jax.task import load_task
    from tdanet_jax.tools import benchmarking

    measured: dict[object, Cost] = {}
    out: dict[str, Cost] = {}
    for label, run in zip(sweep.labels(runs), runs, strict=True):
        config = run.config
        network = config.model, config.network, config.data, config.word_vectors
        if network not in measured:
            task = load_task(OWN_TASK.locate(config, run.folder))
            rows = {batch: benchmarking.decision_row(task, batch, repeats=5) for batch in BATCHES}
            milliseconds = {batch: row["milliseconds"] for batch, row in rows.items()}
            measured[network] = Cost(config.model, rows[BATCHES[0]]["parameters"], milliseconds)
        out.setdefault(label, measured[network])
    return out
