"""Importing rooms."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from tdanet_jax.commands.console import check_new_file, console, fail, remove_abandoned, reporter

if TYPE_CHECKING:
    from tdanet_jax.scenes import dataset, room_names
    from tdanet_jax.scenes.offline import frames


@dataclasses.dataclass(frozen=True)
class Import:
    """Writes a file of rooms for --data, from AI2-THOR metadata or from the original offline data.

    The source is a scene file (JSON, see docs/scenes.md) or, with --from, a folder with a folder
    per room, as SAVN, MJOLNIR and SSNet use it (see docs/data.md).
    """

    scenes: tyro.conf.Positional[Path | None] = None
    """Scene file."""
    room_type: str | None = None
    """Type of the rooms for which neither their file, nor --rooms, nor the name says it: kitchen,
    living_room, bedroom, bathroom, or one of your own, such as office. Names that begin with that
    of an iTHOR room, such as FloorPlan12-3, say it."""
    part: Literal["train", "test"] | None = None
    """Likewise the part of every split that they belong to."""
    rooms: Path | None = None
    """Table (CSV) with the columns name, room_type and part: what the rooms' files do not say.
    Cells may be empty."""
    source: Annotated[Path | None, tyro.conf.arg(name="from")] = None
    """Folder with the rooms' folders; files next to them (parents, class graph, test episodes) are
    imported as well. An interrupted import continues where it stopped."""
    out: Path = Path("tables.npz")
    """File to write; it must not exist."""
    features: bool = False
    """Requires --from. Also copies the scenes' resnet18_featuremap.hdf5 into one memory-mapped file
    next to --out, in half precision: 50 kB per state, 12 GB for all rooms."""
    frame_size: str | None = None
    """Requires --from. WIDTHxHEIGHT in pixels of the recorded frames, such as 640x480; by default
    as images.hdf5 or metadata.json have it, otherwise 300x300."""

    def run(self) -> None:
        """Writes the file, and reports what in the rooms cannot be reached."""
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.checks import survey
        from tdanet_jax.scenes.offline import features, importer

        if (self.scenes is None) == (self.source is None):
            fail("import needs a scene file, or --from a folder of rooms, and not both")
        for flag in ("features", "frame_size"):
            if getattr(self, flag) and self.source is None:
                fail(f"--{flag.replace('_', '-')}: needs --from")
        check_new_file(self.out)
        kinds, frame = self._kinds(), self._frame()
        maps, maps_out = None, features.features_path(self.out)
        if maps_out.exists():  # the new rooms would take them for theirs
            fail(
                f"--out {self.out}: there are feature maps of earlier rooms, {maps_out}; "
                "remove them or choose another name"
            )
        if self.features and self.source is not None:
            maps = features.find_features(self.source, kinds)
        remove_abandoned(self.out, maps_out)
        rooms = self._rooms(kinds, frame)
        console.print(*survey.summary(rooms.tables), sep="\n")
        console.print(*survey.uses(rooms), sep="\n")
        if maps is None:
            dataset.save_rooms(rooms, self.out)
        else:
            with reporter("feature maps") as report:
                features.save_with_maps(rooms, self.out, maps, report)
        if self.source is not None:
            importer.clear_cache(self.source)
        for path in (maps_out, self.out) if maps else (self.out,):
            console.print(f"{path}")

    def _kinds(self) -> room_names.Kinds:
        """Room type and part of the rooms, as the flags say."""
        from tdanet_jax.scenes import room_names

        other = room_names.RoomKind(self.room_type, self.part)
        room_names.check_kind(other)
        table = room_names.read_table(self.rooms) if self.rooms is not None else {}
        return room_names.Kinds(table, other)

    def _frame(self) -> frames.Frame | None:
        """The size of the frames, if --frame-size says it."""
        from tdanet_jax.scenes.offline import frames

        if self.frame_size is None:
            return None
        frame = frames.parse(self.frame_size)
        if frame is None:
            fail(f"--frame-size {self.frame_size}: not WIDTHxHEIGHT in pixels, such as 300x300")
        return frame

    def _rooms(self, kinds: room_names.Kinds, frame: frames.Frame | None) -> dataset.Rooms:
        """The rooms of the source, before anything is written."""
        from tdanet_jax.scenes import dataset
        from tdanet_jax.scenes.offline import importer

        if self.scenes is not None:
            with reporter("rooms") as report:
                return dataset.build_rooms(
                    self.scenes, lambda done, total: report(done / total, "rebuilt"), kinds
                )
        assert self.source is not None
        with reporter("import") as report:

            def show(share: float, line: str) -> None:
                console.print(line)  # all of them; on a terminal above the bar
                if console.is_terminal:
                    report(share, "")

            return importer.read_folder(self.source, show, kinds, frame)
