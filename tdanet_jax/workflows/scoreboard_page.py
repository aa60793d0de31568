"""The blocks of the documentation that are made from the scoreboard's rows.

A block begins with `<!-- scoreboard: ... -->` and ends with `<!-- end -->`, each on a line of its
own. If it names a split, it is that split's part of the scoreboard; if it names rows, a table of
these; if one of them is a pattern, such as validation/rooms-*, a table of the agents of these rows.
"""

from __future__ import annotations

import fnmatch
import functools
import hashlib
import json
import re
import statistics
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

from tdanet_jax.analysis import figures
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.evaluation import comparison, metrics, paper
from tdanet_jax.io import files
from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.scenes.dataset import find_targets, load_rooms
from tdanet_jax.splits import GROUPS, NAMED, file_name, make_split
from tdanet_jax.targets import PAPER
from tdanet_jax.workflows.scoreboard import VALIDATION, Row

#: What the names of the rows begin with that show what more rooms, and more targets, give.
ROOMS, TARGETS = f"{VALIDATION}rooms-", f"{VALIDATION}targets-"
MARK = "<!-- scoreboard: "
_HEADS = ("Agent", "Senses beyond the paper's", "Seeds", "Steps", "Hours")
_BLOCK = re.compile(rf"^{MARK}([^\n]+) -->\n(.*?)^<!-- end -->$", re.DOTALL | re.MULTILINE)


def pages(root: Path | str, rows: Sequence[Row]) -> dict[Path, str]:
    """Every page of a clone that has blocks, as the rows make it.

    Args:
      root: the clone's folder, with `README.md` and `docs/`.
      rows: all rows.

    Raises:
      FileError: a block has no end, or names no row.
    """
    root = Path(root)
    paths = (root / "README.md", *root.glob("docs/**/*.md"))
    found = {path: path.read_text(encoding="utf-8") for path in paths}
    return {
        path: filled(path, text, rows)
        for path, text in found.items()
        if re.search(f"^{MARK}", text, re.MULTILINE)
    }


def filled(path: Path, text: str, rows: Sequence[Row]) -> str:
    """The text of a page with its blocks made from the rows.

    Raises:
      FileError: a block has no end, or names no row.
    """
    by_name = {row.name: row for row in rows}

    def named(pattern: str) -> list[Row]:
        found = [row for row in rows if fnmatch.fnmatchcase(row.name, pattern)]
        if not found:
            raise FileError(path, f"scoreboard: no row {pattern}")
        return found

    def fill(block: re.Match[str]) -> str:
        if MARK in block[2]:
            raise FileError(path, f"{MARK}{block[1]} --> has no <!-- end -->")
        if block[1] in NAMED:
            lines = of_split(block[1], rows)
        elif re.search(r"[*?[]", block[1]):  # what `fnmatch` heeds
            lines = of_agents([row for name in block[1].split() for row in named(name)])
        else:
            if unknown := [name for name in block[1].split() if name not in by_name]:
                raise FileError(path, f"scoreboard: no row {', '.join(unknown)}")
            lines = of_rows([by_name[name] for name in block[1].split()])
        return "\n".join([f"{MARK}{block[1]} -->", *lines, "<!-- end -->"])

    out = _BLOCK.sub(fill, text)
    if len(re.findall(f"^{MARK}", text, re.MULTILINE)) > len(_BLOCK.findall(text)):
        raise FileError(path, f"a block {MARK}... --> has no <!-- end -->")
    return out


def of_rows(rows: Iterable[Row]) -> list[str]:
    """A table of rows: SR and SPL of all episodes, with their intervals."""
    bucket, measures = "L>=1", comparison.MEASURES
    shown = [
        (
            (f"`results/{row.name}`",),
            {
                group: {bucket: {m: metrics.shown(row.results[group][bucket], m) for m in measures}}
                for group in GROUPS
                if row.results.get(group) is not None
            },
        )
        for row in rows
    ]
    return comparison.table(("Row",), shown, buckets=(bucket,), measures=measures)


