"""Room types and parts of rooms: as a scene file says them, or as a user adds them to it."""

from __future__ import annotations

import csv
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from tdanet_jax.scenes.scene import SceneError, check_name
from tdanet_jax.splits import ITHOR_ROOMS, PARTS
from tdanet_jax.vocabulary import ROOM_TYPES, class_words

COLUMNS = ("name", "room_type", "part")


class Label(NamedTuple):
    """What is known of a room; None what is not."""

    room_type: str | None = None
    part: str | None = None  # "train" or "test"


NOTHING = Label()


@dataclasses.dataclass(frozen=True)
class Labels:
    """What a user says of rooms in addition to their scene file.

    Attributes:
      rooms: labels by name, from a table.
      others: that of all rooms which are neither in the table nor iTHOR's.
    """

    rooms: Mapping[str, Label] = dataclasses.field(default_factory=dict)
    others: Label = NOTHING

    def complete(self, name: str, label: Label) -> Label:
        """A room's label, where the file does not say it: from the table, the name, the others."""
        listed = self.rooms.get(name, NOTHING)
        rest = Label(ITHOR_ROOMS[name]) if name in ITHOR_ROOMS else self.others
        return Label(
            label.room_type or listed.room_type or rest.room_type,
            label.part or listed.part or rest.part,
        )


def check_label(label: Label) -> None:
    """Raises SceneError if a room type cannot be one, or a part is neither train nor test."""
    room_type, part = label
    if room_type is not None:
        if not isinstance(room_type, str):
            raise SceneError(f"room_type {room_type!r}: not a name")
        check_name(room_type, "room_type")
        for known in ROOM_TYPES:
            if room_type != known and class_words(room_type) == class_words(known):
                raise SceneError(f"room_type {room_type!r}: did you mean {known}?")
    if part not in (None, *PARTS):
        raise SceneError(f"split {part!r}, not {' or '.join(PARTS)}")


def read_table(path: Path) -> dict[str, Label]:
    """The labels in a CSV file with the columns name, room_type and part; cells may be empty.

    Raises:
      SceneError: it is not such a file; the message names its line.
    """
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file, strict=True))
    except (UnicodeDecodeError, csv.Error) as error:
        raise SceneError(f"{path}: not a table ({error})") from None
    if not rows or sorted(rows[0]) != sorted(COLUMNS):
        raise SceneError(f"{path}: its first line must be {','.join(COLUMNS)}")
    labels: dict[str, Label] = {}
    for number, cells in enumerate(rows[1:], start=2):
        if not cells:
            continue
        try:
            if len(cells) != len(COLUMNS):
                raise SceneError(f"{len(cells)} cells, not {len(COLUMNS)}")
            row = {title: cell.strip() or None for title, cell in zip(rows[0], cells, strict=True)}
            name, label = row["name"], Label(row["room_type"], row["part"])
            check_label(label)
            if name is None or name in labels:
                raise SceneError("no name" if name is None else f"{name} is there twice")
        except SceneError as error:
            raise SceneError(f"{path}, line {number}: {error}") from None
        labels[name] = label
    return labels
