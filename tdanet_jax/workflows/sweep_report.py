"""The report on the runs of a sweep: the paper's tables, costs and learning curves."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tdanet_jax.eval_config import rooms_played
from tdanet_jax.evaluation import comparison, paper
from tdanet_jax.evaluation.comparison import Curve, Result, Spread
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.registry import MODELS
from tdanet_jax.splits import NAMED
from tdanet_jax.workflows.sweep import FinishedRun, evaluated_history, labels

REPORT_VERSION = 1
#: The paper's comparisons of models: split -> table.
PAPER_TABLES = {"22/0": "Table I", "18/4": "Table III", "14/8": "Table III"}


@dataclasses.dataclass(frozen=True)
class Cost:
    """Size and speed of a model on this machine."""

    model: str
    parameters: int  # trained parameters, without word vectors
    milliseconds: Mapping[int, float]  # of a decision, by batch size


@dataclasses.dataclass(frozen=True)
class Report:
    """The content of the report."""

    runs: Sequence[FinishedRun]
    untrained: Sequence[Result]  # policies without training, one for each split and policy
    costs: Mapping[str, Cost]  # by the runs' labels
    curves: Mapping[str, Sequence[Curve]]  # by split
    machine: str  # where the costs were measured
    code: str  # the version of the code
    unfinished: Sequence[str] = ()  # runs of the sweep that are left out, by name

    @property
    def splits(self) -> list[str]:
        """The splits that were trained, in the order of the vocabulary."""
        names = {run.results["split"] for run in self.runs}
        return [name for name in NAMED if name in names] + sorted(names - set(NAMED))

    def results(self, split: str) -> dict[str, list[Result]]:
        """Results on a split by label: policies without training, then models as in MODELS."""
        named = [(result["model"], result) for result in self.untrained]
        named += zip(labels(self.runs), (run.results for run in self.runs), strict=True)
        found: dict[str, list[Result]] = {}
        for label, result in sorted(named, key=lambda pair: _place(pair[1]["model"])):
            if result["split"] == split:
                found.setdefault(label, []).append(result)
        return found


def _place(model: str) -> tuple[int, str]:
    """Sort key: policies without training, then models as in MODELS, then others by name."""
    order = ["random", "shortest_path", *MODELS]
    return (order.index(model) if model in order else len(order), model)


def make_curves(runs: Sequence[FinishedRun], out: Path) -> dict[str, list[Curve]]:
    """Learning curves by split, one for each label, from the evaluated histories."""
    found: dict[str, dict[str, list[list[Result]]]] = {}
    named = zip(labels(runs), runs, strict=True)
    for label, run in sorted(named, key=lambda pair: _place(pair[1].config.model)):
        results = evaluated_history(run, out)
        if results:
            found.setdefault(run.results["split"], {}).setdefault(label, []).append(results)
    return {
        split: [curve for label, seeds in by_label.items()
                if (curve := comparison.curve(label, seeds)).episodes]
        for split, by_label in found.items()
    }  # fmt: skip


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
        "paper_milliseconds": paper.MILLISECONDS,
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
        sd = None if value.sd is None else round(value.sd, 3)
        return {"mean": round(value.mean, 3), "sd": sd}
    if isinstance(value, Mapping):
        return {key: _plain(inner) for key, inner in value.items()}
    return [_plain(inner) for inner in value] if isinstance(value, list) else value


def left_out(report: Report) -> list[str]:
    """One line for each part of the paper's tables for which nothing was trained, and for runs and
    curves that are missing.
    """
    lines = []
    if report.unfinished:
        lines.append(f"Not finished: {', '.join(report.unfinished)}.")
    for split in PAPER_TABLES:
        trained = {run.config.model for run in report.runs if run.results["split"] == split}
        absent = [model for model in MODELS if model not in trained]
        if len(absent) == len(MODELS):
            lines.append(f"Split {split}: nothing was trained.")
        elif absent:
            lines.append(f"Split {split}: not trained: {', '.join(absent)}.")
    drawn = {(split, curve.label) for split, curves in report.curves.items() for curve in curves}
    seeds: dict[tuple[str, str], list[FinishedRun]] = {}
    for label, run in zip(labels(report.runs), report.runs, strict=True):
        seeds.setdefault((run.results["split"], label), []).append(run)
    flat = [run.folder.name for curve in seeds if curve not in drawn for run in seeds[curve]]
    if flat:
        lines.append(f"Learning curve: no history of {', '.join(flat)}.")
    for runs in seeds.values():
        if len({run.config.history for run in runs}) > 1:
            names = ", ".join(run.folder.name for run in runs)
            lines.append(f"Learning curve: of {names}, only the points that all have.")
    return lines


def markdown(report: Report, figures: Mapping[str, str]) -> str:
    """`report.md`.

    Args:
      report: its content.
      figures: the learning curve's file name by split.
    """
    lines = [
        f"# {len(report.runs)} runs",
        "",
        f"SR and SPL in percent, {rooms_played(None, report.splits)}, sampled actions; mean ± "
        f"standard deviation over the seeds of a configuration. Code {report.code}.",
    ]
    for split in report.splits:
        lines += _comparison(report, split)
        if split in figures:
            lines += ["", f"![Learning curve, split {split}]({figures[split]})"]
        lines += _by_room(report, split)
    lines += _ablations(report)
    lines += _costs(report)
    lines += _settings(report)
    lines += _runs(report)
    if absent := left_out(report):
        lines += ["", "## Left out", "", *(f"- {in_markdown(line)}" for line in absent)]
    return "\n".join(lines) + "\n"


def _comparison(report: Report, split: str) -> Iterator[str]:
    """The paper's comparison of models on one split."""
    results = report.results(split)
    summaries = {label: comparison.summary(members) for label, members in results.items()}
    rows = [
        (
            (
                f"{in_markdown(label)} (ours)",
                str(len(out["seeds"])),
                _count(out["episodes_trained"]),
            ),
            out,
        )
        for label, out in summaries.items()
    ]
    theirs = paper.rates(split, next(iter(results.values()))[0].get("targets"))
    rows += [((f"{agent} (paper)", "", ""), groups) for agent, groups in theirs.items()]
    table = f" (the paper's {PAPER_TABLES[split]})" if split in PAPER_TABLES else ""
    yield from ("", f"## Split {split}: comparison of models{table}", "")
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
        ((in_markdown(room), in_markdown(label)), out["by_room"][room])
        for room in rooms
        for label, out in summaries.items()
        if room in out["by_room"]
    ]
    yield from ("", f"### Split {split}, by room type", "")
    yield from comparison.table(("Room", "Model"), rows)


