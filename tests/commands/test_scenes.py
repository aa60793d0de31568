"""The command: what it writes, and one clear line on an error."""

from __future__ import annotations

import copy
import dataclasses
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest

from tdanet_jax import __main__ as tdanet
from tdanet_jax.commands import scenes
from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneTables, dataset, records
from tdanet_jax.scenes import ithor as bundled
from tdanet_jax.scenes.dataset import Extras, Rooms
from tests.commands.test_data import fails
from tests.scenes.test_metadata import DOCUMENT
from tests.support.command import TINY
from tests.support.pages import block


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "lab.json"
    path.write_text(json.dumps(DOCUMENT))
    return path


both = pytest.mark.parametrize(
    "trained", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["evaluated", "trained"]
)


def run_commands(commands: str, trained: bool, *flags: str) -> None:
    """Runs a block's commands; the last, which trains, shortly and with `flags`, or not at all."""
    *lines, train = commands.splitlines()
    if trained:
        lines.append(shlex.join([*shlex.split(train), "--steps", "80", *flags, *TINY]))
    for line in lines:
        program, *given = shlex.split(line)
        assert program == "tdanet"
        tdanet.main(given)


@both
def test_own_rooms_as_the_page_shows_them(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    trained: bool,
) -> None:
    """From the scene file to results. What refuses rooms does so before it trains or plays."""
    monkeypatch.chdir(tmp_path)
    Path("my_rooms.json").write_text(block("scenes.md", "my_rooms.json"))
    run_commands(block("scenes.md", "my_rooms commands"), trained)
    said = capsys.readouterr()
    assert said.err == ""
    assert "Rooms to train in: 1; to be evaluated in: 1" in said.out
    written = sorted(path.name for path in Path("runs").iterdir())
    assert written == ["in-my-rooms", "random-in-my-rooms"][not trained :]
    for folder in written:
        results = json.loads(Path("runs", folder, "results.json").read_text())
        assert results["seen"]["L>=1"]["n"] == 250
        assert list(results["by_room"]) == ["kitchen"]
        assert results["unseen"] is None
        rows = Path("runs", folder, "episodes.jsonl").read_text().splitlines()
        assert {json.loads(row)["scene"] for row in rows} == {"Office"}


