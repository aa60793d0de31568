"""Training: a run in its folder, from its first update to its results in the test rooms."""

from __future__ import annotations

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax

from tdanet_jax import config as configs
from tdanet_jax.analysis import figures
from tdanet_jax.analysis.episode_lookup import name_ranges
from tdanet_jax.config import CONFIG_FILE, WORD_VECTORS_FILE, TrainConfig
from tdanet_jax.eval_config import OWN_TASK
from tdanet_jax.evaluation import episodes, policies, report, rollout
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import regular
from tdanet_jax.models.factory import check_trained, unused_flags
from tdanet_jax.scenes.dataset import idle_rooms
from tdanet_jax.task import Task, load_task, resolve
from tdanet_jax.training import checkpoint, devices, run_file
from tdanet_jax.training.callbacks import Callbacks
from tdanet_jax.training.journal import METRICS_FILE, SINKS, Row, check_log, read_metrics
from tdanet_jax.training.run import Run, chunks_together

#: Between two looks at whether the next rooms are there.
SECONDS_OF_WAITING = 1.0


def train(
    config: TrainConfig | None,
    folder: Path | str,
    *,
    resume: bool = False,
    device_count: int = 1,
    log: Sequence[str] = (),
    tensorboard: bool = False,
    callbacks: Callbacks | None = None,
) -> dict[str, Any] | None:
    """Trains a run to the end of its budget, evaluates it in the test rooms, and writes its report.

    Args:
      config: the run. With `resume`, only its budget counts, as the run's new one, and `data` and
        `word_vectors`, the new places of the run's files; None keeps the run's own.
      folder: where everything is written; new or empty, unless `resume`.
      resume: continue the run in `folder` from its newest checkpoint, bit for bit.
      device_count: devices to split the environments over, in this process.
      log: where else the metrics go: "tensorboard", "wandb", "csv" (`training.journal.SINKS`).
      tensorboard: deprecated until 0.4, `log=["tensorboard"]`.
      callbacks: progress, and a way to stop.

    Returns:
      The content of `results.json`; None if the run was stopped early, and in every process of a
      distributed run but the lead.

    Raises:
      ValueError: a value of the configuration, the folder or a file is not as it must be, or too
        many updates were not finite; one line that names it.
    """
    folder, callbacks = Path(folder), callbacks or Callbacks()
    log = [log] if isinstance(log, str) else log
    if tensorboard:
        warnings.warn('use log=["tensorboard"]', DeprecationWarning, stacklevel=2)
        log = [*log, "tensorboard"]
    check_log(log)
    if resume:
        config = resumed(folder, config)
    elif config is None:
        raise ValueError("a new run needs a configuration")
    else:
        config.check()
        config = config.normalised()
    mesh = devices.connect(device_count)
    learner = config.learner
    devices.check_divides(learner.num_envs, mesh, minibatches=learner.num_minibatches)
    devices.keep_compiled()
    task = load_task(_located(config, folder), callbacks.on_rooms)
    lists = episodes.load(task.tables, task.split, task.extras)  # errors show before training
    if not resume:
        check_trained(config, task.model)
    _note(config, task, not resume, callbacks)
    # What "auto" means here is part of the run: it continues with the same products elsewhere.
    config = resolve(config)
    with files.locked(folder) if devices.is_lead() else contextlib.nullcontext():
        if devices.is_lead() and not resume:
            _check_new(folder)
        devices.wait_for_all("the folder is there")
        with callbacks.shield():
            run = Run(folder, config, task, mesh)
        if resume:
            _check_longer(run)
        devices.wait_for_all("the run is loaded")  # before anyone writes
        if devices.is_lead():
            _prepare(run, callbacks)
        callbacks.on_note(f"{run.title} -> {folder}")
        sinks = [SINKS[name][1](folder) for name in log] if devices.is_lead() else []
        finished = _learn([run], ([row] for row in run.chunks()), callbacks, sinks)
        return _report(run, lists, callbacks) if finished and devices.is_lead() else None


