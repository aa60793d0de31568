"""Evaluates trained agents or untrained policies on the fixed test episodes.

    tdanet evaluate --checkpoint runs/... --policy greedy
    tdanet evaluate --checkpoint runs/... --history
    tdanet evaluate --checkpoint runs/a --checkpoint runs/b --out compared
    tdanet evaluate --checkpoint runs/... --noise sweep
    tdanet evaluate --policy random --split 18/4 --out random

Writes results.json, results.md and episodes.jsonl for one agent; for several checkpoints or a
history, evaluations.json, evaluations.md, episodes.jsonl and, of a history, learning_curve.png.
With --noise sweep: noise.json, noise.md and noise.png.
"""

from __future__ import annotations

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Literal

import tyro

from tdanet_jax.commands.console import (
    RunPath,
    console,
    fail,
    folder_for,
    one_line_errors,
    parse,
    print_summary,
    reporter,
)
from tdanet_jax.config import TrainConfig
from tdanet_jax.eval_config import OWN_TASK, EvalConfig
from tdanet_jax.io import files
from tdanet_jax.io.bundled_agents import folder_of
from tdanet_jax.sense_noise import SWEEP, SWEEP_FILE


@dataclasses.dataclass(frozen=True)
class Command:
    """Evaluates trained agents or untrained policies on the fixed test episodes."""

    checkpoint: Annotated[tuple[RunPath, ...], tyro.conf.UseAppendAction] = ()
    """Folder of a run, whose newest checkpoint is evaluated, or a bundled agent's name. Repeat the
    flag for more runs: they are played in one compiled call and reported together."""
    history: bool = False
    """Evaluate the whole history of each run instead of its newest checkpoint, and draw the
    learning curve."""
    policy: Literal["sample", "greedy", "random", "shortest_path"] = "sample"
    """sample and greedy: how a network's actions are chosen. random and shortest_path (the optimum)
    need no checkpoint."""
    split: str | None = None
    """Split for policies that need no checkpoint; by default 18/4. A run has its own."""
    validation: bool = False
    """Evaluate policies that need no checkpoint on the validation episodes."""
    test: tyro.conf.OmitArgPrefixes[EvalConfig] = OWN_TASK
    seed: int | None = None
    """Seed of sampled actions. By default the run's own, which gives the results that its training
    ended with; 0 for the policies that need no checkpoint."""
    out: Path | None = None
    """Folder to write; must be new or empty. By default <checkpoint>/<policy> for one checkpoint,
    <checkpoint>/history-<policy> for its history, <checkpoint>/noise-<policy> for a sweep over
    noise, runs/<policy> without one; of a bundled agent, in runs/<name>. A sweep over noise
    continues in its folder."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet evaluate")
        trained = command.policy in ("sample", "greedy")
        if trained and not command.checkpoint:
            fail(f"--policy {command.policy} needs --checkpoint")
        if not trained and command.checkpoint:
            fail(f"--policy {command.policy} takes no --checkpoint")
        if not trained and command.history:
            fail(f"--policy {command.policy} has no --history")
        if trained and command.split is not None:
            fail(f"--split {command.split}: a run is evaluated on its own split")
        if trained and command.validation:
            fail("--validation: a trained run has its own rooms and classes")
        if len({run.resolve() for run in command.checkpoint}) < len(command.checkpoint):
            fail("--checkpoint: a run is given twice")
        if len(command.checkpoint) > 1 and command.out is None:
            fail("several checkpoints need --out")
        sweep = command.test.noise == SWEEP
        if sweep and (not trained or command.history):
            fail("--noise sweep: plays the newest networks of runs, without --history")
        config = TrainConfig(
            split=TrainConfig().split if command.split is None else command.split,
            validation=command.validation,
            seed=command.seed or 0,
        )
        test = dataclasses.replace(command.test, noise=None) if sweep else command.test
        test.check(command.policy, command.seed)
        if not trained:
            test.with_targets(dataclasses.replace(config, data=test.data)).check()
        for run in command.checkpoint:
            if folder_of(run) != run:
                fail(f"--checkpoint {run}: give the run; --history plays the points of its history")
        kind = f"noise-{command.policy}" if sweep else command.policy
        kind = f"history-{command.policy}" if command.history else kind
        folder = command.out or (*map(folder_for, command.checkpoint), Path("runs"))[0] / kind
        if sweep and (folder / SWEEP_FILE).is_file():
            files.check_writable(folder)  # it continues
        else:
            files.check_empty(folder)
        if sweep:
            play_noise(command, test, folder)
        else:
            play(command, config, folder)


def play_noise(command: Command, test: EvalConfig, folder: Path) -> None:
    """Plays the episodes at five levels of each kind of noise and writes the report."""
    from tdanet_jax.training import devices
    from tdanet_jax.workflows.noise import evaluate_noise

    devices.keep_compiled()
    devices.start()
    with reporter("evaluating") as show:
        evaluate_noise(command.checkpoint, command.policy, test, command.seed, folder, show)
    console.print(f"wrote {folder / 'noise.md'}")


def play(command: Command, config: TrainConfig, folder: Path) -> None:
    """Plays the episodes and writes the report.

    Args:
      config: rooms, classes and words of a policy that needs no checkpoint.
    """
    from tdanet_jax.training import devices
    from tdanet_jax.workflows.evaluate import evaluate

    devices.keep_compiled()
    devices.start()
    runs = command.checkpoint
    several = command.history or len(runs) > 1
    if not several:
        console.print("playing the episodes ...")
    with reporter("evaluating") if several else contextlib.nullcontext() as show:
        results = evaluate(
            runs if several else runs[0] if runs else None,
            command.policy,
            config=config,
            history=command.history,
            test=command.test,
            seed=command.seed,
            out=folder,
            on_network=show,
        )
    if not several:
        print_summary(results)
    console.print(f"wrote {folder / ('evaluations.md' if several else 'results.md')}")
