"""Trains an agent on the iTHOR training rooms and reports SR and SPL in the test rooms.

    python -m experiments.train_zero_shot --split 18/4

Writes config.json, classes.json, metrics.jsonl, checkpoints, results.json, results.md,
episodes.jsonl and learning_curve.png into --out (by default
runs/<split>-<model>-seed<seed>-<time>).
"""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import os
import signal
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from experiments.console import (
    StopRequest,
    check_empty,
    check_positive,
    console,
    fail,
    one_line_errors,
    parse,
    print_summary,
    reporter,
    stoppable,
)
from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, PRESETS, TrainConfig, run_name
from tdanet_jax.models.registry import MODELS

if TYPE_CHECKING:
    from tdanet_jax.evaluation.episodes import Episodes
    from tdanet_jax.task import Task
    from tdanet_jax.training.run import Row, Run


@dataclasses.dataclass(frozen=True)
class Command:
    """Trains an agent on the iTHOR training rooms and reports SR and SPL in the test rooms."""

    run: tyro.conf.OmitArgPrefixes[TrainConfig]
    preset: Literal["default", "best", "paper"] = "default"
    """Defaults of the other flags. best: what did best on validation, beyond the paper: --odometry,
    --triangulation, --gamma 0.97 and --size-noise 0.5. paper: the reference's constants and its
    budget of 6 M episodes."""
    out: Path | None = None
    """Folder for everything that the run writes; must be new or empty."""
    resume: Path | None = None
    """Folder of a run to go on with; beside it, --devices, --tensorboard and a new budget, which
    replaces the run's (its schedules then follow the new one)."""
    tensorboard: bool = False
    """Also write TensorBoard events (needs tensorboardX)."""
    devices: int = 1
    """Devices to split the environments over, in this process; a CPU is split into as many. More
    processes, here or on other machines, join through JAX_COORDINATOR_ADDRESS, JAX_NUM_PROCESSES
    and JAX_PROCESS_ID."""


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
            folder, config = command.resume, resumed(command)
        else:
            config = command.run
            config.check()
            config = config.normalised()
            joined = bool(os.environ.get("JAX_COORDINATOR_ADDRESS"))
            if command.out is None and joined:
                fail("a run of several processes needs --out: a folder that all of them see")
            folder = command.out or default_folder(config)
            if not joined:
                check_new(folder)
        check_positive(devices=command.devices)
        if command.tensorboard and importlib.util.find_spec("tensorboardX") is None:
            fail("--tensorboard needs tensorboardX: pip install tensorboardX")
        train(config, folder, command)


def resumed(command: Command) -> TrainConfig:
    """The configuration of the run to go on with, with the new budget if there is one."""
    new, folder = command.run, command.resume
    others = dataclasses.replace(command, run=TrainConfig(), devices=1, tensorboard=False)
    if others != Command(run=TrainConfig(), resume=folder) or new != TrainConfig().with_budget(new):
        fail(
            "--resume goes on as the run began: beside it, a new budget (--steps, --episodes, "
            "--minutes), --devices and --tensorboard alone"
        )
    from tdanet_jax.training.checkpoint import is_passed_on

    assert folder is not None
    config = configs.load(folder / CONFIG_FILE)
    if is_passed_on(folder):
        fail(f"--resume {folder}: an agent that was passed on; there is nothing to go on from")
    if new != TrainConfig():
        config = config.with_budget(new)
        config.check()
    return config


def check_new(folder: Path) -> None:
    """Fails if a run cannot begin in `folder`."""
    check_empty(folder, f" (to go on there: --resume {folder})")


def default_folder(config: TrainConfig) -> Path:
    """runs/18-4-tdanet-seed0-20260131-120000."""
    return Path("runs") / f"{run_name(config)}-{time.strftime('%Y%m%d-%H%M%S')}"


def train(config: TrainConfig, folder: Path, command: Command) -> None:
    """Trains to the end of the budget, then evaluates and reports."""
    with stoppable(lambda: how_to_go_on(folder, config.model)) as stop:
        from tdanet_jax.evaluation import episodes
        from tdanet_jax.io import files
        from tdanet_jax.models.registry import unused_flags
        from tdanet_jax.task import load_task, resolve
        from tdanet_jax.training import devices
        from tdanet_jax.training.run import Run

        mesh = devices.connect(command.devices)
        devices.keep_compiled()
        console.quiet = not devices.is_lead()
        with reporter("rooms", transient=True) as report_rooms:
            task = load_task(config, lambda done, total: report_rooms(done / total, "rebuilt"))
        lists = episodes.load(task.tables, task.split, task.extras)
        for flag in unused_flags(config, task.classes) if command.resume is None else ():
            console.print(f"note: {flag} changes nothing for {config.model}")
        # What `auto` means here is part of the run: it goes on with the same products elsewhere.
        config = resolve(config)
        with files.locked(folder) if devices.is_lead() else contextlib.nullcontext():
            if devices.is_lead():
                prepare(folder, config, task, resume=command.resume is not None)
            devices.wait_for_all("the folder is there")
            with stop.deferred():
                run = Run(folder, config, task, mesh)
            devices.wait_for_all("the run is loaded")  # before anyone writes
            console.print(f"{title(run)} -> {folder}")
            learn(run, command.tensorboard and devices.is_lead(), stop)
            if devices.is_lead():
                report_on(run, lists)


