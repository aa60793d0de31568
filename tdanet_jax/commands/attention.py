"""Shows what a trained agent attends to.

    tdanet attention --checkpoint runs/...
    tdanet attention --checkpoint runs/... --scene FloorPlan228 --target Laptop

The first form plays the fixed test episodes, and writes to --out the mean attention by class pair
(class_pairs.csv, .md, .png) and a picture of one episode. The second draws the chosen episode.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import tyro

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
    from tdanet_jax.analysis.trace import Player, Trace
    from tdanet_jax.evaluation.episodes import Episodes
    from tdanet_jax.evaluation.rollout import Records
    from tdanet_jax.scenes import SceneTables

Played = Mapping[str, tuple["Episodes", "Records"]]


@dataclasses.dataclass(frozen=True)
class Command:
    """Shows what a trained agent attends to."""

    checkpoint: RunPath
    """Folder of a run, or a bundled agent's name."""
    choice: tyro.conf.OmitArgPrefixes[Choice]
    out: Path | None = None
    """Folder to write; by default <run>/attention-<policy>, or <run>/attention-<policy>-<updates>
    for a point of the run's history."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet attention", description=__doc__)
        one_episode.check(command.choice, [command.checkpoint], required=False)
        check_folder(command.out or default_folder(command))
        show(command)


def show(command: Command) -> None:
    """Plays, and writes the tables and pictures."""
    from tdanet_jax.analysis import pictures
    from tdanet_jax.training import devices

    devices.keep_compiled()
    devices.start()
    choice, runs = command.choice, [command.checkpoint]
    out = command.out or default_folder(command)
    player = one_episode.load_players(choice, runs, one_episode.rooms_of(choice, runs))[0]
    tables = player.task.tables
    if not player.attends:
        fail(
            f"--checkpoint {command.checkpoint}: this model has no attention over the detections; "
            "the TDANet models have"
        )
    if choice.given:
        trace = one_episode.play(choice, runs, [player], tables)[0]
    else:
        played = play_lists(player, tables, choice.seed)
        write_pairs(player, tables, played, out)
        trace = example(player, tables, played)
    out.mkdir(parents=True, exist_ok=True)
    picture = out / f"{trace.scene}-{trace.target}.png"
    pictures.attention_episode(trace, tables, picture)
    console.print(f"{trace.target} in {trace.scene}: {trace.outcome}")
    console.print(f"wrote {picture}")


def default_folder(command: Command) -> Path:
    """The default of --out: one folder for each network and policy."""
    run = folder_of(command.checkpoint)
    point = "" if run == command.checkpoint else f"-{command.checkpoint.stem}"
    return folder_for(run) / f"attention-{command.choice.policy}{point}"


def play_lists(player: Player, tables: SceneTables, seed: int) -> Played:
    """Plays the fixed test episodes."""
    from tdanet_jax.evaluation import episodes, rollout

    lists = episodes.load(tables, player.task.split, player.task.extras)
    console.print(f"playing {sum(map(len, lists.values())):,} test episodes ...")
    params = player.task.eval_params
    return rollout.evaluate_lists(player.policy, player.weights, params, lists, seed)


def write_pairs(player: Player, tables: SceneTables, played: Played, out: Path) -> None:
    """Writes the mean attention by class pair as a table, a page and a picture."""
    import numpy as np

    from tdanet_jax.analysis import attention, figures, trace
    from tdanet_jax.io import files

    assert player.model is not None
    task = player.task
    visits = [trace.visited(*pair, task.eval_params) for pair in played.values()]
    pose, target = (np.concatenate(part) for part in zip(*visits, strict=True))
    pairs = attention.class_pairs(
        player.model, player.weights, task.words, pose, target, task.eval_params,
        tables.targets, tables.classes,
    )  # fmt: skip
    unseen = {name for names in task.split.unseen.values() for name in names}
    out.mkdir(parents=True, exist_ok=True)
    title = f"Attention of {player.name}, test episodes of split {task.split.name}"
    with files.replacing(out / "class_pairs.csv") as path:
        attention.write_csv(pairs, path)
    files.write_text(out / "class_pairs.md", attention.markdown(pairs, title, unseen))
    figures.class_pairs(pairs, unseen, title, out / "class_pairs.png")
    console.print(f"{len(pose):,} frames; wrote {out / 'class_pairs.csv'}, .md and .png")


def example(player: Player, tables: SceneTables, played: Played) -> Trace:
    """The first success with L >= 5, unseen targets first; failing that, the first episode."""
    import numpy as np

    from tdanet_jax.analysis import trace
    from tdanet_jax.evaluation.episodes import Episodes

    for wanted in (5, 1, 0):
        for chosen, records in reversed(list(played.values())):
            found = np.flatnonzero((records.shortest >= wanted) & (records.success | (wanted == 0)))
            if len(found):
                one = slice(found[0], found[0] + 1)
                episode = Episodes(chosen.pose[one], chosen.target[one])
                actions = records.actions[found[0], : records.length[found[0]]]
                return trace.retrace(player, tables, episode, actions)
    raise ValueError("no test episodes")
