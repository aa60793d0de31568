"""Evaluates a trained agent, or one that needs no training, on the fixed test episodes.

    python -m experiments.evaluate --checkpoint runs/... --policy greedy
    python -m experiments.evaluate --policy random --split 18/4 --out random

Writes results.json, results.md and episodes.jsonl into --out (by default <checkpoint>/<policy>).
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from experiments.console import console, fail, one_line_errors, parse, print_summary
from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, TrainConfig

if TYPE_CHECKING:
    from tdanet_jax.task import Task


@dataclasses.dataclass(frozen=True)
class Command:
    """Evaluates a trained agent, or one that needs no training, on the fixed test episodes."""

    checkpoint: Path | None = None
    """Folder of a run; its newest checkpoint is evaluated."""
    policy: Literal["sample", "greedy", "random", "shortest_path"] = "sample"
    """sample and greedy: how the network's actions are chosen. random and shortest_path need no
    checkpoint; the latter knows the way."""
    split: str = "18/4"
    """Split of the policies that need no checkpoint."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, in place of those of the run, or of the
    bundled ones."""
    seed: int = 0
    """Seed of sampled actions."""
    out: Path | None = None
    """Folder to write; must be new or empty."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    command = parse(Command, arguments, prog="evaluate")
    with one_line_errors():
        trained = command.policy in ("sample", "greedy")
        if trained and command.checkpoint is None:
            fail(f"--policy {command.policy} needs --checkpoint")
        if not trained and command.checkpoint is not None:
            fail(f"--policy {command.policy} takes no --checkpoint")
        if command.checkpoint is None:
            config = TrainConfig(split=command.split, data=command.data)
            config.check()
        else:
            config = configs.load(command.checkpoint / CONFIG_FILE)
            if command.data is not None:
                config = dataclasses.replace(config, data=command.data)
        folder = command.out or (command.checkpoint or Path("runs")) / command.policy
        if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
            fail(f"--out {folder}: exists and is not empty")
        evaluate(command, config, folder)


def evaluate(command: Command, config: TrainConfig, folder: Path) -> None:
    """Plays the episodes and writes the results."""
    from tdanet_jax import episodes, evaluation, policies, report
    from tdanet_jax.task import load_task
    from tdanet_jax.training import Run

    task = load_task(config)
    tables = task.tables
    lists = episodes.load(tables, task.split, task.extras)
    weights, trained, steps = None, 0, 0
    if command.checkpoint is None:
        policy = {"random": policies.random, "shortest_path": policies.shortest_path}[
            command.policy
        ]()
    else:
        check_vocabulary(command.checkpoint, config, task)
        run = Run(command.checkpoint, config, task, other_rooms=command.data is not None)
        if run.fresh:
            fail(f"{command.checkpoint}: no checkpoint")
        policy = policies.network(run.model, task.words, greedy=command.policy == "greedy")
        weights, trained, steps = run.state.params, int(run.state.episodes), run.steps
    played = evaluation.evaluate_lists(policy, weights, task.eval_params, lists, command.seed)
    provenance = report.Provenance(
        split=task.split.name,
        model=command.policy if weights is None else config.model,
        policy=command.policy,
        episodes_trained=trained,
        seed=config.seed if weights is not None else command.seed,
        steps=steps,
        data_version=tables.data_version,
        data=config.data,
    )
    folder.mkdir(parents=True, exist_ok=True)
    print_summary(report.write(folder, provenance, tables, played))
    console.print(f"wrote {folder / 'results.md'}")


def check_vocabulary(run: Path, config: TrainConfig, task: Task) -> None:
    """Ends the program if a model that numbers its classes is to see rooms with others."""
    from tdanet_jax import classes

    names = classes.load(run).names
    numbered = task.model.encoder.ROWS == "class" or task.model.encoder.IMAGE
    if numbered and names and names != task.tables.classes:
        fail(f"--data {config.data}: {config.model} knows the classes of {run} alone, in number")


if __name__ == "__main__":
    main()
