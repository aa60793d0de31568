"""Evaluation with senses that err: agents at five levels of each kind of noise, and the report."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tdanet_jax import sense_noise
from tdanet_jax.analysis import figures
from tdanet_jax.config import OWN_TASK, EvalConfig, describe_departures
from tdanet_jax.evaluation import metrics, report, saved_networks
from tdanet_jax.evaluation.metrics import MEASURES
from tdanet_jax.io import files
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.splits import GROUPS
from tdanet_jax.workflows.evaluate import short_names

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
) -> list[dict[str, Any]]:
    """Plays the fixed test episodes with each agent at each level of each kind of noise.

    All levels are played by one compiled program for each shape of network.

    Args:
      checkpoints: folders of runs.
      policy: "sample" or "greedy", how actions are chosen.
      test: where the evaluation departs from the runs' own task; without noise.
      seed: of sampled actions; by default each run's own.
      out: folder for `noise.json`, `noise.md` and `noise.png`; None writes nothing.
      on_network: called with the share that is done, and what was played last.
      plan: kind, name of the level and noise; the first without noise.

    Returns:
      A row for each agent and level: `agent`, `kind` (None without noise), `level` (the number in
      the level's name), `name`, `noise`, and by group the measures, and `change`, the paired
      differences from the same agent without noise (None for itself).

    Raises:
      ValueError: a folder holds no run, or its network cannot be read.
    """
    test.check()
    names = short_names(checkpoints)
    networks = {
        (run, i): dataclasses.replace(
            saved_networks.find(run, test=test)[0],
            test=dataclasses.replace(test, noise=str(noise)),
        )
        for run in names
        for i, (*_, noise) in enumerate(plan)
    }
    rows: dict[tuple[Path, int], dict[str, Any]] = {}
    clean: dict[Path, Mapping[str, report.Columns]] = {}
    # Runs of one task are played in the order in which they are given, each from its first level.
    keys = {id(network): key for key, network in networks.items()}
    for done in saved_networks.evaluate([*networks.values()], policy == "greedy", seed):
        run, i = keys[id(done.saved)]
        (kind, name, noise), columns = plan[i], done.columns()
        clean.setdefault(run, columns)
        rows[run, i] = {
            "agent": names[run],
            "kind": kind,
            "level": float(name.split()[-1]),
            "name": name,
            "noise": str(noise),
            **_by_group(
                columns, lambda part: metrics.summarise(*(part[c] for c in metrics.COLUMNS))
            ),
            "change": _changes(columns, clean[run]) if i else None,
            "evaluation_seed": done.provenance.evaluation_seed,
            "data_version": done.provenance.data_version,
            "departures": test.departures or None,
        }
        if on_network is not None:
            on_network(len(rows) / len(networks), f"{names[run]}, {kind or 'no noise'} {name}")
    ordered = [rows[key] for key in networks]
    if out is not None:
        _write(Path(out), ordered, policy)
    return ordered


def _by_group(columns: Mapping[str, report.Columns], of: Callable[[report.Columns], Any]) -> dict:
    return {group: of(columns[group]) if group in columns else None for group in GROUPS}


def _changes(ours: Mapping[str, report.Columns], clean: Mapping[str, report.Columns]) -> dict:
    return {
        group: metrics.difference(ours[group], clean[group]) if group in ours else None
        for group in GROUPS
    }


def _write(folder: Path, rows: Sequence[dict[str, Any]], policy: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    files.write_text(folder / "noise.md", markdown(rows, policy))
    figures.noise(rows, "Senses that err, test rooms", folder / "noise.png")
    files.write_text(folder / "noise.json", json.dumps(rows, indent=2) + "\n")


def markdown(rows: Sequence[Mapping[str, Any]], policy: str) -> str:
    """`noise.md`: a table for each kind of noise, absolute and relative to the same without."""
    first = rows[0]
    lines = [
        "# Senses that err",
        "",
        f"{policy} actions, scene tables {first['data_version']}, code {report.code_version()}. "
        "In percent, L >= 1; in brackets, the share of the same agent's figure without noise. "
        + metrics.COLLISION_FREE,
    ]
    if first["departures"]:
        lines += ["", f"**{in_markdown(describe_departures(first['departures']))}.**"]
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
