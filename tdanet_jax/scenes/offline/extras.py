"""What the original data contain in addition to scenes: parents, class graph, test episodes."""

from __future__ import annotations

import dataclasses
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.io.escaping import in_name
from tdanet_jax.io.untrusted import FileError, jsons, pickles, regular
from tdanet_jax.scenes.dataset import Extras, PublishedEpisode
from tdanet_jax.scenes.offline.layout import (
    PARENT_FILE,
    ROOM_NAMES,
    Grid,
    is_view,
    scene_name,
    state_key,
)
from tdanet_jax.splits import in_order, is_plain, known_type
from tdanet_jax.vocabulary import ROOM_TYPES

MOST_EPISODES, MOST_CLASSES = 100_000, 2_000
LARGEST_REWARD = 100.0
WIDEST = 4096  # numbers in an episode's word vector
#: Number of episodes to name, of those that are left out for one reason.
NAMED = 3
#: Lists of episodes are called <room>_test.pkl and <room>_val.pkl.
PARTS = ("test", "val")
EPISODE_FOLDER, GRAPH_FOLDER = "test_val_split", "gcn"
GRAPH_CLASSES, GRAPH_MATRIX = "objects.txt", "adjmat.dat"
#: Targets by room type; not one of the original's files.
TARGET_FILE = "targets.json"


class ImportedRoom(NamedTuple):
    """What the extras must fit."""

    grid: Grid
    classes: Collection[str]
    room_type: str


def read_extras(
    folders: Iterable[Path], rooms: Mapping[str, ImportedRoom], own: Collection[Path] = ()
) -> tuple[Extras, list[str]]:
    """Each of the extras from the first folder that has it, and lines on each.

    Args:
      folders: where to look for all of them but `targets.json`.
      rooms: the imported scenes by name; episodes that do not fit them are left out.
      own: the folders in which a `targets.json` is of these rooms: others use the name, too.

    Raises:
      FileError: a file is broken, or `targets.json` does not fit the rooms.
    """
    places = list(folders)
    parents, adjacency = _first(places, PARENT_FILE), _first(places, GRAPH_FOLDER)
    published, targets = _first(places, EPISODE_FOLDER), _first([*own], TARGET_FILE)
    extras, lines = Extras(), []
    if targets is not None:
        classes = {name for room in rooms.values() for name in room.classes}
        types = {*ROOM_TYPES, *(room.room_type for room in rooms.values())}
        extras = dataclasses.replace(extras, targets=read_targets(targets, classes, types))
        lines.append(f"{targets}: targets of {', '.join(extras.targets)}")
    if parents is not None:
        extras = dataclasses.replace(extras, parents=read_parents(parents))
        count = sum(len(targets) for targets in extras.parents.values())
        lines.append(f"{parents}: parents of {count} targets")
    if adjacency is not None:
        names, matrix = read_graph(adjacency / GRAPH_CLASSES, adjacency / GRAPH_MATRIX)
        extras = dataclasses.replace(extras, graph_classes=names, adjacency=matrix)
        lines.append(f"{adjacency}: a graph of {len(names)} classes")
    if published is not None:
        episodes: list[PublishedEpisode] = []
        left_out: dict[str, list[str]] = defaultdict(list)
        for path in sorted(p for part in PARTS for p in published.glob(f"*_{part}.pkl")):
            kept, others = read_episodes(path, rooms)
            episodes += kept
            for reason, found in others.items():
                left_out[reason] += found
        extras = dataclasses.replace(extras, episodes=tuple(episodes))
        lines.append(f"{published}: {len(episodes)} episodes")
        for reason, found in left_out.items():
            more = ", ..." if len(found) > NAMED else ""
            lines.append(
                f"{published}: {len(found)} episodes left out, {reason}: "
                f"{', '.join(found[:NAMED])}{more}"
            )
    return extras, lines


def _first(folders: list[Path], name: str) -> Path | None:
    return next((folder / name for folder in folders if (folder / name).exists()), None)


def read_parents(path: Path) -> dict[str, dict[str, dict[str, float]]]:
    """Room type -> target -> parent -> R_p, from `c2p_prob.json`.

    Raises:
      FileError: its structure is another, or a reward is not between 0 and 100.
    """
    result: dict[str, dict[str, dict[str, float]]] = {}
    for title, targets in jsons.members(path):
        if title not in ROOM_NAMES:
            raise FileError(path, f"room {title!r} is not one of {', '.join(ROOM_NAMES)}")
        if not isinstance(targets, Mapping):
            raise FileError(path, f"{title}: no targets")
        room = result[ROOM_TYPES[ROOM_NAMES.index(title)]] = {}
        for target, parents in targets.items():
            if not isinstance(parents, Mapping):
                raise FileError(path, f"{title}: {target}: no parents")
            room[target] = {
                name: jsons.number(path, value, f"{target}: {name}", LARGEST_REWARD)
                for name, value in parents.items()
            }
            if any(reward < 0 for reward in room[target].values()):
                raise FileError(path, f"{target}: a reward below 0")
    return result


