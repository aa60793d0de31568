"""Arrays of checkpoints in formats 1 and 2, which Orbax wrote, read in a process of its own.

TensorStore, which reads them, crashes on some damaged ones. A crash ends that process alone, and
what it writes is read like any untrusted npz file.
"""

from __future__ import annotations

import contextlib
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io.escaping import in_line
from tdanet_jax.io.untrusted import FileError, jsons, regular
from tdanet_jax.io.untrusted.budgets import budgets, unpacking_excess

METADATA = "_METADATA"
#: What stands where a tree has no array.
_EMPTY = ("None", "Dict", "List", "Tuple", "NamedTuple")
#: Seconds after which the process is stopped. Reading a checkpoint takes less than one.
SECONDS = 300
#: Bytes that the process may take in addition to the arrays: for libraries and their threads.
_OWN_MEMORY = 4 << 30
#: What the process runs. It finds modules where this one does, except those of a working folder.
_CHILD = """
import sys
sys.path[:] = {path!r}
from tdanet_jax.io.untrusted import orbax
orbax.main({folder!r}, {out!r})
"""


@contextlib.contextmanager
def as_npz(folder: Path) -> Iterator[Path]:
    """The arrays of a state by their names (params/actor/kernel), in a file that is then removed.

    Args:
      folder: the folder of the arrays, `state` in that of the checkpoint.

    Raises:
      FileError: a file is missing or damaged, exceeds a budget, or crashes or delays its reader.
    """
    ours = str(Path(__file__).resolve().parents[3])
    with tempfile.TemporaryDirectory(prefix="tdanet-") as private:
        out = Path(private) / "state.npz"
        path = [entry or ours for entry in sys.path]
        code = _CHILD.format(path=path, folder=str(folder.absolute()), out=str(out))
        try:
            done = subprocess.run(
                [sys.executable, "-c", code], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL, timeout=SECONDS, check=False,
            )  # fmt: skip
        except subprocess.TimeoutExpired:
            raise FileError(folder, f"could not be read within {SECONDS} seconds") from None
        if done.returncode:
            reason = in_line(done.stdout[:1000].decode(errors="replace"))
            raise FileError(folder, reason or f"crashed its reader (status {done.returncode})")
        try:
            yield out
        except FileError as error:  # the file that it names will be gone
            raise FileError(folder, str(error).removeprefix(f"{out}: ")) from None


def main(folder: str, out: str) -> None:
    """Writes the arrays in `folder` to `out`, or prints why not; the process then ends."""
    _limit()
    try:
        np.savez(out, **_arrays(Path(folder)))
    except (ValueError, OSError) as error:
        reason = str(error).removeprefix(f"{folder}/").removeprefix(f"{folder}: ")
        os.write(1, reason.encode(errors="replace"))
        os._exit(1)
    os._exit(0)  # without waiting for TensorStore's threads


def _limit() -> None:
    """Limits what this process takes; if it crashes, it leaves no core dump."""
    try:
        import resource
    except ImportError:  # Windows has no such limits
        return
    memory = int(budgets().unpacked) + _OWN_MEMORY
    for kind, most in (
        (resource.RLIMIT_CORE, 0),
        (resource.RLIMIT_CPU, SECONDS),  # if nobody is there any more to stop it
        (resource.RLIMIT_DATA, memory),
    ):
        hard = resource.getrlimit(kind)[1]
        resource.setrlimit(
            kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard)
        )


def _arrays(folder: Path) -> dict[str, Any]:
    """All arrays, whose sizes are checked before any of them is read."""
    packed = regular.check_tree(folder)
    stores = {name: _opened(folder, name, *place) for name, place in _places(folder).items()}
    if reason := unpacking_excess(len(stores), sum(map(_size, stores.values())), packed):
        raise FileError(folder, reason)
    return {name: _read(folder, name, store) for name, store in stores.items()}


def _places(folder: Path) -> dict[str, tuple[str, str]]:
    """TensorStore's driver and path of each array."""
    content = jsons.load(folder / METADATA, links=False)
    tree = content.get("tree_metadata") if isinstance(content, dict) else None
    if not isinstance(tree, dict):
        raise FileError(folder / METADATA, "no tree_metadata")
    driver = "zarr3" if content.get("use_zarr3") else "zarr"
    found = {}
    for entry in tree.values():
        try:
            parts = [part["key"] for part in entry["key_metadata"]]
            if entry["value_metadata"]["value_type"] not in _EMPTY:
                if "/".join(parts) in ("file", "allow_pickle"):  # arguments of np.savez
                    raise FileError(folder / METADATA, f"{parts[0]} is not the name of an array")
                found["/".join(parts)] = driver, ".".join(parts)
        except (KeyError, TypeError):
            raise FileError(folder / METADATA, "an array without key and value type") from None
    return found


def _opened(folder: Path, name: str, driver: str, place: str) -> Any:
    """A TensorStore of which only the description has been read."""
    import tensorstore

    kvstore = {"driver": "ocdbt", "base": f"file://{folder}/", "path": f"{place}/"}
    try:
        store = tensorstore.open({"driver": driver, "kvstore": kvstore}, read=True, open=True)
        opened = store.result()
    except Exception as error:  # TensorStore raises many kinds
        raise FileError(folder, f"{name} is damaged ({error})") from None
    dtype = np.dtype(opened.dtype.numpy_dtype)
    if dtype.hasobject or dtype.isbuiltin != 1:
        raise FileError(folder, f"{name} is of a type that npz cannot hold")
    return opened


def _size(store: Any) -> int:
    """Bytes that reading an array takes: its own, or those of a chunk that is larger."""
    chunk = store.chunk_layout.read_chunk.shape or ()
    numbers = max(math.prod(map(int, store.shape)), math.prod(map(int, chunk)))
    return numbers * np.dtype(store.dtype.numpy_dtype).itemsize


def _read(folder: Path, name: str, store: Any) -> np.ndarray:
    try:
        return np.asarray(store.read().result())
    except Exception as error:  # TensorStore raises many kinds
        raise FileError(folder, f"{name} is damaged ({error})") from None
