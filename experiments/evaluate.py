"""Evaluates trained agents, or one that needs no training, on the fixed test episodes.

    python -m experiments.evaluate --checkpoint runs/... --policy greedy
    python -m experiments.evaluate --checkpoint runs/... --history
    python -m experiments.evaluate --checkpoint runs/a --checkpoint runs/b --out compared
    python -m experiments.evaluate --policy random --split 18/4 --out random

One agent: results.json, results.md and episodes.jsonl. Several checkpoints, or a run's history:
evaluations.json, evaluations.md, episodes.jsonl and, of a history, learning_curve.png.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from experiments.console import (
    check_empty,
    console,
    fail,
    one_line_errors,
    parse,
    print_summary,
    reporter,
)
from tdanet_jax.config import TrainConfig

if TYPE_CHECKING:
    from tdanet_jax.evaluation.saved_networks import Saved


@dataclasses.dataclass(frozen=True)
class Command:
    """Evaluates trained agents, or one that needs no training, on the fixed test episodes."""

    checkpoint: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """Folder of a run; its newest checkpoint is evaluated. Give the flag again for more runs: they
    are played in one compiled call and set beside one another."""
    history: bool = False
    """Evaluate the whole history of each run in place of its newest checkpoint, and draw the
    learning curve."""
    policy: Literal["sample", "greedy", "random", "shortest_path"] = "sample"
    """sample and greedy: how the network's actions are chosen. random and shortest_path need no
    checkpoint; the latter knows the way."""
    split: str | None = None
    """Split of the policies that need no checkpoint, as of the training command; by default 18/4. A
    run is evaluated on its own."""
    validation: bool = False
    """Their episodes are those that `--validation` of the training command leaves for choices."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, in place of those of the run, or of the
    bundled ones."""
    word_vectors: str | None = None
    """File of word vectors, where rooms hold classes that the bundled ones lack; for the policies
    that need no checkpoint. A run has its own."""
    seed: int | None = None
    """Seed of sampled actions. By default the run's own, which gives the results that its training
    ended with; 0 for the policies that need no checkpoint."""
    out: Path | None = None
    """Folder to write; must be new or empty. By default <checkpoint>/<policy> for one checkpoint,
    <checkpoint>/history-<policy> for its history, runs/<policy> without one."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    command = parse(Command, arguments, prog="evaluate")
    with one_line_errors():
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
        if trained and command.word_vectors is not None:
            fail(f"--word-vectors {command.word_vectors}: a trained run has its own")
        if len(set(command.checkpoint)) < len(command.checkpoint):
            fail("--checkpoint: a run is given twice")
        untrained_config(command).check()
        folder = command.out or default_folder(command)
        check_empty(folder)
        from tdanet_jax.evaluation import saved_networks
        from tdanet_jax.training import devices

        devices.keep_compiled()
        if not trained:
            evaluate_untrained(command, folder)
            return
        networks = [
            n
            for run in command.checkpoint
            for n in saved_networks.find(run, command.history, command.data)
        ]
        if command.history or len(networks) > 1:
            evaluate_several(command, networks, folder)
        else:
            evaluate_one(command, networks[0], folder)


def default_folder(command: Command) -> Path:
    """Where to write if nothing is said."""
    if len(command.checkpoint) > 1:
        fail("several checkpoints need --out")
    kind = f"history-{command.policy}" if command.history else command.policy
    return (command.checkpoint[0] if command.checkpoint else Path("runs")) / kind


def untrained_config(command: Command) -> TrainConfig:
    """The task and seed of the policies that need no checkpoint."""
    return TrainConfig(
        split=TrainConfig().split if command.split is None else command.split,
        validation=command.validation,
        data=command.data,
        word_vectors=command.word_vectors,
        seed=command.seed or 0,
    )


def evaluate_untrained(command: Command, folder: Path) -> None:
    """Random or the shortest path."""
    from tdanet_jax.evaluation import episodes, policies, report, rollout
    from tdanet_jax.task import load_task

    config = untrained_config(command)
    task = load_task(config)
    lists = episodes.load(task.tables, task.split, task.extras)
    make = {"random": policies.random, "shortest_path": policies.shortest_path}[command.policy]
    played = rollout.evaluate_lists(make(), None, task.eval_params, lists, config.seed)
    provenance = report.Provenance(
        split=task.split.name,
        model=command.policy,
        policy=command.policy,
        episodes_trained=0,
        seed=config.seed,
        evaluation_seed=config.seed,
        steps=0,
        data_version=task.tables.data_version,
        data=command.data,
    )
    folder.mkdir(parents=True, exist_ok=True)
    print_summary(report.write(folder, provenance, task.tables, played))
    console.print(f"wrote {folder / report.RESULTS_PAGE}")


def evaluate_one(command: Command, network: Saved, folder: Path) -> None:
    """The newest checkpoint of one run."""
    from tdanet_jax.evaluation import report, saved_networks

    done = next(saved_networks.evaluate([network], command.policy == "greedy", command.seed))
    folder.mkdir(parents=True, exist_ok=True)
    print_summary(report.write(folder, done.provenance, done.task.tables, done.played))
    console.print(f"wrote {folder / report.RESULTS_PAGE}")


def evaluate_several(command: Command, networks: Sequence[Saved], folder: Path) -> None:
    """Several runs, or the history of one or more."""
    from tdanet_jax.analysis import figures
    from tdanet_jax.evaluation import comparison, report, saved_networks
    from tdanet_jax.io import files

    results, records, played = {}, [], {}
    greedy = command.policy == "greedy"
    with reporter("evaluating") as show:
        for done in saved_networks.evaluate(networks, greedy, command.seed):
            results[done.saved] = done.results()
            if not command.history:
                played[done.saved] = done.columns()
            where = {"run": str(done.saved.run), "updates": done.snapshot.updates}
            records += [{**where, **row} for row in report.all_rows(done.task.tables, done.played)]
            show(len(results) / len(networks), f"{done.saved.run.name} {done.snapshot.updates:,}")
    ordered: list[comparison.Result] = [results[network] for network in networks]
    if not command.history:
        ordered = comparison.with_differences(ordered, [played[network] for network in networks])
    names = short_names(command.checkpoint)
    page = comparison.markdown(
        f"{len(networks)} checkpoints", ordered, [names[network.run] for network in networks]
    )
    folder.mkdir(parents=True, exist_ok=True)
    report.write_rows(folder, records)
    files.write_text(folder / "evaluations.md", page)
    if command.history:
        curves = [
            comparison.curve(name, [[r for n, r in results.items() if n.run == run]])
            for run, name in names.items()
        ]
        figures.evaluated_curves(
            curves, "Test rooms, while training", folder / "learning_curve.png"
        )
    files.write_text(folder / "evaluations.json", json.dumps(ordered, indent=2) + "\n")
    console.print(f"wrote {folder / 'evaluations.md'}")


def short_names(runs: Sequence[Path]) -> dict[Path, str]:
    """A name for each run: its folder's, or the whole path where two are called alike."""
    last = [run.resolve().name for run in runs]
    return {
        run: name if last.count(name) == 1 else str(run)
        for run, name in zip(runs, last, strict=True)
    }


if __name__ == "__main__":
    main()
