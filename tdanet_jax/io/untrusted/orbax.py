"""The arrays of an untrusted checkpoint that Orbax wrote, described before any of them is read.

Orbax itself reads all arrays at once; if one of them is damaged, the others may crash the process.
"""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io.untrusted import FileError, jsons

METADATA = "_METADATA"
#: What stands where a tree has no array.
_EMPTY = ("None", "Dict", "List", "Tuple", "NamedTuple")


@dataclasses.dataclass(frozen=True)
class Stored:
    """An array on disk."""

    path: Path  # folder of all arrays
    name: str  # params/actor/kernel
    store: Any  # tensorstore.TensorStore

    @property
    def shape(self) -> tuple[int, ...]:
        """Its shape."""
        return tuple(map(int, self.store.shape))

    @property
    def dtype(self) -> np.dtype:
        """Its type."""
        return np.dtype(self.store.dtype.numpy_dtype)

    @property
    def size(self) -> int:
        """Bytes that reading it takes: those of the array, or of a chunk that is larger."""
        chunk = self.store.chunk_layout.read_chunk.shape or ()
        return max(math.prod(self.shape), math.prod(chunk)) * self.dtype.itemsize

    def read(self) -> np.ndarray:
        """Its numbers.

        Raises:
          FileError: they are damaged.
        """
        try:
            return np.asarray(self.store.read().result())
        except Exception as error:  # TensorStore raises many kinds
            raise FileError(self.path, f"{self.name} is damaged ({error})") from None


def describe(folder: Path) -> dict[str, Stored]:
    """The arrays of a state by name, with their shapes and types.

    Raises:
      FileError: a file is missing or damaged.
    """
    content = jsons.load(folder / METADATA, links=False)
    tree = content.get("tree_metadata") if isinstance(content, dict) else None
    if not isinstance(tree, dict):
        raise FileError(folder / METADATA, "no tree_metadata")
    found = {}
    for entry in tree.values():
        try:
            parts = [part["key"] for part in entry["key_metadata"]]
            empty = entry["value_metadata"]["value_type"] in _EMPTY
            found["/".join(parts)] = None if empty else ".".join(parts)
        except (KeyError, TypeError):
            raise FileError(folder / METADATA, "an array without key and value type") from None
    driver = "zarr3" if content.get("use_zarr3") else "zarr"
    return {
        name: Stored(folder, name, _opened(folder, name, driver, place))
        for name, place in found.items()
        if place is not None
    }


def _opened(folder: Path, name: str, driver: str, place: str) -> Any:
    import tensorstore

    kvstore = {"driver": "ocdbt", "base": f"file://{folder.absolute()}/", "path": f"{place}/"}
    try:
        store = tensorstore.open({"driver": driver, "kvstore": kvstore}, read=True, open=True)
        opened = store.result()
    except Exception as error:  # TensorStore raises many kinds
        raise FileError(folder, f"{name} is damaged ({error})") from None
    if np.dtype(opened.dtype.numpy_dtype).hasobject:
        raise FileError(folder, f"{name} is not numeric")
    return opened
