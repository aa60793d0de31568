"""Results of several networks in comparison: rows of runs, means over seeds, learning curves.

A result is the content of a `results.json`, a plain dictionary; `saved_networks.Evaluated.results`
adds the run's folder, progress and settings.
"""

from __future__ import annotations

import dataclasses
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.config import TrainConfig
from tdanet_jax.eval_config import describe_departures, rooms_played
from tdanet_jax.evaluation import metrics, paper
from tdanet_jax.evaluation.metrics import BUCKETS
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.splits import GROUPS, OPEN
from tdanet_jax.targets import PAPER

Result = Mapping[str, Any]
#: The records of a network by group, as the columns of `report.columns`.
Columns = Mapping[str, Mapping[str, np.ndarray]]
#: What learning curves show.
MEASURES = ("SR", "SPL")
#: Flags of what the paper's agents do not sense.
BEYOND = ("--odometry", "--triangulation", "--robust-triangulation", "--scores", "--sensors")
#: Flags that do not change the trained agent: the seed, and logging or checkpoint intervals.
NOT_SETTINGS = ("--seed", "--chunk-updates", "--checkpoint-minutes", "--history", "--max-skipped")


class Spread(NamedTuple):
    """A mean over seeds; `sd` is the standard deviation, None for a single seed."""

    mean: float
    sd: float | None

    def __str__(self) -> str:
        return f"{self.mean:.1f}" if self.sd is None else f"{self.mean:.1f} ± {self.sd:.1f}"


def flags(config: TrainConfig) -> dict[str, Any]:
    """A configuration's values by flag: --num-envs 256."""
    values = dataclasses.asdict(config)
    values |= values.pop("learner") | values.pop("network")
    return {
        f"--{name.replace('_', '-')}": " ".join(value) or None if name == "sensors" else value
        for name, value in values.items()
    }


def settings(config: TrainConfig) -> dict[str, Any]:
    """The flags that repetitions of a run share."""
    return {flag: value for flag, value in flags(config).items() if flag not in NOT_SETTINGS}


class _Test(NamedTuple):
    """What results must have in common to stand in one table."""

    split: str
    targets: str
    data_version: str


def _test(result: Result) -> _Test:
    return _Test(result["split"], result.get("targets") or PAPER, result["data_version"])


class _Kind(NamedTuple):
    """What repetitions of a run have in common."""

    model: str
    split: str
    values: tuple[tuple[str, Any], ...]  # by flag, where there is one


def _kind(result: Result) -> _Kind:
    values = {
        **result.get("settings", {}),
        "--policy": result["policy"],
        "scene tables": result["data_version"],
    }
    for flag in ("--model", "--split", "--validation"):  # part of the model and the split
        values.pop(flag, None)
    return _Kind(result["model"], result["split"], tuple(values.items()))


def labels(results: Sequence[Result], names: Sequence[str]) -> list[str]:
    """A label for each result; results that differ only in the seed share one.

    A label is the model's name, its sensors, and the settings in which the results of that model
    differ. Results that repeat a seed are not a sample of seeds: their names are added.

    Args:
      results: results, with their runs' `settings` if something was trained.
      names: one for each result; points of one run share one.
    """
    kinds = [_kind(result) for result in results]
    counts = Counter((kind, result["seed"]) for kind, result in zip(kinds, results, strict=True))
    repeated = {kind for (kind, _), count in counts.items() if count > 1}
    out = []
    for kind, name in zip(kinds, names, strict=True):
        rivals = [dict(other.values) for other in kinds if other.model == kind.model]
        differing = [
            _shown(flag, value)
            for flag, value in kind.values
            if (flag in BEYOND and value) or any(rival.get(flag) != value for rival in rivals)
        ]
        out.append(", ".join([kind.model, *differing, *([name] if kind in repeated else [])]))
    return out


def _shown(flag: str, value: Any) -> str:
    """A flag and its value in words: --odometry, no --scores, --gamma 0.97."""
    if value is None or value is False:
        return f"no {flag}"
    return flag if value is True else f"{flag} {value}"


