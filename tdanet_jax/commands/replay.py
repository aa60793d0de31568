"""Writes an episode as one self-contained HTML page.

    tdanet replay --checkpoint runs/... --scene FloorPlan228 --target Laptop

The page shows, step by step, the path on the floor plan, what the agent sees and attends to, its
action probabilities and its value; several agents side by side.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from tdanet_jax.commands import one_episode
from tdanet_jax.commands.console import check_file, one_line_errors, parse


@dataclasses.dataclass(frozen=True)
class Command(one_episode.Comparison):
    """Writes an episode as one self-contained HTML page."""

    out: Path = Path("replay.html")
    """Page to write."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet replay", description=__doc__)
        one_episode.check(command.choice, command.checkpoint)
        check_file(command.out, (".html",))
        from tdanet_jax.analysis import replay
        from tdanet_jax.io import files

        traces, tables = one_episode.play_runs(command)
        page = replay.page(traces, tables)
        command.out.parent.mkdir(parents=True, exist_ok=True)
        files.write_text(command.out, page)
        one_episode.print_outcomes(traces, command.out)
