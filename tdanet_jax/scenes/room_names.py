"""Names of rooms: which are allowed, and what they say about a room's type and part."""

from __future__ import annotations

import csv
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from tdanet_jax.io.escaping import in_name
from tdanet_jax.io.untrusted import FileError, regular
from tdanet_jax.scenes.scene import SceneError
from tdanet_jax.splits import (
    ITHOR_ROOMS,
    PARTS,
    SCENE_NUMBERS,
    TRAIN_SCENES_PER_TYPE,
    known_type,
)
from tdanet_jax.vocabulary import ROOM_TYPES

#: Bytes of UTF-8: names of rooms become names of files.
LONGEST_NAME = 200
COLUMNS = ("name", "room_type", "part")

_ITHOR = re.compile(r"FloorPlan([1-9][0-9]{0,2})(?![0-9])")


class RoomKind(NamedTuple):
    """What kind of room a room is; None what is not known."""

    room_type: str | None = None
    part: str | None = None  # "train" or "test" in every split; None: the split decides by the name


UNKNOWN = RoomKind()


def check_name(name: str, what: str = "room name") -> None:
    """Accepts any name that is safe as the name of a file or folder and on a terminal.

    Raises:
      SceneError: the name is empty, too long, begins or ends with a space, is "." or "..", or has a
        path separator (/, \\ or :) or a character that cannot be printed.
    """
    shown = in_name(name[:40])
    if not name.isprintable():
        raise SceneError(f"{what} {shown!r}: has a control character")
    if any(separator in name for separator in "/\\:") or name in (".", ".."):
        raise SceneError(f"{what} {shown!r}: is a path, not a plain name")
    if not name or name != name.strip() or len(name.encode()) > LONGEST_NAME:
        raise SceneError(
            f"{what} {shown!r}: empty, longer than {LONGEST_NAME} bytes, or with a space at "
            "its start or end"
        )


def check_kind(kind: RoomKind) -> None:
    """Raises SceneError if a room type cannot be one, or a part is neither train nor test."""
    room_type, part = kind
    if room_type is not None:
        if not isinstance(room_type, str):
            raise SceneError(f"room_type {room_type!r}: not a name")
        check_name(room_type, "room_type")
        if room_type != (known := known_type(room_type)):
            raise SceneError(f"room_type {room_type!r}: did you mean {known}?")
    if part not in (None, *PARTS):
        raise SceneError(f"part {part!r}, not {' or '.join(PARTS)}")


def kind_of(name: str) -> RoomKind | None:
    """The kind of a room whose name begins with that of an iTHOR room, otherwise None.

    FloorPlan12-3 and FloorPlan12_b are kitchens and in the part of FloorPlan12, "train";
    FloorPlan123 and FloorPlan_Train1_1 begin with no iTHOR room. The part of iTHOR's own names is
    None: splits list these rooms by name, and `--validation` divides them further.
    """
    match = _ITHOR.match(name)
    room = ITHOR_ROOMS.get(match[0]) if match else None
    if match is None or room is None:
        return None
    trains = SCENE_NUMBERS[room].index(int(match[1])) < TRAIN_SCENES_PER_TYPE
    return RoomKind(room, None if match[0] == name else PARTS[0] if trains else PARTS[1])


@dataclass(frozen=True)
class Kinds:
    """What a user says of rooms in addition to their files.

    Attributes:
      table: kinds by name, from `read_table`.
      other: the kind of rooms whose name says nothing.
    """

    table: Mapping[str, RoomKind] = field(default_factory=dict)
    other: RoomKind = UNKNOWN

    def of(self, name: str, said: RoomKind = UNKNOWN) -> RoomKind:
        """A room's type and part: each as the room's file says it, otherwise the table, otherwise
        the name, or `other` if the name says nothing."""
        listed, rest = self.table.get(name, UNKNOWN), kind_of(name) or self.other
        return RoomKind(
            said.room_type or listed.room_type or rest.room_type,
            said.part or listed.part or rest.part,
        )


def type_names(names: Iterable[str]) -> tuple[str, ...]:
    """iTHOR's room types, then the others among `names`, sorted."""
    return (*ROOM_TYPES, *sorted(set(names) - set(ROOM_TYPES)))


def sort_key(name: str) -> tuple[tuple[bool, int, str], ...]:
    """Sorts names with numbers by their numbers: FloorPlan2-1, FloorPlan2-10, FloorPlan10."""
    return tuple(
        (not part.isdecimal(), int(part) if part.isdecimal() else 0, part)
        for part in re.split(r"([0-9]+)", name)
    )


def read_table(path: Path | str) -> dict[str, RoomKind]:
    """Name -> kind of the rooms in a CSV file with the columns name, room_type and part.

    Cells may be empty, and the columns of type or part missing: the table then says nothing of it.

    Raises:
      FileError: it is not such a table; the message names line and column.
    """
    path = Path(path)
    try:
        rows = csv.reader(regular.read_text(path).splitlines(), strict=True)
        lines = [(rows.line_num, [cell.strip() for cell in row]) for row in rows]
    except OSError as error:
        raise FileError(path, error.strerror) from None
    except csv.Error as error:
        raise FileError(path, f"not a CSV table ({error})") from None
    header = lines[0][1] if lines else []
    if len(set(header)) != len(header) or not {"name"} <= set(header) <= {*COLUMNS}:
        raise FileError(path, f"line 1: the columns are not {', '.join(COLUMNS)}")
    table: dict[str, RoomKind] = {}
    for number, cells in lines[1:]:
        if not any(cells):
            continue
        if len(cells) != len(header):
            raise FileError(path, f"line {number}: {len(cells)} columns, not {len(header)}")
        row = dict(zip(header, cells, strict=True))
        kind = RoomKind(row.get("room_type") or None, row.get("part") or None)
        try:
            check_name(row["name"])
            check_kind(kind)
        except SceneError as error:
            raise FileError(path, f"line {number}: {error}") from None
        if row["name"] in table:
            raise FileError(path, f"line {number}: {row['name']} is listed twice")
        table[row["name"]] = kind
    return table