def train_together(members: Sequence[tuple[TrainConfig, Path | str]], callbacks: Callbacks) -> None:
    """Trains seeds of one configuration in one vmapped call, and reports on each.

    Args:
      members: configurations that differ in their seed alone, and their folders, new or begun.
      callbacks: progress, and a way to stop.
    """
    pairs = [(config, Path(folder)) for config, folder in members]
    with contextlib.ExitStack() as locks:
        task = load_task(_located(*pairs[0]), callbacks.on_rooms)
        lists = episodes.load(task.tables, task.split, task.extras)
        new = any(not (folder / CONFIG_FILE).exists() for _, folder in pairs)
        _note(pairs[0][0], task, new, callbacks)
        runs: list[Run] = []
        for config, folder in pairs:
            locks.enter_context(files.locked(folder))
            if not (folder / CONFIG_FILE).exists():
                _check_new(folder)
            runs.append(Run(folder, config, task, pools=runs[0].pools if runs else None))
            _prepare(runs[-1], callbacks)
            callbacks.on_note(f"{runs[-1].title} -> {folder}")
        if _learn(runs, chunks_together(runs), callbacks):
            for run in runs:
                _report(run, lists, callbacks)


def _note(config: TrainConfig, task: Task, new: bool, callbacks: Callbacks) -> None:
    """Says which flags of a new run change nothing, and which rooms are left out."""
    if new:
        idle = dict.fromkeys(unused_flags(config, task.classes), f"for {config.model}")
        for flag, reason in {**idle, **configs.idle_flags(config)}.items():
            callbacks.on_note(f"note: {flag} changes nothing {reason}")
    if rooms := idle_rooms(task.tables, task.split):
        callbacks.on_note(f"note: no target can be found in {name_ranges(rooms)}: left out")


def resumed(folder: Path | str, new: TrainConfig | None = None) -> TrainConfig:
    """The configuration of the run in a folder, with the budget and the files of another if any.

    Raises:
      ValueError: the folder holds no run, or nothing to continue from; or it has the bundled
        word vectors, and the other has not.
    """
    folder = Path(folder)
    config = configs.load(folder / CONFIG_FILE)
    if checkpoint.is_shared(folder):
        raise ValueError(f"--resume {folder}: a shared agent; there is nothing to continue from")
    if new is not None and new.budget:
        config = config.with_budget(new)
    if new is not None and new.data is not None:
        config = dataclasses.replace(config, data=new.normalised().data)
    if new is not None and new.word_vectors is not None:
        if config.word_vectors is None:
            raise ValueError(
                f"--word-vectors {new.word_vectors}: {folder} was trained with the bundled ones"
            )
        config = dataclasses.replace(config, word_vectors=new.normalised().word_vectors)
    config.check()
    return config


def _located(config: TrainConfig, folder: Path) -> TrainConfig:
    """The configuration of a new run, or of one that has begun, with the files that are there."""
    begun = (folder / CONFIG_FILE).exists()
    if not begun:
        return config
    located = OWN_TASK.locate(config, folder)
    return dataclasses.replace(config, data=located.data, word_vectors=located.word_vectors)


def _check_new(folder: Path) -> None:
    """Raises ValueError unless a new run can begin in a folder."""
    files.check_empty(folder, f" (to continue there: --resume {folder})")


def _check_longer(run: Run) -> None:
    """Raises ValueError if a run that continues has already spent its new budget."""
    before = configs.load(run.folder / CONFIG_FILE).budget
    if run.config.budget != before and run.progress >= 1.0:
        done = f"{run.steps:,} steps, {int(run.state.episodes):,} episodes"
        given = ", ".join(f"--{name} {limit}" for name, limit in run.config.budget.items())
        raise ValueError(
            f"{given}: {run.folder} has already trained as long, {done} and "
            f"{run.seconds / 60:.1f} minutes; give a larger budget, or none to evaluate it again"
        )


