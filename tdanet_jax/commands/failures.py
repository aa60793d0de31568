"""Sorts a run's failed test episodes by cause, and writes some of them as pages.

    tdanet failures --checkpoint runs/...

Reads the run's episodes.jsonl; nothing is played again. Writes failures.md, failures.json,
failures.png and the replays of some failures into --out.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from tdanet_jax.commands import one_episode
from tdanet_jax.commands.console import (
    RunPath,
    check_folder,
    console,
    fail,
    folder_for,
    one_line_errors,
    parse,
)
from tdanet_jax.commands.one_episode import Choice
from tdanet_jax.io.bundled_agents import folder_of

if TYPE_CHECKING:
    from tdanet_jax.analysis.episode_lookup import Recorded
    from tdanet_jax.analysis.failures import Summary
    from tdanet_jax.scenes.dataset import Rooms


@dataclasses.dataclass(frozen=True)
class Command:
    """Sorts a run's failed test episodes by cause, and writes some of them as pages."""

    checkpoint: RunPath
    """Folder of a run, or a bundled agent's name."""
    replays: int = 5
    """Failures to write as pages: of each cause in turn, the commonest first. Without any, the
    run's network is not needed: rows of the scoreboard in results/ will do."""
    out: Path | None = None
    """Folder to write; by default <run>/failures."""
    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote; by default, the run's rooms."""
    word_vectors: str | None = None
    """File of word vectors, instead of the copy that the run holds of its own."""

    @property
    def choice(self) -> Choice:
        """The rooms and words, as the commands that show one episode take them."""
        return Choice(data=self.data, word_vectors=self.word_vectors)


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet failures", description=__doc__)
        if command.replays < 0:
            fail(f"--replays {command.replays}: must not be negative")
        if folder_of(command.checkpoint) != command.checkpoint:
            fail(f"--checkpoint {command.checkpoint}: give the run; its episodes are its last ones")
        out = command.out or folder_for(command.checkpoint) / "failures"
        check_folder(out)
        _write(command, out)


def _write(command: Command, out: Path) -> None:
    """Sorts, and writes the files."""
    from tdanet_jax.analysis import episode_lookup, failures, figures, trace
    from tdanet_jax.io import files
    from tdanet_jax.training import devices

    devices.keep_compiled()
    devices.start()
    run, choice = command.checkpoint, command.choice
    rooms = one_episode.rooms_of(choice, [run])
    task = trace.load_task(run, rooms, choice.word_vectors)
    records = episode_lookup.read_records(run, task.tables)
    summary = failures.summarise(
        run.resolve().name, task.split.name, records, task.tables, task.eval_params
    )
    shown = {f"episode-{f.episode}.html": f for f in failures.examples(summary, command.replays)}
    pages = _pages(command, rooms, {name: records[f.episode] for name, f in shown.items()})
    out.mkdir(parents=True, exist_ok=True)
    for old in _listed(out / "failures.md"):  # and not what someone else has put there
        (out / old).unlink(missing_ok=True)
    for name, page in pages.items():
        files.write_text(out / name, page)
    figures.failures(summary, out / "failures.png")
    files.write_text(out / "failures.json", json.dumps(failures.to_json(summary), indent=1) + "\n")
    files.write_text(out / "failures.md", failures.markdown(summary, "failures.png", shown))
    _print(summary)
    written = "failures.md, .json and .png"
    console.print(f"wrote {out / written}" + (f" and {len(pages)} replays" if pages else ""))


def _listed(report: Path) -> list[str]:
    """The pages that an earlier report links to."""
    text = report.read_text(encoding="utf-8", errors="replace") if report.is_file() else ""
    return re.findall(r"\((episode-\d+\.html)\)", text)


def _pages(command: Command, rooms: Rooms, chosen: Mapping[str, Recorded]) -> dict[str, str]:
    """Replays of recorded episodes, by file name; only they need the run's network."""
    from tdanet_jax.analysis import replay, trace

    if not chosen:
        return {}
    player = one_episode.load_players(command.choice, [command.checkpoint], rooms)[0]
    tables = player.task.tables
    return {
        name: replay.page([trace.retrace(player, tables, one.episode, one.actions)], tables)
        for name, one in chosen.items()
    }


def _print(summary: Summary) -> None:
    """Prints how many failed, and why."""
    from tdanet_jax.analysis.failures import CAUSES

    groups = summary.groups
    console.print(f"{summary.agent}, split {summary.split}")
    for heading, chosen in (
        ("episodes", None),
        ("failed", {}),
        *((cause.meaning, {"cause": key}) for key, cause in CAUSES.items()),
    ):
        counts = (
            summary.episodes(group=g) if chosen is None else summary.count(group=g, **chosen)
            for g in groups
        )
        indent = "    " if chosen else "  "
        cells = (f"{count:>5,} {group}" for count, group in zip(counts, groups, strict=True))
        console.print(f"{indent + heading:<62}" + "  ".join(cells))
