"""Atomic file writes, and locks between processes."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

#: A process locks this file while it works in the folder.
LOCK_FILE = ".lock"
#: Prefix of what is being written; a process that is killed may leave it.
PARTIAL = ".partial-"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Where to write a file or a folder that becomes `path` at the end; removed on an error.

    It lies in a new folder next to `path`, with a random name and for this user alone, so that
    nobody can guess it and put a link there.

    Raises:
      OSError: it cannot be written; the error names `path`.
    """
    try:
        with private_folder(path.parent) as folder:
            yield folder / path.name
            os.replace(folder / path.name, path)
    except OSError as error:
        raise OSError(error.errno, error.strerror or str(error), str(path)) from error


@contextlib.contextmanager
def private_folder(parent: Path) -> Iterator[Path]:
    """A new folder in `parent` for what is being written; removed at the end with what is in it."""
    folder = Path(tempfile.mkdtemp(prefix=f"{PARTIAL}{os.getpid()}-", dir=parent))
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Writes a text file atomically.

    Raises:
      OSError: it cannot be written; the error names `path`.
    """
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def remove_partial(folder: Path) -> list[Path]:
    """Removes unfinished files from `folder`; no other process may be writing to it."""
    found = sorted(folder.glob(f"{PARTIAL}*"))
    for path in found:
        _remove(path)
    return found


def remove_abandoned(path: Path) -> list[Path]:
    """Removes unfinished versions of `path` whose process no longer runs."""
    name = re.compile(rf"{re.escape(PARTIAL)}(\d{{1,9}})-[^-]*")
    found = []
    for folder in sorted(path.parent.glob(f"{PARTIAL}*")):
        match = name.fullmatch(folder.name)
        if match is None or folder.is_symlink() or _is_running(int(match[1])):
            continue
        if os.path.lexists(folder / path.name):
            _remove(folder)
            found.append(folder)
    return found


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()


def _is_running(process: int) -> bool:
    """Whether a process with this id runs on this machine."""
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        pass  # it belongs to another user
    return True


def check_empty(folder: Path, instead: str = "") -> None:
    """Raises ValueError unless `folder` is new, or holds only what a killed process left behind.

    It must also be possible to write there.

    Args:
      instead: what to do otherwise, for the message.
    """
    leftover = (LOCK_FILE, PARTIAL)
    if folder.exists() and (
        not folder.is_dir() or any(not p.name.startswith(leftover) for p in folder.iterdir())
    ):
        raise ValueError(f"--out {folder}: exists and is not empty{instead}")
    check_writable(folder)


def check_new_folder(folder: Path) -> None:
    """As `check_empty`, for a folder that `new_folder` puts in place as a whole."""
    if folder.resolve() == Path.cwd():
        raise ValueError(f"--out {folder}: is the working folder; name a folder in it")
    check_empty(folder)


@contextlib.contextmanager
def new_folder(folder: Path) -> Iterator[Path]:
    """A folder to write into that becomes `folder`, new or empty, at the end; removed on an error.

    Raises:
      ValueError: it is neither, or the working folder.
      OSError: it cannot be written; the error names it.
    """
    check_new_folder(folder)
    folder.parent.mkdir(parents=True, exist_ok=True)
    if folder.is_dir():
        for left in [*folder.iterdir()]:  # by a killed process
            _remove(left)
    with replacing(folder) as fresh:
        fresh.mkdir()
        yield fresh


def check_writable(out: Path) -> None:
    """Raises ValueError unless a file or folder can be written at `out`; leaves nothing there.

    Folders above it may have to be created.
    """
    above = out.absolute().parents
    place = out if out.is_dir() else next(path for path in above if path.exists())
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise ValueError(f"--out {out}: {error.strerror}") from None


@contextlib.contextmanager
def locked(folder: Path, wait: bool = False, name: str = LOCK_FILE) -> Iterator[None]:
    """Holds the lock of a folder, which is created if it does not exist.

    With another `name`, it is a lock of that name alone: of one of the folder's files, say.

    The operating system releases the lock when the process ends, however it ends. On an error, a
    folder that was created for nothing is removed again.

    Raises:
      BlockingIOError: another process holds the lock, and `wait` is False.
      OSError: the folder cannot be written.
    """
    from filelock import FileLock, Timeout  # a robot has it not

    created = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    if path.is_symlink():
        raise OSError(errno.ELOOP, "a link, which is not followed here", str(path))
    lock = FileLock(path)
    try:
        lock.acquire(blocking=wait)
    except Timeout:
        raise BlockingIOError(errno.EWOULDBLOCK, "in use by another process", str(folder)) from None
    try:
        yield
    except BaseException:
        if created and {*folder.iterdir()} <= {path}:
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # another process has come to use them
                for place in created:
                    place.rmdir()
        raise
    finally:
        lock.release()