@both
def test_offices_on_another_grid_as_the_page_shows_them(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    trained: bool,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("offices.json").write_text(block("scenes.md", "offices.json"))
    run_commands(block("scenes.md", "offices commands"), trained, "--odometry")
    said = capsys.readouterr()
    assert said.err == ""
    assert "Targets in rooms of type office: Laptop\n" in said.out
    written = sorted(Path("runs").iterdir())
    assert len(written) == 1 + trained
    for folder in written:
        results = json.loads((folder / "results.json").read_text())
        assert list(results["by_room"]) == ["office"]
        assert list(results["by_target"]) == ["Laptop"]
        rows = [json.loads(row) for row in (folder / "episodes.jsonl").read_text().splitlines()]
        assert {row["rotation"] for row in rows} == {0, 90, 180, 270}
        assert {row["horizon"] for row in rows} == {0}
        assert {row["scene"] for row in rows} == {"Office-2"}
        assert max(row["e"] for row in rows) <= 200
    export = ["export", "--data", "offices.npz", "--out", "original"]
    assert "rooms of type office: the original layout has" in fails(scenes, export, capsys)
    assert not Path("original").exists()
    rooms = dataset.load_rooms("offices.npz")
    assert rooms.tables.grid == PoseGrid(0.5, 4, (0,))
    assert len(rooms.tables.position) * 4 == rooms.tables.num_states


@both
def test_houses_as_the_page_shows_them(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    trained: bool,
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("houses.json").write_text(block("scenes.md", "houses.json"))
    imports, inspects, evaluates, trains = block("scenes.md", "houses commands").splitlines()
    lines = [imports, inspects, *[evaluates] * trained, trains]
    run_commands("\n".join(lines), trained)
    said = capsys.readouterr()
    assert said.err == ""
    assert "Of these, houses with rooms of several types: 2; positions: kitchen 3, bedroom 3" in (
        said.out
    )
    tables = dataset.load_rooms("houses.npz").tables
    assert tables.position_room_type.tolist() == [0, 0, 2, 2, 2, 0]
    assert tables.reachable.all()
    for folder in Path("runs").iterdir() if trained else ():
        rows = [json.loads(row) for row in (folder / "episodes.jsonl").read_text().splitlines()]
        pairs = {(row["scene"], row["room"], row["target"], row["z"]) for row in rows}
        assert pairs == {
            ("House-2", "kitchen", "Mug", 0.5),
            ("House-2", "bedroom", "Pillow", 0.25),
        }
        results = json.loads((folder / "results.json").read_text())
        assert list(results["by_room"]) == ["kitchen", "bedroom"]


LABELS = "name,room_type,part\nFloorPlan1-1,kitchen,train\nFloorPlan_Train1_1,hall,\n"


def test_types_and_parts_from_flags_and_a_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The file says most, then the table, names that begin with iTHOR's, the flags."""
    monkeypatch.chdir(tmp_path)
    bare = {key: value for key, value in DOCUMENT.items() if key != "room_type"}
    names = ("FloorPlan1-1", "FloorPlan_Train1_1", "Attic", "FloorPlan401", "FloorPlan430-5")
    documents = [{**bare, "name": name} for name in names]
    documents.append({**DOCUMENT, "name": "Lab", "split": "test"})
    Path("rooms.json").write_text(json.dumps(documents))
    Path("rooms.csv").write_text(LABELS)
    flags = "--rooms rooms.csv --room-type den --part test --out rooms.npz"
    scenes.main(["import", "rooms.json", *flags.split()])
    rooms = dataset.load_rooms("rooms.npz")
    tables = rooms.tables
    assert tables.room_types[4:] == ("den", "hall")
    assert [tables.room_types[kind] for kind in tables.room_type] == [
        "kitchen", "hall", "den", "bathroom", "bathroom", "bedroom"
    ]  # fmt: skip
    assert rooms.extras is not None
    assert rooms.extras.parts == {
        "FloorPlan1-1": "train", "FloorPlan_Train1_1": "test", "Attic": "test",
        "FloorPlan430-5": "test", "Lab": "test",
    }  # fmt: skip


@pytest.mark.parametrize(
    ("table", "flags", "message"),
    [
        (None, "", "rooms.json: Lab: no room type; give it in the file"),
        (None, "--rooms none.csv", "none.csv: No such file or directory"),
        (None, "--room-type a/b", "room_type 'a/b': is a path"),
        (None, "--room-type Kitchen", "room_type 'Kitchen': did you mean kitchen?"),
        ("", "", "rooms.csv: line 1: the columns are not name, room_type, part"),
        ("room_type,part\n", "", "rooms.csv: line 1: the columns are not name, room_type, part"),
        ("name,room_type,part\nDen,office,\n", "", "no room is called Den, which --rooms lists"),
        ("name,room_type,part\nLab,office\n", "", "rooms.csv: line 2: 2 columns, not 3"),
        (
            "name,room_type,part\nLab,office,half\n",
            "",
            "rooms.csv: line 2: part 'half', not train",
        ),
        ("name,room_type,part\n,office,test\n", "", "rooms.csv: line 2: room name '': empty"),
        ("name,room_type,part\n" + 2 * "Lab,den,\n", "", "rooms.csv: line 3: Lab is listed twice"),
        ("name,room_type,part\nLab,,test\n", "", "rooms.json: Lab: no room type"),
    ],
)
def test_labels_that_do_not_do(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    table: str | None,
    flags: str,
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    bare = {key: value for key, value in DOCUMENT.items() if key != "room_type"}
    Path("rooms.json").write_text(json.dumps(bare))
    if table is not None:
        Path("rooms.csv").write_text(table)
        flags += " --rooms rooms.csv"
    said = fails(scenes, ["import", "rooms.json", "--out", "rooms.npz", *flags.split()], capsys)
    assert message in said
    assert not Path("rooms.npz").exists()


def test_unused_rooms_and_missing_word_vectors_are_reported(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    named = {**DOCUMENT, "name": "FloorPlan5"}
    named["objects"] = [
        {**DOCUMENT["objects"][0], "objectId": name, "objectType": name}
        for name in ("MugXqzzy", "Pillow")
    ]
    scene_file.write_text(json.dumps([DOCUMENT, named]))
    scenes.main(["import", str(scene_file), "--out", str(scene_file.with_name("lab.npz"))])
    said = capsys.readouterr()
    assert said.err.startswith("warning: no split uses Lab; a run needs a room to train in")
    assert len(said.err.splitlines()) == 1
    assert "Rooms to train in: 1; to be evaluated in: 0" in said.out
    assert "No bundled word vectors for MugXqzzy (xqzzy): without --word-vectors" in said.out


@pytest.mark.parametrize(
    ("change", "useless"),
    [
        ({"objectType": "Stool"}, "train in or to be evaluated in"),
        ({"objectType": "Toaster"}, "train in or to be evaluated in"),  # not in a bedroom
        ({"objectType": "Pillow"}, ""),
        ({"objectType": "Pillow", "far": 9.0}, "be evaluated in"),
    ],
)
def test_rooms_without_targets_are_reported(
    scene_file: Path, capsys: pytest.CaptureFixture[str], change: dict[str, Any], useless: str
) -> None:
    """Training would fail in them."""
    thing = {**DOCUMENT["objects"][0], "objectType": change["objectType"]}
    far = copy.deepcopy(thing)
    far["axisAlignedBoundingBox"]["center"]["z"] += change.get("far", 0.0)
    rooms = [
        {**DOCUMENT, "split": "train", "objects": [thing]},
        {**DOCUMENT, "name": "Attic", "split": "test", "objects": [far]},
    ]
    scene_file.write_text(json.dumps(rooms))
    scenes.main(["import", str(scene_file), "--out", str(scene_file.with_name("lab.npz"))])
    said = capsys.readouterr().err.splitlines()
    if useless:
        assert said == [
            f"warning: no room to {useless} holds a target that can be found there, and a run "
            "needs one: in a bedroom, Blinds, DeskLamp, Pillow, AlarmClock, CD"
        ]
    else:
        assert said == []


def test_more_classes_than_can_be_numbered(
    scene_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    things = [
        {**DOCUMENT["objects"][0], "objectId": f"{i}", "objectType": f"Thing{i}"}
        for i in range(128)
    ]
    scene_file.write_text(json.dumps({**DOCUMENT, "objects": things}))
    out = scene_file.with_name("lab.npz")
    message = fails(scenes, ["import", str(scene_file), "--out", str(out)], capsys)
    assert "lab.json: 128 classes, more than 127" in message
    assert not out.exists()


def test_import(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = scene_file.with_name("lab.npz")
    scenes.main(["import", str(scene_file), "--out", str(out)])
    tables = SceneTables.load(out)
    assert tables.scenes == ("Lab",)
    assert tables.classes == ("Desk", "Mug")
    assert tables.data_version in capsys.readouterr().out
    assert sorted(p.name for p in out.parent.iterdir()) == ["lab.json", "lab.npz"]


def test_export_says_what_it_leaves_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    given = ["--scenes", "FloorPlan204", "FloorPlan428"]
    scenes.main(["export", "--out", str(tmp_path / "out"), *given])
    assert (
        "Left out 272 states that are not connected to the largest part of their room: "
        "FloorPlan204 (272). Of "
    ) in (said := capsys.readouterr().out)
    assert re.search(r"Of \d+ test episodes in the exported rooms, \d+ start there", said)
    scenes.main(["export", "--out", str(tmp_path / "whole"), "--scenes", "FloorPlan428"])
    assert "Left out" not in capsys.readouterr().out


def test_generated_rooms_are_written_and_drawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    scenes.main(
        ["generate", "--rooms", "2", "--seed", "3", "--validation", "--out", "generated.npz"]
    )
    said = capsys.readouterr().out
    assert "2 rooms, " in said
    assert "Targets visible from nowhere in a room that holds them: 0" in said
    assert "Made by command generate, rooms 2, seed 3, known 64 rooms, source " in said
    scenes.main(["inspect", "living_room-0001", "--data", "generated.npz", "--out", "room.png"])
    assert Path("room.png").stat().st_size > 10_000


@pytest.mark.slow
def test_variants_are_written_compared_and_drawn(
    ithor: SceneTables,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def run(command: str) -> None:
        scenes.main(command.split())

    monkeypatch.chdir(tmp_path)
    names = ("FloorPlan416", "FloorPlan430")  # for training and for tests
    known = [room for room in bundled.load_scenes() if room.name in names]
    given = Rooms(ithor.subset(names), Extras(), records=records.of_scenes(known))
    dataset.save_rooms(given, Path("rooms.npz"))
    run("vary --copies 2 --seed 7 --data rooms.npz --out variants.npz")
    said = capsys.readouterr().out
    assert "2 rooms, " in said
    assert "Made by command vary, copies 2, seed 7, source " in said
    rooms = dataset.load_rooms("variants.npz")
    assert rooms.tables.scenes == ("FloorPlan416-v01", "FloorPlan416-v02")
    run("vary --copies 1 --part all --data rooms.npz --out all.npz")
    assert dataset.load_rooms("all.npz").tables.scenes == ("FloorPlan416-v01", "FloorPlan430-v01")
    capsys.readouterr()
    run("compare variants.npz --data rooms.npz")
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Made by command vary")
    rows = {line[:46].strip(): line[46:].split() for line in lines[1:]}
    assert rows["rooms"] == ["1", "2"]  # with the room that they are from
    counts = [len(known[0].points), len(rooms.tables.position) / 2]
    assert rows["reachable points in a room"] == [f"{count:.1f}" for count in counts]
    assert float(rows["random agent, SR"][0]) > 0
    run("inspect FloorPlan416-v02 --data variants.npz --out room.png")
    run("inspect FloorPlan416 --variants 1 --data rooms.npz --out plans.png")
    for picture in ("room.png", "plans.png"):
        assert Path(picture).stat().st_size > 10_000
    test_room = Rooms(ithor.subset(names[1:]), Extras(), records=records.of_scenes(known[1:]))
    dataset.save_rooms(test_room, Path("test.npz"))
    none = fails(scenes, shlex.split("vary --data test.npz --out new.npz"), capsys)
    assert "test.npz: has no training rooms" in none
    dataset.save_rooms(dataclasses.replace(given, records=None), Path("tables.npz"))
    unknown = fails(scenes, shlex.split("vary --data tables.npz --out new.npz"), capsys)
    assert "these rooms do not say what lies on what: import them from a scene file" in unknown
    assert not Path("new.npz").exists()


def test_inspect_own_and_bundled_rooms(scene_file: Path) -> None:
    out = scene_file.with_name("lab.png")
    scenes.main(["inspect", "Lab", "--scenes", str(scene_file), "--out", str(out)])
    assert out.stat().st_size > 10_000
    pose = ["--position", "-3", "2", "--rotation", "90", "--horizon", "30", "--out", str(out)]
    scenes.main(["inspect", "FloorPlan430", *pose])


def test_bad_input(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    here = scene_file.parent
    assert "FloorPlan0" in fails(scenes, ["inspect", "FloorPlan0"], capsys)
    pose = ["--position", "0", "0", "--rotation", "50", "--out", str(here / "a.png")]
    assert "50" in fails(scenes, ["inspect", "FloorPlan1", *pose], capsys)
    assert "nope.json" in fails(scenes, ["import", str(here / "nope.json"), "--out", "x"], capsys)
    assert "lab.json" in fails(
        scenes, ["import", str(scene_file), "--out", str(scene_file)], capsys
    )
    (here / "bad.json").write_text(json.dumps({**DOCUMENT, "objects": []}))
    out = here / "bad.npz"
    assert "Lab: no objects" in fails(
        scenes, ["import", str(here / "bad.json"), "--out", str(out)], capsys
    )
    assert "FloorPlan1=" in fails(scenes, ["collect", "FloorPlan1="], capsys)
    assert sorted(p.name for p in here.iterdir()) == ["bad.json", "lab.json"]


@pytest.mark.slow
def test_verify(capsys: pytest.CaptureFixture[str]) -> None:
    scenes.main(["verify", "--rooms", "2", "--views", "1", "--worst", "3"])
    lines = capsys.readouterr().out.splitlines()
    [everything] = [line for line in lines if line.startswith("all classes")]
    assert everything.split()[2:5] == ["357", "17", "20"]
    [stood] = [line for line in lines if line.startswith("  on any point")]
    assert stood.split()[-2:] == ["0", "503"]
    assert any(line.startswith("Boxes against") for line in lines)
    assert any("AlarmClock" in line and "FloorPlan329" in line for line in lines)
