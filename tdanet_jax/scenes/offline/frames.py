"""The size of the recorded frames, in whose pixels boxes are given."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

from tdanet_jax.io.escaping import in_line
from tdanet_jax.io.untrusted import FileError, hdf5
from tdanet_jax.scenes.offline import layout
from tdanet_jax.vocabulary import IMAGE_SIZE

FLAG = "--frame-size WIDTHxHEIGHT"
LARGEST = 10_000  # pixels along a side
#: Bytes of metadata.json that are searched: a state's event has some hundred thousand.
_HEAD = 4 << 20


class Frame(NamedTuple):
    """Width and height of a frame in pixels."""

    width: int
    height: int

    def __str__(self) -> str:
        return f"{self.width}x{self.height}"


#: Of the published recordings.
USUAL = Frame(IMAGE_SIZE, IMAGE_SIZE)


def parse(text: str) -> Frame | None:
    """A frame from "WIDTHxHEIGHT", or None if it is none."""
    match = re.fullmatch(r"([1-9][0-9]{1,4})x([1-9][0-9]{1,4})", text)
    if match is None or max(int(match[1]), int(match[2])) > LARGEST:
        return None
    return Frame(int(match[1]), int(match[2]))


def recorded(folder: Path) -> tuple[Frame | None, str]:
    """The size that a scene's folder tells, and the file that does, or why it does not.

    It is that of the first image in `images.hdf5`, or screenWidth and screenHeight of the first
    event in `metadata.json`.
    """
    images, metadata = folder / layout.IMAGE_FILE, folder / layout.METADATA_FILE
    problem = ""
    if images.is_file():
        try:
            with hdf5.opened(images) as reader:
                names = reader.names()
                shape = reader.shape(names[0]) if names else ()
            if len(shape) == 3 and shape[2] in (3, 4) and 0 < min(shape) <= max(shape) <= LARGEST:
                return Frame(shape[1], shape[0]), images.name
            problem = f"{images.name}: " + (
                f"shape {shape} is not that of an image" if names else "no images"
            )
        except FileError as error:  # images themselves are not needed
            problem = str(error).removeprefix(f"{in_line(folder)}/")
    if metadata.is_file():
        with metadata.open("rb") as file:
            head = file.read(_HEAD)
        sides = [re.search(rb'"screen%s"\s*:\s*([1-9][0-9]{1,3})\b' % side, head)
                 for side in (b"Width", b"Height")]  # fmt: skip
        if sides[0] and sides[1]:
            return Frame(int(sides[0][1]), int(sides[1][1])), metadata.name
    return None, problem
