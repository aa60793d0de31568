"""Draws the paths of one or several agents through the same episode on the floor plan.

python -m experiments.trajectories --checkpoint runs/A --checkpoint runs/B \\
    --scene FloorPlan228 --target Laptop --out trajectories.png
python -m experiments.trajectories --checkpoint runs/A \\
    --scene FloorPlan228 --target Laptop --out episode.gif

The second writes an animation: the growing path, next to what the agent sees and attends to.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from experiments import one_episode
from experiments.console import check_picture, one_line_errors, parse
from experiments.one_episode import Choice


@dataclasses.dataclass(frozen=True)
class Command:
    """Draws the paths of one or several agents through the same episode on the floor plan."""

    checkpoint: tyro.conf.UseAppendAction[tuple[Path, ...]]
    """Folder of a run; repeat the flag to compare several."""
    choice: tyro.conf.OmitArgPrefixes[Choice]
    shortest: bool = False
    """Also draw the shortest path."""
    out: Path = Path("trajectories.png")
    """Picture to write (.png, .pdf, .svg), or an animation (.gif) with the camera's view."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    command = parse(Command, arguments, prog="trajectories", description=__doc__)
    with one_line_errors():
        one_episode.check(command.choice, command.checkpoint)
        write(command)


def write(command: Command) -> None:
    """Plays the episode and draws it."""
    from tdanet_jax.analysis import pictures
    from tdanet_jax.scenes import floor_plan
    from tdanet_jax.training import devices

    animated = command.out.suffix == ".gif"
    if not animated:
        check_picture(command.out)
    devices.keep_compiled()
    choice, runs = command.choice, command.checkpoint
    rooms = one_episode.load_rooms(choice, runs)
    traces = one_episode.play_runs(choice, runs, rooms, command.shortest)
    plan = floor_plan.of_room(rooms.tables, traces[0].scene)
    command.out.parent.mkdir(parents=True, exist_ok=True)
    draw = pictures.animation if animated else pictures.trajectories
    draw(traces, plan, rooms.tables, command.out)
    one_episode.print_outcomes(traces, command.out)


if __name__ == "__main__":
    main()
