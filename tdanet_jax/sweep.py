"""A sweep: runs of several splits, models and seeds in one folder, and the report about them.

A run's folder tells how far it is: nothing yet, begun (there is a `config.json`), or finished
(there is a `results.json`, which is written last). So an interrupted sweep goes on where it was.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

from tdanet_jax import comparison, files, paper
from tdanet_jax import config as configs
from tdanet_jax.comparison import Curve, Result, Spread
from tdanet_jax.config import CONFIG_FILE, MODELS, TrainConfig
from tdanet_jax.vocabulary import UNSEEN

REPORT_VERSION = 1
#: Where the evaluated histories of a sweep's runs are kept.
HISTORIES = "histories"
#: The splits of the paper's tables.
PAPER_SPLITS = ("18/4", "14/8")


def plan(
    base: TrainConfig, splits: Sequence[str], models: Sequence[str], seeds: Sequence[int]
) -> list[TrainConfig]:
    """The configurations of a sweep, seeds of one split and model together.

    Raises:
      ValueError: a value is not allowed or given twice; the message names the flag.
    """
    for flag, given in (("--splits", splits), ("--models", models), ("--seeds", seeds)):
        if not given:
            raise ValueError(f"{flag}: give at least one")
        if len(set(given)) < len(given):
            raise ValueError(f"{flag}: a value is given twice")
    out = [
        dataclasses.replace(base, split=split, model=model, seed=seed)
        for split in splits
        for model in models
        for seed in seeds
    ]
    for config in out:
        config.check()
    return out


def run_name(config: TrainConfig) -> str:
    """18-4-tdanet-seed0."""
    split = config.split.replace("/", "-") + ("-validation" if config.validation else "")
    return f"{split}-{config.model}-seed{config.seed}"


def progress(folder: Path, config: TrainConfig) -> Literal["new", "begun", "finished"]:
    """How far the run of a configuration is.

    Args:
      config: as it runs, with no `auto` left (`task.resolve`).

    Raises:
      ValueError: the folder holds a run of another configuration; the message names the flags.
    """
    from tdanet_jax.report import RESULTS_FILE

    if not (folder / CONFIG_FILE).exists():
        return "new"
    there = comparison.flags(configs.load(folder / CONFIG_FILE))
    ours = comparison.flags(config)
    differing = sorted(flag for flag in ours if ours[flag] != there[flag])
    if differing:
        raise ValueError(
            f"{folder}: trained with other values of {', '.join(differing)}; "
            "choose another --out, or the flags of before"
        )
    return "finished" if (folder / RESULTS_FILE).exists() else "begun"


@dataclasses.dataclass(frozen=True)
class Finished:
    """A finished run.

    Attributes:
      folder: where it is.
      config: what was trained.
      results: the content of its `results.json`, and its settings.
      seconds: training time; None if nothing says.
    """

    folder: Path
    config: TrainConfig
    results: Result
    seconds: float | None


def finished(folder: Path) -> Finished:
    """A finished run.

    Raises:
      ValueError: the folder holds none; the message names it.
    """
    from tdanet_jax.report import RESULTS_FILE
    from tdanet_jax.training import METRICS_FILE, read_metrics

    config = configs.load(folder / CONFIG_FILE)
    path = folder / RESULTS_FILE
    try:
        results = json.loads(path.read_text())
        results["seen"]["L>=1"], *(results[name] for name in _READ)
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; the run is not finished") from None
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the results of a run ({error})") from None
    rows = read_metrics(folder) if (folder / METRICS_FILE).exists() else []
    results["settings"] = comparison.settings(config)
    return Finished(folder, config, results, rows[-1]["seconds"] if rows else None)


#: What a report reads in a `results.json`, beside the rates of groups.
_READ = (
    "split", "model", "policy", "seed", "data_version", "episodes_trained", "steps", "by_room"
)  # fmt: skip


def find(out: Path) -> list[Finished]:
    """The finished runs in a sweep's folder, by name."""
    return [finished(path) for path in _with_results(out) if (path / CONFIG_FILE).exists()]


def find_others(out: Path) -> list[Path]:
    """Folders of results there that are no runs, say of a policy without training."""
    return [path for path in _with_results(out) if not (path / CONFIG_FILE).exists()]


