"""Mutated files: whatever is wrong with an untrusted file ends in one clear line.

Memory and time are measured as well. The fast tier tries some hundred mutations,
`pytest -m slow tests/system/test_fuzz.py` 10,000 of each kind of file, and 500 of the checkpoints
that Orbax wrote, each of which is read in a process of its own.
"""

from __future__ import annotations

import contextlib
import json
import pickle
import shutil
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.analysis import episode_lookup
from tdanet_jax.evaluation import comparison, results_file
from tdanet_jax.io.untrusted import hdf5, pickles
from tdanet_jax.models.classes import load_vocabulary
from tdanet_jax.scenes import dataset, metadata
from tdanet_jax.scenes.offline import extras, importer, layout, reader
from tdanet_jax.training import history, journal, run_file
from tdanet_jax.training.checkpoint import ARRAYS, FORMAT, META, Checkpoints
from tests.support import handmade, original

MOST_MEMORY, MOST_SECONDS = 100 << 20, 10.0  # of one small file
#: Values in place of others; "@" becomes 1e400.
ODD: list[Any] = [
    10**400, -(10**400), "@", -1, 0, 0.5, 10**9, 2**63, 1e308, True, None, "", "x" * 300,
    "../../escaped", "/escaped", "a\x1b[2Jb", "[/x]", "$a$|<b>", "\ud800", [], {}, [[]], {"a": {}},
    [[[[[[[[[[1]]]]]]]]]], [None], {"": None},
]  # fmt: skip
SCENE = {
    "name": "Attic",
    "room_type": "bedroom",
    "objects": [
        {
            "objectId": "Mug|1",
            "objectType": "Mug",
            "axisAlignedBoundingBox": {
                "center": {"x": 0, "y": 1, "z": 1},
                "size": {"x": 0.1, "y": 0.1, "z": 0.1},
            },
            "rotation": {"x": 0, "y": 90, "z": 0},
            "parentReceptacles": ["Table|1"],
            "visible": True,
        }
    ],
    "reachable_positions": [{"x": 0, "y": 0.9, "z": 0}, {"x": 0, "y": 0.9, "z": 0.25}],
    "gridSize": 0.25,
    "rotateStepDegrees": 45,
    "horizons": [0, 30],
    "split": "train",
}
OLD_RUN = Path(__file__).parents[1] / "data" / "run_format_1_best"
BUNDLED = Path(__file__).parents[2] / "agents" / "18-4-best"

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


def with_odd(data: bytes, share: float, value: object) -> bytes:
    """A JSON document (or the first line of several) in which one value is replaced."""
    content = json.loads(data.splitlines()[0] if b"}\n{" in data else data)
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        members = node.items() if isinstance(node, dict) else enumerate(node)
        for key, inner in members:
            places.append((node, key))
            if isinstance(inner, dict | list):
                visit(inner)

    visit(content)
    node, key = places[int(share * len(places))]
    node[key] = value
    return json.dumps(content).replace('"@"', "1e400").encode()


def read_scene(path: Path) -> None:
    reader.read_scene(path.parent, "FloorPlan1", 0)


def read_pickle(path: Path) -> None:
    extras.read_episodes(path, {"FloorPlan21": extras.ImportedRoom(GRID, {"Mug"}, "kitchen")})


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
ROOMS = handmade.lopsided()


def read_config(path: Path) -> None:
    configs.load(path)


def read_classes(path: Path) -> None:
    load_vocabulary(path.parent).normalised_adjacency()


def read_metrics(path: Path) -> None:
    journal.read_metrics(path.parent)


def read_results(path: Path) -> None:
    comparison.summary([results_file.read(path)])


def read_processes(path: Path) -> None:
    run_file.read(path.parent)


def read_record(path: Path) -> None:
    episode_lookup.read_record(path.parent, 0, ROOMS)


def read_checkpoint(path: Path) -> None:
    run = next(folder.parent for folder in path.parents if folder.name == "checkpoints")
    Checkpoints(run).snapshot()


def seeds(root: Path) -> list[tuple[Path, Callable[[Path], object]]]:
    """Good files of every kind, and what reads each."""
    scenes = original.write_all(root)
    with original.fake_torch():
        tensors = [original.Tensor(np.arange(9), 1, (2, 3), (1, 2)), np.eye(3)]
        (root / "tensors.pkl").write_bytes(pickle.dumps(tensors, 3))
    (root / "glove.txt").write_text("mug 1 2 3\nbread 0.5 -1e-3 2\n")
    dataset.save_rooms(importer.read_folder(scenes, lambda share, line: None), root / "rooms.npz")
    room = scenes / "FloorPlan1"
    names = ("grid.json", "graph.json", "visible_object_map.json", "objects_bb.json")
    (root / "scenes.json").write_text(json.dumps(SCENE))
    return [
        *((room / name, read_scene) for name in names),
        (root / "data" / "c2p_prob.json", extras.read_parents),
        (root / "test_val_split" / "kitchen_test.pkl", read_pickle),
        (root / "data" / "gcn" / "adjmat.dat", read_matrix),
        (root / "tensors.pkl", read_tensor),
        (root / "rooms.npz", dataset.load_rooms),
        (root / "glove.txt", words.read_words),
        (root / "scenes.json", metadata.read_scenes),
        *run_files(root / "run"),
        *feature_files(root),
    ]


