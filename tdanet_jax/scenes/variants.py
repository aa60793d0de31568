"""The tables of variants of training rooms, built once per machine: what `--variants` trains in."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import json
from collections.abc import Sequence

import numpy as np

import tdanet_jax
from tdanet_jax.io import assets
from tdanet_jax.scenes import cache, ithor, tabulation
from tdanet_jax.scenes.checks import survey
from tdanet_jax.scenes.dataset import Extras, Rooms
from tdanet_jax.scenes.placement import Statistics, statistics
from tdanet_jax.scenes.pools import Part
from tdanet_jax.scenes.records import of_scenes
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.scenes.vary import vary

#: The seed of the variants in training: the same for all seeds of a run, which thus share them.
SEED = 0

_MODULES = tuple(
    f"scenes.{name}"
    for name in ("reachable", "placement", "furniture", "vary", "records", "variants")
)


def source(
    rooms: Rooms, names: Sequence[str], modules: Sequence[str] = _MODULES, *others: str
) -> str:
    """Hash of all that variants follow from but their numbers and seed, 16 hex digits.

    Args:
      names: the rooms from which the statistics are.
      modules: that make the rooms, besides those that make tables.
      others: texts from which the rooms follow as well.
    """
    records = {} if rooms.records is None else rooms.records
    content = assets.sha256(assets.path(ithor.ASSET)) if rooms.extras is None else ""
    return cache.source_hash(
        (*cache.MODULES, *modules),
        content,
        rooms.tables.data_version,
        *(hashlib.sha256(records[name].tobytes()).hexdigest() for name in sorted(records)),
        json.dumps([*names, *rooms.tables.targets]),
        np.__version__,  # whose streams of random numbers may change
        *others,
    )


def make(
    rooms: Rooms,
    names: Sequence[str],
    known: Sequence[str],
    copies: int,
    seed: int,
    progress: Progress | None = None,
) -> Rooms:
    """Variants 1 to `copies` of some rooms, room by room, with a note on how they were made.

    Those in which no target can be found are left out. Targets, parents and class graph are those
    that the rooms came with.

    Args:
      names: the rooms.
      known: the training rooms from which the statistics are.
      progress: called with (variants done, variants in all).

    Raises:
      SceneError: the rooms do not say what lies on what, or there are too many of them.
    """
    usual, varied = statistics(rooms.scenes(known)), list[Scene]()
    for scene in rooms.scenes(names):
        for copy in range(1, copies + 1):
            varied.append(vary(scene, usual, seed, copy))
            if progress is not None:
                progress(len(varied) / 3, len(names) * copies)

    def report(done: float, total: int) -> None:
        if progress is not None:
            progress((total + 2 * done) / 3, total)

    classes, targets = rooms.tables.classes, rooms.tables.targets
    tables = tabulation.build(varied, classes, targets, progress=report)
    own = rooms.extras or Extras()
    extras = dataclasses.replace(
        own,
        targets={room: own.targets[room] for room in own.targets if room in tables.room_types},
        episodes=(),
        parts={scene.name: scene.part for scene in varied if scene.part is not None},
        made={
            "command": "vary",
            "copies": copies,
            "seed": seed,
            "source": source(rooms, known),
            "rooms": rooms.tables.data_version,
            "version": tdanet_jax.__version__,
        },
    )
    if empty := survey.without_targets(Rooms(tables, extras)):
        varied = [scene for scene in varied if scene.name not in empty]
        tables = tables.subset([scene.name for scene in varied])
        left = {name: part for name, part in extras.parts.items() if name not in empty}
        extras = dataclasses.replace(extras, parts=left)
    return Rooms(tables, extras, records=of_scenes(varied))


def parts(rooms: Rooms, names: Sequence[str], copies: int) -> list[Part]:
    """Variants 1 to `copies` of some training rooms, a part for each number.

    Args:
      names: the rooms. Statistics come from them alone.

    Raises:
      SceneError: when a part is built, if the rooms do not say what lies on what.
    """
    key = source(rooms, names)

    @functools.cache
    def known() -> tuple[list[Scene], Statistics]:
        scenes = rooms.scenes(names)
        return scenes, statistics(scenes)

    def part(copy: int) -> Part:
        def load(progress: Progress) -> SceneTables:
            def build() -> SceneTables:
                progress(0.0, len(names))
                scenes, usual = known()
                varied = [vary(scene, usual, SEED, copy) for scene in scenes]
                tables = rooms.tables
                return tabulation.build(varied, tables.classes, tables.targets, progress=progress)

            return cache.load_or_build(f"{cache.VARIANTS}{key}-{copy}", build)

        return Part(len(names), load)

    return [part(copy) for copy in range(1, copies + 1)]