def _with_results(out: Path) -> list[Path]:
    from tdanet_jax.report import RESULTS_FILE

    return [path.parent for path in sorted(out.glob(f"*/{RESULTS_FILE}"))]


def labels(runs: Sequence[Finished]) -> list[str]:
    """What the report calls each run: those that differ in the seed alone share a name."""
    return comparison.labels([run.results for run in runs], [run.folder.name for run in runs])


def histories(runs: Sequence[Finished], out: Path) -> Iterator[tuple[Finished, int]]:
    """Evaluates the histories that are not evaluated yet, into `out`/histories/<run>.json.

    Actions are sampled with each run's own seed: the end of its budget gives its results again.
    Yields a run and the points of it that are done, after each point.

    Raises:
      ValueError: a point cannot be read, or belongs to other rooms.
    """
    from tdanet_jax import history, saved

    waiting = {}
    for run in runs:
        if history.points(run.folder) and evaluated_history(run, out) is None:
            waiting[run.folder] = (run, saved.find(run.folder, with_history=True))
    done: dict[Path, list[Result]] = {folder: [] for folder in waiting}
    networks = [network for _, members in waiting.values() for network in members]
    for one in saved.evaluate(networks, greedy=False):
        folder = one.saved.run
        run, members = waiting[folder]
        done[folder].append(one.results())
        if len(done[folder]) == len(members):
            (out / HISTORIES).mkdir(exist_ok=True)
            kept = {"of": _fingerprint(run), "results": done[folder]}
            files.write_text(out / HISTORIES / f"{folder.name}.json", json.dumps(kept) + "\n")
        yield run, len(done[folder])


def evaluated_history(run: Finished, out: Path) -> list[Result] | None:
    """The results of a run's history, or None if it is not evaluated as it is now."""
    path = out / HISTORIES / f"{run.folder.name}.json"
    if not path.exists():
        return None
    try:
        kept = json.loads(path.read_text())
        of, results = kept["of"], kept["results"]
    except (ValueError, KeyError, TypeError):
        return None  # it is evaluated anew
    return results if of == _fingerprint(run) else None


def _fingerprint(run: Finished) -> str:
    """Another one for another configuration, other rooms or other networks in its history."""
    from tdanet_jax import history

    points = {path.name: history.checksums(path) for path in history.points(run.folder)}
    told = [configs.to_json(run.config), run.results["data_version"], points]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()


def untrained(runs: Sequence[Finished], seed: int) -> list[Result]:
    """Results of random actions and of the shortest path on the splits of the runs."""
    from tdanet_jax import episodes, evaluation, policies, report
    from tdanet_jax.task import load_task

    out: list[Result] = []
    for config in {run.results["split"]: run.config for run in runs}.values():
        task = load_task(config)
        lists = episodes.load(task.tables, task.split, task.extras)
        for name, make in (("random", policies.random), ("shortest_path", policies.shortest_path)):
            played = evaluation.evaluate_lists(make(), None, task.eval_params, lists, seed)
            provenance = report.Provenance(
                split=task.split.name, model=name, policy=name, episodes_trained=0, seed=seed,
                evaluation_seed=seed, steps=0, data_version=task.tables.data_version,
                data=config.data,
            )  # fmt: skip
            groups = {group: report.columns(task.tables, *pair) for group, pair in played.items()}
            out.append(report.results(provenance, groups))
    return out


@dataclasses.dataclass(frozen=True)
class Cost:
    """Size and speed of a model on this machine.

    Attributes:
      model: its name.
      parameters: all trained numbers; word vectors are not among them.
      milliseconds: of one decision for a batch of so many agents.
    """

    model: str
    parameters: int
    milliseconds: Mapping[int, float]


@dataclasses.dataclass(frozen=True)
class Report:
    """All that the report shows.

    Attributes:
      runs: the finished runs.
      untrained: results of policies that need no training, one for each split and policy.
      costs: by the runs' labels.
      curves: learning curves by split.
      machine: where the costs were measured.
      code: the version of the code.
    """

    runs: Sequence[Finished]
    untrained: Sequence[Result]
    costs: Mapping[str, Cost]
    curves: Mapping[str, Sequence[Curve]]
    machine: str
    code: str

    @property
    def splits(self) -> list[str]:
        """The splits that were trained, in the order of the vocabulary."""
        names = {run.results["split"] for run in self.runs}
        return [name for name in UNSEEN if name in names] + sorted(names - set(UNSEEN))

    def results(self, split: str) -> dict[str, list[Result]]:
        """Results on a split by label: those without training, then in the order of MODELS."""
        named = [(result["model"], result) for result in self.untrained]
        named += zip(labels(self.runs), (run.results for run in self.runs), strict=True)
        found: dict[str, list[Result]] = {}
        for label, result in sorted(named, key=lambda pair: _place(pair[1]["model"])):
            if result["split"] == split:
                found.setdefault(label, []).append(result)
        return found


