"""Checking the rebuilt rooms against AI2-THOR."""

from __future__ import annotations

import dataclasses
import time

from tdanet_jax.commands.console import check_at_most, check_positive, console, reporter
from tdanet_jax.poses import ITHOR
from tdanet_jax.splits import make_split
from tdanet_jax.vocabulary import ALL_TARGETS


@dataclasses.dataclass(frozen=True)
class Verify:
    """Compares the rebuilt rooms with AI2-THOR's own flags and with dense ray casting."""

    rooms: int = 8
    """Number of rooms for dense ray casting, spread over all of them."""
    views: int = 4
    """Number of views per room for dense ray casting, drawn with a fixed seed."""
    worst: int = 40
    """Number of classes to list, those with the most disagreements first."""

    def run(self) -> None:
        """Prints the tables."""
        check_positive(rooms=self.rooms, views=self.views, worst=self.worst)
        from tdanet_jax.env.reward import PARENT_CANDIDATES
        from tdanet_jax.scenes import ithor, load_tables
        from tdanet_jax.scenes.checks import agreement, dense_rays, grid, survey
        from tdanet_jax.scenes.visibility.rules import RULES

        start = time.monotonic()
        rooms = ithor.load_scenes()
        check_at_most("rooms", self.rooms, len(rooms))
        check_at_most("views", self.views, min(len(room.points) for room in rooms) * ITHOR.views)
        train = set(make_split("22/0").train_scenes)
        parts = {
            "train": [room for room in rooms if room.name in train],
            "test": [room for room in rooms if room.name not in train],
        }
        groups = {"22 targets": ALL_TARGETS, "possible parents": PARENT_CANDIDATES}
        console.print(*grid.summary(rooms, ithor.published_points(), train), sep="\n")
        console.print(*agreement.table(parts, groups, RULES, self.worst), sep="\n")
        console.print(dense_rays.summary(rooms, RULES, self.rooms, self.views))
        with reporter("rooms") as report:
            tables = load_tables(lambda done, total: report(done / total, "rebuilt"))
        console.print(*survey.summary(tables), sep="\n")
        console.print(f"{time.monotonic() - start:.0f} s")
