"""Trains several splits, models and seeds, and reports them in the form of the paper's tables.

    tdanet sweep --splits 18/4 14/8 --seeds 0 1 2 --minutes 10 --out runs/sweep

Every other flag is one of the training command and applies to all runs. After an interruption, run
the same command again: it skips the finished runs and continues the unfinished one. Runs that
another process is training are skipped; the exit status is 1 if the report lacks any of them.
Writes a folder for each run, report.md, report.json and the learning curves into --out.
"""

from __future__ import annotations

import contextlib
import dataclasses
import difflib
import functools
import itertools
import json
import os
import shlex
import sys
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import tyro

from tdanet_jax.commands.console import (
    RunPath,
    check_folder,
    check_positive,
    console,
    fail,
    one_line_errors,
    one_line_usage,
    reporter,
)
from tdanet_jax.commands.running import IF_MEMORY_ENDS, how_to_continue, parse_command, stoppable
from tdanet_jax.commands.running import Command as TrainingCommand
from tdanet_jax.commands.streams import output_may_break
from tdanet_jax.config import CONFIG_FILE, TrainConfig, run_name
from tdanet_jax.eval_config import OWN_TASK, rooms_played
from tdanet_jax.io import files
from tdanet_jax.splits import file_name
from tdanet_jax.targets import PAPER, naming
from tdanet_jax.training import cluster
from tdanet_jax.workflows import sweep, sweep_report
from tdanet_jax.workflows.sweep import FinishedRun
from tdanet_jax.workflows.sweep_report import Cost

