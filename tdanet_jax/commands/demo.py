"""Shows the bundled agent finding something: writes a page and opens it.

    tdanet demo
    tdanet demo --scene FloorPlan305 --target pillow

The page shows, step by step, the path on the floor plan, what the agent sees and attends to, and
its action probabilities. If --out ends in .gif, it becomes an animation.
"""

from __future__ import annotations

import dataclasses
import webbrowser
from pathlib import Path

from tdanet_jax import config as configs
from tdanet_jax.commands import one_episode
from tdanet_jax.commands.console import RunPath, check_file, console, fail, one_line_errors, parse
from tdanet_jax.commands.one_episode import Choice
from tdanet_jax.config import CONFIG_FILE
from tdanet_jax.io.bundled_agents import find_run, folder_of
from tdanet_jax.targets import PAPER

#: A task has rooms to train in and rooms to be tested in; these two are computed in no time.
SMALL_ROOMS = ("FloorPlan401", "FloorPlan428")


@dataclasses.dataclass(frozen=True)
class Command:
    """Shows the bundled agent finding something: writes a page and opens it."""

    checkpoint: RunPath = Path("18-4-best")
    """A bundled agent, or the folder of a run."""
    scene: str = "FloorPlan228"
    """One of the 120 iTHOR rooms."""
    target: str = "Laptop"
    """What to look for, by any of its names. Laptop is a class that the bundled agent was never
    trained to find."""
    seed: int = 3
    """Seed for drawing the start and sampling actions."""
    out: Path = Path("runs/demo.html")
    """Page (.html) or animation (.gif) to write."""
    show: bool = True
    """Open it in the browser."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet demo", description=__doc__)
        command = dataclasses.replace(command, checkpoint=find_run(command.checkpoint))
        choice = Choice(scene=command.scene, target=command.target, seed=command.seed)
        one_episode.check(choice, [command.checkpoint])
        check_file(command.out, (".html", ".gif"))
        show(command, choice)
        if command.show:
            webbrowser.open(command.out.resolve().as_uri())


def show(command: Command, choice: Choice) -> None:
    """Plays the episode, without the tables of all 120 rooms if it can, and writes the file."""
    from tdanet_jax.analysis import pictures, replay, trace
    from tdanet_jax.analysis.episode_lookup import name_ranges
    from tdanet_jax.io import files
    from tdanet_jax.scenes import floor_plan, ithor, tabulation
    from tdanet_jax.scenes.dataset import Rooms, load_rooms
    from tdanet_jax.training import devices

    devices.keep_compiled()
    devices.start()
    scenes = {scene.name: scene for scene in ithor.load_scenes()}
    if command.scene not in scenes:
        fail(f"--scene {command.scene}: no such room; there are {name_ranges([*scenes])}")
    console.print(f"{command.checkpoint.name} looks for {command.target} ...")
    names = dict.fromkeys((command.scene, *SMALL_ROOMS))
    classes = {item.object_class for scene in scenes.values() for item in scene.objects}
    config = configs.load(folder_of(command.checkpoint) / CONFIG_FILE)
    if config.sought == PAPER and not config.validation:
        tables = tabulation.build([scenes[name] for name in names], sorted(classes))
        rooms = Rooms(tables, extras=None)
    else:  # its targets are found in its training rooms, and those of validation are others
        rooms = load_rooms(None)
    rooms = one_episode.with_target(choice, rooms)
    player = trace.load_player(command.checkpoint, rooms)
    tables = player.task.tables
    traces = one_episode.play(choice, [command.checkpoint], [player], tables)
    command.out.parent.mkdir(parents=True, exist_ok=True)
    if command.out.suffix == ".gif":
        plan = floor_plan.of_room(tables, command.scene)
        pictures.animation(traces, plan, tables, command.out)
    else:
        files.write_text(command.out, replay.page(traces, tables))
    one_episode.print_outcomes(traces, command.out)