def _place(model: str) -> tuple[int, str]:
    """Sorts models: those without training, then in the order of MODELS, then by name."""
    order = ["random", "shortest_path", *MODELS]
    return (order.index(model) if model in order else len(order), model)


def make_curves(runs: Sequence[Finished], out: Path) -> dict[str, list[Curve]]:
    """Learning curves by split, one a label, from the evaluated histories."""
    found: dict[str, dict[str, list[list[Result]]]] = {}
    named = zip(labels(runs), runs, strict=True)
    for label, run in sorted(named, key=lambda pair: _place(pair[1].config.model)):
        results = evaluated_history(run, out)
        if results:
            found.setdefault(run.results["split"], {}).setdefault(label, []).append(results)
    return {
        split: [comparison.curve(label, seeds) for label, seeds in by_label.items()]
        for split, by_label in found.items()
    }


def to_json(report: Report) -> dict[str, Any]:
    """The content of `report.json`."""
    return {
        "version": REPORT_VERSION,
        "code": report.code,
        "machine": report.machine,
        "comparison": {
            split: {
                label: _plain(comparison.summary(results))
                for label, results in report.results(split).items()
            }
            for split in report.splits
        },
        "paper": [rate._asdict() for rate in paper.RATES],
        "paper_parameters_mebi": paper.PARAMETERS,
        "costs": {label: dataclasses.asdict(cost) for label, cost in report.costs.items()},
        "learning_curves": {
            split: {
                curve.label: {
                    "episodes": curve.episodes,
                    **{" ".join(key): _plain(values) for key, values in curve.values.items()},
                }
                for curve in curves
            }
            for split, curves in report.curves.items()
        },
        "runs": [
            {
                "run": str(run.folder),
                "training_seconds": run.seconds,
                **{k: v for k, v in run.results.items() if k not in ("by_room", "by_target")},
            }
            for run in report.runs
        ],
        "left_out": left_out(report),
    }


def _plain(value: Any) -> Any:
    """Spreads as {"mean", "sd"}, in dictionaries and lists."""
    if isinstance(value, Spread):
        return {
            "mean": round(value.mean, 3),
            "sd": None if value.sd is None else round(value.sd, 3),
        }
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list) else value


def left_out(report: Report) -> list[str]:
    """One line for each part of the paper's tables that nothing was trained for."""
    lines = []
    for split in PAPER_SPLITS:
        trained = {run.config.model for run in report.runs if run.results["split"] == split}
        absent = [model for model in MODELS if model not in trained]
        if len(absent) == len(MODELS):
            lines.append(f"Split {split}: nothing was trained.")
        elif absent:
            lines.append(f"Split {split}: not trained: {', '.join(absent)}.")
    drawn = {(split, curve.label) for split, curves in report.curves.items() for curve in curves}
    flat = [
        run.folder.name
        for label, run in zip(labels(report.runs), report.runs, strict=True)
        if (run.results["split"], label) not in drawn
    ]
    if flat:
        lines.append(f"Learning curve: no history of {', '.join(flat)}.")
    return lines


def markdown(report: Report, figures: Mapping[str, str]) -> str:
    """`report.md`.

    Args:
      figures: name of the learning curve's file by split.
    """
    lines = [
        f"# {len(report.runs)} runs",
        "",
        f"SR and SPL in percent, test rooms, sampled actions; mean ± deviation over seeds of one "
        f"configuration. Code {report.code}.",
    ]
    for split in report.splits:
        lines += _comparison(report, split)
        if split in figures:
            lines += ["", f"![Learning curve, split {split}]({figures[split]})"]
        lines += _by_room(report, split)
    lines += _ablations(report)
    lines += _costs(report)
    lines += _runs(report)
    if absent := left_out(report):
        lines += ["", "## Left out", "", *(f"- {line}" for line in absent)]
    return "\n".join(lines) + "\n"


