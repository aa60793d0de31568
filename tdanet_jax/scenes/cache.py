"""Tables are computed once per machine and kept in the user's cache folder.

A cached file's name holds a hash of everything that it follows from: the bundled rooms and the
source of the modules that compute the tables. Files appear whole or not at all, and of processes
that find none at the same time one computes while the others wait.
"""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import inspect
import os
import shutil
import time
import warnings
from pathlib import Path

import platformdirs

from tdanet_jax.io import assets, files
from tdanet_jax.scenes import ithor, tables

VARIABLE = "TDANET_CACHE"
#: What nobody has used for so long is removed when new tables are stored.
FORGOTTEN_DAYS = 30
#: Names of the tables, and of the folders in which imports keep their parts.
TABLES, IMPORTS = "ithor-", "import-"
_MODULES = (
    "io.archive",
    "poses",
    "vocabulary",
    "scenes.scene",
    "scenes.visibility.rules",
    "scenes.visibility.geometry",
    "scenes.visibility.rays",
    "scenes.visibility.solids",
    "scenes.visibility.raster",
    "scenes.visibility.build",
    "scenes.tables",
    "scenes.ithor",
)


def folder() -> Path:
    """The cache folder: `TDANET_CACHE` if set, else the platform's own place for caches."""
    chosen = os.environ.get(VARIABLE)
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("tdanet_jax"))


def key() -> str:
    """Hash of what the bundled tables follow from, 16 hex digits."""
    digest = hashlib.sha256(assets.sha256(assets.path(ithor.ASSET)).encode())
    for name in _MODULES:
        module = importlib.import_module(f"tdanet_jax.{name}")
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()[:16]


def load_tables(progress: tables.Progress | None = None) -> tables.SceneTables:
    """The bundled rooms' tables, from the cache or computed and cached.

    A cached file whose checksum is wrong is rebuilt with a warning. Where the cache cannot be
    written the tables are computed all the same.
    """
    path = folder() / f"{TABLES}{key()}.npz"
    if (found := _read(path)) is not None:
        return found
    with contextlib.ExitStack() as stack:
        _lock(stack)
        if (found := _read(path)) is not None:
            return found
        if path.exists():
            warnings.warn(f"{path}: damaged, computed anew", stacklevel=2)
        result = tables.build(ithor.load_scenes(), progress=progress)
        try:
            _store(result, path)
            _remove_forgotten(path.parent)
        except OSError as error:
            warnings.warn(f"{path}: not cached ({error.strerror})", stacklevel=2)
    return result


def _lock(stack: contextlib.ExitStack) -> None:
    """Makes other processes wait until `stack` unwinds; where nothing can be written, none need."""
    try:
        stack.enter_context(files.locked(folder()))
    except BlockingIOError:
        warnings.warn("another process computes the rooms' tables: waiting for it", stacklevel=3)
        stack.enter_context(files.locked(folder(), wait=True))
    except OSError:
        return
    files.remove_partial(folder())


def _read(path: Path) -> tables.SceneTables | None:
    """The cached tables, or None if they are missing or not those whose checksum was written."""
    try:
        if path.with_suffix(".sha256").read_text(errors="replace").strip() == assets.sha256(path):
            touch(path)
            return tables.SceneTables.load(path)
    except OSError:
        pass
    return None


def touch(path: Path) -> None:
    """Marks a file or folder of the cache as used now; where it cannot be written, it is not."""
    with contextlib.suppress(OSError):
        os.utime(path)


def _remove_forgotten(place: Path) -> None:
    """Removes tables and parts of imports that nobody has used for long. Under the lock.

    A process that reads them has them open, or computes anew what it does not find.
    """
    oldest = time.time() - FORGOTTEN_DAYS * 86400
    for path in [*place.glob(f"{TABLES}*.npz"), *place.glob(f"{IMPORTS}*")]:
        with contextlib.suppress(OSError):
            if path.stat().st_mtime >= oldest:
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
                path.with_suffix(".sha256").unlink()


def _store(result: tables.SceneTables, path: Path) -> None:
    with files.replacing(path) as fresh:
        result.save(fresh)
        files.write_text(path.with_suffix(".sha256"), assets.sha256(fresh) + "\n")
