"""A sweep: runs of several splits, models and seeds in one folder.

A run's folder shows how far it is: new, begun (it has a `config.json`), or finished (it has a
`results.json`, which is written last). So an interrupted sweep continues where it was.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.eval_config import OWN_TASK
from tdanet_jax.evaluation import comparison, results_file
from tdanet_jax.evaluation.comparison import Result
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import jsons, npz
from tdanet_jax.splits import split_name
from tdanet_jax.targets import known_classes, naming

#: Settings of the network that can be "auto".
AUTO = ("precision", "image")
#: Where the evaluated histories of a sweep's runs are kept.
HISTORIES = "histories"


def plan(
    base: TrainConfig,
    splits: Sequence[str],
    models: Sequence[str],
    seeds: Sequence[int],
    per_model: Mapping[str, TrainConfig] | None = None,
) -> list[TrainConfig]:
    """The configurations of a sweep; the seeds of one split and model follow one another.

    Args:
      base: everything else of the runs.
      splits: their splits.
      models: their models.
      seeds: their seeds.
      per_model: what takes the place of `base` for some models.

    Raises:
      ValueError: a value is not allowed or given twice; the message names the flag.
    """
    classes = known_classes(base.targets, base.data)
    with naming("--splits", "--split"):
        splits = [split_name(split, classes) for split in splits]
    for flag, given in (("--splits", splits), ("--models", models), ("--seeds", seeds)):
        if not given:
            raise ValueError(f"{flag}: give at least one")
        if len(set(given)) < len(given):
            raise ValueError(f"{flag}: a value is given twice")
    own = per_model or {}
    out = [
        dataclasses.replace(own.get(model, base), split=split, model=model, seed=seed)
        for split in splits
        for model in models
        for seed in seeds
    ]
    with (
        naming("--splits", "--split"),
        naming("--models", "--model"),
        naming("--seeds", "--seed"),
    ):
        for config in out:
            config.check()
    return out


def settled(out: Path | str, config: TrainConfig) -> TrainConfig:
    """A run of the sweep in `out` with every "auto" replaced by what suits this machine.

    A run that has begun keeps the values that it began with, and its other seeds take the same
    ones. So a sweep can be continued on another kind of machine.
    """
    from tdanet_jax.task import resolve

    own = Path(out) / configs.run_name(config) / CONFIG_FILE
    seeds = f"{own.parent.name.rpartition('seed')[0]}seed*/{CONFIG_FILE}"
    begun = own if own.exists() else min(Path(out).glob(seeds), default=None)
    if begun is not None:
        there = configs.load(begun).network
        names = (name for name in AUTO if getattr(config.network, name) == "auto")
        auto: dict[str, Any] = {name: getattr(there, name) for name in names}
        config = dataclasses.replace(config, network=dataclasses.replace(config.network, **auto))
    return resolve(config)


def progress(folder: Path | str, config: TrainConfig) -> Literal["new", "begun", "finished"]:
    """How far the run of a configuration is.

    Args:
      folder: the run's.
      config: the run, `settled`.

    Raises:
      ValueError: the folder holds a run of another configuration; the message names the flags.
    """
    folder = Path(folder)
    from tdanet_jax.evaluation.report import RESULTS_FILE

    if not (folder / CONFIG_FILE).exists():
        return "new"
    there = comparison.flags(configs.load(folder / CONFIG_FILE))
    ours = comparison.flags(config)
    differing = sorted(flag for flag in ours if ours[flag] != there[flag])
    if differing:
        raise ValueError(
            f"{folder}: trained with other values of {', '.join(differing)}; "
            "choose another --out, or the same flags as before"
        )
    return "finished" if (folder / RESULTS_FILE).exists() else "begun"


@dataclasses.dataclass(frozen=True)
class FinishedRun:
    """A finished run."""

    folder: Path
    config: TrainConfig
    results: Result  # the content of its `results.json`, and its settings
    seconds: float | None  # training time; None if unknown


def finished(folder: Path | str) -> FinishedRun:
    """The finished run in a folder.

    Raises:
      ValueError: there is none; the message names the folder.
    """
    folder = Path(folder)
    from tdanet_jax.evaluation.report import RESULTS_FILE
    from tdanet_jax.training.journal import METRICS_FILE, read_metrics

    config = configs.load(folder / CONFIG_FILE)
    path = folder / RESULTS_FILE
    if not path.exists():
        raise ValueError(f"{path}: no such file; the run is not finished")
    results = results_file.read(path)
    rows = read_metrics(folder) if (folder / METRICS_FILE).exists() else []
    results["settings"] = comparison.settings(config)
    return FinishedRun(folder, config, results, rows[-1].get("seconds") if rows else None)


def find(out: Path | str) -> list[FinishedRun]:
    """The finished runs in a sweep's folder, by name."""
    out = Path(out)
    return [finished(path) for path in _with_results(out) if (path / CONFIG_FILE).exists()]


