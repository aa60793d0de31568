"""One way to train: a run in its folder, from its first update to its results."""

from __future__ import annotations

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.evaluation import episodes
from tdanet_jax.evaluation.evaluate import report_run
from tdanet_jax.io import files
from tdanet_jax.models.factory import unused_flags
from tdanet_jax.task import Task, load_task, resolve
from tdanet_jax.training import checkpoint, devices
from tdanet_jax.training.journal import Row, tensorboard_sink
from tdanet_jax.training.run import Run, chunks_together


class Callbacks:
    """What a caller hears while runs train. Override the methods that you need."""

    def on_rooms(self, done: int, total: int) -> None:
        """So many of the bundled rooms have been rebuilt; only on a machine's first start."""

    def on_note(self, text: str) -> None:
        """Something worth a line."""

    def on_rows(self, runs: Sequence[Run], rows: Sequence[Row]) -> None:
        """A chunk of updates is done: a row of metrics for each of the runs that took part."""

    def should_stop(self) -> bool:
        """Whether to save and stop after this chunk."""
        return False

    def on_stop(self) -> None:
        """The runs stop early, here or because another process does, and are being saved."""

    def shield(self) -> AbstractContextManager[None]:
        """Entered around work that no signal may interrupt."""
        return contextlib.nullcontext()


def train(
    config: TrainConfig | None,
    folder: Path | str,
    *,
    resume: bool = False,
    device_count: int = 1,
    tensorboard: bool = False,
    callbacks: Callbacks | None = None,
) -> dict[str, Any] | None:
    """Trains a run to the end of its budget, evaluates it in the test rooms, and writes its report.

    Args:
      config: the run. With `resume`, only its budget counts, as the run's new one; None keeps the
        run's own.
      folder: where everything is written; new or empty, unless `resume`.
      resume: continue the run in `folder` from its newest checkpoint, bit for bit.
      device_count: devices to split the environments over, in this process.
      tensorboard: also write TensorBoard events (needs tensorboardX).
      callbacks: progress, and a way to stop.

    Returns:
      The content of `results.json`; None if the run was stopped early, and in all processes of a
      distributed run but the lead.

    Raises:
      ValueError: a value of the configuration, the folder or a file is not as it must be, or too
        many updates were not finite; one line that names it.
    """
    folder, callbacks = Path(folder), callbacks or Callbacks()
    if resume:
        config = resumed(folder, config)
    else:
        if config is None:
            raise ValueError("a new run needs a configuration")
        config.check()
        config = config.normalised()
    mesh = devices.connect(device_count)
    devices.keep_compiled()
    task = load_task(config, callbacks.on_rooms)
    for flag in () if resume else unused_flags(config, task.classes):
        callbacks.on_note(f"note: {flag} changes nothing for {config.model}")
    # What `auto` means here is part of the run: elsewhere it continues with the same products.
    config = resolve(config)
    with files.locked(folder) if devices.is_lead() else contextlib.nullcontext():
        if devices.is_lead():
            prepare(folder, config, task, resume, callbacks)
        devices.wait_for_all("the folder is there")
        with callbacks.shield():
            run = Run(folder, config, task, mesh)
        devices.wait_for_all("the run is loaded")  # before anyone writes
        callbacks.on_note(f"{run.title} -> {folder}")
        sink = tensorboard_sink(folder) if tensorboard and devices.is_lead() else None
        if not learn([run], run_rows(run), callbacks, sink) or not devices.is_lead():
            return None
        return finish(run, callbacks)


def train_together(
    members: Sequence[tuple[TrainConfig, Path]], callbacks: Callbacks | None = None
) -> bool:
    """Trains seeds of one configuration in one vmapped call, then reports on each.

    Args:
      members: configurations that differ in their seed alone, and folders, new or begun.

    Returns:
      False if they were stopped early.
    """
    callbacks = callbacks or Callbacks()
    with contextlib.ExitStack() as locks:
        task = load_task(members[0][0], callbacks.on_rooms)
        runs = []
        for config, folder in members:
            locks.enter_context(files.locked(folder))
            prepare(folder, config, task, (folder / CONFIG_FILE).exists(), callbacks)
            runs.append(Run(folder, config, task))
            callbacks.on_note(f"{runs[-1].title} -> {folder}")
        if not learn(runs, chunks_together(runs), callbacks):
            return False
        for run in runs:
            finish(run, callbacks)
    return True


def resumed(folder: Path, budget: TrainConfig | None = None) -> TrainConfig:
    """The configuration of the run in a folder, with a new budget if one is given.

    Raises:
      ValueError: the folder holds no run, or nothing to continue from.
    """
    config = configs.load(folder / CONFIG_FILE)
    if checkpoint.is_shared(folder):
        raise ValueError(f"--resume {folder}: a shared agent; there is nothing to continue from")
    if budget is not None and any(getattr(budget, name) is not None for name in configs.BUDGETS):
        config = config.with_budget(budget)
        config.check()
    return config


def prepare(
    folder: Path, config: TrainConfig, task: Task, resume: bool, callbacks: Callbacks
) -> None:
    """Leaves in a run's folder what a run begins with."""
    if not resume:
        files.check_empty(folder, f" (to continue there: --resume {folder})")
    for path in files.remove_partial(folder) + files.remove_partial(folder / checkpoint.FOLDER):
        callbacks.on_note(f"removed {path}: half-written when the run was stopped")
    configs.save(config, folder / CONFIG_FILE)
    task.classes.save(folder)


def run_rows(run: Run) -> Iterator[list[Row]]:
    """`Run.chunks`, as a list for each chunk."""
    for row in run.chunks():
        yield [row]


def learn(
    runs: Sequence[Run], chunks: Iterator[list[Row]], callbacks: Callbacks, sink: Any = None
) -> bool:
    """Trains to the end of the budget, with checkpoints; saves in the end.

    Returns:
      Whether it came to the end of the budget: False if a process stops it.
    """

    def save() -> float:
        for run in runs:
            run.save()
        return runs[0].seconds

    saved = save()  # a folder that cannot be written shows before training, not after
    callbacks.on_note("compiling ...")
    with callbacks.shield():
        for rows in chunks:
            callbacks.on_rows(runs, rows)
            if sink is not None:
                sink(rows[0])
            if devices.anywhere(callbacks.should_stop()):
                callbacks.on_stop()
                save()
                return False
            if runs[0].seconds - saved > 60 * runs[0].config.checkpoint_minutes:
                saved = save()
        save()
    return True


def finish(run: Run, callbacks: Callbacks) -> dict[str, Any]:
    """Evaluates a run that has ended and writes its learning curve and report."""
    from tdanet_jax.analysis import figures
    from tdanet_jax.training.journal import read_metrics

    figures.learning_curve(read_metrics(run.folder), run.title, run.folder / "learning_curve.png")
    callbacks.on_note("evaluating ...")
    lists = episodes.load(run.task.tables, run.task.split, run.task.extras)
    return report_run(run, lists)
