"""Untrusted npz archives."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.io.untrusted import FileError, npz


def packed(path: Path, **entries: bytes) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)
    return path


def npy(array: np.ndarray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def test_arrays_come_back(tmp_path: Path) -> None:
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.asfortranarray(np.eye(3, 2)),
              "c/d": np.zeros((0, 4), np.int8), "e": np.array(["x", "yz"])}  # fmt: skip
    np.savez_compressed(tmp_path / "a.npz", **arrays)  # type: ignore[arg-type]
    found = npz.read(tmp_path / "a.npz")
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array)
        assert found[name].dtype == array.dtype


@pytest.mark.parametrize("name", ["../a.npy", "/etc/a.npy", "a/../../b.npy", "a\\b.npy", "a.txt"])
def test_names_outside_the_archive(tmp_path: Path, name: str) -> None:
    path = packed(tmp_path / "a.npz", **{name: npy(np.zeros(3))})
    with pytest.raises(FileError, match=r"a\.npz: .* is not the name of an array"):
        npz.read(path)
    assert [p.name for p in tmp_path.rglob("*")] == ["a.npz"]


def test_objects_sizes_and_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, a=np.array([print], object))
    with pytest.raises(FileError, match="is not numeric"):
        npz.read(path)
    huge = npy(np.zeros(3)).replace(
        b"'shape': (3,), }" + b" " * 12, b"'shape': (1000000000000,), }"
    )
    with pytest.raises(FileError, match="size is not the one in its header"):
        npz.read(packed(path, **{"a.npy": huge}))
    whole = packed(path, **{"a.npy": npy(np.zeros(300))}).read_bytes()
    for content in (b"", b"PK", whole[:1000], whole[:40] + b"\xff" * 40 + whole[80:]):
        path.write_bytes(content)
        with pytest.raises(FileError, match=r"a\.npz: "):
            npz.read(path)
    with pytest.raises(FileError, match="no such file"):
        npz.read(tmp_path / "b.npz")