def run_files(run: Path) -> list[tuple[Path, Callable[[Path], object]]]:
    """The files of a run's folder, and what reads each."""
    run.mkdir()
    for name in ("config.json", "classes.json", "metrics.jsonl"):
        shutil.copyfile(OLD_RUN / name, run / name)
    record = {"scene": "Room0", "target": "Mug", "x": 0, "z": 0, "rotation": 0, "horizon": 0,
              "L": 1, "actions": ["Done"]}  # fmt: skip
    (run / "episodes.jsonl").write_text(json.dumps(record) + "\n")
    shutil.copyfile(BUNDLED / "results.json", run / "results.json")
    run_file.write(run, [run_file.Process(command="tdanet train", machine="EPYC")])
    where = {"updates": 7, "episodes": 5, "seconds": 0.5, "point": 1, "data_version": "x"}
    network = {"a": {"b": np.ones(3, np.float32)}, "c": np.eye(4, dtype=np.float32)}
    point = history.write(run, history.Snapshot(network, **where))
    saved = run / "checkpoints" / "6"  # without checksums, which whoever sends it can write anew
    saved.mkdir(parents=True)
    arrays = {"params/a/b": network["a"]["b"], "params/c": network["c"], "key": np.uint32([1, 2])}
    np.savez(saved / ARRAYS, updates=np.int32(6), episodes=np.int32(5), **arrays)
    meta = {"seconds": 0.5, "data_version": "x", "variants": None, "format": FORMAT}
    (saved / META).write_text(json.dumps(meta))
    return [
        (run / "config.json", read_config),
        (run / "classes.json", read_classes),
        (run / "metrics.jsonl", read_metrics),
        (run / "results.json", read_results),
        (run / "run.json", read_processes),
        (run / "episodes.jsonl", read_record),
        (point, history.read),
        (saved / META, read_checkpoint),
        (saved / ARRAYS, read_checkpoint),
    ]


def feature_files(root: Path) -> list[tuple[Path, Callable[[Path], object]]]:
    with contextlib.suppress(ImportError):
        import h5py

        with h5py.File(root / "features.hdf5", "w") as file:
            file.create_dataset("a", data=np.arange(40.0), compression="gzip")
            file["b"] = np.arange(6, dtype=np.int32)
        return [(root / "features.hdf5", read_features)]
    return []


class Seeds(list):
    """Whose names alone are printed with a failure."""

    def __repr__(self) -> str:
        return str([path.name for path, *_ in self])


@pytest.fixture(scope="module")
def good(tmp_path_factory: pytest.TempPathFactory) -> Seeds:
    root = tmp_path_factory.mktemp("fuzz")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TDANET_CACHE", str(root / "cache"))
        return Seeds((path, path.read_bytes(), read) for path, read in seeds(root))


def check(path: Path, data: bytes, content: bytes, read: Callable[[Path], object]) -> None:
    """Reads other content in place of a good file: in bounded time and memory, or in one line."""
    path.write_bytes(content)
    refusal = ""
    tracemalloc.start()
    before = time.process_time()
    try:
        read(path)
    except ValueError as error:
        refusal = str(error)
    finally:
        path.write_bytes(data)
        peak, seconds = tracemalloc.get_traced_memory()[1], time.process_time() - before
        tracemalloc.stop()
    assert refusal.isprintable()
    assert not refusal or str(path.parent) in refusal or "checkpoints/6" in refusal
    assert peak < MOST_MEMORY
    assert seconds < MOST_SECONDS


@given(st.integers(0, 19), edits)
@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
def test_a_few_mutations(good: Seeds, which: int, changes: list[tuple[str, float, bytes]]) -> None:
    path, data, read = good[which % len(good)]
    check(path, data, mutate(data, changes), read)


@given(st.integers(0, 19), st.floats(0, 1, exclude_max=True), st.sampled_from(ODD))
@settings(max_examples=150, suppress_health_check=[HealthCheck.too_slow])
def test_a_few_odd_values(good: Seeds, which: int, share: float, value: object) -> None:
    texts = [item for item in good if item[0].suffix in (".json", ".jsonl")]
    path, data, read = texts[which % len(texts)]
    check(path, data, with_odd(data, share, value), read)


@pytest.mark.slow
@pytest.mark.parametrize("which", range(20))
def test_many_mutations(good: Seeds, which: int) -> None:
    """10,000 of each kind."""
    path, data, read = good[which % len(good)]

    @given(edits, st.floats(0, 1, exclude_max=True), st.none() | st.sampled_from(ODD))
    @settings(max_examples=10_000, suppress_health_check=[HealthCheck.too_slow])
    def mutated(changes: list[tuple[str, float, bytes]], share: float, value: object) -> None:
        odd = value is not None and path.suffix in (".json", ".jsonl")
        check(path, data, with_odd(data, share, value) if odd else mutate(data, changes), read)

    mutated()


@pytest.mark.slow
def test_mutations_of_checkpoints_that_orbax_wrote(tmp_path: Path) -> None:
    """500 in all: some crash the process that reads them, and none the one that asks for them."""
    run = shutil.copytree(OLD_RUN, tmp_path / "run")
    saved = run / "checkpoints" / "6"
    (saved / "SHA256SUMS").unlink()
    state = saved / "state"
    arrays = sorted(p for folder in state.rglob("d") for p in folder.iterdir())
    paths = [saved / "meta" / "metadata", state / "_METADATA", state / "manifest.ocdbt", *arrays]

    @given(st.sampled_from([*paths, *3 * arrays]), edits)
    @settings(max_examples=500, suppress_health_check=[HealthCheck.too_slow])
    def mutated(path: Path, changes: list[tuple[str, float, bytes]]) -> None:
        data = path.read_bytes()
        check(path, data, mutate(data, changes), read_checkpoint)

    mutated()
