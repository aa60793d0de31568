"""The cache of tables, which are computed once per machine: of the bundled rooms, of variants
and of generated rooms.

The name of a cached file contains a hash of everything that determines it: the rooms and the
source of the modules that compute the tables; or tables and further targets
(`target_distances`). Files are written atomically, and if several processes need the same one at
the same time, one computes it while the others wait.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import inspect
import os
import shutil
import tempfile
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import platformdirs

from tdanet_jax.io import archive, assets, files
from tdanet_jax.io.untrusted import npz
from tdanet_jax.scenes import ithor, tabulation
from tdanet_jax.scenes.tables import SceneTables

VARIABLE = "TDANET_CACHE"
#: Files that have not been used for this long are removed when new tables are stored.
UNUSED_DAYS = 30
#: Prefixes of tables, of those of variants and of generated rooms, of distances to targets that
#: tables do not have (`target_distances`), and of the folders in which an import keeps the scenes
#: that it has read.
TABLES, VARIANTS, GENERATED = "ithor-", "variants-", "generated-"
DISTANCES, IMPORTS = "distances-", "import-"
#: What the name of a file's lock ends with. It is removed with the lock, unless the process is
#: killed.
LOCK = ".lock"
MODULES = (
    "io.archive",
    "poses",
    "vocabulary",
    "scenes.scene",
    "scenes.room_names",
    "scenes.visibility.rules",
    "scenes.visibility.geometry",
    "scenes.visibility.rays",
    "scenes.visibility.solids",
    "scenes.visibility.build",
    "scenes.tables",
    "scenes.tabulation",
    "scenes.ithor",
)


def folder() -> Path:
    """The cache folder: `TDANET_CACHE` if set, otherwise the platform's folder for caches.

    A user without a home gets a temporary one, for this process alone, with a warning.
    """
    if chosen := os.environ.get(VARIABLE):
        return Path(chosen)
    try:
        return Path(platformdirs.user_cache_dir("tdanet_jax"))
    except RuntimeError:
        return Path(_temporary().name)


@functools.cache
def _temporary() -> tempfile.TemporaryDirectory[str]:
    """A cache folder that is removed when the process ends."""
    warnings.warn(
        f"no home folder for the cache: what is computed now will be again; set {VARIABLE} to a "
        "folder to keep it",
        stacklevel=3,
    )
    return tempfile.TemporaryDirectory(prefix="tdanet_jax-", ignore_cleanup_errors=True)


def key() -> str:
    """Hash of everything that determines the bundled tables, 16 hex digits."""
    return source_hash(MODULES, assets.sha256(assets.path(ithor.ASSET)))


def source_hash(modules: Sequence[str], *others: str) -> str:
    """Hash of the source of modules of this package and of other texts, 16 hex digits."""
    digest = hashlib.sha256("".join(others).encode())
    for name in modules:
        module = importlib.import_module(f"tdanet_jax.{name}")
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()[:16]


def load_tables(progress: tabulation.Progress | None = None) -> SceneTables:
    """The tables of the bundled rooms, from the cache, or computed and then cached."""
    return load_or_build(
        f"{TABLES}{key()}", lambda: tabulation.build(ithor.load_scenes(), progress=progress)
    )


def load_or_build(name: str, build: Callable[[], SceneTables]) -> SceneTables:
    """The tables in the cached file of a name, or built and then cached.

    Warns if a cached file is damaged, which is then replaced, and if the cache cannot be written.
    """
    arrays = load(f"{name}.npz", lambda: build().to_arrays())
    return SceneTables.from_arrays(arrays)


def load(name: str, compute: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of a file of the cache, or computed and then cached.

    Args:
      name: of the file; it contains a hash of everything that determines the arrays.

    Warns as `load_or_build` does.
    """
    path = folder() / name
    if (found := _read(path)) is not None:
        return found
    with contextlib.ExitStack() as stack:
        _lock(stack, path)
        if (found := _read(path)) is not None:
            return found
        if path.exists():
            warnings.warn(f"{path}: damaged, computed again", stacklevel=3)
        result = compute()
        try:
            with files.locked(path.parent, wait=True):  # of the folder: nobody else writes to it
                files.remove_partial(path.parent)
                _store(result, path)
                _remove_unused(path.parent)
        except OSError as error:
            warnings.warn(f"{path}: not cached ({error.strerror})", stacklevel=3)
    return result


def _lock(stack: contextlib.ExitStack, path: Path) -> None:
    """Holds the lock of a file until `stack` unwinds, unless the cache cannot be written."""
    name = f".{path.stem}{LOCK}"
    with contextlib.suppress(OSError):
        try:
            stack.enter_context(files.locked(path.parent, name=name))
        except BlockingIOError:
            what = f"another process computes {path.name}: waiting for it"
            warnings.warn(what, stacklevel=3)
            stack.enter_context(files.locked(path.parent, wait=True, name=name))
        stack.callback(_remove, path.parent / name)


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def _read(path: Path) -> dict[str, np.ndarray] | None:
    """The cached arrays, or None if they are missing or their checksum is wrong."""
    try:
        if path.with_suffix(".sha256").read_text(errors="replace").strip() == assets.sha256(path):
            touch(path)
            return npz.read(path)
    except OSError:
        pass
    return None


def touch(path: Path) -> None:
    """Marks a file or folder of the cache as used now, if it can be written."""
    with contextlib.suppress(OSError):
        os.utime(path)


def _remove_unused(place: Path) -> None:
    """Removes tables, distances, locks and scenes of imports that have long been unused; holds the
    folder's lock.

    A process that reads them has them open, or computes again what it does not find.
    """
    oldest = time.time() - UNUSED_DAYS * 86400
    stored = (TABLES, VARIANTS, GENERATED, DISTANCES)
    kinds = [*(f"{kind}*.npz" for kind in stored), *(f".{kind}*{LOCK}" for kind in stored)]
    kinds.append(f"{IMPORTS}*")
    for path in [path for kind in kinds for path in place.glob(kind)]:
        with contextlib.suppress(OSError):
            if path.stat().st_mtime >= oldest:
                continue
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink()
                _remove(path.with_suffix(".sha256"))


def _store(result: dict[str, np.ndarray], path: Path) -> None:
    with files.replacing(path) as temporary:
        archive.write(temporary, result, compress=True)
        files.write_text(path.with_suffix(".sha256"), assets.sha256(temporary) + "\n")
