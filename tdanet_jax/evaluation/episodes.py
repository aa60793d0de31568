"""Fixed lists of test episodes, stored as integers with the hash of their tables."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from tdanet_jax.io import assets
from tdanet_jax.scenes.dataset import Extras, PublishedEpisode, Rooms, find_targets
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.splits import GROUPS, NAMED, OPEN, UNSEEN, Split, make_split
from tdanet_jax.vocabulary import ALL_TARGETS

ASSET = "episodes.npz"
EPISODES_PER_ROOM_TYPE = 250
#: Of the open benchmark, for each target of a room type, by group.
EPISODES_PER_TARGET = {"seen": 10, "unseen": 40}
#: Seed of the lists; they change only with the tables.
LIST_SEED = 20240413


@dataclasses.dataclass(frozen=True)
class Episodes:
    """Starts and targets of E episodes.

    Attributes:
      pose: [E] int32, start pose in the full tables.
      target: [E] int32, index among the tables' targets.
    """

    pose: np.ndarray
    target: np.ndarray

    def __len__(self) -> int:
        return len(self.pose)


def draw(
    tables: SceneTables,
    scenes: Sequence[str],
    targets: Mapping[str, Sequence[str]],
    per_room_type: int,
    seed: int,
) -> Episodes:
    """Draws episodes as training does: uniformly a scene, then a target in it, then a start.

    Targets are those of the room type that can be reached from somewhere in the scene's rooms of
    this type; starts are positions in these rooms from which the target can be reached, with any
    rotation and horizon 0. In a house, the target may be in another room.
    """
    rng = np.random.default_rng(seed)
    index = {name: i for i, name in enumerate(tables.scenes)}
    reachable = tables.reachable
    starts, goals = [], []
    for kind, room in enumerate(tables.room_types):
        options = []
        for scene in scenes:
            positions = tables.positions_in(index[scene], kind)
            found = [tables.targets.index(name) for name in targets.get(room, ())]
            found = [goal for goal in found if reachable[positions, goal].any()]
            if found:
                options.append((positions, found))
        for _ in range(per_room_type if options else 0):
            positions, found = options[rng.integers(len(options))]
            goal = found[rng.integers(len(found))]
            valid = positions[reachable[positions, goal]]
            position = valid[rng.integers(len(valid))]
            starts.append(tables.grid.look_level(position, rng.integers(tables.grid.rotations)))
            goals.append(goal)
    return Episodes(np.array(starts, np.int32), np.array(goals, np.int32))


def draw_evenly(
    tables: SceneTables,
    scenes: Sequence[str],
    targets: Mapping[str, Sequence[str]],
    per_target: int,
    seed: int,
) -> Episodes:
    """Draws as many episodes for each target of a room type, in turn in the rooms with it.

    Starts are drawn as in `draw`; targets that can be found in none of the rooms are left out.
    """
    rng = np.random.default_rng(seed)
    reachable = tables.reachable
    starts, goals = [], []
    for kind, room in enumerate(tables.room_types):
        here = [tables.positions_in(tables.scenes.index(scene), kind) for scene in scenes]
        for name in targets.get(room, ()):
            goal = tables.targets.index(name)
            found = [valid for p in here if (valid := p[reachable[p, goal]]).size]
            for number in range(per_target if found else 0):
                valid = found[number % len(found)]
                position = valid[rng.integers(len(valid))]
                starts.append(tables.grid.look_level(position, rng.integers(tables.grid.rotations)))
                goals.append(goal)
    return Episodes(np.array(starts, np.int32), np.array(goals, np.int32))


def draw_split(tables: SceneTables, split: Split) -> dict[str, Episodes]:
    """The seen and the unseen list of a split; a split without unseen classes has none."""
    lists = {}
    for group, targets in zip(GROUPS, (split.seen, split.unseen), strict=True):
        if any(targets.values()):
            seed = LIST_SEED + GROUPS.index(group)
            what = tables, split.eval_scenes, targets
            lists[group] = (
                draw_evenly(*what, EPISODES_PER_TARGET[group], seed)
                if split.is_open
                else draw(*what, EPISODES_PER_ROOM_TYPE, seed)
            )
    return lists


def in_training_rooms(tables: SceneTables, split: Split) -> dict[str, Episodes]:
    """Episodes in a split's training rooms, by group, drawn as its test episodes are.

    Raises:
      ValueError: none can be drawn.
    """
    lists = draw_split(tables, dataclasses.replace(split, eval_scenes=split.train_scenes))
    return _found(lists, split, "training rooms")


def _found(lists: dict[str, Episodes], split: Split, where: str) -> dict[str, Episodes]:
    """The lists with an episode; one of seen targets must be among them."""
    lists = {group: episodes for group, episodes in lists.items() if len(episodes)}
    if "seen" not in lists:
        raise ValueError(f"no seen target of split {split.name} can be reached in its {where}")
    return lists


def build_asset(tables: SceneTables, out_dir: Path | str) -> Path:
    """Writes the lists of every published split, and of its validation, for these tables."""
    out_dir = Path(out_dir)
    arrays = {"data_version": np.frombuffer(tables.data_version.encode(), np.uint8)}
    for name in NAMED:
        for validation in (False, True):
            split = make_split(name, validation)
            if split.is_open:
                tables, targets = find_targets(OPEN, Rooms(tables, None), validation)
                split = make_split(name, validation, targets)
                version = np.frombuffer(tables.data_version.encode(), np.uint8)
                arrays[f"{OPEN}/data_version"] = version
            for group, episodes in draw_split(tables, split).items():
                arrays[f"{split.name}/{group}/pose"] = episodes.pose
                arrays[f"{split.name}/{group}/target"] = episodes.target
    np.savez(out_dir / ASSET, **arrays)  # type: ignore[arg-type]
    return out_dir / ASSET


def load(tables: SceneTables, split: Split, extras: Extras | None = None) -> dict[str, Episodes]:
    """The test episodes of a split, by group.

    In the bundled rooms, the lists of the published splits are stored; those of other splits are
    drawn in the same way. Imported rooms have the published episodes that came with them; a group
    without any that can be solved is drawn. A drawn list is the same every time.

    Args:
      extras: what came with imported rooms; None with the bundled ones.

    Raises:
      ValueError: the stored lists belong to other tables, or nothing can be evaluated.
    """
    if extras is None:
        return _committed(tables, split) or draw_split(tables, split)
    lists = draw_split(tables, split) | published(tables, split, extras.episodes)
    return _found(lists, split, "test rooms")


def published(
    tables: SceneTables, split: Split, listed: Sequence[PublishedEpisode]
) -> dict[str, Episodes]:
    """The published test episodes of a split's evaluation rooms, by group, if there are any.

    Episodes whose target cannot be reached are left out.
    """
    scenes = {name: i for i, name in enumerate(tables.scenes) if name in split.eval_scenes}
    lists: dict[str, Episodes] = {}
    for group, targets in zip(GROUPS, (split.seen, split.unseen), strict=True):
        starts, goals = [], []
        for episode in listed:
            scene = scenes.get(episode.scene)
            if scene is None or episode.part != "test":
                continue
            pose = tables.nearest_state(
                scene, episode.x, episode.z, episode.rotation, episode.horizon
            )
            if episode.target not in targets.get(tables.room_at(pose), ()):
                continue
            goal = tables.targets.index(episode.target)
            if tables.distance[pose, goal] >= 0:
                starts.append(pose)
                goals.append(goal)
        if starts:
            lists[group] = Episodes(np.array(starts, np.int32), np.array(goals, np.int32))
    return lists


def stored_version(of_open: bool) -> str:
    """The version of the scene tables that the stored lists belong to.

    Args:
      of_open: those of the open-vocabulary benchmark, whose tables have other targets.
    """
    with np.load(assets.path(ASSET), allow_pickle=False) as data:
        return bytes(data[f"{OPEN}/data_version" if of_open else "data_version"]).decode()


def _committed(tables: SceneTables, split: Split) -> dict[str, Episodes]:
    """The stored lists of a split that has a name, with its own targets; none of another."""
    version = stored_version(split.is_open)
    with np.load(assets.path(ASSET), allow_pickle=False) as data:
        if (split.is_open or tables.targets == ALL_TARGETS) and version != tables.data_version:
            raise ValueError(
                f"{ASSET} belongs to scene tables {version}, these are {tables.data_version}: "
                "reinstall tdanet_jax, or run `tdanet scenes build`"
            )
        if not split.is_open and not any(
            _same_targets(split, make_split(name, validation))
            for name in UNSEEN
            for validation in (False, True)
        ):
            return {}
        return {
            group: Episodes(
                data[f"{split.name}/{group}/pose"], data[f"{split.name}/{group}/target"]
            )
            for group in GROUPS
            if f"{split.name}/{group}/pose" in data
        }


def _same_targets(one: Split, other: Split) -> bool:
    """Whether two splits have one name, and seen and unseen targets in the same room types."""
    return (one.name, one.seen, one.unseen) == (other.name, other.seen, other.unseen)
