"""Mutated files: whatever is wrong with an untrusted file ends in one clear line.

The fast tier tries a few hundred mutations, `pytest -m slow tests/system/test_fuzz.py` 12,000.
"""

from __future__ import annotations

import contextlib
import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tdanet_jax import words
from tdanet_jax.io.untrusted import FileError, hdf5, pickles
from tdanet_jax.scenes import dataset
from tdanet_jax.scenes.offline import extras, importer, layout, reader
from tests.support import original

edits = st.lists(
    st.tuples(
        st.sampled_from(["set", "insert", "delete", "repeat", "cut"]),
        st.floats(0, 1),
        st.binary(min_size=1, max_size=4) | st.sampled_from(
            [b"NaN", b"1e999", b"-", b'"', b"[", b"}", b"null", b"\\u0000", b"9" * 20, b"\xff" * 8,
             b"\x80", b"R", b"b", b"c", b"os\nsystem\n", b"(", b"t", b"u", b"0", b"\x93"]
        ),
    ),
    min_size=1,
    max_size=4,
)  # fmt: skip


def mutate(data: bytes, changes: list[tuple[str, float, bytes]]) -> bytes:
    for kind, share, piece in changes:
        at = int(share * len(data))
        if kind == "set":
            data = data[:at] + piece + data[at + len(piece) :]
        elif kind == "insert":
            data = data[:at] + piece + data[at:]
        elif kind == "delete":
            data = data[:at] + data[at + len(piece) :]
        elif kind == "repeat":
            data = data[:at] + data[at : at + 40] + data[at:]
        else:
            data = data[:at]
    return data


def read_scene(path: Path) -> None:
    reader.read_scene(path.parent, "FloorPlan1", 0)


def read_pickle(path: Path) -> None:
    extras.read_episodes(path, {"FloorPlan21": extras.KnownRoom(GRID, {"Mug"})})


def read_matrix(path: Path) -> None:
    extras.read_graph(path.with_name("objects.txt"), path)


def read_tensor(path: Path) -> None:
    for item in pickles.load(path.read_bytes(), path):
        pickles.array(item, path)


def read_features(path: Path) -> None:
    with hdf5.opened(path) as file:
        for name in file.names():
            file.read(name)


GRID = layout.Grid(np.array([[p["x"], p["y"], p["z"]] for p in original.POINTS]))


def seeds(root: Path) -> list[tuple[Path, Callable[[Path], object]]]:
    """Good files, and what reads each."""
    scenes = original.write_all(root)
    with original.fake_torch():
        tensors = [original.Tensor(np.arange(9), 1, (2, 3), (1, 2)), np.eye(3)]
        (root / "tensors.pkl").write_bytes(pickle.dumps(tensors, 3))
    (root / "glove.txt").write_text("mug 1 2 3\nbread 0.5 -1e-3 2\n")
    dataset.save_rooms(importer.read_folder(scenes, lambda share, line: None), root / "rooms.npz")
    room = scenes / "FloorPlan1"
    names = ("grid.json", "graph.json", "visible_object_map.json", "objects_bb.json")
    return [
        *((room / name, read_scene) for name in names),
        (root / "data" / "c2p_prob.json", extras.read_parents),
        (root / "test_val_split" / "kitchen_test.pkl", read_pickle),
        (root / "data" / "gcn" / "adjmat.dat", read_matrix),
        (root / "tensors.pkl", read_tensor),
        (root / "rooms.npz", dataset.load_rooms),
        (root / "glove.txt", words.load_word_vectors),
        *feature_files(root),
    ]


def feature_files(root: Path) -> list[tuple[Path, Callable[[Path], object]]]:
    with contextlib.suppress(ImportError):
        import h5py

        with h5py.File(root / "features.hdf5", "w") as file:
            file.create_dataset("a", data=np.arange(40.0), compression="gzip")
            file["b"] = np.arange(6, dtype=np.int32)
        return [(root / "features.hdf5", read_features)]
    return []


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> list:
    root = tmp_path_factory.mktemp("fuzz")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TDANET_CACHE", str(root / "cache"))
        return [(path, path.read_bytes(), read) for path, read in seeds(root)]


def check(good: list, which: int, changes: list[tuple[str, float, bytes]]) -> None:
    path, data, read = good[which % len(good)]
    path.write_bytes(mutate(data, changes))
    refusal = ""
    try:
        read(path)
    except FileError as error:
        refusal = str(error)
    finally:
        path.write_bytes(data)
    assert refusal.isprintable()
    assert not refusal or str(path.parent) in refusal


@given(st.integers(0, 10), edits)
@settings(max_examples=300, suppress_health_check=[HealthCheck.too_slow])
def test_a_few_mutations(good: list, which: int, changes: list[tuple[str, float, bytes]]) -> None:
    check(good, which, changes)


@pytest.mark.slow
@given(st.integers(0, 10), edits)
@settings(max_examples=12_000, suppress_health_check=[HealthCheck.too_slow])
def test_many_mutations(good: list, which: int, changes: list[tuple[str, float, bytes]]) -> None:
    check(good, which, changes)
