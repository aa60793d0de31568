"""Chooses the unseen classes of the open-vocabulary benchmark, `--split open` (docs/evaluation.md).

Nothing here has seen an agent's result: only rooms, sizes and word vectors count.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tdanet_jax.env.reward import cosines
from tdanet_jax.io import files
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.target_distances import with_targets
from tdanet_jax.splits import OPEN_ASSET, in_order, make_split
from tdanet_jax.vocabulary import ROOM_TYPES
from tdanet_jax.words import WordVectors

#: A class is a target in a room type if it can be found in so many of its rooms.
TRAINING_ROOMS, TEST_ROOMS = 4, 2
#: Classes that nobody looks for: parts of the building, and parts of other objects.
LEFT_OUT = ("BathtubBasin", "LightSwitch", "ShowerGlass", "SinkBasin", "StoveKnob", "Window")
#: One class in so many is unseen.
ONE_IN = 5
#: Random choices, of which the most balanced one is taken.
DRAWS = 3_000


def build_asset(tables: SceneTables, vectors: WordVectors, out_dir: Path | str) -> Path:
    """Writes the benchmark's targets by room type, its unseen and its validation's classes."""
    path = Path(out_dir) / OPEN_ASSET
    files.write_text(path, json.dumps(choose(tables, vectors), indent=1) + "\n")
    return path


def choose(tables: SceneTables, vectors: WordVectors) -> dict[str, object]:
    """The content of the asset: "targets", "unseen" and "validation"."""
    targets = find_targets(tables)
    classes = in_order(name for names in targets.values() for name in names)
    unseen = balanced(tables, vectors, targets, classes, seed=0)
    seen = [name for name in classes if name not in unseen]
    validation = balanced(tables, vectors, targets, seen, seed=1)
    return {"targets": targets, "unseen": unseen, "validation": validation}


def find_targets(tables: SceneTables) -> dict[str, tuple[str, ...]]:
    """Room type -> the classes that can be found in enough of its rooms."""
    tables = with_targets(tables, in_order({*tables.classes} - {*LEFT_OUT}))
    split = make_split("22/0")
    there = (tables.position_scene == scene for scene in range(len(tables.scenes)))
    found = np.array([tables.reachable[positions].any(axis=0) for positions in there])  # [R, G]
    needed = ((split.train_scenes, TRAINING_ROOMS), (split.eval_scenes, TEST_ROOMS))
    enough = {}
    for kind, room in enumerate(ROOM_TYPES):
        kept = np.ones(len(tables.targets), bool)
        for scenes, least in needed:
            chosen = np.isin(np.array(tables.scenes), scenes) & (tables.room_type == kind)
            kept &= found[chosen].sum(axis=0) >= least
        enough[room] = in_order(np.array(tables.targets, object)[kept])
    return enough


def balanced(
    tables: SceneTables,
    vectors: WordVectors,
    targets: dict[str, tuple[str, ...]],
    classes: Sequence[str],
    seed: int,
) -> tuple[str, ...]:
    """A fifth of the classes, spread evenly over what makes a class easy or hard.

    Of `DRAWS` random choices, the one that comes nearest to a fifth of the classes of each room
    type, of the small, middle and large ones, and of those whose most similar seen class is far,
    middling or near: least sum of squared differences, the first among equals.
    """
    count = round(len(classes) / ONE_IN)
    order = np.random.default_rng(seed).random((DRAWS, len(classes))).argsort(axis=1)
    chosen = np.zeros((DRAWS, len(classes)), bool)
    np.put_along_axis(chosen, order[:, :count], True, axis=1)
    similar = np.round(cosines(vectors.table(tuple(classes), None)), 4)
    np.fill_diagonal(similar, -1)
    nearest = np.array([np.where(unseen, -1, similar).max(axis=1) for unseen in chosen])
    bounds = np.quantile(similar.max(axis=1), (1 / 3, 2 / 3))
    rank = np.argsort(np.argsort(sizes(tables, classes), kind="stable"), kind="stable")
    level = 3 * rank // len(classes)
    groups = [np.isin(np.array(classes), names) for names in targets.values()]
    groups += [level == third for third in range(3)]
    shares = [(chosen & group).sum(axis=1) / group.sum() for group in groups]
    near = np.digitize(nearest, bounds)  # [DRAWS, C], of each class in each choice
    shares += [3 * (chosen & (near == third)).sum(axis=1) / len(classes) for third in range(3)]
    off = ((np.array(shares) - 1 / ONE_IN) ** 2).sum(axis=0)
    return tuple(np.array(classes, object)[chosen[np.round(off, 9).argmin()]])


def sizes(tables: SceneTables, classes: Sequence[str]) -> np.ndarray:
    """The median longest side of each class's objects in the training rooms: [C] metres."""
    training = tables.subset(make_split("22/0").train_scenes)
    longest = (training.object_box[:, 3:] - training.object_box[:, :3]).max(axis=1)
    kinds = (training.object_class == training.classes.index(name) for name in classes)
    return np.array([round(float(np.median(longest[kind])), 4) for kind in kinds])
