"""Regular files: no pipe or device is ever opened, and in a run's folder no link is followed."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from tdanet_jax.io.untrusted import FileError
from tdanet_jax.io.untrusted.budgets import excess


@contextlib.contextmanager
def opened(path: Path, links: bool = True) -> Iterator[BinaryIO]:
    """A regular file, open for reading.

    Args:
      links: whether `path` may be a link, as a file that the user named may be.

    Raises:
      FileNotFoundError: there is no such file.
      FileError: it is not a regular file.
    """
    status = os.stat(path) if links else os.lstat(path)
    _check(path, status.st_mode)
    # O_NONBLOCK: if a pipe has taken its place meanwhile, opening it does not wait.
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if links else os.O_NOFOLLOW)
    with os.fdopen(os.open(path, flags), "rb") as file:
        _check(path, os.fstat(file.fileno()).st_mode)
        yield file


def read_bytes(path: Path, links: bool = True) -> bytes:
    """The content of a regular file, if it is within the budget.

    Raises:
      FileNotFoundError: there is no such file.
      FileError: it is not a regular file, or too large.
    """
    with opened(path, links) as file:
        size = os.fstat(file.fileno()).st_size
        if reason := excess("size", size, f"has {size} bytes"):
            raise FileError(path, reason)
        return file.read(size)


def read_text(path: Path, links: bool = True, errors: str = "strict") -> str:
    """The text of a regular file in UTF-8, with or without a byte-order mark; as `read_bytes`.

    Args:
      errors: "replace", if bytes that are not UTF-8 are no error, as for `bytes.decode`.
    """
    try:
        return read_bytes(path, links).decode("utf-8-sig", errors)
    except UnicodeDecodeError as error:
        raise FileError(path, f"not UTF-8 ({error})") from None


def check_folder(path: Path) -> None:
    """Raises FileError if there is something else than a folder at `path`, or a link to one."""
    if os.path.lexists(path):
        _check(path, os.lstat(path).st_mode, stat.S_IFDIR)


def check_tree(folder: Path) -> int:
    """Bytes of all files in a folder of regular files and folders; nothing is opened.

    Raises:
      FileError: the folder, or anything in it, is a link, a pipe or a device.
    """
    _check(folder, os.lstat(folder).st_mode, stat.S_IFDIR)
    size = 0
    for place, folders, names in os.walk(folder):
        for name in folders:
            _check(Path(place) / name, os.lstat(Path(place) / name).st_mode, stat.S_IFDIR)
        for name in names:
            status = os.lstat(Path(place) / name)
            _check(Path(place) / name, status.st_mode)
            size += status.st_size
    return size


def _check(path: Path, mode: int, wanted: int = stat.S_IFREG) -> None:
    if stat.S_ISLNK(mode):
        raise FileError(path, "a link, which is not followed here")
    if stat.S_IFMT(mode) != wanted:
        raise FileError(path, f"not a {'folder' if wanted == stat.S_IFDIR else 'regular file'}")
