"""Agreement of the reachable points with places where agents stood in AI2-THOR."""

from __future__ import annotations

import importlib.resources
import json
from collections.abc import Collection, Iterator, Mapping, Sequence

import numpy as np

from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes.scene import Scene


def places() -> dict[str, np.ndarray]:
    """Places [N, 2] (x, z in metres) where agents stood in published test episodes, by room."""
    text = (importlib.resources.files(__package__) / "places.json").read_text()
    return {name: np.array(found) for name, found in json.loads(text)["places"].items()}


def on_grid(places: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether each of `places` [N, 2] (x, z) is one of the points [P, 3]: [N] bool."""
    offset = np.abs(places[:, None] - points[:, [0, 2]]).max(axis=2)
    return offset.min(axis=1, initial=np.inf) < GRID_SIZE / 2


def summary(
    scenes: Sequence[Scene], published: Mapping[str, np.ndarray], train: Collection[str]
) -> Iterator[str]:
    """Lines on how many points are published and added, and how many known places are on them.

    Args:
      published: of each room, which of its points are published: name -> [P] bool.
      train: names of the training rooms.
    """
    known = places()
    yield "Reachable points, and places where AI2-THOR's agents stood:"
    yield f"{'':27}   train    test"
    rows: dict[str, list[int]] = {}
    for part in (True, False):
        for scene in scenes:
            if (scene.name in train) != part:
                continue
            before = scene.points[published[scene.name]]
            stood = known.get(scene.name, np.zeros((0, 2)))
            assert scene.default_position is not None
            start = scene.default_position[None, [0, 2]]
            for title, count in {
                "published points": len(before),
                "points added": len(scene.points) - len(before),
                "places in test episodes": len(stood),
                "  on a published point": on_grid(stood, before).sum(),
                "  on any point": on_grid(stood, scene.points).sum(),
                "agents in default frames": 1,
                "  at a published point": on_grid(start, before).sum(),
                "  at any point": on_grid(start, scene.points).sum(),
            }.items():
                rows.setdefault(title, [0, 0])[1 - part] += int(count)
    for title, (first, second) in rows.items():
        yield f"{title:27} {first:7,} {second:7,}"
