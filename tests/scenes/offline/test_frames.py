"""The size of the recorded frames: from files beside the boxes, or from the user."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.scenes.offline import frames
from tdanet_jax.scenes.offline.frames import Frame


@pytest.mark.parametrize(
    ("text", "frame"),
    [("300x300", Frame(300, 300)), ("640x480", Frame(640, 480)), ("10000x10", Frame(10000, 10)),
     ("10001x10", None), ("0x300", None), ("300", None), ("300x", None), ("300X300", None),
     ("300x300x3", None), ("-5x300", None), ("3e2x300", None), ("", None)],
)  # fmt: skip
def test_frames_from_flags(text: str, frame: Frame | None) -> None:
    assert frames.parse(text) == frame
    assert frame is None or str(frame) == text


def test_images_tell_their_size(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    assert frames.recorded(tmp_path) == (None, "")
    for shape, expected in (
        ((480, 640, 3), (Frame(640, 480), "images.hdf5")),
        ((1080, 1920, 3), (Frame(1920, 1080), "images.hdf5")),  # more than is read of a dataset
        ((300, 300, 4), (Frame(300, 300), "images.hdf5")),
        ((5,), (None, "images.hdf5: shape (5,) is not that of an image")),
        ((3, 300, 300), (None, "images.hdf5: shape (3, 300, 300) is not that of an image")),
        ((0, 300, 3), (None, "images.hdf5: shape (0, 300, 3) is not that of an image")),
    ):
        with h5py.File(tmp_path / "images.hdf5", "w") as file:
            file["0.00|0.00|0|0"] = np.zeros(shape, np.uint8)
        assert frames.recorded(tmp_path) == expected
    with h5py.File(tmp_path / "images.hdf5", "w") as file:
        file["link"] = h5py.SoftLink("/elsewhere")
    assert frames.recorded(tmp_path) == (None, "images.hdf5: link is a link")
    h5py.File(tmp_path / "images.hdf5", "w").close()
    assert frames.recorded(tmp_path) == (None, "images.hdf5: no images")
    for content in (b"", b"damaged"):
        (tmp_path / "images.hdf5").write_bytes(content)
        found, problem = frames.recorded(tmp_path)
        assert found is None
        assert problem.startswith("images.hdf5: not a readable HDF5 file (")


def test_metadata_tell_the_size_of_the_screen(tmp_path: Path) -> None:
    for event, expected in (
        ({"screenWidth": 640, "screenHeight": 480.0}, (Frame(640, 480), "metadata.json")),
        ({"screenWidth": 640}, (None, "")),
    ):
        content = {"0.00|0.00|0|0": {"objects": [], **event}}
        (tmp_path / "metadata.json").write_text(json.dumps(content))
        assert frames.recorded(tmp_path) == expected
