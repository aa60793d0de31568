"""Files that appear whole or not at all, so that a reader never meets a half-written one."""

from __future__ import annotations

import contextlib
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

#: What is being written carries this before its name; a process that is killed may leave it.
PARTIAL = ".partial-"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """A path to write to, beside `path`; renamed to `path` at the end, removed on an error.

    Raises:
      OSError: it cannot be written; the error names `path`.
    """
    fresh = path.with_name(f"{PARTIAL}{os.getpid()}-{path.name}")
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
        fresh.write_text(text)


def remove_partial(folder: Path) -> list[Path]:
    """Removes what was half-written in `folder`, which nobody else may be writing to now."""
    found = sorted(folder.glob(f"{PARTIAL}*"))
    for path in found:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
    return found
