"""Writes an episode as one self-contained HTML page.

    python -m experiments.replay --checkpoint runs/... --scene FloorPlan228 --target Laptop

The page shows, step by step, the path on the floor plan, what the agent sees and attends to, its
action probabilities and its value; several agents side by side.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from experiments import one_episode
from experiments.console import one_line_errors, parse
from experiments.one_episode import Choice


@dataclasses.dataclass(frozen=True)
class Command:
    """Writes an episode as one self-contained HTML page."""

    checkpoint: tyro.conf.UseAppendAction[tuple[Path, ...]]
    """Folder of a run; repeat the flag to compare several."""
    choice: tyro.conf.OmitArgPrefixes[Choice]
    shortest: bool = False
    """Also show the shortest path."""
    out: Path = Path("replay.html")
    """Page to write."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    command = parse(Command, arguments, prog="replay", description=__doc__)
    with one_line_errors():
        one_episode.check(command.choice, command.checkpoint)
        write(command)


def write(command: Command) -> None:
    """Plays the episode and writes the page."""
    from tdanet_jax.analysis import replay
    from tdanet_jax.io import files
    from tdanet_jax.training import devices

    devices.keep_compiled()
    choice, runs = command.choice, command.checkpoint
    rooms = one_episode.load_rooms(choice, runs)
    traces = one_episode.play_runs(choice, runs, rooms, command.shortest)
    page = replay.page(traces, rooms.tables)
    command.out.parent.mkdir(parents=True, exist_ok=True)
    files.write_text(command.out, page)
    one_episode.print_outcomes(traces, command.out)


if __name__ == "__main__":
    main()
