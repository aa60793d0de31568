"""Comparing rooms with the bundled ones."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import tyro

from tdanet_jax.commands.console import console, fail, load_rooms
from tdanet_jax.splits import make_split


@dataclasses.dataclass(frozen=True)
class Compare:
    """Compares rooms with the bundled training rooms: sizes, what is in view, how hard tasks are.

    Variants are compared with the rooms that they come from.
    """

    rooms: tyro.conf.Positional[str]
    """File of rooms that `tdanet scenes vary`, `generate` or `import` wrote."""
    data: str | None = None
    """File of rooms to compare with, instead of the bundled ones."""

    def run(self) -> None:
        """Prints the table."""
        from tdanet_jax.evaluation import room_statistics
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.checks import survey
        from tdanet_jax.scenes.vary import original_name
        from tdanet_jax.training import devices

        devices.start()
        given, other = dataset.load_rooms(self.rooms), load_rooms(self.data)
        train = dataset.assign_rooms(make_split("22/0"), other).train_scenes
        known = [name for name in other.tables.scenes if name in train]
        origins = {original_name(name) for name in given.tables.scenes}
        chosen = [name for name in other.tables.scenes if name in origins] or known
        if not chosen:
            fail(f"{self.data}: has no training rooms to compare with")
        title = "bundled" if self.data is None else Path(self.data).stem[:11]
        own = Path(self.rooms).stem[:11]
        if own == title:
            title, own = "bundled" if self.data is None else "--data", "rooms"
        columns = {title: other.tables.subset(chosen), own: given.tables}
        console.print(*survey.making(given), *room_statistics.table(columns), sep="\n")