def read_targets(
    path: Path, classes: Collection[str], types: Collection[str]
) -> dict[str, tuple[str, ...]]:
    """Room type -> target classes, from `targets.json`.

    Raises:
      FileError: its structure is another, a room type occurs twice, or no room is of a type or
        holds a class.
    """
    found: dict[str, tuple[str, ...]] = {}
    for title, names in jsons.members(path):
        room = known_type(title)
        if room not in types or room in found:
            problem = "is there twice" if room in found else "no room is of this type"
            raise FileError(path, f"{title}: {problem}")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise FileError(path, f"{title}: not a list of classes")
        for name in names:
            if name not in classes or not is_plain(name):
                raise FileError(path, f"{title}: {name}: no room holds such a class")
        found[room] = in_order(names)
    return found


def read_graph(names_path: Path, matrix_path: Path) -> tuple[tuple[str, ...], np.ndarray]:
    """The class graph: n names, and their adjacency [n, n] float32.

    Raises:
      FileError: a file is missing or broken, or they do not match.
    """
    try:
        text = regular.read_bytes(names_path).decode("utf-8-sig", errors="replace")
        content = regular.read_bytes(matrix_path)
    except FileNotFoundError as error:
        raise FileError(error.filename, "no such file") from None
    names = tuple(line.strip() for line in text.splitlines() if line.strip())
    if not 0 < len(names) <= MOST_CLASSES or len(set(names)) != len(names):
        raise FileError(names_path, "not a list of distinct class names")
    if odd := next((name for name in names if not name.isprintable()), None):
        raise FileError(names_path, f"class {odd[:40]}: has a control character")
    value = pickles.load_torch(content, matrix_path)
    matrix = pickles.array(value, matrix_path, MOST_CLASSES**2)
    if matrix.shape != (len(names), len(names)):
        raise FileError(matrix_path, f"shape {matrix.shape} is not that of {len(names)} classes")
    plain = matrix.astype(np.float32)
    if not (np.isfinite(plain) & (plain >= 0)).all():
        raise FileError(matrix_path, "holds NaN, infinity or a weight below 0")
    return names, plain


def read_episodes(
    path: Path, rooms: Mapping[str, ImportedRoom]
) -> tuple[list[PublishedEpisode], dict[str, list[str]]]:
    """The episodes of `<room>_<test|val>.pkl` that fit the rooms, and all others, by reason.

    Raises:
      FileError: it is not a list of episodes.
    """
    part = path.stem.rpartition("_")[2]
    if part not in PARTS:
        raise FileError(path, "not named <room>_test.pkl or <room>_val.pkl")
    records = pickles.load(regular.read_bytes(path), path)
    if not isinstance(records, list) or len(records) > MOST_EPISODES:
        raise FileError(path, "not a list of episodes")
    found: list[PublishedEpisode] = []
    others: dict[str, list[str]] = defaultdict(list)
    for i, episode in enumerate(_episodes(path, records, part)):
        if reason := _misfit(episode, rooms.get(episode.scene)):
            key = state_key(episode.x, episode.z, episode.rotation, episode.horizon)
            name = f"episode {i} of {path.name} ({episode.scene:.40} {key} {episode.target:.40})"
            others[reason].append(in_name(name))
        else:
            found.append(episode)
    return found, others


def _misfit(episode: PublishedEpisode, room: ImportedRoom | None) -> str | None:
    """Why an episode cannot be used, or None if it can."""
    if room is None:
        return "in rooms that were not imported"
    if not is_view(episode.rotation, episode.horizon):
        return "rotation or horizon not one of the task's"
    if room.grid.point_at(episode.x, episode.z) is None:
        return "start off the grid of grid.json"
    if episode.target not in room.classes:
        return "target not in the room"
    return None


def _episodes(path: Path, records: list[Any], part: str) -> Iterator[PublishedEpisode]:
    for i, record in enumerate(records):
        where = f"episode {i}"
        if not isinstance(record, dict) or not {"scene", "state", "goal_object_type"} <= set(
            record
        ):
            raise FileError(path, f"{where}: no scene, state and goal_object_type")
        scene, target = record["scene"], record["goal_object_type"]
        if not isinstance(scene, str) or not isinstance(target, str):
            raise FileError(path, f"{where}: scene or goal_object_type is not text")
        if "glove_embedding" in record:  # only checked: word vectors come from --word-vectors
            pickles.array(record["glove_embedding"], path, WIDEST)
        state = record["state"]
        fields = state.state if isinstance(state, pickles.Call) else None
        if not isinstance(fields, dict) or not state.name.endswith(pickles.AGENT_STATE):
            raise FileError(path, f"{where}: its state is not a {pickles.AGENT_STATE}")
        x, z, rotation, horizon = (
            jsons.number(path, fields.get(name), f"{where}: {name}", 1000.0)
            for name in ("x", "z", "rotation", "horizon")
        )
        yield PublishedEpisode(
            part, scene_name(scene), x, z, round(rotation), round(horizon), target
        )