#: Batches whose inference time is reported.
BATCHES = (1, 1024)
#: Seed of the random actions that runs are compared with.
UNTRAINED_SEED = 0
#: Exit statuses above this one mean that a signal stopped the program.
SIGNALLED = 128
#: Exit status if the report lacks runs that were left to other processes.
INCOMPLETE = 1
#: Flags of the training command that a sweep sets itself.
OWN = {
    "--split": "--splits",
    "--model": "--models",
    "--seed": "--seeds",
    "--resume": "the same command again instead",
    "--log": "none",
    "--tensorboard": "none",
}
#: Fields of `Command` that say what to train.
TRAINED = ("splits", "models", "seeds", "per_model", "vmap_seeds")
#: Flags of the training command that all models of a sweep share.
SHARED = ("--out", "--devices", "--data", "--targets", "--validation")


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
    per_model: tuple[str, ...] = ()
    """Flags for one model alone, in quotes: "savn: --num-envs 64 --learning-rate 1e-3"."""
    vmap_seeds: bool = False
    """Train the seeds of a split and model in one vmapped call; needs a budget in steps. For
    accelerators: on a CPU it is slower than one seed after the other, unless networks are small.
    Seeds of savn and li are trained one by one all the same."""
    shard: str | None = None
    """I/N: train the I-th of N shares of the runs, I from 1, and write no report. The machines need
    not share a folder: afterwards, copy all runs into one and use --report-only
    (docs/cluster.md)."""
    report_only: bool = False
    """Train nothing; report on the finished runs in --out and on --include."""
    include: tuple[RunPath, ...] = ()
    """Finished runs elsewhere to include in the report, or bundled agents, by name."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    words = sys.argv[1:] if arguments is None else arguments
    with one_line_errors(IF_MEMORY_ENDS):
        with one_line_usage():
            command, rest = tyro.cli(
                Command,
                args=words,
                return_unknown_args=True,
                prog="tdanet sweep",
                description=__doc__,
            )
        if command.report_only and (given := [*rest[:1], *given_of(command, TRAINED)]):
            fail(f"--report-only trains nothing and takes no {given[0]}")
        check_own(rest)
        training = parse_command(rest)
        base, per_model = training.run.normalised(), parse_per_model(command, rest)
        configs = sweep.plan(base, command.splits, command.models, command.seeds, per_model)
        configs = share(command, configs)
        if command.vmap_seeds and any({*config.budget} - {"steps"} for config in configs):
            fail("--vmap-seeds needs a budget in --steps: all seeds must end together")
        if command.vmap_seeds and training.devices > 1:
            fail("--vmap-seeds and --devices: choose one")
        if os.environ.get(cluster.ADDRESS):
            fail(f"a sweep is one process; {cluster.ADDRESS} is set")
        if cluster.several() and not command.shard and not command.report_only:
            fail("a sweep is one process, and several were started: give each its --shard")
        check_positive(devices=training.devices)
        included = [sweep.finished(folder) for folder in command.include]
        planned = [] if command.report_only else [command.out / run_name(c) for c in configs]
        # Runs that do not fit into one report are refused now, not after hours of training.
        check_alike([*sweep.find(command.out), *included], planned)
        check_folder(command.out)
        with output_may_break():
            run(command, training, configs, included, shlex.join(["tdanet", "sweep", *words]))


def given_of(command: Command, names: Sequence[str]) -> list[str]:
    """The flags among these fields whose values are not the defaults."""
    given = (name for name in names if getattr(command, name) != getattr(Command, name))
    return [f"--{name.replace('_', '-')}" for name in given]


def share(command: Command, configs: Sequence[TrainConfig]) -> list[TrainConfig]:
    """The runs of `--shard`; seeds that are trained together stay together."""
    if command.shard is None:
        return [*configs]
    if command.report_only:
        fail("--shard: --report-only trains nothing, and reports on all runs")
    if command.include:
        fail("--include: --shard reports nothing; give it with --report-only, when all are done")
    number, _, count = command.shard.partition("/")
    if not (number.isdecimal() and count.isdecimal() and 1 <= int(number) <= int(count)):
        fail(f"--shard {command.shard}: must be I/N, I from 1 to N")
    groups = [[*group] for _, group in itertools.groupby(configs, alike(command))]
    return [*itertools.chain(*groups[int(number) - 1 :: int(count)])]


def alike(command: Command) -> Callable[[TrainConfig], Any]:
    """The key of runs that are trained in one call, which follow one another."""
    if command.vmap_seeds:
        return lambda config: (config.split, config.model, config.network)
    return lambda config: config


def check_own(words: Sequence[str], where: str = "") -> None:
    """Fails if there is a flag of the training command that a sweep sets itself."""
    for word in words:
        if word.partition("=")[0] in OWN:
            fail(f"{where}{word}: a sweep takes {OWN[word.partition('=')[0]]}")


def parse_per_model(command: Command, rest: Sequence[str]) -> dict[str, TrainConfig]:
    """The configurations of the models with flags of their own.

    Args:
      command: the sweep.
      rest: the flags of the training command that apply to all runs.
    """
    out: dict[str, TrainConfig] = {}
    for given in command.per_model:
        model, colon, flags = given.partition(":")
        where = f"--per-model {model}: "
        if not colon:
            fail(f'--per-model {given}: write "MODEL: FLAGS", in quotes')
        if model not in command.models:
            near = difflib.get_close_matches(model, command.models, 1)
            hint = f"did you mean {near[0]}?" if near else f"there are {', '.join(command.models)}"
            fail(f"{where}not one of --models; {hint}")
        if model in out:
            fail(f"{where}is given twice")
        try:
            words = shlex.split(flags)
            check_own(words, where)
            for word in words:
                if word.partition("=")[0].replace("_", "-").replace("--no-", "--") in SHARED:
                    fail(f"{where}{word}: must be the same for all models")
            out[model] = parse_command([*rest, *words], where).run.normalised()
            out[model].check()
        except ValueError as error:
            fail(f"{where}{error}")
    return out


def run(
    command: Command,
    training: TrainingCommand,
    configs: Sequence[TrainConfig],
    included: Sequence[FinishedRun],
    typed: str,
) -> None:
    """Trains and reports; says how to continue if a signal stops it."""
    from tdanet_jax.evaluation import report

    report.code_version()  # as it is now
    try:
        left = [] if command.report_only else train_all(command, training, configs, typed)
        if command.shard is None:
            with stoppable(lambda: "finished evaluations are kept"):
                unfinished = write_report(command.out, included, left)
        else:
            unfinished = sweep.unfinished(command.out)
    except SystemExit as stop:
        if isinstance(stop.code, int) and stop.code > SIGNALLED:
            console.print("run the same command again to continue the sweep")
        raise
    if left:
        console.print(f"left to other processes: {', '.join(folder.name for folder in left)}")
    if missing := [f.name for f in unfinished if command.report_only or f in left]:
        console.print(f"not finished: {', '.join(missing)}")
        raise SystemExit(INCOMPLETE)
    if command.shard is not None:
        console.print("when all shares are done, and their runs lie in one folder:")
        console.print(f"tdanet sweep --out {shlex.quote(str(command.out))} --report-only")


def train_all(
    command: Command, training: TrainingCommand, configs: Sequence[TrainConfig], typed: str
) -> list[Path]:
    """Trains the runs that are not finished.

    Args:
      command: the sweep.
      training: the flags of the training command.
      configs: all runs.
      typed: the command line, for their `run.json`.

    Returns:
      The folders of runs that are left to other processes, which train them.
    """
    from tdanet_jax.models.classes import ClassVocabulary
    from tdanet_jax.models.factory import check_trained, make_model
    from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic
    from tdanet_jax.training import devices

    cluster.leave()  # each share has runs of its own
    mesh = devices.connect(training.devices)
    devices.keep_compiled()
    todo, adaptive = [], set()
    # A clash, or a model that cannot be made, shows before anything trains.
    for asked in configs:
        folder = command.out / run_name(asked)
        config = sweep.settled(command.out, asked)
        with naming("--models", "--model"):
            model, learner = make_model(config, ClassVocabulary()), config.learner
        devices.check_divides(learner.num_envs, mesh, minibatches=learner.num_minibatches)
        progress = sweep.progress(folder, config)
        if progress == "new":
            check_trained(config, model)
        if progress != "finished":
            todo.append((config, folder))
        if isinstance(model, AdaptiveActorCritic):
            adaptive.add(config.model)
    console.print(f"{len(configs)} runs, {len(configs) - len(todo)} finished, {len(todo)} to train")
    left: list[Path] = []
    key = alike(command)
    for _, group in itertools.groupby(todo, lambda run: key(run[0])):
        members = [*group]
        model_name, vmapped = members[0][0].model, command.vmap_seeds
        if vmapped and model_name in adaptive:
            # Together, they would compute an inner step for every action.
            console.print(f"note: seeds of {model_name}, which adapts, are trained one by one")
            vmapped = False
        while members := [
            (config, folder)
            for config, folder in members
            if folder not in left and sweep.progress(folder, config) != "finished"
        ]:
            try:
                train_members(members, vmapped, training.devices, typed)
                break
            except BlockingIOError as held:
                if held.filename not in [str(folder) for _, folder in members]:
                    raise
                left.append(Path(held.filename))
                console.print(f"{held.filename}: another process trains it; skipped")
    return left


def train_members(
    members: Sequence[tuple[TrainConfig, Path]], together: bool, device_count: int, typed: str
) -> None:
    """Trains runs one after another, or the seeds of one split and model together.

    Raises:
      BlockingIOError: another process trains one of them; the error names its folder.
    """
    from tdanet_jax.workflows.train import train, train_together

    if together:
        with stoppable(lambda: "every seed is saved", typed) as reports:
            train_together(members, reports)
        return
    for config, folder in members:
        resume = (folder / CONFIG_FILE).exists()
        advice = functools.partial(how_to_continue, folder, config, device_count)
        with stoppable(advice, typed) as reports:
            train(config, folder, resume=resume, device_count=device_count, callbacks=reports)


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


def write_report(
    out: Path, included: Sequence[FinishedRun], left: Sequence[Path] = ()
) -> list[Path]:
    """Evaluates what is missing, and reports on the runs in `out` and on those included.

    Args:
      out: the folder of the sweep.
      included: finished runs elsewhere.
      left: runs that other processes train.

    Returns:
      The folders of the runs in `out` that are not finished.
    """
    from tdanet_jax.analysis import figures
    from tdanet_jax.evaluation import report
    from tdanet_jax.training import devices

    if not (sweep.find(out) or included):
        if left:
            console.print(f"{out}: no finished run to report on yet")
            return [*left]
        fail(f"{out}: no finished run")
    for folder in sweep.find_others(out):
        warnings.warn(f"{folder}: no run (it has no {CONFIG_FILE}); left out", stacklevel=2)
    with alone(out):
        runs = [*sweep.find(out), *included]  # another process may have finished some meanwhile
        done = [run.folder for run in runs]
        begun = dict.fromkeys([*left, *sweep.unfinished(out)])
        unfinished = [folder for folder in begun if folder not in done]
        check_alike(runs)
        with reporter("histories") as show:
            for run, part in sweep.histories(runs, out):
                show(part, run.folder.name)
        curves = sweep_report.make_curves(runs, out)
        console.print("measuring inference ...")
        found = sweep_report.Report(
            runs=runs,
            untrained=sweep.untrained(runs, UNTRAINED_SEED),
            costs=costs(runs),
            curves=curves,
            machine=devices.processor(),
            code=report.code_version(),
            unfinished=[folder.name for folder in unfinished],
        )
        names = {split: f"learning_curve-{file_name(split)}.png" for split in curves}
        for split, name in names.items():
            title = f"Split {split}, {rooms_played(None, [split])}"
            figures.evaluated_curves(curves[split], title, out / name)
        content = json.dumps(sweep_report.to_json(found), indent=2)
        files.write_text(out / "report.json", content + "\n")
        files.write_text(out / "report.md", sweep_report.markdown(found, names))
    console.print(f"wrote {out / 'report.md'}")
    return unfinished


def check_alike(runs: Sequence[FinishedRun], planned: Sequence[Path] = ()) -> None:
    """Fails if the runs, and those planned, do not fit into one report."""
    folders = [run.folder for run in runs]
    names = [folder.name for folder in (*folders, *(set(planned) - set(folders)))]
    for name in names:
        if names.count(name) > 1:
            fail(f"two runs are called {name}: rename one of the folders")
    first: dict[str, FinishedRun] = {}
    for run in runs:
        alike = first.setdefault(run.results["split"], run)
        for field, what in (("data_version", "scene tables"), ("targets", "targets")):
            if run.results.get(field, PAPER) != alike.results.get(field, PAPER):
                fail(f"{run.folder}: was evaluated on other {what} than {alike.folder}")


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
