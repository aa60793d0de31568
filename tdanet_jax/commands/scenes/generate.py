"""Writing generated rooms."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from tdanet_jax.commands.console import (
    check_at_most,
    check_new_file,
    check_positive,
    console,
    load_rooms,
    remove_abandoned,
    reporter,
)
from tdanet_jax.config import MOST_GENERATED, check_seed
from tdanet_jax.splits import make_split


@dataclasses.dataclass(frozen=True)
class Generate:
    """Writes a file of generated rooms of iTHOR's four types, furnished like the training rooms.

    The same arguments give the same file, which says how it was made. To train in generated rooms,
    use `tdanet train --generated` instead; it needs no file.
    """

    out: Path
    """File to write; it must not exist."""
    rooms: int = 100
    """Number of rooms; the four types take turns."""
    seed: int = 0
    """Random seed of the rooms."""
    validation: bool = False
    """Makes them like the rooms that --validation trains in, without furniture of any others."""

    def run(self) -> None:
        """Writes the file."""
        from tdanet_jax.scenes import dataset, generated
        from tdanet_jax.scenes.checks import survey

        check_positive(rooms=self.rooms)
        check_at_most("rooms", self.rooms, MOST_GENERATED)
        check_seed(self.seed)
        check_new_file(self.out)
        remove_abandoned(self.out)
        rooms = load_rooms(None)
        train = make_split("22/0", self.validation).train_scenes
        known = [name for name in rooms.tables.scenes if name in train]
        with reporter("rooms") as report:
            made = generated.make(
                rooms, known, self.rooms, self.seed,
                lambda done, total: report(done / total, "generated"),
            )  # fmt: skip
        console.print(*survey.summary(made.tables), *survey.making(made), sep="\n")
        dataset.save_rooms(made, self.out)
        console.print(f"{self.out}")
