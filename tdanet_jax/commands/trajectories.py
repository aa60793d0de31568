"""Draws the paths of one or several agents through the same episode on the floor plan.

    tdanet trajectories --checkpoint runs/A --checkpoint runs/B \\
        --scene FloorPlan228 --target Laptop --out trajectories.png

If --out ends in .gif, it becomes an animation: the path grows step by step, next to what the agent
sees and attends to.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from tdanet_jax.commands import one_episode
from tdanet_jax.commands.console import check_file, check_picture, one_line_errors, parse


@dataclasses.dataclass(frozen=True)
class Command(one_episode.Comparison):
    """Draws the paths of one or several agents through the same episode on the floor plan."""

    out: Path = Path("trajectories.png")
    """Picture to write (.png, .pdf, .svg or another format of Matplotlib), or an animation (.gif)
    with the camera's view."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet trajectories", description=__doc__)
        one_episode.check(command.choice, command.checkpoint)
        from tdanet_jax.analysis import pictures
        from tdanet_jax.scenes import floor_plan

        animated = command.out.suffix == ".gif"
        (check_file if animated else check_picture)(command.out)
        traces, tables = one_episode.play_runs(command)
        plan = floor_plan.of_room(tables, traces[0].scene)
        command.out.parent.mkdir(parents=True, exist_ok=True)
        draw = pictures.animation if animated else pictures.trajectories
        draw(traces, plan, tables, command.out)
        one_episode.print_outcomes(traces, command.out)
