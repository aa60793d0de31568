"""Evaluation: policies and the networks of runs on the fixed test episodes, and their reports."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tdanet_jax.analysis import figures
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.eval_config import OWN_TASK, EvalConfig, rooms_played
from tdanet_jax.evaluation import comparison, policies, report, rollout, saved_networks, selection
from tdanet_jax.evaluation.policies import MakePolicy, Policy
from tdanet_jax.evaluation.saved_networks import SavedNetwork
from tdanet_jax.io import files
from tdanet_jax.io.bundled_agents import find_run
from tdanet_jax.task import ALL_ROOMS, ITHOR, environment, load_task

#: Policies that need no checkpoint.
UNTRAINED: dict[str, Callable[[], Policy]] = {
    "random": policies.random,
    "shortest_path": policies.shortest_path,
}


def evaluate(
    checkpoint: Path | str | Sequence[Path | str] | None = None,
    policy: str | Policy | MakePolicy = "sample",
    *,
    config: TrainConfig | None = None,
    history: bool = False,
    data: str | None = None,
    test: EvalConfig | None = None,
    seed: int | None = None,
    out: Path | str | None = None,
    on_network: Callable[[float, str], None] | None = None,
) -> Any:
    """Plays the fixed test episodes.

    Args:
      checkpoint: folder of a run, or several, which are played in one compiled call; None for
        policies that need none.
      policy: "sample" or "greedy", how a network's actions are chosen; "random" or
        "shortest_path"; or a custom `Policy`, such as `policies.on_host` makes of a network that
        was trained elsewhere.
      config: rooms, classes and words for policies without a checkpoint; by default split 18/4.
      history: evaluate the whole history of each run instead of its newest checkpoint.
      data: file of rooms to evaluate in, instead of the run's; short for `test.data`.
      test: where the evaluation departs from the run's own task or `config`.
      seed: of sampled actions; by default the run's own, which gives the results that its training
        ended with, and `config.seed` without a run.
      out: folder to write: `results.json`, `results.md` and `episodes.jsonl` for one network,
        `evaluations.json`, `evaluations.md` and `episodes.jsonl` for several; None writes nothing.
      on_network: for several networks, called with the share of them that is done and the name of
        the last; before the first, with 0 and their number.

    Returns:
      The content of `results.json` for one network or policy, a list of them for several.

    Raises:
      ValueError: a folder holds no run, its network cannot be read, or the arguments do not go
        together.
    """
    report.code_version()  # now, and not at the end, when the checkout may be another
    folder = None if out is None else Path(out)
    if folder is not None:
        files.check_writable(folder)
        if (folder / CONFIG_FILE).exists():
            raise ValueError(
                f"--out {folder}: is a run with results of its own; choose another folder"
            )
    test = test or OWN_TASK
    test.check(policy, seed)
    if data is not None:
        test = dataclasses.replace(test, data=data)
    if checkpoint is None:
        return _evaluate_policy(policy, config or TrainConfig(), test, seed, folder)
    if policy not in ("sample", "greedy"):
        raise ValueError(f"policy {policy}: a checkpoint's actions are sampled or greedy")
    single = isinstance(checkpoint, str | Path)
    given = [checkpoint] if isinstance(checkpoint, str | Path) else [*checkpoint]
    runs = [find_run(run) for run in given]
    networks = [n for run in runs for n in saved_networks.find(run, history, test)]
    evaluated = saved_networks.evaluate(networks, policy == "greedy", seed)
    if single and not history:
        done = next(evaluated)
        return report.results(done.provenance, done.task.tables, done.played, folder)
    results, records, columns = {}, [], {}
    if on_network is not None:
        on_network(0.0, f"{len(networks)} networks")
    for done in evaluated:
        results[done.saved] = done.results()
        if not history:
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
        _write(folder, runs, networks, ordered, records, history)
    return ordered


def _evaluate_policy(
    policy: str | Policy | MakePolicy,
    config: TrainConfig,
    test: EvalConfig,
    seed: int | None,
    folder: Path | None,
) -> dict[str, Any]:
    """A policy without a checkpoint."""
    if replaced := [name.replace("_", "-") for name in test.decisions.replaced]:
        raise ValueError(f"--{replaced[0]}: is for trained agents, and needs a checkpoint")
    name = policy if isinstance(policy, str) else "custom"
    if isinstance(policy, str):
        if policy not in UNTRAINED:
            known = ", ".join(UNTRAINED)
            raise ValueError(f"policy {policy}: needs a checkpoint, or choose one of {known}")
        policy = UNTRAINED[policy]()
    files = {"data": test.data, "word_vectors": test.word_vectors}
    chosen: dict[str, Any] = {name: path for name, path in files.items() if path is not None}
    config = test.with_targets(dataclasses.replace(config, **chosen))
    config.check()
    if callable(policy):  # observations as long as in `task.make`, where there is one pool
        config = dataclasses.replace(config, pool_rooms=ALL_ROOMS)
    else:
        config = config.for_tests()
    task, seed = load_task(config), config.seed if seed is None else seed
    params, lists = selection.select(task, test)
    params = selection.with_senses(task, params, [test.senses])[0]
    if callable(policy):
        env = environment(task, f"{ITHOR}{config.split}", "test")
        params = params.with_rows(env.default_params.max_detections)
        policy = policy(env)
    played = rollout.evaluate_lists(policy, None, params, lists, seed)
    provenance = report.Provenance.of(task, config, name, seed, departures=test.departures)
    return report.results(provenance, task.tables, played, folder)


def _write(
    folder: Path,
    runs: Sequence[Path],
    networks: Sequence[SavedNetwork],
    results: Sequence[comparison.Result],
    records: Sequence[dict[str, Any]],
    history: bool,
) -> None:
    """Writes the report on several runs, or on the history of one or more."""
    names = short_names(runs)
    title = f"{len(networks)} checkpoints"
    page = comparison.markdown(title, results, [names[network.run] for network in networks])
    folder.mkdir(parents=True, exist_ok=True)
    report.write_rows(folder, records)
    files.write_text(folder / "evaluations.md", page)
    if history:
        pairs = [*zip(networks, results, strict=True)]
        curves = [
            comparison.curve(name, [[result for network, result in pairs if network.run == run]])
            for run, name in names.items()
        ]
        picture = folder / "learning_curve.png"
        splits = [result["split"] for result in results]
        where = rooms_played(networks[0].test.departures, splits).capitalize()
        figures.evaluated_curves(curves, f"{where}, while training", picture)
    files.write_text(folder / "evaluations.json", json.dumps(results, indent=2) + "\n")


def short_names(runs: Sequence[Path | str]) -> dict[Path, str]:
    """A name for each run: its folder's, or the whole path if two folders have the same name."""
    paths = [Path(run) for run in runs]
    last = [path.resolve().name for path in paths]
    return {
        run: name if last.count(name) == 1 else str(run)
        for run, name in zip(paths, last, strict=True)
    }