def _ablations(report: Report) -> Iterator[str]:
    """TDANet and its ablations, on the splits on which any of them was trained."""
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
                rows.append(
                    ((split, in_markdown(label), *parts), comparison.summary(results[label]))
                )
    if rows:
        yield from ("", "## Ablations (the paper's Tables IV and V)", "")
        yield from comparison.table(("Split", "Model", *_ABLATED.values()), rows)


_ABLATED = {"target_attention": "Target attention", "siamese": "Siamese comparison"}


def _costs(report: Report) -> Iterator[str]:
    """Parameters and inference time."""
    batches = list(dict.fromkeys(b for cost in report.costs.values() for b in cost.milliseconds))
    times = (f"ms, batch {batch:,}" for batch in batches)
    heads = ["Model", "Parameters", "in 2^20", "in 2^20, paper", *times, "ms, paper"]
    yield from ("", "## Parameters and inference time", "")
    yield from (f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}")
    for label, cost in sorted(report.costs.items(), key=lambda item: _place(item[1].model)):
        name = paper.NAMES.get(cost.model, "")
        published, milliseconds = paper.PARAMETERS.get(name), paper.MILLISECONDS.get(name)
        cells = [
            in_markdown(label),
            f"{cost.parameters:,}",
            f"{cost.parameters / 2**20:.2f}",
            "-" if published is None else f"{published:.2f}",
            *(f"{cost.milliseconds[batch]:.2f}" for batch in batches),
            "-" if milliseconds is None else f"{milliseconds:.1f}",
        ]
        yield f"| {' | '.join(cells)} |"
    yield from ("", f"Time of one decision for a batch of agents, on {report.machine}.")
    yield "The paper's time is that of one decision on an NVIDIA GeForce RTX 3060."
    yield "The paper's word vectors have 300 dimensions; here, the input layers fit the run's."


def _settings(report: Report) -> Iterator[str]:
    """The flags in which the configurations differ, apart from the model and the split."""
    named = zip(labels(report.runs), report.runs, strict=True)
    settings = {label: run.results["settings"] for label, run in named}
    names = dict.fromkeys(name for values in settings.values() for name in values)
    differing = [
        name
        for name in names
        if name not in ("--model", "--split")
        and len({str(values.get(name)) for values in settings.values()}) > 1
    ]
    if differing:
        yield from ("", "## Settings that differ", "")
        yield from (f"| Model | {' | '.join(differing)} |", f"|{'---|' * (1 + len(differing))}")
        for label, values in settings.items():
            cells = [in_markdown(label), *(in_markdown(str(values.get(n))) for n in differing)]
            yield f"| {' | '.join(cells)} |"


def _runs(report: Report) -> Iterator[str]:
    """Every run."""
    yield from ("", "## Runs", "")
    rows = [
        (
            (
                in_markdown(run.folder.name),
                str(run.results["seed"]),
                f"{run.results['episodes_trained']:,}",
                f"{run.results['steps']:,}",
                "-" if run.seconds is None else f"{run.seconds / 60:.1f}",
            ),
            run.results,
        )
        for run in report.runs
    ]
    heads = ("Run", "Seed", "Training episodes", "Steps", "Training minutes")
    yield from comparison.table(heads, rows)


def _count(value: Spread | None) -> str:
    return "" if value is None else f"{value.mean:,.0f}"