def prepare(folder: Path, config: TrainConfig, task: Task, resume: bool) -> None:
    """What a run finds in its folder when it begins."""
    from tdanet_jax.io import files
    from tdanet_jax.training.checkpoint import FOLDER

    if not resume:
        check_new(folder)  # again: another process may have begun there meanwhile
    for path in files.remove_partial(folder) + files.remove_partial(folder / FOLDER):
        console.print(f"removed {path}: half-written when the run was stopped")
    configs.save(config, folder / CONFIG_FILE)
    task.classes.save(folder)


def trust(model: str) -> str:
    """The setting without which commands refuse a run's model; none for our own models."""
    return "" if model in MODELS else f"{configs.TRUST}={model}"


def how_to_go_on(folder: Path, model: str) -> str:
    """What to say to someone who has stopped a run."""
    from tdanet_jax.training.checkpoint import Checkpoints

    if not (folder / CONFIG_FILE).exists():
        return "the run had not begun"
    again = f"{trust(model)} python -m experiments.train_zero_shot --resume {folder}".lstrip()
    return f"{Checkpoints(folder).latest() or 0:,} updates are saved; go on with: {again}"


def title(run: Run) -> str:
    """tdanet, split 18/4, seed 0; or tdanet, --odometry, ..."""
    from tdanet_jax.evaluation.report import agent_name

    name = agent_name(
        run.config.model,
        "odometry" in run.model.spec.sensors,
        "triangulation" in run.model.spec.sensors,
    )
    return f"{name}, split {run.task.split.name}, seed {run.config.seed}"


def learn(run: Run, tensorboard: bool, stop: StopRequest) -> None:
    """Trains to the end of the budget or to a signal in any process, and saves."""
    from tdanet_jax.training import devices

    run.save()  # who cannot save learns it before training, not after
    saved = run.seconds
    console.print("compiling ...")
    with (
        stop.deferred(),
        reporter("training") as show,
        metrics_sink(run.folder, tensorboard) as sink,
    ):
        for row in run.chunks():
            show(run.progress, figures_of(row))
            sink(row)
            if devices.anywhere(stop.signal is not None):
                stop.signal = stop.signal or signal.SIGTERM
                break
            if run.seconds - saved > 60 * run.config.checkpoint_minutes:
                run.save()
                saved = run.seconds
        run.save()


def figures_of(row: Row) -> str:
    """The figures beside the progress bar."""
    skipped = f"  {row['skipped']} updates skipped" if row["skipped"] else ""

    def shown(name: str, factor: float, digits: int) -> str:
        return "-" if row[name] is None else f"{factor * row[name]:.{digits}f}"

    return (
        f"{row['steps_per_second']:,.0f} steps/s  {row['episodes']:,} episodes  "
        f"SR {shown('success', 100, 1)}  SPL {shown('spl', 100, 1)}  "
        f"entropy {shown('entropy', 1, 2)}{skipped}"
    )


@contextlib.contextmanager
def metrics_sink(folder: Path, tensorboard: bool) -> Iterator[Callable[[Row], None]]:
    """Where rows of metrics go beside `metrics.jsonl`: TensorBoard, or nowhere.

    Events that cannot be written are given up with a warning; training goes on.
    """
    if not tensorboard:
        yield lambda row: None
        return
    # Not SummaryWriter: its thread dies of a full disk, and its queue then blocks for ever.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.summary import scalar

    writer: EventsWriter | None = None
    lost = False

    def write(row: Row) -> None:
        nonlocal writer, lost
        if lost:
            return
        try:
            if writer is None:
                (folder / "tensorboard").mkdir(exist_ok=True)
                writer = EventsWriter(str(folder / "tensorboard" / "events"))
            for name in (name for name in row if name != "steps" and row[name] is not None):
                summary = scalar(f"train/{name}", row[name])
                writer.write_event(Event(wall_time=time.time(), step=row["steps"], summary=summary))
            writer.flush()
        except OSError as error:
            lost = True
            warnings.warn(f"{folder / 'tensorboard'}: given up ({error.strerror})", stacklevel=2)

    yield write


def report_on(run: Run, lists: Mapping[str, Episodes]) -> None:
    """Evaluates the agent and writes the results and the learning curve."""
    import jax

    from tdanet_jax.analysis import figures
    from tdanet_jax.evaluation import policies, report, rollout
    from tdanet_jax.training.run import read_metrics

    figures.learning_curve(read_metrics(run.folder), title(run), run.folder / "learning_curve.png")
    console.print("evaluating ...")
    task, seed = run.task, run.config.seed
    policy = policies.network(run.model, task.words)
    weights = jax.device_get(run.state.params)
    played = rollout.evaluate_lists(policy, weights, task.eval_params, lists, seed)
    provenance = report.Provenance(
        split=task.split.name,
        model=run.config.model,
        policy="sample",
        episodes_trained=int(run.state.episodes),
        seed=seed,
        evaluation_seed=seed,
        steps=run.steps,
        data_version=task.tables.data_version,
        data=run.config.data,
        image=task.image,
        odometry="odometry" in task.spec.sensors,
        triangulation="triangulation" in task.spec.sensors,
    )
    print_summary(report.write(run.folder, provenance, task.tables, played))
    console.print(f"wrote {run.folder / 'results.md'}")
    if setting := trust(run.config.model):
        console.print(f"a model of your own: to evaluate or load it, export {setting}")


if __name__ == "__main__":
    main()
