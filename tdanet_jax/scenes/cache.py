"""Tables are computed once per machine and kept in the user's cache folder.

A cached file's name holds a hash of everything that it follows from: the bundled rooms and the
source of the modules that compute the tables. Files appear whole or not at all, so that
processes building at the same time do not disturb each other.
"""

import hashlib
import importlib
import inspect
import os
import secrets
import warnings
from pathlib import Path

import platformdirs

from tdanet_jax import assets
from tdanet_jax.scenes import ithor, tables
from tdanet_jax.vocabulary import ALL_TARGETS

VARIABLE = "TDANET_CACHE"
_MODULES = (
    "archive",
    "scene",
    "rules",
    "geometry",
    "rays",
    "solids",
    "raster",
    "visibility",
    "tables",
    "ithor",
)


def folder() -> Path:
    """The cache folder: `TDANET_CACHE` if set, else the platform's own place for caches."""
    chosen = os.environ.get(VARIABLE)
    return Path(chosen) if chosen else Path(platformdirs.user_cache_dir("tdanet_jax"))


def key() -> str:
    """Hash of what the bundled tables follow from, 16 hex digits."""
    digest = hashlib.sha256(assets.sha256(assets.path(ithor.ASSET)).encode())
    digest.update(repr(ALL_TARGETS).encode())
    for name in _MODULES:
        module = importlib.import_module(f"tdanet_jax.scenes.{name}")
        digest.update(inspect.getsource(module).encode())
    return digest.hexdigest()[:16]


def load_tables(progress: tables.Progress | None = None) -> tables.SceneTables:
    """The bundled rooms' tables, from the cache or computed and cached.

    A cached file whose checksum is wrong is rebuilt with a warning. Where the cache cannot be
    written the tables are computed all the same.
    """
    path = folder() / f"ithor-{key()}.npz"
    checksum = path.with_suffix(".sha256")
    if path.is_file():
        if checksum.is_file() and checksum.read_text().strip() == assets.sha256(path):
            return tables.SceneTables.load(path)
        warnings.warn(f"{path}: damaged, computed anew", stacklevel=2)
    result = tables.build(ithor.load_scenes(), progress=progress)
    try:
        _store(result, path, checksum)
    except OSError as error:
        warnings.warn(f"{path}: not cached ({error.strerror})", stacklevel=2)
    return result


def _store(result: tables.SceneTables, path: Path, checksum: Path) -> None:
    """Write beside the final place, then rename: readers see an old file or a whole new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fresh = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}")
    note = fresh.with_name(fresh.name + ".sha256")
    try:
        result.save(fresh)
        note.write_text(assets.sha256(fresh) + "\n")
        os.replace(note, checksum)  # first: no reader shall see tables without their checksum
        os.replace(fresh, path)
    finally:
        fresh.unlink(missing_ok=True)
        note.unlink(missing_ok=True)
