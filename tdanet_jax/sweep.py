"""A sweep: runs of several splits, models and seeds in one folder, and the report about them.

A run's folder tells how far it is: nothing yet, begun (there is a `config.json`), or finished
(there is a `results.json`, which is written last). So an interrupted sweep goes on where it was.
"""

from __future__ import annotations

import dataclasses
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
RESULTS_FILE = "results.json"
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
    if not (folder / CONFIG_FILE).exists():
        return "new"
    there = configs.to_json(configs.load(folder / CONFIG_FILE))
    differing = sorted(_differing(configs.to_json(config), there))
    if differing:
        raise ValueError(
            f"{folder}: trained with other values of {', '.join(differing)}; "
            "choose another --out, or the flags of before"
        )
    return "finished" if (folder / RESULTS_FILE).exists() else "begun"


def _differing(ours: Mapping[str, Any], theirs: Mapping[str, Any]) -> Iterator[str]:
    """The flags in which two configurations differ."""
    for name in ours.keys() | theirs.keys():
        one, other = ours.get(name), theirs.get(name)
        if isinstance(one, Mapping) and isinstance(other, Mapping):
            yield from _differing(one, other)
        elif one != other:
            yield f"--{name.replace('_', '-')}"


@dataclasses.dataclass(frozen=True)
class Finished:
    """A finished run.

    Attributes:
      folder: where it is.
      config: what was trained.
      results: the content of its `results.json`.
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
    from tdanet_jax.training import METRICS_FILE, read_metrics

    config = configs.load(folder / CONFIG_FILE)
    path = folder / RESULTS_FILE
    try:
        results = json.loads(path.read_text())
        results["by_room"], results["seen"]["L>=1"]
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; the run is not finished") from None
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not the results of a run ({error})") from None
    rows = read_metrics(folder) if (folder / METRICS_FILE).exists() else []
    return Finished(folder, config, results, rows[-1]["seconds"] if rows else None)


def find(out: Path) -> list[Finished]:
    """The finished runs in a sweep's folder, by name."""
    return [finished(path.parent) for path in sorted(out.glob(f"*/{RESULTS_FILE}"))]


def histories(runs: Sequence[Finished], out: Path, seed: int) -> Iterator[tuple[Finished, int]]:
    """Evaluates the histories that are not evaluated yet, into `out`/histories/<run>.json.

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
    for one in saved.evaluate(networks, greedy=False, seed=seed):
        folder = one.saved.run
        run, members = waiting[folder]
        done[folder].append(one.results())
        if len(done[folder]) == len(members):
            (out / HISTORIES).mkdir(exist_ok=True)
            text = json.dumps(done[folder]) + "\n"
            files.write_text(out / HISTORIES / f"{folder.name}.json", text)
        yield run, len(done[folder])


def evaluated_history(run: Finished, out: Path) -> list[Result] | None:
    """The results of a run's history, or None if it is not evaluated as it is now."""
    from tdanet_jax import history

    path = out / HISTORIES / f"{run.folder.name}.json"
    if not path.exists():
        return None
    try:
        results: list[Result] = json.loads(path.read_text())
        updates = [result["updates"] for result in results]
    except (json.JSONDecodeError, KeyError, TypeError):
        return None  # it is evaluated anew
    return results if updates == [int(p.stem) for p in history.points(run.folder)] else None


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
                steps=0, data_version=task.tables.data_version, data=config.data,
            )  # fmt: skip
            groups = {group: report.columns(task.tables, *pair) for group, pair in played.items()}
            out.append(report.results(provenance, groups))
    return out


@dataclasses.dataclass(frozen=True)
class Cost:
    """Size and speed of a model on this machine.

    Attributes:
      parameters: all trained numbers; word vectors are not among them.
      milliseconds: of one decision for a batch of so many agents.
    """

    parameters: int
    milliseconds: Mapping[int, float]


