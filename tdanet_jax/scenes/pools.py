"""Rooms that are added to the training rooms, in pools that take turns if they are too many."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from tdanet_jax.scenes import tabulation
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.tabulation import Progress


class Part(NamedTuple):
    """Some rooms, in a file of the cache once they have been built."""

    rooms: int
    load: Callable[[Progress], SceneTables]  # told (rooms done, `rooms`) while any are built


def deal(parts: Sequence[Part], most: int) -> list[list[Part]]:
    """Parts in as many pools as would have at most `most` rooms each if parts were all alike.

    Kinds of rooms are spread over the pools: of n pools, the first has parts 1, n + 1, ...
    """
    count = -(-sum(part.rooms for part in parts) // most)
    pools = min(count, len(parts))
    return [list(parts[first::pools]) for first in range(pools)]


def load(
    pool: Sequence[Part], classes: Sequence[str], progress: Progress | None = None
) -> SceneTables:
    """The tables of the rooms of a pool, from the cache or built.

    Args:
      classes: the vocabulary of the training rooms.
      progress: called with (rooms done, rooms of the pool) before each part and while rooms are
        built.

    Raises:
      SceneError: the training rooms do not say what lies on what.
    """
    total = sum(part.rooms for part in pool)
    done, tables = 0, []
    for part in pool:

        def report(more: float, _: int, before: int = done) -> None:
            if progress is not None:
                progress(before + more, total)

        report(0.0, part.rooms)
        tables.append(part.load(report))
        done += part.rooms
    return tabulation.join(tables, classes)
