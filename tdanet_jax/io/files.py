"""Files that appear whole or not at all, and locks between processes."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

#: A process holds the lock of this file while it works in the folder.
LOCK_FILE = ".lock"
#: What is being written carries this before its name; a process that is killed may leave it.
PARTIAL = ".partial-"


def partial_path(path: Path) -> Path:
    """Where this process writes what is to be at `path`: beside it."""
    return path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path to write to, beside `path`; renamed to `path` at the end, removed on an error.

    Raises:
      OSError: it cannot be written; the error names `path`.
    """
    fresh = partial_path(path)
    try:
        yield fresh
        os.replace(fresh, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error
    finally:
        fresh.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file whole.

    Raises:
      OSError: it cannot be written; the error names `path`.
    """
    with replacing(path) as fresh:
        fresh.write_text(text, encoding="utf-8")


def remove_partial(folder: Path) -> list[Path]:
    """Removes what was half-written in `folder`, which nobody else may be writing to now."""
    found = sorted(folder.glob(f"{PARTIAL}*"))
    for path in found:
        _remove(path)
    return found


def remove_abandoned(path: Path) -> list[Path]:
    """Removes what processes that are no more had half-written of `path`."""
    name = re.compile(rf"{re.escape(PARTIAL)}(\d{{1,9}})-{re.escape(path.name)}")
    found = []
    for beside in sorted(path.parent.glob(f"{PARTIAL}*")):
        match = name.fullmatch(beside.name)
        if match is not None and not _runs(int(match[1])):
            _remove(beside)
            found.append(beside)
    return found


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


def _runs(process: int) -> bool:
    """Whether there is a process of this number on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # somebody else's
    return True


@contextlib.contextmanager
def locked(folder: Path, wait: bool = False) -> Iterator[None]:
    """Inside, no other process is in here for the same folder, which is made if need be.

    The system gives the lock back when its holder dies, in whatever way.

    Raises:
      BlockingIOError: another process holds the lock, and `wait` is False.
      OSError: the folder cannot be written.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = FileLock(folder / LOCK_FILE)
    try:
        lock.acquire(blocking=wait)
    except Timeout:
        raise BlockingIOError(errno.EWOULDBLOCK, "in use by another process", str(folder)) from None
    try:
        yield
    finally:
        lock.release()
