"""The training loop: a run in its folder, from its first update to the end of its budget."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.io import files
from tdanet_jax.models.factory import unused_flags
from tdanet_jax.task import Task, load_task, resolve
from tdanet_jax.training import checkpoint, devices
from tdanet_jax.training.callbacks import Callbacks
from tdanet_jax.training.journal import Row, tensorboard_sink
from tdanet_jax.training.run import Run, chunks_together

Result = TypeVar("Result")


def train(
    config: TrainConfig | None,
    folder: Path,
    then: Callable[[Run], Result],
    *,
    resume: bool = False,
    device_count: int = 1,
    tensorboard: bool = False,
    callbacks: Callbacks,
) -> Result | None:
    """Trains a run to the end of its budget; see `tdanet_jax.runs.train`.

    Args:
      then: called with the finished run while its folder is still locked; its result is returned.
    """
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
    # What "auto" means here is part of the run: it continues with the same products elsewhere.
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
        if not learn([run], ([row] for row in run.chunks()), callbacks, sink):
            return None
        return then(run) if devices.is_lead() else None


def train_together(
    members: Sequence[tuple[TrainConfig, Path]],
    then: Callable[[Run], Any],
    callbacks: Callbacks,
) -> None:
    """Trains seeds of one configuration in one vmapped call.

    Args:
      members: configurations that differ in their seed alone, and their folders, new or begun.
      then: called with each run at the end of the budget; not if they are stopped early.
    """
    with contextlib.ExitStack() as locks:
        task = load_task(members[0][0], callbacks.on_rooms)
        runs = []
        for config, folder in members:
            locks.enter_context(files.locked(folder))
            prepare(folder, config, task, (folder / CONFIG_FILE).exists(), callbacks)
            runs.append(Run(folder, config, task))
            callbacks.on_note(f"{runs[-1].title} -> {folder}")
        if learn(runs, chunks_together(runs), callbacks):
            for run in runs:
                then(run)


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
