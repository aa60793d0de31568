"""Untrusted HDF5 files: only small numeric datasets that are stored in the file itself."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io.untrusted import FileError

#: Numbers in the largest dataset that is read; a feature map has 512 x 7 x 7.
LARGEST = 1 << 22
#: Filters that are read: HDF5's own deflate, shuffle and checksum, and h5py's lzf.
_FILTERS = (1, 2, 3, 32000)


class Reader:
    """The datasets of an open file, by name."""

    def __init__(self, path: Path, file: Any) -> None:
        self._path = path
        self._file = file

    def names(self) -> list[str]:
        """Names at the top level of the file."""
        with _plain_errors(self._path):
            return [str(name) for name in self._file]

    def read(self, name: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
        """The numbers of a dataset.

        Args:
          shape: the shape that it must have; None accepts any.

        Raises:
          FileError: it is a link, is stored in another file, too large, not numeric, not finite,
            or of another shape.
        """
        with _plain_errors(self._path):
            dataset = self._dataset(name)
            self._check(name, dataset, shape)
            value = np.asarray(dataset[()])
        if value.dtype.kind == "f" and not np.isfinite(value).all():
            raise FileError(self._path, f"{name} holds NaN or infinity")
        return value

    def shape(self, name: str) -> tuple[int, ...]:
        """The shape of a dataset of any size, of which nothing is read.

        Raises:
          FileError: it is a link, or has no shape.
        """
        with _plain_errors(self._path):
            shape = self._dataset(name).shape
        if shape is None:
            raise FileError(self._path, f"{name} has no shape")
        return tuple(map(int, shape))

    def _dataset(self, name: str) -> Any:
        import h5py

        link = self._file.get(name, getlink=True)
        if not isinstance(link, h5py.HardLink):
            raise FileError(self._path, f"{name} is a link")
        dataset = self._file[name]
        if not isinstance(dataset, h5py.Dataset):
            raise FileError(self._path, f"{name} is not a dataset")
        return dataset

    def _check(self, name: str, dataset: Any, shape: tuple[int, ...] | None) -> None:
        """Refuses a dataset before anything of it is read."""
        if dataset.external or dataset.is_virtual:
            raise FileError(self._path, f"{name} is stored in another file")
        if dataset.shape is None or dataset.dtype.kind not in "fiu":
            raise FileError(self._path, f"{name} is not numeric")
        if shape is not None and dataset.shape != shape:
            raise FileError(self._path, f"{name} has shape {dataset.shape}, not {shape}")
        largest = max(math.prod(map(int, s)) for s in (dataset.shape, dataset.chunks or ()))
        if largest > LARGEST:
            raise FileError(self._path, f"{name} has {largest} numbers, more than {LARGEST}")
        stored = dataset.id.get_create_plist()
        if any(stored.get_filter(i)[0] not in _FILTERS for i in range(stored.get_nfilters())):
            raise FileError(self._path, f"{name} has an unsupported compression filter")


def need_h5py(path: Path) -> None:
    """Raises FileError if h5py, which reads and writes `path`, is not installed."""
    try:
        import h5py  # noqa: F401
    except ImportError:
        raise FileError(path, "needs h5py: pip install h5py") from None


@contextlib.contextmanager
def opened(path: Path) -> Iterator[Reader]:
    """Opens a file for reading.

    Raises:
      FileError: it is missing or not an HDF5 file, or h5py is not installed.
    """
    need_h5py(path)
    import h5py

    if not path.is_file():
        raise FileError(path, "not a regular file" if path.exists() else "no such file")
    with _plain_errors(path):
        file = h5py.File(path, "r", locking=False)
    with file:
        yield Reader(path, file)


@contextlib.contextmanager
def _plain_errors(path: Path) -> Iterator[None]:
    """Turns whatever h5py raises about a broken file into one line."""
    try:
        yield
    except FileError:
        raise
    except Exception as error:  # h5py raises many kinds for a damaged file
        raise FileError(path, f"not a readable HDF5 file ({error})") from None
