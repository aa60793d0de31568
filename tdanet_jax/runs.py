"""Whole runs, for the public functions and the commands: train and report, evaluate and report."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax

from tdanet_jax.analysis import figures
from tdanet_jax.config import TrainConfig
from tdanet_jax.evaluation import comparison, episodes, policies, report, rollout, saved_networks
from tdanet_jax.evaluation.policies import Policy
from tdanet_jax.evaluation.saved_networks import SavedNetwork
from tdanet_jax.io import files
from tdanet_jax.task import load_task
from tdanet_jax.training import train as loop
from tdanet_jax.training.callbacks import Callbacks
from tdanet_jax.training.journal import read_metrics
from tdanet_jax.training.run import Run

#: Policies that need no checkpoint.
UNTRAINED: dict[str, Callable[[], Policy]] = {
    "random": policies.random,
    "shortest_path": policies.shortest_path,
}


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
      The content of `results.json`; None if the run was stopped early, and in every process of a
      distributed run but the lead.

    Raises:
      ValueError: a value of the configuration, the folder or a file is not as it must be, or too
        many updates were not finite; one line that names it.
    """
    callbacks = callbacks or Callbacks()
    return loop.train(
        config,
        Path(folder),
        lambda run: finish(run, callbacks),
        resume=resume,
        device_count=device_count,
        tensorboard=tensorboard,
        callbacks=callbacks,
    )


def finish(run: Run, callbacks: Callbacks) -> dict[str, Any]:
    """Evaluates a run at the end of its budget; writes its learning curve and its report."""
    figures.learning_curve(read_metrics(run.folder), run.title, run.folder / "learning_curve.png")
    callbacks.on_note("evaluating ...")
    task, config = run.task, run.config
    lists = episodes.load(task.tables, task.split, task.extras)
    weights = jax.device_get(run.state.params)
    policy = policies.network(run.model, task.words)
    played = rollout.evaluate_lists(policy, weights, task.eval_params, lists, config.seed)
    provenance = report.Provenance.of(
        task, config, "sample", config.seed, int(run.state.episodes), int(run.state.updates)
    )
    results = report.write(run.folder, provenance, task.tables, played)
    callbacks.on_results(run.folder, results)
    return results


def evaluate(
    checkpoint: Path | str | Sequence[Path | str] | None = None,
    policy: str | Policy = "sample",
    *,
    config: TrainConfig | None = None,
    history: bool = False,
    data: str | None = None,
    seed: int | None = None,
    out: Path | str | None = None,
    on_network: Callable[[float, str], None] | None = None,
) -> Any:
    """Plays the fixed test episodes.

    Args:
      checkpoint: folder of a run, or several, which are played in one compiled call; None for
        policies that need none.
      policy: "sample" or "greedy", how a network's actions are chosen; "random" or
        "shortest_path"; or a `Policy` of your own.
      config: rooms, classes and words for policies without a checkpoint; by default split 18/4.
      history: evaluate the whole history of each run instead of its newest checkpoint.
      data: file of rooms to evaluate in, instead of the run's.
      seed: of sampled actions; by default the run's own, which gives the results that its training
        ended with, and `config.seed` without a run.
      out: folder to write: `results.json`, `results.md` and `episodes.jsonl` for one network,
        `evaluations.json`, `evaluations.md` and `episodes.jsonl` for several; None writes nothing.
      on_network: called with the share of the networks that are done, and the last one's name.

    Returns:
      The content of `results.json` for one network or policy, a list of them for several.

    Raises:
      ValueError: a folder holds no run, its network cannot be read, or the arguments do not go
        together.
    """
    folder = None if out is None else Path(out)
    if checkpoint is None:
        return _evaluate_policy(policy, config or TrainConfig(), seed, folder)
    if policy not in ("sample", "greedy"):
        raise ValueError(f"policy {policy}: a checkpoint's actions are sampled or greedy")
    single = isinstance(checkpoint, str | Path)
    runs = [Path(checkpoint)] if isinstance(checkpoint, str | Path) else [*map(Path, checkpoint)]
    networks = [n for run in runs for n in saved_networks.find(run, history, data)]
    if single and not history:
        done = next(saved_networks.evaluate(networks, policy == "greedy", seed))
        if folder is None:
            return report.results(done.provenance, done.columns())
        return report.write(folder, done.provenance, done.task.tables, done.played)
    results, records, columns = {}, [], {}
    for done in saved_networks.evaluate(networks, policy == "greedy", seed):
        results[done.saved] = done.results()
        columns[done.saved] = done.columns()
        where = {"run": str(done.saved.run), "updates": done.snapshot.updates}
        records += [{**where, **row} for row in report.all_rows(done.task.tables, done.played)]
        if on_network is not None:
            name = f"{done.saved.run.name} {done.snapshot.updates:,}"
            on_network(len(results) / len(networks), name)
    ordered: list[comparison.Result] = [results[network] for network in networks]
    if not history:
        ordered = comparison.with_differences(ordered, [columns[network] for network in networks])
    if folder is not None:
        _write_several(folder, runs, networks, ordered, records, history)
    return ordered


