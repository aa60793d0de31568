"""Untrusted npz archives: numeric arrays, whose sizes are checked before they are read."""

from __future__ import annotations

import contextlib
import math
import os
import zipfile
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Literal, NamedTuple

import numpy as np

from tdanet_jax.io.untrusted import FileError, regular
from tdanet_jax.io.untrusted.budgets import unpacking_excess

#: What NumPy writes; other methods expand far more.
METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_BLOCK = 1 << 20  # bytes


class Header(NamedTuple):
    """What an array says of itself."""

    shape: tuple[int, ...]
    by_column: bool
    dtype: np.dtype


def read(
    path: Path,
    links: bool = True,
    only: Callable[[str], bool] = lambda name: True,
    check: Callable[[Mapping[str, Header]], object] | None = None,
) -> dict[str, np.ndarray]:
    """The arrays of an npz.

    Args:
      links: whether `path` may be a link, as a file that the user named may be.
      only: the names of the arrays that are read.
      check: called before any of them is read, and raises FileError if they are not the right ones.
        It takes the place of the budgets: whoever knows the shapes knows what they take.

    Raises:
      FileError: it is missing or damaged, exceeds a budget, or holds Python objects or names
        outside the archive.
    """
    with _opened(path, links) as (archive, size):
        named = {_name(path, entry): entry for entry in archive.filelist}
        entries = {name: entry for name, entry in named.items() if only(name)}
        if check is None:
            _check_budgets(path, entries.values(), size)
        else:
            check({name: _header(path, archive, entry) for name, entry in entries.items()})
        return {name: _array(path, archive, entry) for name, entry in entries.items()}


def checksums(path: Path, links: bool = True) -> list[tuple[str, int]]:
    """Name and checksum (CRC-32) of every array, from the archive's directory alone.

    Raises:
      FileError: it is missing or damaged, or exceeds a budget.
    """
    with _opened(path, links) as (archive, size):
        _check_budgets(path, archive.filelist, size)
        return [(entry.filename, entry.CRC) for entry in archive.filelist]


@contextlib.contextmanager
def _opened(path: Path, links: bool) -> Iterator[tuple[zipfile.ZipFile, int]]:
    """The archive, and its bytes on disk."""
    try:
        with regular.opened(path, links) as file, zipfile.ZipFile(file) as archive:
            yield archive, os.fstat(file.fileno()).st_size
    except FileNotFoundError:
        raise FileError(path, "no such file") from None
    except FileError:
        raise
    except Exception as error:  # zipfile and NumPy raise many kinds for a damaged file
        raise FileError(path, f"not an npz archive ({error})") from None


def _check_budgets(path: Path, entries: Collection[zipfile.ZipInfo], size: int) -> None:
    """Raises FileError if what the archive says of its arrays is not within the budgets."""
    if reason := unpacking_excess(len(entries), sum(entry.file_size for entry in entries), size):
        raise FileError(path, reason)


def _name(path: Path, entry: zipfile.ZipInfo) -> str:
    """The name of an array, if it is one, and packed by a method that NumPy uses."""
    name = entry.filename
    if not name.endswith(".npy") or ".." in name or name.startswith("/") or "\\" in name:
        raise FileError(path, f"{name!r} is not the name of an array")
    if entry.compress_type not in METHODS:
        raise FileError(path, f"{name} is packed by an unsupported method")
    return name[:-4]


def _header(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> Header:
    with archive.open(entry) as file:
        return _header_of(path, entry, file)


def _header_of(path: Path, entry: zipfile.ZipInfo, file: IO[bytes]) -> Header:
    """The header with which an array begins, if the rest is as long as it says."""
    if np.lib.format.read_magic(file) != (1, 0):  # NumPy's, but for records of named columns
        raise FileError(path, f"{entry.filename} is not numeric")
    header = Header(*np.lib.format.read_array_header_1_0(file))
    if header.dtype.hasobject or header.dtype.itemsize == 0:
        raise FileError(path, f"{entry.filename} is not numeric")
    if math.prod(header.shape) * header.dtype.itemsize > entry.file_size:
        reason = f"{entry.filename} is damaged: its size is not the one in its header"
        raise FileError(path, reason)
    return header


def _array(path: Path, archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> np.ndarray:
    with archive.open(entry) as file:
        shape, by_column, dtype = _header_of(path, entry, file)
        size = math.prod(shape) * dtype.itemsize
        order: Literal["F", "C"] = "F" if by_column else "C"
        content, filled = np.empty(size, np.uint8), 0
        while filled < size and (block := file.read(min(_BLOCK, size - filled))):
            content[filled : filled + len(block)] = np.frombuffer(block, np.uint8)
            filled += len(block)
        if filled < size:
            raise FileError(path, f"{entry.filename} is damaged: it breaks off")
        file.read(1)  # the end, where its checksum is compared
        return content.view(dtype).reshape(shape, order=order)
