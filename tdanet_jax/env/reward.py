"""Partial rewards: which objects are parents of a target, and what seeing one is worth.

R_p = R_t * Pr(t | p) * 0.1 (the paper's Eq. 3 and its text). Pr(t | p) is estimated in the training
rooms of the target's type, or types, and in houses with such a room: over rooms that hold both
classes, the share in which the nearest instances are within 1.5 m of each other.

SSNet (Zhao et al. 2023) pays for likeness instead: 0.1 times the cosine between the word vectors of
the target and of a class in view, whenever it is the largest of the episode so far.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tdanet_jax.scenes.tables import SceneTables
    from tdanet_jax.splits import Split

#: Reward of any step that earns nothing else, a failed Done included.
STEP_REWARD = -0.01
#: R_t, the reward of a `Done` with the target visible.
DONE_REWARD = 5.0
#: R_p = R_t * Pr(t | p) * PARENT_SHARE.
PARENT_SHARE = 0.1
PARENTS_PER_TARGET = 3
#: What a cosine of 1 is worth where likeness is paid for.
SIMILARITY_SHARE = 0.1
#: Nearest instances at most this far apart (metres, centre to centre) count as together.
NEAR = 1.5
#: A parent stands in at least this share of the rooms that hold the target: one room proves little.
MIN_SUPPORT = 0.25

#: The larger, receptacle-like classes that can be parents.
PARENT_CANDIDATES = (
    "ArmChair", "Bathtub", "Bed", "Cabinet", "CoffeeMachine", "CoffeeTable", "CounterTop", "Desk",
    "DiningTable", "Drawer", "Dresser", "FloorLamp", "Fridge", "Microwave", "Ottoman", "Shelf",
    "ShelvingUnit", "ShowerDoor", "SideTable", "Sink", "Sofa", "StoveBurner", "TVStand", "Toilet",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Parents:
    """Parents of each target.

    Attributes:
      classes: [G, 3] int32 class indices, -1 where a target has fewer than three.
      reward: [G, 3] float32, R_p; 0 where there is no parent.
    """

    classes: np.ndarray
    reward: np.ndarray


def no_parents(tables: SceneTables) -> Parents:
    """Parents of nothing: no partial reward."""
    shape = len(tables.targets), PARENTS_PER_TARGET
    return Parents(np.full(shape, -1, np.int32), np.zeros(shape, np.float32))


def cosines(words: np.ndarray) -> np.ndarray:
    """Cosines between all word vectors [C, D]: [C, C] float32, 0 where a vector is zero."""
    length = np.linalg.norm(words, axis=1, keepdims=True)
    unit = words / np.where(length > 0, length, 1.0)
    return np.clip(unit @ unit.T, -1.0, 1.0).astype(np.float32)


def greatest_similarity(tables: SceneTables, cosine: np.ndarray) -> np.ndarray:
    """The largest cosine between each target and a class in view: [S, G] float32, 0 in an empty
    frame.

    Args:
      tables: training rooms, without the classes that training must not know.
      cosine: [C, C], from `cosines`.
    """
    found = np.zeros((tables.num_states, len(tables.targets)), np.float32)
    filled = np.flatnonzero(np.diff(tables.row_start))
    boxed = tables.row_box[:, 0] >= 0  # what is visible without a known box is no detection
    if filled.size:
        for goal, target in enumerate(tables.targets):
            of_row = cosine[tables.classes.index(target)][tables.row_class] * boxed
            found[filled, goal] = np.maximum.reduceat(of_row, tables.row_start[filled])
    return found


def find_parents(tables: SceneTables, targets: Mapping[str, Sequence[str]]) -> Parents:
    """The parents of every target.

    Args:
      tables: training rooms only, and without the classes that training must not know.
      targets: room type -> target classes; a target without a room type gets no parents.
    """
    classes = np.full((len(tables.targets), PARENTS_PER_TARGET), -1, np.int32)
    reward = np.zeros((len(tables.targets), PARENTS_PER_TARGET), np.float32)
    for goal, target in enumerate(tables.targets):
        sought = [target in targets.get(room, ()) for room in tables.room_types]
        scenes = np.unique(tables.position_scene[np.array(sought)[tables.position_room_type]])
        for slot, (share, name) in enumerate(_nearest_classes(tables, target, scenes)):
            classes[goal, slot] = tables.classes.index(name)
            reward[goal, slot] = DONE_REWARD * share * PARENT_SHARE
    return Parents(classes, reward)


def named_parents(tables: SceneTables, split: Split) -> dict[str, dict[str, dict[str, float]]]:
    """The parents of a split's targets in its training rooms: room type -> target -> parent -> R_p.

    Targets without parents are left out.
    """
    scenes = [name for name in split.train_scenes if name in tables.scenes]
    targets = {
        room: tuple(name for name in names if name in tables.targets)
        for room, names in split.seen.items()
    }
    found = find_parents(tables.subset(scenes), targets)
    named: dict[str, dict[str, dict[str, float]]] = {}
    for room, names in targets.items():
        for target in names:
            goal = tables.targets.index(target)
            for c, reward in zip(found.classes[goal], found.reward[goal], strict=True):
                if c >= 0:
                    parents = named.setdefault(room, {}).setdefault(target, {})
                    parents[tables.classes[c]] = float(reward)
    return named


def published_parents(
    tables: SceneTables,
    targets: Mapping[str, Sequence[str]],
    published: Mapping[str, Mapping[str, Mapping[str, float]]],
    hidden: Collection[str],
) -> Parents:
    """The parents that came with imported data: R_p itself, so nothing is rescaled.

    Args:
      tables: their classes are the vocabulary; parents of other names are left out.
      targets: room type -> target classes; a target without a room type gets no parents.
      published: room type -> target -> parent -> R_p; the three largest stay. Of a target of
        several room types, a parent has the larger value.
      hidden: classes that training must not know, as parents neither.
    """
    classes = np.full((len(tables.targets), PARENTS_PER_TARGET), -1, np.int32)
    reward = np.zeros((len(tables.targets), PARENTS_PER_TARGET), np.float32)
    merged: dict[str, dict[str, float]] = {}
    for room, names in targets.items():
        for target in names:
            known = merged.setdefault(target, {})
            for name, share in published.get(room, {}).get(target, {}).items():
                if name in tables.classes and name not in hidden:
                    known[name] = max(share, known.get(name, share))
    for target, known in merged.items():
        best = sorted(known.items(), key=lambda item: (-item[1], item[0]))
        for slot, (name, share) in enumerate(best[:PARENTS_PER_TARGET]):
            classes[tables.targets.index(target), slot] = tables.classes.index(name)
            reward[tables.targets.index(target), slot] = share
    return Parents(classes, reward)


def _nearest_classes(
    tables: SceneTables, target: str, scenes: np.ndarray
) -> list[tuple[float, str]]:
    """The target's parents in these rooms, best first: (Pr(t | p), class)."""
    support = np.isfinite(nearest_distances(tables, target, target, scenes)).sum()
    candidates = []
    for name in PARENT_CANDIDATES:
        if name == target:
            continue
        gaps = nearest_distances(tables, target, name, scenes)
        gaps = gaps[np.isfinite(gaps)]
        if gaps.size and gaps.size >= MIN_SUPPORT * support and (gaps <= NEAR).any():
            # Ties go to the class that is nearer on average, then to the first name.
            candidates.append((-float((gaps <= NEAR).mean()), float(gaps.mean()), name))
    return [(-share, name) for share, _, name in sorted(candidates)[:PARENTS_PER_TARGET]]


def nearest_distances(
    tables: SceneTables, first: str, second: str, scenes: np.ndarray
) -> np.ndarray:
    """Distance of the nearest instances of two classes in each scene, centre to centre.

    Returns:
      [len(scenes)] metres; infinite where a scene does not hold both, in known places.
    """
    gaps = np.full(len(scenes), np.inf)
    if first not in tables.classes or second not in tables.classes:
        return gaps
    centres = (tables.object_box[:, :3] + tables.object_box[:, 3:]) / 2
    is_first = tables.object_class == tables.classes.index(first)
    is_second = tables.object_class == tables.classes.index(second)
    for i, scene in enumerate(scenes):
        here = tables.object_scene == scene
        a, b = centres[here & is_first], centres[here & is_second]
        if len(a) and len(b):
            apart = np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1))
            gaps[i] = np.nanmin(apart, initial=np.inf)  # the place of some is unknown
    return gaps
