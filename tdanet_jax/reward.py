"""Partial rewards: which objects are parents of a target, and what seeing one is worth.

R_p = R_t * Pr(t | p) * 0.1 (the paper's Eq. 3 and its text). Pr(t | p) is estimated in the training
rooms: over rooms that hold both classes, the share in which the nearest instances are within
1.5 m of each other.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from tdanet_jax.scenes.tables import SceneTables

#: Reward of any step that earns nothing else, a failed Done included.
STEP_REWARD = -0.01
#: R_t, the reward of a `Done` with the target visible.
DONE_REWARD = 5.0
#: R_p = R_t * Pr(t | p) * PARENT_SHARE.
PARENT_SHARE = 0.1
PARENTS_PER_TARGET = 3
#: Nearest instances at most this far apart (metres, centre to centre) count as together.
NEAR = 1.5

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


def find_parents(tables: SceneTables) -> Parents:
    """Parents of every target, estimated in the rooms of `tables` (pass training rooms only)."""
    classes = np.full((len(tables.targets), PARENTS_PER_TARGET), -1, np.int32)
    reward = np.zeros((len(tables.targets), PARENTS_PER_TARGET), np.float32)
    for goal, target in enumerate(tables.targets):
        candidates = []
        for name in PARENT_CANDIDATES:
            if name == target or name not in tables.classes:
                continue
            gaps = nearest_distances(tables, target, name)
            if gaps.size and (gaps <= NEAR).any():
                # Ties go to the class that is nearer on average, then to the first name.
                candidates.append((-(gaps <= NEAR).mean(), gaps.mean(), name))
        for slot, (share, _, name) in enumerate(sorted(candidates)[:PARENTS_PER_TARGET]):
            classes[goal, slot] = tables.classes.index(name)
            reward[goal, slot] = DONE_REWARD * -share * PARENT_SHARE
    return Parents(classes, reward)


def nearest_distances(tables: SceneTables, first: str, second: str) -> np.ndarray:
    """Distance (metres) of the nearest instances of two classes, per room that holds both."""
    centres = (tables.object_box[:, :3] + tables.object_box[:, 3:]) / 2
    is_first = tables.object_class == tables.classes.index(first)
    is_second = tables.object_class == tables.classes.index(second)
    nearest = []
    for scene in range(len(tables.scenes)):
        here = tables.object_scene == scene
        a, b = centres[here & is_first], centres[here & is_second]
        if len(a) and len(b):
            nearest.append(np.sqrt(((a[:, None] - b[None]) ** 2).sum(-1)).min())
    return np.array(nearest)
