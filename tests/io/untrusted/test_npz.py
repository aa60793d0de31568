"""Untrusted npz archives."""

from __future__ import annotations

import io
import os
import tracemalloc
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


def test_sizes_are_added_up_before_anything_is_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    zeros = npy(np.zeros(16 << 20, np.int8))
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name in range(5):
            archive.writestr(f"{name}.npy", zeros)
    tracemalloc.start()
    with pytest.raises(FileError, match=r"unpacks to 1.* times its size, more than 200"):
        npz.read(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()


def test_an_array_is_read_once_and_not_copied(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    np.savez(path, a=np.ones(32 << 20, np.int8))
    tracemalloc.start()
    assert npz.read(path)["a"].all()
    assert tracemalloc.get_traced_memory()[1] < 40 << 20
    tracemalloc.stop()


def test_too_many_arrays_and_other_methods(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TDANET_BUDGETS", "arrays=2")
    path = packed(tmp_path / "a.npz", **{f"{i}.npy": npy(np.zeros(3)) for i in range(3)})
    with pytest.raises(FileError, match=r"3 arrays, more than 2; .* TDANET_BUDGETS=arrays=3"):
        npz.read(path)
    for method in (zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA):  # they expand a million-fold
        with zipfile.ZipFile(path, "w", method) as archive:
            archive.writestr("a.npy", npy(np.zeros(3)))
        with pytest.raises(FileError, match="unsupported method"):
            npz.read(path)


def test_pipes_and_links(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.npz")
    np.savez(tmp_path / "whole.npz", a=np.zeros(3))
    (tmp_path / "link.npz").symlink_to("whole.npz")
    for place in (tmp_path / "pipe.npz", Path("/dev/zero"), tmp_path):
        with pytest.raises(FileError, match="not a regular file"):
            npz.read(place)
    assert npz.read(tmp_path / "link.npz").keys() == {"a"}
    with pytest.raises(FileError, match="a link, which is not followed"):
        npz.read(tmp_path / "link.npz", links=False)
