"""Trains an agent on the iTHOR training rooms and reports SR and SPL in the test rooms.

    tdanet train --split 18/4

Writes run.json, config.json, classes.json, metrics.jsonl, checkpoints, results.json, results.md,
episodes.jsonl and learning_curve.png into --out (by default
runs/<split>-<model>-seed<seed>-<time>).
"""

from __future__ import annotations

import dataclasses
import shlex
import sys
import time
from pathlib import Path

from tdanet_jax.commands.console import check_positive, console, fail, one_line_errors
from tdanet_jax.commands.running import (
    IF_MEMORY_ENDS,
    Command,
    how_to_continue,
    parse_command,
    stoppable,
    trust,
)
from tdanet_jax.commands.streams import output_may_break
from tdanet_jax.config import TrainConfig, run_name
from tdanet_jax.io import files
from tdanet_jax.training import cluster
from tdanet_jax.training.journal import check_log


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    words = sys.argv[1:] if arguments is None else arguments
    with one_line_errors(IF_MEMORY_ENDS):
        command = parse_command(words)
        config = check(command)
        folder = command.resume or command.out or default_folder(config)
        if command.resume is None and not cluster.several():
            files.check_empty(folder, f" (to continue there: --resume {shlex.quote(str(folder))})")
        with output_may_break():
            run(command, config, folder, shlex.join(["tdanet", "train", *words]))


def check(command: Command) -> TrainConfig:
    """The run's configuration; fails early on flags that do not go together."""
    config = command.run
    if command.resume is not None:
        given = dataclasses.replace(
            command, run=TrainConfig(), devices=1, log=(), tensorboard=False
        )
        new = dataclasses.replace(
            TrainConfig().with_budget(config), data=config.data, word_vectors=config.word_vectors
        )
        if given != Command(run=TrainConfig(), resume=command.resume) or config != new:
            fail(
                "--resume continues a run as it began: it takes a new budget (--steps, --episodes, "
                "--minutes), the new place of its rooms (--data) and of its word vectors "
                "(--word-vectors), --devices and --log alone"
            )
        from tdanet_jax.workflows.train import resumed

        config = resumed(command.resume, config)
    else:
        config.check()
        config = config.normalised()
        if command.out is None and cluster.several():
            fail("a run of several processes needs --out, a folder that all of them can access")
    check_positive(devices=command.devices)
    check_log(command.sinks)
    return config


def default_folder(config: TrainConfig) -> Path:
    """runs/18-4-tdanet-seed0-20260131-120000."""
    return Path("runs") / f"{run_name(config)}-{time.strftime('%Y%m%d-%H%M%S')}"


def run(command: Command, config: TrainConfig, folder: Path, typed: str) -> None:
    """Trains to the end of the budget, then evaluates and reports.

    Args:
      command: what was asked for.
      config: the run.
      folder: where everything is written.
      typed: the command line, for `run.json`.
    """
    flags = command.devices, command.sinks
    with stoppable(lambda: how_to_continue(folder, config, *flags), typed) as reports:
        from tdanet_jax.workflows.train import train

        results = train(
            config,
            folder,
            resume=command.resume is not None,
            device_count=command.devices,
            log=command.sinks,
            callbacks=reports,
        )
        if results is not None and (setting := trust(config)):
            console.print(f"custom code: to evaluate or load this run, export {setting}")
