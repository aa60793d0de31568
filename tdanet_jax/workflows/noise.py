"""Evaluation with senses that err: agents at five levels of each kind of noise, and the report.

A sweep takes some ten minutes for each agent. `noise.json` is written after every level, and one
that was stopped continues with those that it does not hold.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from tdanet_jax import sense_noise
from tdanet_jax.analysis import figures
from tdanet_jax.eval_config import OWN_TASK, EvalConfig, describe_departures, rooms_played
from tdanet_jax.evaluation import comparison, metrics, report, results_file, saved_networks
from tdanet_jax.evaluation.metrics import MEASURES
from tdanet_jax.evaluation.saved_networks import SavedNetwork
from tdanet_jax.io import files
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.sense_noise import SWEEP_FILE
from tdanet_jax.splits import GROUPS, OF_VALIDATION
from tdanet_jax.workflows.evaluate import short_names

Row = dict[str, Any]
#: The kind, the level's name and the noise of everything that a sweep plays; first without noise.
PLAN = [
    (None, "0", sense_noise.NONE),
    *((kind, name, noise) for kind, levels in sense_noise.SWEEPS.items()
      for name, noise in levels.items()),
]  # fmt: skip


def evaluate_noise(
    checkpoints: Sequence[Path | str],
    policy: str = "sample",
    test: EvalConfig = OWN_TASK,
    seed: int | None = None,
    out: Path | str | None = None,
    on_network: Callable[[float, str], None] | None = None,
    plan: Sequence[tuple[str | None, str, sense_noise.SenseNoise]] = PLAN,
) -> list[Row]:
    """Plays the fixed test episodes with each agent at each level of each kind of noise.

    All levels are played by one compiled program for each shape of network.

    Args:
      checkpoints: folders of runs.
      policy: "sample" or "greedy", how actions are chosen.
      test: where the evaluation departs from the runs' own task; without noise.
      seed: of sampled actions; by default each run's own.
      out: folder for `noise.json`, `noise.md` and `noise.png`; None writes nothing. Levels that its
        `noise.json` holds are not played again.
      on_network: called with the share that is done, and what was played last; first with the share
        that is there.
      plan: kind, name of the level and noise; the first without noise.

    Returns:
      A row for each agent and level: `agent`, `kind` (None without noise), `level` (the number in
      the level's name), `name`, `noise`, and by group the measures, and `change`, the paired
      differences from the same agent without noise (None for itself).

    Raises:
      ValueError: a folder holds no run, its network cannot be read, or `noise.json` is not of the
        same agents, episodes, rooms and seed.
      BlockingIOError: another process writes to the folder.
    """
    report.code_version()  # as it is now
    test.check(policy, seed)
    folder = None if out is None else Path(out)
    with contextlib.nullcontext() if folder is None else files.locked(folder):
        if folder is not None:
            files.remove_partial(folder)
        levels = _levels(checkpoints, test, plan)
        same = {level.row["agent"]: level.same(policy, seed) for level in levels if level.is_clean}
        rows = {} if folder is None else _there(folder / SWEEP_FILE, levels, same)
        if on_network is not None:
            on_network(len(rows) / len(levels), f"{len(rows)} of {len(levels)} levels are there")
        for i, row in _played(levels, rows, same, policy == "greedy", seed):
            rows[i] = row
            if folder is not None:
                text = json.dumps([rows[i] for i in sorted(rows)], indent=2) + "\n"
                files.write_text(folder / SWEEP_FILE, text)
            if on_network is not None:
                name = f"{row['agent']}, {row['kind'] or 'no noise'} {row['name']}"
                on_network(len(rows) / len(levels), name)
        ordered = [rows[i] for i in range(len(levels))]
        if folder is not None:
            files.write_text(folder / "noise.md", markdown(ordered))
            configs = [level.network.config for level in levels]
            splits = [config.split + OF_VALIDATION * config.validation for config in configs]
            where = rooms_played(comparison.common_departures(ordered), splits)
            figures.noise(ordered, f"Senses that err, {where}", folder / "noise.png")
    return ordered


@dataclasses.dataclass(frozen=True)
class _Level:
    """An agent at a level of noise."""

    network: SavedNetwork
    row: Row  # what its row begins with

    @property
    def is_clean(self) -> bool:
        """Whether it is without noise."""
        return self.row["kind"] is None

    def same(self, policy: str, seed: int | None) -> Row:
        """What is known of its row before it is played, and equal for all rows of the agent."""
        snapshot, test = self.network.load(), self.network.test
        noiseless = dataclasses.replace(test, noise=None)
        return {
            "network": self.network.fingerprint(snapshot),
            "policy": policy,
            "updates": snapshot.updates,
            "evaluation_seed": self.network.config.seed if seed is None else seed,
            "test_targets": test.test_targets,
            "departures": dataclasses.replace(self.network, test=noiseless).departures or None,
        }


def _levels(
    checkpoints: Sequence[Path | str],
    test: EvalConfig,
    plan: Sequence[tuple[str | None, str, sense_noise.SenseNoise]],
) -> list[_Level]:
    """All that a sweep plays, in the order of its rows."""
    out = []
    for run, agent in short_names(checkpoints).items():
        (network,) = saved_networks.find(run, test=test)
        for kind, name, noise in plan:
            row = {
                "agent": agent, "kind": kind, "level": float(name.split()[-1]), "name": name,
                "noise": str(noise),
            }  # fmt: skip
            own = dataclasses.replace(test, noise=str(noise))
            out.append(_Level(dataclasses.replace(network, test=own), row))
    return out


def _there(path: Path, levels: Sequence[_Level], same: Mapping[str, Row]) -> dict[int, Row]:
    """The rows that a sweep has written, by their place among all.

    Args:
      path: of `noise.json`.
      levels: all that the sweep plays.
      same: what all rows of an agent must have, by its name.

    Raises:
      FileError: they are of other agents, levels, episodes or seeds, or the file is broken.
    """
    if not path.exists():
        return {}
    content = jsons.load(path, links=False)
    heads = [level.row for level in levels]
    versions: dict[str, str] = {}
    out = {}
    if not isinstance(content, list):
        raise FileError(path, "not the rows of a sweep")
    for row in content:
        results_file.check_groups(path, row, "a row, ")
        head = {name: row.get(name) for name in heads[0]}
        if head not in heads:
            what = f"{head['agent']}, {head['kind'] or 'no noise'} {head['name']}"
            raise FileError(path, f"holds {what}, which is not asked for; choose another --out")
        level = levels[i := heads.index(head)]
        if (agent := level.row["agent"]) not in versions:
            versions[agent] = level.network.data_version
        expected = {**same[agent], "data_version": versions[agent]}
        if differing := [name for name, value in expected.items() if row.get(name) != value]:
            raise FileError(
                path,
                f"{agent} was played with other values of {', '.join(differing)}; "
                "choose another --out",
            )
        out[i] = row
    return out


def _played(
    levels: Sequence[_Level],
    rows: Mapping[int, Row],
    same: Mapping[str, Row],
    greedy: bool,
    seed: int | None,
) -> Iterator[tuple[int, Row]]:
    """Plays the levels that have no row, and gives their places and rows."""
    agents = {level.row["agent"] for i, level in enumerate(levels) if i not in rows}
    # Differences need the episodes without noise, so these are played again.
    again = [level.is_clean and level.row["agent"] in agents for level in levels]
    networks = [one.network for i, one in enumerate(levels) if i not in rows or again[i]]
    place = {id(level.network): i for i, level in enumerate(levels)}
    clean: dict[str, Mapping[str, report.Columns]] = {}
    # Runs of one task are played in the order in which they are given, each from its first level.
    for done in saved_networks.evaluate(networks, greedy, seed):
        level, columns = levels[i := place[id(done.saved)]], done.columns()
        before = clean.setdefault(level.row["agent"], columns)
        row = {
            **level.row,
            **_by_group(
                columns, lambda part: metrics.summarise(*(part[c] for c in metrics.COLUMNS))
            ),
            "change": None if level.is_clean else _changes(columns, before),
            **same[level.row["agent"]],
            "data_version": done.provenance.data_version,
        }
        if i not in rows:
            yield i, row
        elif row != rows[i]:
            raise ValueError(
                f"{level.network.run}: plays the episodes otherwise than when the sweep began; "
                "choose another --out"
            )


def _by_group(columns: Mapping[str, report.Columns], of: Callable[[report.Columns], Any]) -> dict:
    return {group: of(columns[group]) if group in columns else None for group in GROUPS}


def _changes(ours: Mapping[str, report.Columns], clean: Mapping[str, report.Columns]) -> dict:
    return {
        group: metrics.difference(ours[group], clean[group]) if group in ours else None
        for group in GROUPS
    }


def markdown(rows: Sequence[Mapping[str, Any]]) -> str:
    """`noise.md`: a table for each kind of noise, absolute and relative to the same without."""
    first = rows[0]
    lines = [
        "# Senses that err",
        "",
        f"{first['policy']} actions, scene tables {first['data_version']}, "
        f"code {report.code_version()}. In percent, L >= 1; in brackets, the share of the same "
        "agent's figure without noise. " + metrics.COLLISION_FREE,
    ]
    if departures := comparison.common_departures(rows):
        lines += ["", f"**{in_markdown(describe_departures(departures))}.**"]
    if first.get("test_targets") is not None:
        lines += ["", f"Targets: {in_markdown(first['test_targets'])}."]
    heads = ["Level", "Agent", *(f"{group} {m}" for group in GROUPS for m in MEASURES)]
    clean = {row["agent"]: row for row in rows if row["kind"] is None}
    for kind in dict.fromkeys(row["kind"] for row in rows):
        own = [row for row in rows if row["kind"] == kind]
        levels = dict.fromkeys(row["name"] for row in own)
        lines += ["", f"## {(kind or 'without noise').capitalize()}", ""]
        lines += [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        for name in levels:
            for row in (row for row in own if row["name"] == name):
                cells = [
                    _cell(row[group], clean[row["agent"]][group] if kind else None, measure)
                    for group in GROUPS
                    for measure in MEASURES
                ]
                lines.append(f"| {' | '.join([name, in_markdown(row['agent']), *cells])} |")
    return "\n".join(lines) + "\n"


def _cell(ours: Mapping[str, Any] | None, clean: Mapping[str, Any] | None, measure: str) -> str:
    """A figure, and its share of that without noise."""
    value = None if ours is None else ours["L>=1"][measure]
    if value is None:
        return "-"
    before = None if clean is None else clean["L>=1"][measure]
    return f"{value:.1f} ({100 * value / before:.0f} %)" if before else f"{value:.1f}"