def of_agents(rows: Iterable[Row]) -> list[str]:
    """A table of the agents of rows, in their order: SR and SPL of all episodes.

    The flags that all of them share are given once, before the table.
    """
    agents = _by_agent(rows)
    flags = [seeds[0].flags for seeds in agents.values()]
    common = [flag for flag in flags[0] if all(flag in own for own in flags)]
    shared = len(agents) > 1 and len(common) > 1
    one_model = shared and not common[0].startswith("--")
    shown = []
    for own, seeds in zip(flags, agents.values(), strict=True):
        rest = [flag for flag in own if flag not in common]
        name, _, *cells = _of_agent(seeds)
        if one_model:
            name = _code(" ".join(rest)) if rest else "as it is"
        elif shared:
            name = _named(rest)
        shown.append(((name, *cells), comparison.summary([row.results for row in seeds])))
    table = comparison.table(
        (_HEADS[0], *_HEADS[2:]), shown, buckets=("L>=1",), measures=comparison.MEASURES
    )
    what = f"is {_named(common)} with" if one_model else f"has {_code(' '.join(common))} and"
    said = [f"Each {what} what its row says.", ""] if shared else []
    return ["", *said, *table, ""]


def _by_agent(rows: Iterable[Row]) -> dict[str, list[Row]]:
    agents: dict[str, list[Row]] = {}
    for row in rows:
        agents.setdefault(row.agent, []).append(row)
    return agents


def of_split(split: str, rows: Iterable[Row]) -> list[str]:
    """A split's part of the scoreboard: its agents, the paper's, learning curves, and the runs."""
    own = sorted((row for row in rows if row.results["split"] == split), key=lambda row: row.name)
    agents = _by_agent(own)
    summaries = {
        agent: comparison.summary([row.results for row in seeds]) for agent, seeds in agents.items()
    }
    present = [group for group in GROUPS if any(out[group] for out in summaries.values())]
    best_first = sorted(
        agents, key=lambda agent: -(summaries[agent][present[-1]]["L>=1"]["SR"].mean)
    )
    published = paper.rates(split)
    shown = [(_of_agent(agents[agent]), summaries[agent]) for agent in best_first] + [
        ((f"{agent} (paper)", "", "", "", ""), groups) for agent, groups in published.items()
    ]
    lines = comparison.table(_HEADS, shown, groups=present, measures=("SR", "SPL", "CF-SR"))
    lines += ["", paper.worlds(None)] if published else []
    if any(row.metrics for row in own):
        name = picture(split)
        lines += ["", f"![SR and SPL in the training rooms against environment steps]({name})"]
    return ["", *lines, "", *_runs([row for agent in best_first for row in agents[agent]]), ""]


def _of_agent(seeds: Sequence[Row]) -> tuple[str, ...]:
    """The cells of an agent before its results."""
    steps = comparison.spread(row.results["steps"] / 1e6 for row in seeds)
    hours = [row.hours for row in seeds if row.hours is not None]
    trained = steps is not None and steps.mean > 0
    senses = seeds[0].senses
    return (
        _named(seeds[0].flags),
        "" if senses is None else ", ".join(map(in_markdown, senses)) or "none",
        ", ".join(str(row.results["seed"]) for row in seeds) if trained else "",
        f"{steps.mean:.1f} M" if steps is not None and trained else "",
        f"{statistics.fmean(hours):.2f}" if len(hours) == len(seeds) else "",
    )