def _prepare(run: Run, callbacks: Callbacks) -> None:
    """Writes what a run's folder holds from the start; `--resume` writes what is missing anew.

    The configuration comes first: a folder that has one can be resumed, any other is still new.
    """
    folder, task = run.folder, run.task
    commit = report.code_version()
    with callbacks.shield():
        regular.check_tree(folder)  # where a link leads, nothing is written or deleted
        for path in files.remove_partial(folder) + files.remove_partial(folder / checkpoint.FOLDER):
            callbacks.on_note(f"removed {path}: half-written when the run was stopped")
        if run.progress < 1.0:  # results there are of a former budget, which this run goes beyond
            for name in (report.RESULTS_FILE, report.RESULTS_PAGE, report.EPISODES_FILE):
                (folder / name).unlink(missing_ok=True)
        configs.save(run.config, folder / CONFIG_FILE)
        if run.config.word_vectors is not None and not (folder / WORD_VECTORS_FILE).exists():
            task.vectors.save_copy(folder / WORD_VECTORS_FILE, task.tables.classes)
        task.classes.save(folder)
        run_file.add(folder, run_file.this_process(callbacks.command, commit, run.mesh))


def _learn(
    runs: Sequence[Run],
    chunks: Iterator[list[Row]],
    callbacks: Callbacks,
    sinks: Sequence[Callable[[Row], None]] = (),
) -> bool:
    """Trains and saves; returns False if a process has stopped it before the budget's end."""

    def save() -> list[float]:
        for run in runs:
            run.save()
        return [run.seconds for run in runs]

    def stops() -> bool:
        if stopped := _waits_or_stops(runs, callbacks):
            callbacks.on_stop()
            save()
        return stopped

    saved = save()  # a folder that cannot be written shows before training, not after
    pools = runs[0].pools
    if pools.unreached:
        callbacks.on_note(
            f"note: the budget ends before the turn of {pools.unreached} of {pools.count} pools of "
            "rooms; with a lower --pool-updates turns are shorter"
        )
    callbacks.on_note("compiling ...")
    with callbacks.shield(), contextlib.closing(pools):
        if stops():
            return False
        before = [run.steps for run in runs]
        for rows in chunks:
            trained = [run for run, steps in zip(runs, before, strict=True) if run.steps > steps]
            before = [run.steps for run in runs]
            callbacks.on_rows(trained, rows)
            for sink in sinks:
                sink(rows[0])
            if stops():
                return False
            unsaved = max(run.seconds - at for run, at in zip(runs, saved, strict=True))
            if unsaved > 60 * runs[0].config.checkpoint_minutes:
                saved = save()
        save()
    return True


def _waits_or_stops(runs: Sequence[Run], callbacks: Callbacks) -> bool:
    """Waits until the rooms of the next chunk are there; True if a process stops the runs."""
    furthest = max(run.steps for run in runs)
    run = next((run for run in runs if run.steps < furthest), runs[0])  # that trains next
    waits = False
    while not devices.anywhere(callbacks.should_stop()):
        done = run.wait_for_rooms(SECONDS_OF_WAITING if waits else 0.0)
        if not devices.anywhere(done is not None):
            return False
        if not waits:
            callbacks.on_note("waiting for the next pool of rooms ...")
        waits = True
        callbacks.on_rooms(*done or (1.0, 1))
    return True


def _report(run: Run, lists: Mapping[str, Episodes], callbacks: Callbacks) -> dict[str, Any]:
    """Evaluates a finished run; writes its learning curve and its results."""
    if (run.folder / METRICS_FILE).exists():
        curve = run.folder / "learning_curve.png"
        figures.learning_curve(read_metrics(run.folder), run.title, curve)
    else:
        callbacks.on_note(f"note: no {METRICS_FILE}, and so no learning curve")
    callbacks.on_note("evaluating ...")
    task, seed = run.task, run.config.seed
    policy = policies.network(run.model, task.words)
    weights = jax.device_get(run.state.params)
    played = rollout.evaluate_lists(policy, weights, task.eval_params, lists, seed)
    provenance = report.Provenance.of(
        task, run.config, "sample", seed, int(run.state.episodes), int(run.state.updates)
    )
    results = report.results(provenance, task.tables, played, run.folder)
    callbacks.on_results(run.folder, results)
    return results