def _comparison(report: Report, split: str) -> Iterator[str]:
    """The paper's comparison of models on one split, as a whole and by room type."""
    results = report.results(split)
    summaries = {label: comparison.summary(members) for label, members in results.items()}
    rows = [
        ((f"{label} (ours)", str(len(out["seeds"])), _count(out["episodes_trained"])), out)
        for label, out in summaries.items()
    ]
    theirs = comparison.paper_rows(split)
    rows += [((f"{agent} (paper)", "", ""), groups) for agent, groups in theirs.items()]
    yield from ("", f"## Split {split}: comparison of models (the paper's Tables I to III)", "")
    yield from comparison.table(("Model", "Seeds", "Training episodes"), rows)
    if theirs:
        worlds = dict.fromkeys(
            paper.worlds(run.config.data) for run in report.runs if run.results["split"] == split
        )
        yield from ("", *worlds)


def _by_room(report: Report, split: str) -> Iterator[str]:
    """The same by room type; the shortest path scores 100 everywhere and is left out."""
    results = report.results(split)
    summaries = {k: comparison.summary(r) for k, r in results.items() if k != "shortest_path"}
    rooms = dict.fromkeys(room for out in summaries.values() for room in out["by_room"])
    rows = [
        ((room, label), out["by_room"][room])
        for room in rooms
        for label, out in summaries.items()
        if room in out["by_room"]
    ]
    yield from ("", f"### Split {split}, by room type", "")
    yield from comparison.table(("Room", "Model"), rows)


def _ablations(report: Report) -> Iterator[str]:
    """TDANet and its parts left out, where any such model was trained."""
    module = MODELS["tdanet"][0]
    variants = [model for model, (name, _) in MODELS.items() if name == module]
    rows = []
    for split in report.splits:
        results = report.results(split)
        models = {label: members[0]["model"] for label, members in results.items()}
        if len(set(models.values()) & set(variants)) > 1:
            for label in (label for label, model in models.items() if model in variants):
                made_with = MODELS[models[label]][1]
                parts = ["no" if made_with.get(p) is False else "yes" for p in _ABLATED]
                rows.append(((split, label, *parts), comparison.summary(results[label])))
    if rows:
        yield from ("", "## Ablations (the paper's Tables IV and V)", "")
        yield from comparison.table(("Split", "Model", *_ABLATED.values()), rows)


_ABLATED = {"target_attention": "Target attention", "siamese": "Siamese comparison"}


def _costs(report: Report) -> Iterator[str]:
    """Parameters and inference time."""
    batches = list(dict.fromkeys(b for cost in report.costs.values() for b in cost.milliseconds))
    heads = [
        "Model",
        "Parameters",
        "in 2^20",
        "in 2^20, paper",
        *(f"ms, batch {b:,}" for b in batches),
    ]
    yield from ("", "## Parameters and inference time", "")
    yield from (f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}")
    for label, cost in sorted(report.costs.items(), key=lambda item: _place(item[1].model)):
        published = paper.PARAMETERS.get(paper.NAMES.get(cost.model, ""))
        cells = [
            label,
            f"{cost.parameters:,}",
            f"{cost.parameters / 2**20:.2f}",
            "-" if published is None else f"{published:.2f}",
            *(f"{cost.milliseconds[batch]:.2f}" for batch in batches),
        ]
        yield f"| {' | '.join(cells)} |"
    yield from ("", f"One decision of so many agents at once, on {report.machine}.")
    yield "The paper's word vectors are 300 wide; the input layers here follow the run's."


def _runs(report: Report) -> Iterator[str]:
    """Every run."""
    yield from ("", "## Runs", "")
    rows = [
        (
            (run.folder.name, str(run.results["seed"]), f"{run.results['episodes_trained']:,}",
             f"{run.results['steps']:,}",
             "-" if run.seconds is None else f"{run.seconds / 60:.1f}"),
            run.results,
        )
        for run in report.runs
    ]  # fmt: skip
    heads = ("Run", "Seed", "Training episodes", "Steps", "Training minutes")
    yield from comparison.table(heads, rows)


def _count(value: Spread | None) -> str:
    return "" if value is None else f"{value.mean:,.0f}"
