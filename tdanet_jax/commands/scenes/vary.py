"""Writing variants of rooms."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Literal

from tdanet_jax.commands.console import (
    check_at_most,
    check_new_file,
    check_positive,
    console,
    fail,
    load_rooms,
    remove_abandoned,
    reporter,
)
from tdanet_jax.config import MOST_VARIANTS, check_seed
from tdanet_jax.splits import make_split


@dataclasses.dataclass(frozen=True)
class Vary:
    """Writes a file of variants of rooms: small objects elsewhere, half of the rooms mirrored.

    The same arguments give the same file, which says how it was made. To train in variants, use
    `tdanet train --variants` instead; it needs no file.
    """

    out: Path
    """File to write; it must not exist."""
    copies: int = 16
    """Variants of each room, called FloorPlan1-v01 and so on; those with even numbers are
    mirrored."""
    seed: int = 0
    """Random seed of the variants."""
    part: Literal["train", "test", "all"] = "train"
    """The rooms to vary. What lies on what is taken from the training rooms in any case."""
    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote from a scene file, instead of the
    bundled ones."""

    def run(self) -> None:
        """Writes the file."""
        from tdanet_jax.scenes import dataset, variants
        from tdanet_jax.scenes.checks import survey

        check_positive(copies=self.copies)
        check_at_most("copies", self.copies, MOST_VARIANTS)
        check_seed(self.seed)
        check_new_file(self.out)
        remove_abandoned(self.out)
        rooms = load_rooms(self.data)
        split = dataset.assign_rooms(make_split("22/0"), rooms)
        parts = {"train": split.train_scenes, "test": split.eval_scenes}
        train = [name for name in rooms.tables.scenes if name in parts["train"]]
        chosen = parts.get(self.part, (*parts["train"], *parts["test"]))
        names = [name for name in rooms.tables.scenes if name in chosen]
        if not train or not names:
            fail(f"{self.data}: has no {'training' if not train else self.part} rooms")
        with reporter("variants") as report:
            varied = variants.make(
                rooms, names, train, self.copies, self.seed,
                lambda done, total: report(done / total, "built"),
            )  # fmt: skip
        if empty := len(names) * self.copies - len(varied.tables.scenes):
            console.print(f"Left out, as no target can be found in them: {empty} variants")
        if not varied.tables.scenes:
            fail("vary: no variant is left")
        console.print(next(survey.summary(varied.tables)), *survey.making(varied), sep="\n")
        dataset.save_rooms(varied, self.out)
        console.print(f"{self.out}")
