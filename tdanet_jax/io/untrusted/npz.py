"""Untrusted npz archives: numeric arrays, whose sizes are checked before they are read."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import Literal

import numpy as np

from tdanet_jax.io.untrusted import FileError

LARGEST = 1 << 32  # bytes of the largest array that is read


def read(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an npz.

    Raises:
      FileError: it is missing or damaged, or holds Python objects or names outside the archive.
    """
    if not path.is_file():
        raise FileError(path, "no such file")
    try:
        with zipfile.ZipFile(path) as archive:
            return {entry.filename[:-4]: _array(path, archive, entry) for entry in archive.filelist}
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
        version = np.lib.format.read_magic(file)
        read_header = np.lib.format.read_array_header_1_0
        if version != (1, 0):
            read_header = np.lib.format.read_array_header_2_0
        shape, by_column, dtype = read_header(file)
        size = math.prod(shape) * dtype.itemsize
        if dtype.hasobject or dtype.itemsize == 0:
            raise FileError(path, f"{name} is not numeric")
        if size > LARGEST or size > entry.file_size:
            raise FileError(path, f"{name} is damaged: its size is not the one in its header")
        order: Literal["F", "C"] = "F" if by_column else "C"
        return np.frombuffer(bytearray(file.read(size)), dtype).reshape(shape, order=order)
