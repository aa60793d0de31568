"""Exporting rooms."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tdanet_jax.commands.console import (
    check_new_file,
    console,
    fail,
    load_rooms,
    remove_abandoned,
    reporter,
)
from tdanet_jax.splits import UNSEEN, make_split

if TYPE_CHECKING:
    from tdanet_jax.scenes import SceneTables, dataset


@dataclasses.dataclass(frozen=True)
class Export:
    """Writes rooms as a folder with a folder per room, which SAVN, MJOLNIR and SSNet read.

    Of each room, the largest part in which every state leads to every other is written.
    """

    out: Path
    """Folder to write; it must not exist."""
    scenes: tuple[str, ...] = ()
    """Rooms to write, such as FloorPlan1 FloorPlan2; by default all."""
    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote, instead of the bundled ones."""
    features: bool = False
    """Also writes resnet18_featuremap.hdf5: each view's class raster, one-hot in 512 x 7 x 7."""
    vectors: bool = False
    """Also writes thor_glove/glove_map<D>d.hdf5, a word vector per class."""
    word_vectors: str | None = None
    """Requires --vectors. File of word vectors, instead of the bundled ones."""

    def run(self) -> None:
        """Writes the folder."""
        from tdanet_jax import words
        from tdanet_jax.env.reward import named_parents
        from tdanet_jax.scenes.dataset import assign_rooms
        from tdanet_jax.scenes.offline import exporter

        if self.word_vectors is not None and not self.vectors:
            fail(f"--word-vectors {self.word_vectors}: only with --vectors")
        check_new_file(self.out, in_folder=False)
        remove_abandoned(self.out)
        rooms = load_rooms(self.data)
        tables, extras = rooms.tables, rooms.extras
        if extras is not None and extras.has_parents:
            parents = extras.parents
        else:
            parents = named_parents(tables, assign_rooms(make_split("22/0"), rooms))
        if self.scenes:
            tables = tables.subset(self.scenes)
        exporter.check_layout(tables)
        vectors = None
        if self.vectors:
            vectors = words.load_word_vectors(self.word_vectors, tables.classes).table(
                tables.classes, None
            )
        starts = test_starts(rooms, tables)
        with reporter("export") as report:
            written = exporter.write_folder(
                tables, self.out, report, parents, vectors, self.features
            )
        if written.left_out:
            listed = ", ".join(f"{name} ({count:,})" for name, count in written.left_out.items())
            console.print(
                f"Left out {sum(written.left_out.values()):,} states that are not connected to the "
                f"largest part of their room: {listed}. Of {len(starts):,} test episodes in the "
                f"exported rooms, {sum(not written.kept[s] for s in starts):,} start there: play "
                "none of them in the export"
            )
        console.print(f"{self.out}")


def test_starts(rooms: dataset.Rooms, tables: SceneTables) -> list[int]:
    """The start states of the test episodes in `tables`, which are some of the rooms.

    Of bundled rooms, those of the published splits; of imported data, the published ones.
    """
    from tdanet_jax.evaluation import episodes

    whole, number = rooms.tables, {name: i for i, name in enumerate(tables.scenes)}
    if rooms.extras is not None:
        return [
            tables.nearest_state(number[e.scene], e.x, e.z, e.rotation, e.horizon)
            for e in rooms.extras.episodes
            if e.part == "test" and e.scene in number
        ]
    lists = [episodes.load(whole, make_split(name)) for name in UNSEEN]
    listed = {
        (int(pose), int(target))
        for groups in lists
        for group in groups.values()
        for pose, target in zip(group.pose, group.target, strict=True)
    }
    kept = np.isin(whole.state_scene, [whole.scenes.index(name) for name in tables.scenes])
    state = np.cumsum(kept) - 1
    return [int(state[pose]) for pose, _ in sorted(listed) if kept[pose]]
