"""Untrusted npz archives: numeric arrays, whose sizes are checked before they are read."""

from __future__ import annotations

import contextlib
import math
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

import numpy as np

from tdanet_jax.io.untrusted import FileError, regular
from tdanet_jax.io.untrusted.budgets import unpacking_excess

#: What NumPy writes; other methods expand far more.
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_BLOCK = 1 << 20  # bytes


def read(path: Path, links: bool = True) -> dict[str, np.ndarray]:
    """All arrays of an npz.

    Args:
      links: whether `path` may be a link, as a file that the user named may be.

    Raises:
      FileError: it is missing or damaged, exceeds a budget, or holds Python objects or names
        outside the archive.
    """
    with _opened(path, links) as archive:
        return {entry.filename[:-4]: _array(path, archive, entry) for entry in archive.filelist}


def checksums(path: Path, links: bool = True) -> list[tuple[str, int]]:
    """Name and checksum (CRC-32) of every array, from the archive's directory alone.

    Raises:
      FileError: it is missing or damaged.
    """
    with _opened(path, links) as archive:
        return [(entry.filename, entry.CRC) for entry in archive.filelist]


@contextlib.contextmanager
def _opened(path: Path, links: bool) -> Iterator[zipfile.ZipFile]:
    """The archive, if what it says of itself is within the budgets."""
    try:
        with regular.opened(path, links) as file, zipfile.ZipFile(file) as archive:
            entries = archive.filelist
            unpacked = sum(entry.file_size for entry in entries)
            if reason := unpacking_excess(len(entries), unpacked, os.fstat(file.fileno()).st_size):
                raise FileError(path, reason)
            for entry in entries:
                if entry.compress_type not in METHODS:
                    raise FileError(path, f"{entry.filename} is packed by an unsupported method")
            yield archive
    except FileNotFoundError:
        raise FileError(path, "no such file") from None
    except FileError:
        raise
    except Exception as error:  # zipfile and NumPy raise many kinds for a damaged file
        raise FileError(path, f"not an npz archive ({error})") from None


def _array(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    """One array, whose size is checked against its header before it is read."""
    name = entry.filename
    if not name.endswith(".npy") or ".." in name or name.startswith("/") or "\\" in name:
        raise FileError(path, f"{name!r} is not the name of an array")
    with archive.open(entry) as file:
        if np.lib.format.read_magic(file) != (1, 0):  # NumPy's, but for records of named columns
            raise FileError(path, f"{name} is not numeric")
        shape, by_column, dtype = np.lib.format.read_array_header_1_0(file)
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or dtype.itemsize == 0:
            raise FileError(path, f"{name} is not numeric")
        if size > entry.file_size:
            raise FileError(path, f"{name} is damaged: its size is not the one in its header")
        order: Literal["F", "C"] = "F" if by_column else "C"
        content, filled = np.empty(size, np.uint8), 0
        while filled < size and (block := file.read(min(_BLOCK, size - filled))):
            content[filled : filled + len(block)] = np.frombuffer(block, np.uint8)
            filled += len(block)
        if filled < size:
            raise FileError(path, f"{name} is damaged: it breaks off")
        file.read(1)  # the end, where its checksum is compared
        return content.view(dtype).reshape(shape, order=order)
