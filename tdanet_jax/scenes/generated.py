"""Tables of generated rooms: as a file, and built once per machine for `--generated`."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

import tdanet_jax
from tdanet_jax.io import assets
from tdanet_jax.poses import ITHOR
from tdanet_jax.scenes import cache, tabulation, variants
from tdanet_jax.scenes.dataset import Extras, Rooms
from tdanet_jax.scenes.generation import catalogue
from tdanet_jax.scenes.generation.rooms import Generator
from tdanet_jax.scenes.pools import Part
from tdanet_jax.scenes.records import of_scenes
from tdanet_jax.scenes.scene import Scene, SceneError
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.tabulation import Progress

#: The seed of the rooms in training: the same for all seeds of a run, which thus share them.
SEED = 0
CHUNK = 100  # rooms in a part, a file of the cache

_MODULES = (
    "scenes.reachable",
    "scenes.placement",
    "scenes.records",
    *(f"scenes.generation.{name}" for name in ("catalogue", "pieces", "plan", "floor", "furnish",
                                               "counters", "room_types", "rooms")),
    "scenes.generated",
)  # fmt: skip


def source(rooms: Rooms, known: Sequence[str]) -> str:
    """Hash of all that generated rooms follow from but their numbers and seed, 16 hex digits."""
    return variants.source(rooms, known, _MODULES, assets.sha256(assets.path(catalogue.ASSET)))


def make(
    rooms: Rooms, known: Sequence[str], count: int, seed: int, progress: Progress | None = None
) -> Rooms:
    """Generated rooms 1 to `count`, with a note on how they were made.

    Args:
      known: the training rooms that they are like.
      progress: called with (rooms done, rooms in all).

    Raises:
      SceneError: the rooms do not say what lies on what, or are not of all of iTHOR's types.
    """
    scenes, tables = _build(rooms, known, range(1, count + 1), seed, progress)
    extras = Extras(
        parts={scene.name: "train" for scene in scenes},
        made={
            "command": "generate",
            "rooms": count,
            "seed": seed,
            "known": f"{len(known)} rooms",
            "source": source(rooms, known),
            "version": tdanet_jax.__version__,
        },
    )
    return Rooms(tables, extras, records=of_scenes(scenes))


def parts(rooms: Rooms, known: Sequence[str], count: int) -> list[Part]:
    """Generated rooms 1 to `count`, a hundred to a part.

    Args:
      known: the training rooms that they are like.

    Raises:
      SceneError: when a part is built, as for `make`.
    """
    key = source(rooms, known)

    def part(numbers: range) -> Part:
        def load(progress: Progress) -> SceneTables:
            def build() -> SceneTables:
                return _build(rooms, known, numbers, SEED, progress)[1]

            name = f"{cache.GENERATED}{key}-{numbers[0]}-{numbers[-1]}"
            return cache.load_or_build(name, build)

        return Part(len(numbers), load)

    firsts = range(1, count + 1, CHUNK)
    return [part(range(first, min(first + CHUNK, count + 1))) for first in firsts]


def _build(
    rooms: Rooms, known: Sequence[str], numbers: range, seed: int, progress: Progress | None
) -> tuple[list[Scene], SceneTables]:
    if rooms.tables.grid != ITHOR:
        raise SceneError("rooms are generated on iTHOR's grid, and these rooms are on another")
    generator, targets = Generator(rooms.scenes(known)), rooms.tables.targets

    def one(number: int) -> tuple[Scene, SceneTables]:
        return _seen(generator.room(number, seed), targets)

    found: list[tuple[Scene, SceneTables]] = []
    with ThreadPoolExecutor(min(os.cpu_count() or 1, tabulation.MOST_WORKERS)) as pool:
        try:
            for room in pool.map(one, numbers):
                found.append(room)
                if progress is not None:
                    progress(len(found), len(numbers))
        finally:
            pool.shutdown(cancel_futures=True)
    scenes = [scene for scene, _ in found]
    return scenes, tabulation.join([tables for _, tables in found], rooms.tables.classes)


def _seen(scene: Scene, targets: Sequence[str]) -> tuple[Scene, SceneTables]:
    """A room without the small objects that can be seen from nowhere within reach, and its tables.

    Without an object, others may be seen differently, so this is repeated until none is hidden.
    """
    while True:
        tables = tabulation.build_room(scene, targets)
        seen = np.zeros(len(scene.objects), bool)
        seen[tables.row_object[tables.row_visible]] = True
        kept = tuple(
            item for item, known in zip(scene.objects, seen, strict=True)
            if known or not item.pickupable
        )  # fmt: skip
        if len(kept) == len(scene.objects):
            return scene, tables
        scene = dataclasses.replace(scene, objects=kept)
