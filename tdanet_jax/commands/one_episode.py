"""Shared by the commands that show one episode: which episode, and the agents that play it."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import tyro

from tdanet_jax import config as configs
from tdanet_jax.commands.console import RunPath, console, fail, load_rooms
from tdanet_jax.config import CONFIG_FILE
from tdanet_jax.decisions import OWN_DECISIONS, Decisions
from tdanet_jax.eval_config import EvalConfig
from tdanet_jax.io.bundled_agents import folder_of
from tdanet_jax.poses import TURNS

if TYPE_CHECKING:
    from tdanet_jax.analysis.trace import Player, Trace
    from tdanet_jax.scenes import SceneTables
    from tdanet_jax.scenes.dataset import Rooms


@dataclasses.dataclass(frozen=True)
class Choice:
    """Which episode to show."""

    scene: str | None = None
    """Room, such as FloorPlan228; requires --target."""
    target: str | None = None
    """Target class by any of its names, such as Laptop or tv; requires --scene."""
    start: tuple[float, float, int] | None = None
    """x and z in metres, rotation in degrees (in iTHOR a multiple of 45). The episode starts at the
    nearest reachable point, at most 0.5 m away. By default, a start is drawn."""
    episode: int | None = None
    """Instead of --scene and --target: an episode of the first checkpoint's episodes.jsonl, counted
    from 0. It is shown as recorded; further checkpoints play it from the same start."""
    seed: int = 0
    """Seed for drawing the start and sampling actions."""
    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote; by default, the first run's rooms."""
    word_vectors: str | None = None
    """File of word vectors, instead of the copies that the runs hold of their own."""
    policy: Literal["sample", "greedy"] = "sample"
    """Whether actions are sampled or the most probable ones are taken."""
    decisions: Decisions = OWN_DECISIONS
    """How the agents decide, instead of as their runs say."""

    @property
    def given(self) -> bool:
        """Whether any flag chooses an episode."""
        return any(flag is not None for flag in (self.scene, self.target, self.start, self.episode))


@dataclasses.dataclass(frozen=True)
class Comparison:
    """Flags of the commands that show several agents in the same episode."""

    checkpoint: tyro.conf.UseAppendAction[tuple[RunPath, ...]]
    """Folder of a run, or a bundled agent's name; repeat the flag to compare several."""
    choice: tyro.conf.OmitArgPrefixes[Choice]
    shortest: bool = False
    """Also shows the shortest path."""


def check(choice: Choice, runs: Sequence[Path], required: bool = True) -> None:
    """Ends the program, before anything is computed, unless the flags choose one episode.

    Args:
      required: whether an episode must be chosen.
    """
    if not runs:
        fail("give --checkpoint, the folder of a run")
    configs.check_seed(choice.seed)
    choice.decisions.check(choice.policy)
    if choice.start is not None:
        start = f"--start {' '.join(map(str, choice.start))}"
        if not all(map(math.isfinite, choice.start)):
            fail(f"{start}: must be finite")
        if choice.start[2] % min(TURNS):
            fail(f"{start}: rotation {choice.start[2]}: not a multiple of {min(TURNS)} degrees")
    for run in runs:
        configs.load(folder_of(run) / CONFIG_FILE)
    if choice.episode is not None:
        if (choice.scene, choice.target, choice.start) != (None, None, None):
            fail("--episode takes no --scene, --target or --start")
        _check_recorded(choice, runs)
    elif (choice.scene is None or choice.target is None) and (required or choice.given):
        fail("give --scene and --target, or --episode")


def _check_recorded(choice: Choice, runs: Sequence[Path]) -> None:
    """Fails if what was recorded is not the first run's, or if a flag of play plays nothing."""
    if folder_of(runs[0]) != runs[0]:
        fail(f"--checkpoint {runs[0]}: give the run; its episodes are those of its last network")
    given = [name for name in ("seed", "policy") if getattr(choice, name) != getattr(Choice, name)]
    given += choice.decisions.replaced
    if len(runs) == 1 and given:
        flag = given[0].replace("_", "-")
        fail(f"--{flag}: has no effect on --episode, which is shown as recorded")


def rooms_of(choice: Choice, runs: Sequence[Path]) -> Rooms:
    """The rooms of --data or of the first run, with --target among the targets if it is a class.

    Shows progress if they are rebuilt.
    """
    run = folder_of(runs[0])
    files = EvalConfig(data=choice.data, word_vectors=choice.word_vectors)
    data = files.locate(configs.load(run / CONFIG_FILE), run).data
    return with_target(choice, load_rooms(data))


def with_target(choice: Choice, rooms: Rooms) -> Rooms:
    """The rooms with --target among the targets if it is a class."""
    from tdanet_jax.labels import Labels
    from tdanet_jax.scenes.target_distances import with_targets

    classes = rooms.tables.classes
    sought = Labels(classes).find(choice.target) if choice.target else None
    asked = [sought] if sought in classes else []
    return dataclasses.replace(rooms, tables=with_targets(rooms.tables, asked))


def load_players(choice: Choice, runs: Sequence[Path], rooms: Rooms) -> list[Player]:
    """The agents of some runs, by different names; each run's targets follow those before it."""
    from tdanet_jax.analysis import trace

    greedy, words = choice.policy == "greedy", choice.word_vectors
    players = []
    for run in runs:
        players.append(trace.load_player(run, rooms, greedy, words, choice.decisions))
        rooms = dataclasses.replace(rooms, tables=players[-1].task.tables)
    names = [player.name for player in players]
    return [
        player if names.count(player.name) == 1 else dataclasses.replace(player, name=str(run))
        for player, run in zip(players, runs, strict=True)
    ]


def play(
    choice: Choice, runs: Sequence[Path], players: Sequence[Player], tables: SceneTables
) -> list[Trace]:
    """Each player's trace of the chosen episode; players[0] is the agent of runs[0]."""
    from tdanet_jax.analysis import episode_lookup, trace

    first: list[Trace] = []
    if choice.episode is not None:
        record = episode_lookup.read_record(folder_of(runs[0]), choice.episode, tables)
        episode = record.episode
        first = [trace.retrace(players[0], tables, episode, record.actions)]
    else:
        assert choice.scene is not None
        assert choice.target is not None
        start = None if choice.start is None else episode_lookup.Start(*choice.start)
        episode = episode_lookup.find(tables, choice.scene, choice.target, start, choice.seed)
    others = (trace.play(player, tables, episode, choice.seed) for player in players[len(first) :])
    return [*first, *others]


def play_runs(command: Comparison) -> tuple[list[Trace], SceneTables]:
    """Traces of the chosen episode by the agents of the runs, and the rooms in which it is."""
    from tdanet_jax.analysis import trace
    from tdanet_jax.training import devices

    devices.keep_compiled()
    devices.start()
    choice, runs = command.choice, command.checkpoint
    players = load_players(choice, runs, rooms_of(choice, runs))
    tables = players[0].task.tables
    if command.shortest:
        players.append(trace.Player("shortest path", players[0].task))
    return play(choice, runs, players, tables), tables


def print_outcomes(traces: Sequence[Trace], out: Path) -> None:
    """Prints the outcome of each trace, and the file that was written."""
    console.print(f"{traces[0].target} in {traces[0].scene}")
    for trace in traces:
        console.print(f"  {trace.player}: {trace.outcome}")
    console.print(f"wrote {out}")
