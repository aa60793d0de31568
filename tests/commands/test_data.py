"""Rooms and word vectors from files, through the commands that a user types."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tdanet_jax
from tdanet_jax.agent.detection import Detection
from tdanet_jax.commands import evaluate, scenes, train_zero_shot
from tdanet_jax.io import files
from tdanet_jax.scenes import SceneTables, dataset, tabulation
from tdanet_jax.scenes.offline import features, importer
from tests.conftest import SOME_ROOMS
from tests.support import original, toy
from tests.support.command import TINY


@pytest.fixture(autouse=True)
def parts_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Imports cache scenes in a separate folder; the bundled tables stay where they are."""
    monkeypatch.setattr(importer, "_cache_folder", lambda root: tmp_path / "parts")


def fails(command, arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as stop:
        command.main(arguments)
    assert stop.value.code == 2
    message = capsys.readouterr().err
    assert message.startswith("error: ")
    assert message.count("\n") == 1
    return message


@pytest.mark.parametrize(
    "trained", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["evaluated", "trained"]
)
def test_the_miniature_trains_and_evaluates(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    trained: bool,
) -> None:
    """Old-style links, names of AI2-THOR 1.0, published parents, graph and episodes."""
    monkeypatch.chdir(tmp_path)
    source = original.write_all(tmp_path / "original")
    scenes.main(["import", "--from", str(source), "--out", "rooms.npz"])
    said = capsys.readouterr().out
    assert "FloorPlan21: 3 points, visible_object_map.json (3 objects)" in said
    assert "c2p_prob.json: parents of 1 targets" in said
    assert "left out: Sink, Toaster" in said
    vectors = np.random.default_rng(0).normal(size=(3, 7)).round(3)
    names = ["apple", "tabletop", "table"]
    lines = [" ".join(map(str, [name, *row])) for name, row in zip(names, vectors, strict=True)]
    Path("glove.txt").write_text("\n".join(lines))
    rooms = ["--data", "rooms.npz", "--word-vectors", "glove.txt"]
    run = ["--steps", "800", *TINY, "--out", "run"]
    message = fails(train_zero_shot, [*rooms, *run], capsys)
    assert "no word vectors for the targets Mug (mug): give a file with --word-vectors" in message
    assert not Path("run").exists()
    shortest = ["--policy", "shortest_path", *rooms, "--out", "shortest"]
    assert "no word vectors for the targets Mug (mug)" in fails(evaluate, shortest, capsys)

    with Path("glove.txt").open("a") as file:
        file.write("\nmug 1 0 0 0 0 0 0\ntop 0 1 0 0 0 0 0\n")
    evaluate.main(shortest)
    assert json.loads(Path("shortest/results.json").read_text())["seen"]["L>=1"]["SR"] == 100
    if not trained:
        return
    train_zero_shot.main([*rooms, *run])
    results = json.loads(Path("run/results.json").read_text())
    assert results["data_version"] == dataset.load_rooms(Path("rooms.npz")).tables.data_version
    assert results["seen"]["L>=1"]["n"] == 2, "the published episodes"
    assert results["unseen"] is None
    assert str(tmp_path / "rooms.npz") in Path("run/results.md").read_text()

    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")  # files are found from any folder
    evaluate.main(["--checkpoint", "../run", "--out", "again"])
    assert json.loads(Path("again/results.json").read_text())["seen"] == results["seen"]
    agent = tdanet_jax.load("../run")
    seen = [Detection("table top", 0, 0, 1, 1)]
    _, decision = agent.act(agent.start(), seen, target="mug")
    assert decision.probabilities.shape == (6,)


def test_rooms_of_any_name_and_frame(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every line is printed, brackets in names included, and the flags are obeyed."""
    monkeypatch.chdir(tmp_path)
    for name in ("FloorPlan_Train1_1", "Lab [bold]", "FloorPlan21-1"):
        original.write_room(tmp_path / "rooms" / name)
    Path("rooms.csv").write_text("name,room_type,part\nLab [bold],bedroom,test\n")
    given = ["--from", "rooms", "--rooms", "rooms.csv", "--frame-size", "600x400"]
    scenes.main(["import", *given, "--out", "some.npz"])
    said = capsys.readouterr()
    assert "FloorPlan_Train1_1: left out, --room-type or --rooms must say its type" in said.out
    assert "Lab [bold]: 3 points" in said.out
    assert "FloorPlan21-1: 3 points" in said.out
    assert "import with --frame-size WIDTHxHEIGHT" in said.err
    scenes.main(["import", *given, "--room-type", "kitchen", "--part", "train", "--out", "all.npz"])
    rooms = dataset.load_rooms("all.npz")
    assert rooms.tables.scenes == ("FloorPlan21-1", "FloorPlan_Train1_1", "Lab [bold]")
    assert rooms.tables.room_type.tolist() == [0, 0, 2]
    assert rooms.extras is not None
    assert rooms.extras.parts == {
        "FloorPlan21-1": "test", "FloorPlan_Train1_1": "train", "Lab [bold]": "test"
    }  # fmt: skip
    assert rooms.tables.row_box[:, 2].max() == 200 * 16 / 2
    assert rooms.tables.row_box[:, 3].max() == 300 * 16 * 3 / 4
    escaped = dataclasses.replace(rooms.tables, scenes=("FloorPlan21-1", "../../a", "Lab"))
    dataset.save_rooms(dataset.Rooms(escaped, None), Path("escaped.npz"))
    before = sorted(tmp_path.rglob("*"))
    arguments = ["export", "--data", "escaped.npz", "--out", "out"]
    assert "room name '../../a': is a path" in fails(scenes, arguments, capsys)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("part", ["train", "test"])
def test_exported_rooms_have_the_parents_of_those_that_train(
    part: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever their names; without training rooms, there are no parents and no file of them."""
    monkeypatch.chdir(tmp_path)
    mug, sink = (toy.thing(name, (0.0, toy.CAMERA, 1.2)) for name in ("Mug", "Sink"))
    tables = tabulation.build([toy.room(toy.line(2), mug, sink, name="Lab")])
    dataset.save_rooms(
        dataset.Rooms(tables, dataset.Extras(parts={"Lab": part})), Path("rooms.npz")
    )
    scenes.main(["export", "--data", "rooms.npz", "--out", "out"])
    file = Path("out/c2p_prob.json")
    if part == "test":
        assert not file.exists()
    else:
        assert json.loads(file.read_text()) == {"Kitchen": {"Mug": {"Sink": 0.5}}}


def write_features(place: Path) -> None:
    """Feature maps of a scene of the miniature, all ones."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(place / "resnet18_featuremap.hdf5", "w") as file:
        for key in original.KEYS:
            file.create_dataset(key, data=np.ones((512, 7, 7), np.float32), compression="gzip")


def test_an_interrupted_import_continues_where_it_stopped(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever stops it: a scene is read once until all is written, and is then forgotten."""
    monkeypatch.chdir(tmp_path)
    source = original.write_all(tmp_path / "original")
    command = ["import", "--from", "original/data", "--features", "--out", "rooms.npz"]
    read: list[str] = []
    plain = importer.read_scene
    monkeypatch.setattr(
        importer, "read_scene", lambda *given: (read.append(given[1]), plain(*given))[1]
    )
    write_features(source / "FloorPlan1")
    message = fails(scenes, command, capsys)  # before anything is read
    assert "FloorPlan21_physics/resnet18_featuremap.hdf5: no such file" in message
    assert read == []
    write_features(source / "FloorPlan21_physics")
    for where, what in ((features, "write_features"), (dataset, "save_rooms")):

        def stop(*_: Any) -> None:
            os.kill(os.getpid(), signal.SIGINT)

        with monkeypatch.context() as patch:
            patch.setattr(where, what, stop)
            with pytest.raises(SystemExit):
                scenes.main(command)
        assert not list(tmp_path.glob("*rooms*"))
        assert len(list((tmp_path / "parts").iterdir())) == 2
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    left = f"{files.PARTIAL}{killed.pid}-x"
    Path(left).mkdir()
    Path(left, "rooms.features.npy").write_bytes(b"half")
    capsys.readouterr()
    scenes.main(command)
    assert f"removed {left}: half-written" in capsys.readouterr().out
    assert read == ["FloorPlan1", "FloorPlan21"]
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "original", "rooms.features.npy", "rooms.npz"
    ]  # fmt: skip
    rooms = dataset.load_rooms(tmp_path / "rooms.npz")
    assert (features.load_features(tmp_path / "rooms.npz", rooms.tables) == 1).all()


def test_an_import_of_feature_maps_asks_for_h5py_first(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    source = original.write_all(tmp_path / "original")
    write_features(source / "FloorPlan1")
    monkeypatch.setitem(sys.modules, "h5py", None)  # as if it were not installed
    given = ["--from", str(source), "--features", "--out", str(tmp_path / "rooms.npz")]
    assert "needs h5py: pip install h5py\n" in fails(scenes, ["import", *given], capsys)
    assert not (tmp_path / "parts").exists()


@pytest.mark.slow
def test_eight_exported_rooms_train_and_evaluate(
    ithor: SceneTables, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    scenes.main(["export", "--out", "out", "--scenes", *SOME_ROOMS])
    scenes.main(["import", "--from", "out", "--out", "rooms.npz"])
    data = ["--data", "rooms.npz"]
    train_zero_shot.main([*data, "--steps", "4000", *TINY, "--out", "run"])
    evaluate.main(["--checkpoint", "run", "--policy", "greedy", "--out", "greedy"])
    evaluate.main(["--policy", "shortest_path", *data, "--out", "shortest"])
    results = json.loads(Path("shortest/results.json").read_text())
    assert results["seen"]["L>=1"]["SR"] == results["unseen"]["L>=1"]["SPL"] == 100
    assert results["seen"]["L>=1"]["n"] >= 500
    # A run goes to other rooms, too: the bundled ones, as a file.
    ithor.save(Path("bundled.npz"))
    evaluate.main(["--checkpoint", "run", "--data", "bundled.npz", "--out", "bundled"])
    results = json.loads(Path("bundled/results.json").read_text())
    assert results["seen"]["L>=1"]["n"] == 1000


def test_wrong_arguments_give_one_line_and_write_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    source = original.write_all(tmp_path / "original")
    (tmp_path / "taken").mkdir()
    (source / "FloorPlan21_physics" / "graph.json").write_text('{"nodes": [], "links": [{}]}')
    (tmp_path / "own.json").write_text("{}")
    (tmp_path / "old.features.npy").write_bytes(b"of earlier rooms")
    before = sorted(tmp_path.rglob("*"))
    for command, arguments, reason in (
        (scenes, ["import"], "a scene file, or --from a folder"),
        (scenes, ["import", "own.json", "--from", "original"], "not both"),
        (scenes, ["import", "own.json", "--features"], "--features: needs --from"),
        (scenes, ["import", "own.json", "--frame-size", "3x3"], "--frame-size: needs --from"),
        (scenes, ["import", "own.json", "--rooms", "rooms.csv"], "rooms.csv: No such file"),
        (scenes, ["import", "--from", "original", "--room-type", "Kitchen"], "did you mean"),
        (scenes, ["import", "--from", "original", "--frame-size", "300"],
         "--frame-size 300: not WIDTHxHEIGHT in pixels, such as 300x300"),
        (scenes, ["import", "--from", "original", "--rooms", "a.csv"], "a.csv: No such file"),
        (scenes, ["import", "--from", "nowhere"], "nowhere: no folder"),
        (scenes, ["import", "--from", "original", "--out", "taken"], "--out taken: exists"),
        (scenes, ["import", "--from", "original", "--out", "no/a.npz"], "no such folder"),
        (scenes, ["import", "own.json", "--out", "old.npz"],
         "--out old.npz: there are feature maps of earlier rooms, old.features.npy; remove them"),
        (scenes, ["export", "--out", "taken"], "--out taken: exists"),
        (scenes, ["export", "--out", "a", "--scenes", "FloorPlan0"], "FloorPlan0: no such scene"),
        (scenes, ["export", "--out", "a", "--data", "own.json"], "own.json: a scene file"),
        (scenes, ["inspect", "FloorPlan1", "--data", "b.npz"], "b.npz: no such file"),
        (evaluate, ["--policy", "random", "--data", "b.npz"], "b.npz: no such file"),
        (train_zero_shot, ["--data", "own.json"], "own.json: a scene file"),
        (train_zero_shot, ["--word-vectors", "b.txt"], "b.txt: no such file"),
        (scenes, ["import", "--from", "original", "--out", "a.npz"],
         "graph.json: a link's source None is not among the nodes"),
    ):  # fmt: skip
        assert reason in fails(command, arguments, capsys)
        found = [p for p in tmp_path.rglob("*") if "parts" not in str(p)]
        assert sorted(found) == before
