"""Untrusted HDF5 files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax.io.untrusted import FileError, hdf5

h5py = pytest.importorskip("h5py")


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A good dataset, and next to it everything that is refused."""
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["secret"] = np.zeros(3)
    (tmp_path / "raw").write_bytes(bytes(64))
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file.create_dataset("good", data=np.arange(6.0).reshape(2, 3), compression="gzip")
        file["external link"] = h5py.ExternalLink("other.h5", "secret")
        file["soft link"] = h5py.SoftLink("/good")
        file.create_dataset("elsewhere", (8,), "f8", external=[(tmp_path / "raw", 0, 64)])
        layout = h5py.VirtualLayout((3,), "f8")
        layout[:] = h5py.VirtualSource(str(tmp_path / "other.h5"), "secret", (3,))
        file.create_virtual_dataset("virtual", layout)
        file.create_dataset("huge", (10**12,), "f4", chunks=(1024,))
        file.create_dataset("wide", (4,), "f4", maxshape=(None,), chunks=(1 << 23,))
        file["text"] = "hello"
        file.create_dataset("objects", (2,), h5py.ref_dtype)
        file["nan"] = np.array([1.0, np.nan])
        file.create_group("group")
        file.create_dataset("szip", data=np.zeros(64), scaleoffset=2)
    return path


@pytest.mark.parametrize(
    ("name", "reason"),
    [("external link", "link"), ("soft link", "link"), ("elsewhere", "another file"),
     ("virtual", "another file"), ("huge", "1000000000000 numbers"), ("wide", "8388608 numbers"),
     ("text", "not numeric"), ("objects", "not numeric"), ("nan", "NaN"),
     ("group", "not a dataset"), ("szip", "compression filter"), ("missing", "link")],
)  # fmt: skip
def test_what_is_refused(path: Path, name: str, reason: str) -> None:
    with hdf5.opened(path) as reader, pytest.raises(FileError, match=rf"a\.h5: {name} .*{reason}"):
        reader.read(name)


def test_what_is_read(path: Path) -> None:
    with hdf5.opened(path) as reader:
        np.testing.assert_array_equal(reader.read("good", (2, 3)), np.arange(6).reshape(2, 3))
        assert "good" in reader.names()
        with pytest.raises(FileError, match=r"good has shape \(2, 3\), not \(3, 2\)"):
            reader.read("good", (3, 2))


def test_shapes_of_what_is_too_large_to_be_read(path: Path) -> None:
    with hdf5.opened(path) as reader:
        assert reader.shape("huge") == (10**12,)
        for name, reason in (("soft link", "is a link"), ("group", "is not a dataset")):
            with pytest.raises(FileError, match=rf"a\.h5: {name} {reason}"):
                reader.shape(name)


@pytest.mark.parametrize("content", [b"", b"text", b"\x89HDF\r\n\x1a\n" + bytes(600)])
def test_what_is_not_hdf5(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "b.h5"
    path.write_bytes(content)
    with pytest.raises(FileError, match=r"b\.h5: not a readable HDF5 file"), hdf5.opened(path):
        pass
    with pytest.raises(FileError, match="no such file"), hdf5.opened(tmp_path / "c.h5"):
        pass


def test_without_h5py(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    modules: dict[str, Any] = sys.modules  # type: ignore[assignment]
    monkeypatch.setitem(modules, "h5py", None)
    with pytest.raises(FileError, match="pip install"), hdf5.opened(path):
        pass