def spread(values: Iterable[float | None]) -> Spread | None:
    """Mean and standard deviation of the values that are not None; None if there are none."""
    known = [value for value in values if value is not None]
    if not known:
        return None
    return Spread(statistics.fmean(known), statistics.stdev(known) if len(known) > 1 else None)


def summary(results: Sequence[Result]) -> dict[str, Any]:
    """Means and deviations over seeds: group -> bucket -> measure, and the same by room type."""
    rooms = dict.fromkeys(room for result in results for room in result["by_room"])
    return {
        "seeds": [result["seed"] for result in results],
        "episodes_trained": spread(result["episodes_trained"] for result in results),
        **_groups(results),
        "by_room": {
            room: _groups([r["by_room"][room] for r in results if room in r["by_room"]])
            for room in rooms
        },
    }


def _groups(parts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    out: dict[str, Any] = {}
    for group in GROUPS:
        found = [part[group] for part in parts if part.get(group) is not None]
        out[group] = {
            bucket: {
                measure: spread(part[bucket].get(measure) for part in found)
                for measure in metrics.MEASURES
            }
            for bucket in BUCKETS
        } if found else None  # fmt: skip
    return out


def with_differences(results: Sequence[Result], played: Sequence[Columns]) -> list[Result]:
    """Adds to each result its `difference` from the first result in the same episodes, by group.

    It is None for that first one itself. Otherwise `to` is the other's run, and each group holds
    `metrics.difference`, ours minus theirs.

    Args:
      results: as `saved_networks.Evaluated.results` gives them.
      played: the records of each.
    """
    out: list[Result] = []
    for i, result in enumerate(results):
        first = next(j for j in range(i + 1) if _same_episodes(results, played, i, j))
        difference = None if first == i else {
            "to": results[first]["run"],
            **{
                group: metrics.difference(played[i][group], played[first][group])
                if group in played[i] else None
                for group in GROUPS
            },
        }  # fmt: skip
        out.append({**result, "difference": difference})
    return out


def _same_episodes(
    results: Sequence[Result], played: Sequence[Columns], one: int, other: int
) -> bool:
    """Whether two networks have the same starts and targets in the same rooms."""
    ours, theirs = played[one], played[other]
    return (
        _test(results[one]) == _test(results[other])
        and ours.keys() == theirs.keys()
        and all(
            np.array_equal(ours[group][name], theirs[group][name])
            for group in ours
            for name in ("scene", "target", "x", "z", "rotation", "horizon")
        )
    )


def table(
    first: Sequence[str],
    rows: Iterable[tuple[Sequence[str], Mapping[str, Any]]],
    *,
    groups: Sequence[str] = GROUPS,
    buckets: Sequence[str] = tuple(BUCKETS),
    measures: Sequence[str] = metrics.MEASURES,
) -> list[str]:
    """A table as in the paper: the measures of seen and unseen targets, L >= 1 and L >= 5.

    Args:
      first: headings of the columns before the results.
      rows: the cells of these columns, and group -> bucket -> measure -> a printable value.
      groups: those to show.
      buckets: those to show.
      measures: those to show.
    """
    columns = [(group, bucket, m) for group in groups for bucket in buckets for m in measures]
    heads = [*first, *(f"{group} {measure} {bucket}" for group, bucket, measure in columns)]
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for cells, found in rows:
        figures = [
            _cell(((found.get(group) or {}).get(bucket) or {}).get(measure))
            for group, bucket, measure in columns
        ]
        lines.append(f"| {' | '.join([*cells, *figures])} |")
    return lines


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def markdown(title: str, results: Sequence[Result], runs: Sequence[str]) -> str:
    """A page on several networks: a row for each, means over seeds, the paper's rows.

    Args:
      title: of the page.
      results: as `saved_networks.Evaluated.results` gives them.
      runs: a short name for each; points of one run, which are not averaged, share one.
    """
    departures = common_departures(results)
    where = rooms_played(departures, [result["split"] for result in results])
    lines = [
        f"# {in_markdown(title)}",
        "",
        f"SR and SPL in percent, {where}. {metrics.COLLISION_FREE}",
    ]
    if departures:
        lines += ["", f"**{in_markdown(describe_departures(departures))}.**"]
    tests = [_test(result) for result in results]
    for test in dict.fromkeys(tests):
        own = [result for result, of in zip(results, tests, strict=True) if of == test]
        names = [run for run, of in zip(runs, tests, strict=True) if of == test]
        rows: list[_Row] = [
            ((in_markdown(run), f"{r['updates']:,}", f"{r['episodes_trained']:,}", r["policy"]), r)
            for run, r in zip(names, own, strict=True)
        ]
        rows += (differing := list(_differences(own, names)))
        rows += _means(own, names)
        compared = test.targets == PAPER and not departures
        published = paper.rates(test.split, PAPER) if compared else {}
        for agent, groups in published.items():
            rows.append(((f"{agent} (paper)", "", "", ""), groups))
        lines += ["", f"## Split {test.split}", ""]
        if test.targets not in (PAPER, OPEN):
            lines += [f"Targets: {in_markdown(test.targets)}.", ""]
        data = own[0]["data"]
        if len({of.data_version for of in tests}) > 1:
            rooms = "the bundled ones" if data is None else in_markdown(data)
            lines += [f"Rooms: {rooms}, scene tables {test.data_version}.", ""]
        lines += table(("Agent", "Updates", "Training episodes", "Actions"), rows)
        if differing:
            lines += ["", "Differences: in the same episodes, 95 % intervals (paired bootstrap)."]
        if published:
            lines += ["", paper.worlds(data)]
    return "\n".join(lines) + "\n"


_Row = tuple[Sequence[str], Mapping[str, Any]]


def _differences(results: Sequence[Result], names: Sequence[str]) -> Iterator[_Row]:
    """A row for each network that is compared with another."""
    for result, name in zip(results, names, strict=True):
        if (difference := result.get("difference")) is None:
            continue
        to = next(n for r, n in zip(results, names, strict=True) if r["run"] == difference["to"])
        groups = {
            group: {
                bucket: {measure: metrics.shown(part, measure) for measure in metrics.MEASURES}
                for bucket, part in difference[group].items()
            }
            for group in GROUPS
            if difference[group] is not None
        }
        yield (in_markdown(f"{name} minus {to}"), "", "", result["policy"]), groups


def _means(results: Sequence[Result], names: Sequence[str]) -> Iterator[_Row]:
    """A row for each label that several seeds share; none for points of histories."""
    if len(set(names)) < len(names):
        return
    together: dict[str, list[Result]] = {}
    for label, result in zip(labels(results, names), results, strict=True):
        together.setdefault(label, []).append(result)
    for label, seeds in together.items():
        if len(seeds) > 1:
            yield (
                (f"**{in_markdown(label)}, {len(seeds)} seeds**", "", "", seeds[0]["policy"]),
                summary(seeds),
            )


def common_departures(results: Iterable[Mapping[str, Any]]) -> Mapping[str, Any] | None:
    """How results that were played alike depart from the official test.

    They can only differ in word vectors, which are no departure of an agent that was trained with
    them (`SavedNetwork.departures`).
    """
    return max((r.get("departures") or {} for r in results), key=len, default=None) or None


class Curve(NamedTuple):
    """A learning curve: means and standard deviations over seeds at each point."""

    label: str
    episodes: list[float]  # training episodes, mean over seeds
    values: dict[tuple[str, str], list[Spread | None]]  # by group and measure, L >= 1


def curve(label: str, runs: Sequence[Sequence[Result]]) -> Curve:
    """The curve of one or several seeds, from the results of their histories.

    It has the points of the budget that all seeds have.
    """
    by_share = [{result["share"]: result for result in run} for run in runs]
    common = sorted(set.intersection(*(set(points) for points in by_share)))
    at = [[points[share] for points in by_share] for share in common]
    return Curve(
        label=label,
        episodes=[statistics.fmean(r["episodes_trained"] for r in seeds) for seeds in at],
        values={
            (group, measure): [
                spread(r[group]["L>=1"][measure] for r in seeds if r[group] is not None)
                for seeds in at
            ]
            for group in GROUPS
            for measure in MEASURES
        },
    )
