"""Results of several networks side by side: rows of runs, means over seeds, learning curves.

A result is the content of a `results.json`, a plain dictionary; `saved.Evaluated.results` adds
where in its run the network was.
"""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from tdanet_jax import paper
from tdanet_jax.metrics import BUCKETS

Result = Mapping[str, Any]
GROUPS = ("seen", "unseen")
MEASURES = ("SR", "SPL")


class Spread(NamedTuple):
    """A mean over seeds; `sd` is the deviation of single seeds, None for one seed."""

    mean: float
    sd: float | None

    def __str__(self) -> str:
        return f"{self.mean:.1f}" if self.sd is None else f"{self.mean:.1f} ± {self.sd:.1f}"


class Key(NamedTuple):
    """What results differ in that are no repetitions of one another."""

    split: str
    model: str
    policy: str
    data_version: str


def by_key(results: Iterable[Result]) -> dict[Key, list[Result]]:
    """Results of equal split, model, policy and rooms together: one for each seed."""
    out: dict[Key, list[Result]] = {}
    for result in results:
        key = Key(*(result[name] for name in Key._fields))
        out.setdefault(key, []).append(result)
    return out


def spread(values: Iterable[float | None]) -> Spread | None:
    """Mean and deviation of what is not None; None if nothing is left."""
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
                measure: spread(part[bucket][measure] for part in found) for measure in MEASURES
            }
            for bucket in BUCKETS
        } if found else None  # fmt: skip
    return out


def table(
    first: Sequence[str], rows: Iterable[tuple[Sequence[str], Mapping[str, Any]]]
) -> list[str]:
    """A table in the paper's form: SR and SPL of seen and unseen targets, L >= 1 and L >= 5.

    Args:
      first: headings of the columns before the figures.
      rows: the cells of these columns, and group -> bucket -> measure -> anything that prints.
    """
    names = [f"{g} {m} {b}" for g in GROUPS for b in BUCKETS for m in MEASURES]
    heads = [*first, *names]
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for cells, groups in rows:
        figures = [
            _cell(((groups.get(group) or {}).get(bucket) or {}).get(measure))
            for group in GROUPS
            for bucket in BUCKETS
            for measure in MEASURES
        ]
        lines.append(f"| {' | '.join([*cells, *figures])} |")
    return lines


def _cell(value: object) -> str:
    if value is None:
        return "-"
    return f"{value:.1f}" if isinstance(value, float) else str(value)


def paper_rows(split: str) -> dict[str, dict[str, Any]]:
    """The paper's agents on a split: name -> group -> bucket -> measure."""
    out: dict[str, dict[str, Any]] = {}
    for group in GROUPS:
        for agent, rates in paper.rates(split, group):
            out.setdefault(agent, {})[group] = {
                bucket: {"SR": rate.sr, "SPL": rate.spl} for bucket, rate in rates.items()
            }
    return out


def markdown(title: str, results: Sequence[Result], runs: Sequence[str]) -> str:
    """A page about several networks: a row for each, means over seeds, the paper's rows.

    Args:
      results: as `saved.Evaluated.results` gives them.
      runs: a short name for each.
    """
    lines = [f"# {title}", "", "SR and SPL in percent, test rooms."]
    for split in dict.fromkeys(result["split"] for result in results):
        own = [
            (result, run) for result, run in zip(results, runs, strict=True)
            if result["split"] == split
        ]  # fmt: skip
        rows = [
            ((run, f"{r['updates']:,}", f"{r['episodes_trained']:,}", r["policy"]), r)
            for r, run in own
        ]
        if len({run for _, run in own}) == len(own):
            for key, members in by_key(result for result, _ in own).items():
                if len(members) > 1:
                    mean = f"**{key.model}, {len(members)} seeds**"
                    rows.append(((mean, "", "", key.policy), summary(members)))
        for agent, groups in paper_rows(split).items():
            rows.append(((f"{agent} (paper)", "", "", ""), groups))
        lines += ["", f"## Split {split}", ""]
        lines += table(("Agent", "Updates", "Training episodes", "Actions"), rows)
        if paper_rows(split):
            worlds = dict.fromkeys(paper.worlds(result["data"]) for result, _ in own)
            lines += ["", *worlds]
    return "\n".join(lines) + "\n"


class Curve(NamedTuple):
    """A learning curve: means over seeds at each point, and how far single seeds lie from them."""

    label: str
    episodes: list[float]  # training episodes, mean over seeds
    values: dict[tuple[str, str], list[Spread | None]]  # by group and measure, L >= 1


def curve(label: str, runs: Sequence[Sequence[Result]]) -> Curve:
    """The curve of one or several seeds, from the results of their histories.

    Only the points of the budget that every seed has are taken.
    """
    by_point = [{result["point"]: result for result in run} for run in runs]
    shared = sorted(set.intersection(*(set(points) for points in by_point)))
    at = [[points[point] for points in by_point] for point in shared]
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