def _runs(rows: Iterable[Row]) -> list[str]:
    """A table of who made each row, and how."""
    heads = ("Row", "Hours", "Hardware", "Code", "Command")
    lines = [f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
    for row in rows:
        cells = (
            f"`results/{row.name}`",
            "" if row.hours is None else f"{row.hours:.2f}",
            _listed(map(in_markdown, (p.machine for p in row.processes if p.machine))),
            _listed(map(in_markdown, (p.commit for p in row.processes if p.commit))),
            _listed(_code(p.command) for p in row.processes if p.command),
        )
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def _named(flags: Sequence[str]) -> str:
    """A model and its flags (`Row.flags`), which are no command."""
    model, *rest = flags
    return " ".join([in_markdown(model), *[_code(" ".join(rest))] * bool(rest)])


def _listed(texts: Iterable[str]) -> str:
    return "; ".join(dict.fromkeys(texts))


def _code(text: str) -> str:
    return f"<code>{in_markdown(text)}</code>"


def picture(split: str) -> str:
    """The name of the file in `docs/` with a split's learning curves."""
    return f"scoreboard-{file_name(split)}.png"


def write(root: Path | str, rows: Sequence[Row]) -> list[Path]:
    """Writes the blocks of all pages, and draws the learning curves and what more rooms and targets
    give, where they have changed.

    Returns:
      What was not up to date; pictures without rows are deleted.

    Raises:
      FileError: a block has no end, or names no row.
    """
    root, changed = Path(root), []
    for path, text in pages(root, rows).items():
        if path.read_text(encoding="utf-8") != text:
            files.write_text(path, text)
            changed.append(path)
    for split in NAMED:
        runs = [row for row in rows if row.results["split"] == split and row.metrics]
        curves = [(row.agent, row.metrics) for row in runs]
        draw = functools.partial(figures.training_curves, curves, f"Split {split}, training rooms")
        changed += _drawn(root / "docs" / picture(split), curves, draw)
    points = [_room_point(row) for row in rows if row.name.startswith(ROOMS)]
    others = [_target_point(row) for row in rows if row.name.startswith((ROOMS, TARGETS))]
    points += [point for point in others if point is not None]
    path = root / "docs" / "data_curve.png"
    return changed + _drawn(path, points, functools.partial(figures.data_curve, points))


def _drawn(path: Path, content: Sequence[Any], draw: Callable[[Path, str], None]) -> list[Path]:
    """Draws a picture whose content has changed, or deletes one without content; it, if so."""
    before = path.read_bytes() if path.exists() else None
    mark = hashlib.sha256(json.dumps(content).encode()).hexdigest()
    if content and (before is None or mark.encode() not in before):
        draw(path, mark)
    elif not content and before is not None:
        path.unlink()
    else:
        return []
    return [path]


#: What is counted, its kind and number, and SR and SPL by group.
Point = tuple[str, str, int, dict[str, dict[str, float]]]


def _room_point(row: Row) -> Point:
    """The kind and number of a run's training rooms. Raises ValueError: it was not trained here."""
    config = _config(row)
    own = len(make_split(config.split, config.validation).train_scenes)
    kinds = {
        "real rooms": 0 if config.generated_only else own,
        "variants": config.variants * own,
        "generated rooms": config.generated,
    }
    kind = " and ".join(name for name, count in kinds.items() if count)
    return "training rooms", kind, sum(kinds.values()), _rates(row)


def _target_point(row: Row) -> Point | None:
    """The number of a run's training targets, each of a room type; None in other than real rooms.

    Raises:
      ValueError: it was not trained here.
    """
    config = _config(row)
    if config.variants or config.generated:
        return None
    targets = None
    if config.targets != PAPER:
        targets = _targets(config.targets, config.validation)
    seen = make_split(config.split, config.validation, targets).seen
    count = sum(map(len, seen.values()))
    return "pairs of a room type and a target", "real rooms", count, _rates(row)


@functools.cache
def _targets(text: str, validation: bool) -> dict[str, tuple[str, ...]]:
    """The targets that `--targets` asks for in the bundled rooms, by room type."""
    return find_targets(text, load_rooms(None), validation)[1]


def _config(row: Row) -> TrainConfig:
    if row.config is None:
        raise ValueError(f"{row.name}: no {CONFIG_FILE}")
    return row.config


def _rates(row: Row) -> dict[str, dict[str, float]]:
    bucket = {group: row.results[group]["L>=1"] for group in GROUPS}
    return {group: {m: bucket[group][m] for m in comparison.MEASURES} for group in GROUPS}