def unfinished(out: Path | str) -> list[Path]:
    """The folders of runs in a sweep's folder that have begun and are not finished, by name."""
    from tdanet_jax.evaluation.report import RESULTS_FILE

    begun = (path.parent for path in sorted(Path(out).glob(f"*/{CONFIG_FILE}")))
    return [folder for folder in begun if not (folder / RESULTS_FILE).exists()]


def find_others(out: Path | str) -> list[Path]:
    """Folders with results that are not runs, for example of the random policy."""
    out = Path(out)
    return [path for path in _with_results(out) if not (path / CONFIG_FILE).exists()]


def _with_results(out: Path) -> list[Path]:
    from tdanet_jax.evaluation.report import RESULTS_FILE

    return [path.parent for path in sorted(out.glob(f"*/{RESULTS_FILE}"))]


def labels(runs: Sequence[FinishedRun]) -> list[str]:
    """A label for each run; runs that differ only in the seed share one."""
    return comparison.labels([run.results for run in runs], [run.folder.name for run in runs])


def histories(runs: Sequence[FinishedRun], out: Path | str) -> Iterator[tuple[FinishedRun, float]]:
    """Evaluates the histories that are not evaluated yet, into `out`/histories/<run>.json.

    Actions are sampled with each run's own seed, so that its last point has the run's results.
    Yields, after each point, its run and the share of all points that are done.

    Raises:
      ValueError: a point cannot be read, or belongs to other rooms.
    """
    out = Path(out)
    from tdanet_jax.evaluation import saved_networks
    from tdanet_jax.training import history

    waiting = {}
    for run in runs:
        if history.points(run.folder) and evaluated_history(run, out) is None:
            waiting[run.folder] = (run, saved_networks.find(run.folder, with_history=True))
    done: dict[Path, list[Result]] = {folder: [] for folder in waiting}
    networks = [network for _, members in waiting.values() for network in members]
    for count, one in enumerate(saved_networks.evaluate(networks, greedy=False), 1):
        folder = one.saved.run
        run, members = waiting[folder]
        done[folder].append(one.results())
        if len(done[folder]) == len(members):
            (out / HISTORIES).mkdir(exist_ok=True)
            kept = {"of": _fingerprint(run), "results": done[folder]}
            files.write_text(out / HISTORIES / f"{folder.name}.json", json.dumps(kept) + "\n")
        yield run, count / len(networks)


def evaluated_history(run: FinishedRun, out: Path | str) -> list[Result] | None:
    """The results of a run's history; None if it has not been evaluated, or has changed since."""
    out = Path(out)
    path = out / HISTORIES / f"{run.folder.name}.json"
    if not path.exists():
        return None
    try:
        kept = jsons.load(path, links=False)
        of, results = kept["of"], kept["results"]
        for result in results if of == _fingerprint(run) else ():
            results_file.check(path, result)
            jsons.number(path, result["share"], "share", 1)
    except (ValueError, KeyError, TypeError):
        return None
    return results if of == _fingerprint(run) else None


def _fingerprint(run: FinishedRun) -> str:
    """Changes with the configuration, the rooms and the networks of the history."""
    from tdanet_jax.training import history

    points = {p.name: npz.checksums(p, links=False) for p in history.points(run.folder)}
    told = [configs.to_json(run.config), run.results["data_version"], points]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def untrained(runs: Sequence[FinishedRun], seed: int) -> list[Result]:
    """Results of random actions and of the shortest path on the splits of the runs."""
    from tdanet_jax.workflows.evaluate import UNTRAINED, evaluate

    splits = {run.results["split"]: run for run in runs}.values()
    located = [OWN_TASK.locate(run.config, run.folder) for run in splits]
    return [evaluate(policy=n, config=config, seed=seed) for config in located for n in UNTRAINED]