def _evaluate_policy(
    policy: str | Policy, config: TrainConfig, seed: int | None, folder: Path | None
) -> dict[str, Any]:
    """A policy without a checkpoint."""
    name, chosen = ("custom", policy)
    if isinstance(policy, str):
        if policy not in UNTRAINED:
            known = ", ".join(UNTRAINED)
            raise ValueError(f"policy {policy}: needs a checkpoint, or choose one of {known}")
        name, chosen = policy, UNTRAINED[policy]()
    assert isinstance(chosen, Policy)
    task, seed = load_task(config), config.seed if seed is None else seed
    lists = episodes.load(task.tables, task.split, task.extras)
    played = rollout.evaluate_lists(chosen, None, task.eval_params, lists, seed)
    provenance = report.Provenance.of(task, config, name, seed)
    if folder is None:
        groups = {group: report.columns(task.tables, *pair) for group, pair in played.items()}
        return report.results(provenance, groups)
    return report.write(folder, provenance, task.tables, played)


def _write_several(
    folder: Path,
    runs: Sequence[Path],
    networks: Sequence[SavedNetwork],
    results: Sequence[comparison.Result],
    records: Sequence[dict[str, Any]],
    history: bool,
) -> None:
    """The report on several runs, or on the history of one or more."""
    names = short_names(runs)
    title = f"{len(networks)} checkpoints"
    page = comparison.markdown(title, results, [names[network.run] for network in networks])
    folder.mkdir(parents=True, exist_ok=True)
    report.write_rows(folder, records)
    files.write_text(folder / "evaluations.md", page)
    if history:
        of_run = {
            run: [r for n, r in zip(networks, results, strict=True) if n.run == run] for run in runs
        }
        curves = [comparison.curve(name, [of_run[run]]) for run, name in names.items()]
        picture = folder / "learning_curve.png"
        figures.evaluated_curves(curves, "Test rooms, while training", picture)
    files.write_text(folder / "evaluations.json", json.dumps(results, indent=2) + "\n")


def short_names(runs: Sequence[Path]) -> dict[Path, str]:
    """A name for each run: its folder's, or the whole path if two folders have the same name."""
    last = [run.resolve().name for run in runs]
    return {
        run: name if last.count(name) == 1 else str(run)
        for run, name in zip(runs, last, strict=True)
    }


def train_together(members: Sequence[tuple[TrainConfig, Path]], callbacks: Callbacks) -> None:
    """Trains seeds of one configuration in one vmapped call, and reports on each.

    Args:
      members: configurations that differ in their seed alone, and their folders, new or begun.
    """
    loop.train_together(members, lambda run: finish(run, callbacks), callbacks)