@dataclasses.dataclass(frozen=True)
class Report:
    """All that the report shows.

    Attributes:
      runs: the finished runs.
      untrained: results of policies that need no training, one for each split and policy.
      costs: by model.
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
        """Results by model on a split: those without training, then in the order of MODELS."""
        found: dict[str, list[Result]] = {}
        for result in (*self.untrained, *(run.results for run in self.runs)):
            if result["split"] == split:
                found.setdefault(result["model"], []).append(result)
        order = ["random", "shortest_path", *MODELS]
        return dict(sorted(found.items(), key=lambda item: _place(order, item[0])))


def _place(order: Sequence[str], name: str) -> tuple[int, str]:
    return (order.index(name) if name in order else len(order), name)


def make_curves(runs: Sequence[Finished], out: Path) -> dict[str, list[Curve]]:
    """Learning curves by split, one a model, from the evaluated histories."""
    found: dict[str, dict[str, list[list[Result]]]] = {}
    for run in runs:
        results = evaluated_history(run, out)
        if results:
            by_model = found.setdefault(run.results["split"], {})
            by_model.setdefault(run.results["model"], []).append(results)
    order = list(MODELS)
    return {
        split: [
            comparison.curve(model, models[model])
            for model in sorted(models, key=lambda name: _place(order, name))
        ]
        for split, models in found.items()
    }


def to_json(report: Report) -> dict[str, Any]:
    """The content of `report.json`."""
    return {
        "version": REPORT_VERSION,
        "code": report.code,
        "machine": report.machine,
        "comparison": {
            split: {
                model: _plain(comparison.summary(results))
                for model, results in report.results(split).items()
            }
            for split in report.splits
        },
        "paper": [rate._asdict() for rate in paper.RATES],
        "paper_parameters_mebi": paper.PARAMETERS,
        "costs": {model: dataclasses.asdict(cost) for model, cost in report.costs.items()},
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
        absent = [model for model in MODELS if model not in report.results(split)]
        if len(absent) == len(MODELS):
            lines.append(f"Split {split}: nothing was trained.")
        elif absent:
            lines.append(f"Split {split}: not trained: {', '.join(absent)}.")
    flat = [run.folder.name for run in report.runs if not _has_curve(report, run)]
    if flat:
        lines.append(f"Learning curve: no history of {', '.join(flat)}.")
    return lines


def _has_curve(report: Report, run: Finished) -> bool:
    curves = report.curves.get(run.results["split"], ())
    return any(curve.label == run.results["model"] for curve in curves)


def markdown(report: Report, figures: Mapping[str, str]) -> str:
    """`report.md`.

    Args:
      figures: name of the learning curve's file by split.
    """
    lines = [
        f"# {len(report.runs)} runs",
        "",
        f"SR and SPL in percent, test rooms, sampled actions; mean ± deviation over seeds. Code "
        f"{report.code}.",
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
    summaries = {model: comparison.summary(members) for model, members in results.items()}
    rows = [
        ((f"{model} (ours)", str(len(out["seeds"])), _count(out["episodes_trained"])), out)
        for model, out in summaries.items()
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
    summaries = {m: comparison.summary(r) for m, r in results.items() if m != "shortest_path"}
    rooms = dict.fromkeys(room for out in summaries.values() for room in out["by_room"])
    rows = [
        ((room, model), out["by_room"][room])
        for room in rooms
        for model, out in summaries.items()
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
        found = [model for model in variants if model in results]
        if len(found) > 1:
            for model in found:
                settings = MODELS[model][1]
                parts = ["no" if settings.get(p) is False else "yes" for p in _ABLATED]
                rows.append(((split, model, *parts), comparison.summary(results[model])))
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
    for model in sorted(report.costs, key=lambda name: _place(list(MODELS), name)):
        cost = report.costs[model]
        published = paper.PARAMETERS.get(paper.NAMES.get(model, ""))
        cells = [
            model,
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
