"""Looks up episodes: one by room, target and start, or those that a run has recorded."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.evaluation import episodes
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.evaluation.report import EPISODES_FILE
from tdanet_jax.io.untrusted import FileError, jsons, regular
from tdanet_jax.labels import Labels
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.splits import GROUPS
from tdanet_jax.vocabulary import ACTION_NAMES

#: How far from a start the nearest reachable point may be, in metres.
FARTHEST_START = 0.5


class Start(NamedTuple):
    """Where an episode starts: at the nearest reachable point, at most 0.5 m away."""

    x: float  # metres
    z: float  # metres
    rotation: int  # degrees clockwise from +z
    horizon: int = 0  # degrees down


class Recorded(NamedTuple):
    """An episode of a run's `episodes.jsonl`."""

    episode: Episodes
    actions: np.ndarray  # [T] int
    group: str  # "seen" or "unseen"


def find(
    tables: SceneTables, scene: str, target: str, start: Start | None = None, seed: int = 0
) -> Episodes:
    """One episode in a room.

    Args:
      target: a target class, or a label that means it, such as "tv".
      start: by default one is drawn, as for test episodes; in a house, in a room of any type.
      seed: for drawing the start.

    Raises:
      ValueError: there is no such room, target or heading, no reachable point near the start, or
        the target is out of reach; the message lists what there is.
    """
    if scene not in tables.scenes:
        raise ValueError(f"{scene}: no such room; there are {name_ranges(tables.scenes)}")
    index = tables.scenes.index(scene)
    level = tables.grid.look_level(np.flatnonzero(tables.position_scene == index))
    within = tables.distance[level].max(axis=0, initial=-1) >= 0
    found = sorted(name for name, ok in zip(tables.targets, within, strict=True) if ok)
    if target not in tables.targets:
        target = Labels(tables.classes).find(target) or target
    if target not in found:
        raise ValueError(
            f"{target}: no target that can be seen in {scene}; there: {', '.join(found) or 'none'}"
        )
    if start is None:
        one_type = np.zeros_like(tables.position_room_type)
        house = dataclasses.replace(tables, position_room_type=one_type)
        return episodes.draw(house, [scene], {tables.room_types[0]: [target]}, 1, seed)
    pose, goal = tables.nearest_state(index, *start), tables.targets.index(target)
    x, _, z = tables.position[tables.grid.split(pose).position]
    away = math.hypot(x - start.x, z - start.z)
    if not away <= FARTHEST_START:  # so that NaN is refused, too
        raise ValueError(
            f"start at x {start.x:g}, z {start.z:g}: {away:.2f} m from the nearest reachable point "
            f"in {scene}, x {x:g}, z {z:g}; at most {FARTHEST_START} m"
        )
    if tables.distance[pose, goal] < 0:
        raise ValueError(f"{target}: out of reach from x {start.x:g}, z {start.z:g} in {scene}")
    return Episodes(np.array([pose], np.int32), np.array([goal], np.int32))


def name_ranges(names: Sequence[str]) -> str:
    """Names with runs of numbers abbreviated: "FloorPlan1-30, FloorPlan201-230"."""
    stems = [re.sub(r"\d+$", "", name) for name in names]
    numbers = [int(name[len(stem) :] or -1) for name, stem in zip(names, stems, strict=True)]
    # Within a run of numbers, number minus index is constant.
    runs = itertools.groupby(range(len(names)), key=lambda i: (stems[i], numbers[i] - i))
    ends = [(run[0], run[-1]) for run in (list(members) for _, members in runs)]
    return ", ".join(names[a] + (f"-{numbers[b]}" if b > a else "") for a, b in ends)


def read_record(run: Path | str, index: int, tables: SceneTables) -> Recorded:
    """Episode `index`, counted from 0, of a run's `episodes.jsonl`.

    Raises:
      ValueError: there is no such episode, or it does not belong to these tables.
    """
    path, lines = _lines(run)
    if not 0 <= index < len(lines):
        raise ValueError(f"{path}: no episode {index}; there are 0 to {len(lines) - 1}")
    return _parse(path, index, lines[index], tables)


def read_records(run: Path | str, tables: SceneTables) -> list[Recorded]:
    """All episodes of a run's `episodes.jsonl`, in its order.

    Raises:
      ValueError: there are none, or one does not belong to these tables.
    """
    path, lines = _lines(run)
    if not lines:
        raise ValueError(f"{path}: no episodes")
    return [_parse(path, index, line, tables) for index, line in enumerate(lines)]


def _lines(run: Path | str) -> tuple[Path, list[str]]:
    """The file of a run's records, and its lines."""
    path = Path(run) / EPISODES_FILE
    try:
        return path, regular.read_text(path, links=False).splitlines()
    except FileNotFoundError:
        raise ValueError(
            f"{path}: no such file; a run writes it when training ends (rows of "
            "results/validation/ have none)"
        ) from None


def _parse(path: Path, index: int, line: str, tables: SceneTables) -> Recorded:
    where = f"{path}, line {index + 1}"
    row = jsons.parse(where, line)
    try:
        return _recorded(where, row, tables)
    except FileError:
        raise
    except ValueError as error:
        raise FileError(where, error) from None


def _recorded(where: str, row: Any, tables: SceneTables) -> Recorded:
    if not isinstance(row, dict):
        raise FileError(where, "not the record of an episode")
    x, z, rotation, horizon, _ = (
        jsons.number(where, row.get(name), name, 1e6)
        for name in ("x", "z", "rotation", "horizon", "L")
    )
    for name in ("scene", "target"):
        if not isinstance(row.get(name), str):
            raise FileError(where, f"{name} is not text")
    if row.get("group") not in GROUPS:
        raise FileError(where, f"group is not one of {', '.join(GROUPS)}")
    start = Start(x, z, round(rotation), round(horizon))
    episode = find(tables, row["scene"], row["target"], start)
    if not isinstance(row.get("actions"), list):
        raise FileError(where, "actions is not a list")
    for name in row["actions"]:
        if name not in ACTION_NAMES:
            raise ValueError(f"{name!r}: no action; there are {', '.join(ACTION_NAMES)}")
    actions = np.array([ACTION_NAMES.index(name) for name in row["actions"]], int)
    place = tables.position[tables.grid.split(episode.pose[0]).position][[0, 2]]
    shortest = tables.distance[episode.pose[0], episode.target[0]] + 1
    if not np.allclose(place, (x, z), atol=1e-3) or shortest != row["L"]:
        raise ValueError("recorded on other scene tables")
    if not len(actions):
        raise ValueError("no actions")
    return Recorded(episode, actions, row["group"])
