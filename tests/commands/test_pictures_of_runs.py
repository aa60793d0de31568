"""The commands that show what an agent does: replay, trajectories, attention."""

from __future__ import annotations

import csv
import dataclasses
import json
import re
import shutil
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from tdanet_jax import config as configs
from tdanet_jax.commands import attention, demo, evaluate, failures, replay, trajectories
from tdanet_jax.commands.one_episode import Choice
from tdanet_jax.config import CONFIG_FILE
from tdanet_jax.evaluation import episodes
from tdanet_jax.scenes import dataset
from tdanet_jax.scenes.offline import importer
from tdanet_jax.training import devices, history
from tdanet_jax.training.checkpoint import newest
from tests.conftest import TINY, save_untrained
from tests.support import browser, original


@pytest.mark.parametrize("command", [replay, trajectories, attention, evaluate])
def test_what_is_compiled_is_kept_for_the_next_start(monkeypatch, capsys, opinionated_run, command):
    """From the first program on: JAX decides whether to keep any when it compiles that one."""

    def keep():
        raise ValueError("compiled programs are kept")

    monkeypatch.setattr(devices, "keep_compiled", keep)
    chosen = [] if command is evaluate else ["--scene", "FloorPlan229", "--target", "Painting"]
    with pytest.raises(SystemExit):
        command.main(["--checkpoint", str(opinionated_run), *chosen, "--data", "nowhere.npz"])
    assert "compiled programs are kept" in capsys.readouterr().err


@pytest.mark.parametrize("command", [replay, trajectories, attention])
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("", "checkpoint"),
        ("--checkpoint nowhere --episode 0", "nowhere/config.json: no such file"),
        ("--checkpoint RUN --scene FloorPlan229", "give --scene and --target, or --episode"),
        ("--checkpoint RUN --start 0 0 0", "give --scene and --target, or --episode"),
        ("--checkpoint RUN --episode 0 --scene FloorPlan229", "--episode takes no --scene"),
        ("--checkpoint RUN --episode 8", "no episode 8; there are 0 to 7"),
        ("--checkpoint RUN --scene Attic --target Mug", "Attic: no such room; there are FloorPlan"),
        ("--checkpoint RUN --scene FloorPlan229 --target Mug", "there: ArmChair, "),
        (
            "--checkpoint RUN --scene FloorPlan229 --target Painting --start 0 0 30",
            "rotation 30: not a multiple of 45",
        ),
        (
            "--checkpoint RUN --scene FloorPlan229 --target Painting --start 100 100 0",
            "start at x 100, z 100: ",
        ),
    ],
)
def test_wrong_arguments_give_one_line_and_write_nothing(
    tmp_path, monkeypatch, capsys, rooms_file, opinionated_run, command, arguments, message
):
    monkeypatch.chdir(tmp_path)
    words = [str(opinionated_run) if word == "RUN" else word for word in arguments.split()]
    before = sorted(opinionated_run.rglob("*"))
    with pytest.raises(SystemExit) as stop:
        command.main([*words, "--data", str(rooms_file)])
    said = capsys.readouterr()
    assert stop.value.code == 2
    assert message in said.err
    assert len(said.err.strip().splitlines()) == 1
    assert list(tmp_path.iterdir()) == []
    assert sorted(opinionated_run.rglob("*")) == before


def test_a_picture_of_an_unknown_kind_is_refused(tmp_path, capsys, rooms_file, opinionated_run):
    out = tmp_path / "paths.jpeg2"
    with pytest.raises(SystemExit):
        trajectories.main(
            ["--checkpoint", str(opinionated_run), "--episode", "1", "--data", str(rooms_file),
             "--out", str(out)]
        )  # fmt: skip
    assert "jpeg2" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_paths_of_two_runs_and_the_shortest_are_drawn(
    tmp_path, capsys, rooms_file, opinionated_run
):
    run, out = str(opinionated_run), tmp_path / "new" / "paths.svg"
    trajectories.main(
        ["--checkpoint", run, "--checkpoint", run, "--shortest", "--episode", "3",
         "--data", str(rooms_file), "--out", str(out)]
    )  # fmt: skip
    record = json.loads((opinionated_run / "episodes.jsonl").read_text().splitlines()[3])
    said = capsys.readouterr().out
    assert f"{record['target']} in {record['scene']}" in said
    how = "success" if record["success"] else "failure"
    assert re.search(rf"{run}: {how}.*, {record['e']} action", said)
    assert f"shortest path: success, {record['L']} action" in said
    assert "<svg" in out.read_text()
    assert [path.name for path in out.parent.iterdir()] == ["paths.svg"]


@pytest.mark.slow
def test_an_episode_is_animated(tmp_path, rooms_file, opinionated_run):
    out = tmp_path / "episode.gif"
    chosen = ["--episode", "3", "--data", str(rooms_file), "--out", str(out)]
    trajectories.main(["--checkpoint", str(opinionated_run), *chosen])
    record = json.loads((opinionated_run / "episodes.jsonl").read_text().splitlines()[3])
    with Image.open(out) as file:
        assert file.n_frames == record["e"] + 1


def test_attention_is_averaged_over_the_test_episodes_and_one_is_drawn(
    tmp_path, monkeypatch, capsys, rooms_file, opinionated_run, some_rooms
):
    def few(tables, split, extras=None):
        return {
            "seen": episodes.draw(tables, split.eval_scenes, split.seen, 4, seed=0),
            "unseen": episodes.draw(tables, split.eval_scenes, split.unseen, 4, seed=1),
        }

    monkeypatch.setattr(episodes, "load", few)
    run, out = str(opinionated_run), tmp_path / "out"
    attention.main(["--checkpoint", run, "--data", str(rooms_file), "--out", str(out)])
    said = capsys.readouterr().out
    assert "playing 32 test episodes" in said
    names = {path.name for path in out.iterdir()}
    assert len(names) == 4
    assert {"class_pairs.csv", "class_pairs.md", "class_pairs.png"} < names
    frames = int(re.search(r"([\d,]+) frames", said).group(1).replace(",", ""))
    with (out / "class_pairs.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert frames > 32
    assert {row["target"] for row in rows} <= set(some_rooms.targets)
    assert max(int(row["frames"]) for row in rows) <= frames
    shares = np.array([float(row["attention"]) for row in rows])
    assert (shares >= 0).all()
    assert (shares <= 1 + 1e-4).all()

    attention.main(
        ["--checkpoint", run, "--data", str(rooms_file), "--episode", "2", "--out", str(out)]
    )
    record = json.loads((opinionated_run / "episodes.jsonl").read_text().splitlines()[2])
    assert (out / f"{record['scene']}-{record['target']}.png").stat().st_size > 10_000


def test_every_network_and_policy_has_its_own_folder(tmp_path):
    run, point = tmp_path / "run", tmp_path / "run" / "history" / "00000020.npz"
    greedy = Choice(policy="greedy")
    for checkpoint, choice, name in (
        (run, Choice(), "attention-sample"),
        (run, greedy, "attention-greedy"),
        (point, greedy, "attention-greedy-00000020"),
    ):
        assert attention.default_folder(attention.Command(checkpoint, choice)) == run / name


@pytest.mark.slow
def test_a_model_that_sees_an_image_and_adapts_is_shown_next_to_another(
    tmp_path, capsys, rooms_file, opinionated_run, some_rooms, glove
):
    run, out = tmp_path / "savn", tmp_path / "both.html"
    network = dataclasses.replace(TINY.network, image="raster", inner_rate=50.0)
    save_untrained(dataclasses.replace(TINY, model="savn", network=network), run, some_rooms, glove)
    chosen = ["--scene", "FloorPlan229", "--target", "picture frame"]  # a Painting
    chosen += ["--start", "-1.25", "0.5", "90"]
    both = ["--checkpoint", str(run), "--checkpoint", str(opinionated_run), "--policy", "greedy"]
    replay.main([*both, *chosen, "--data", str(rooms_file), "--out", str(out)])
    text = re.search(r'type="application/json">(.*?)</script>', out.read_text(), re.S).group(1)
    adaptive, attending = json.loads(text)["players"]
    assert (adaptive["attends"], attending["attends"]) == (False, True)
    decided = adaptive["steps"][:-1]
    assert len(decided) > 6  # so that it has adapted
    for step in decided:  # as the network that played decided
        assert step["action"] == np.argmax(step["probabilities"])
    with pytest.raises(SystemExit):
        attention.main(["--checkpoint", str(run), *chosen, "--data", str(rooms_file)])
    assert f"{run}: this model has no attention" in capsys.readouterr().err


@pytest.mark.slow
def test_a_model_that_was_trained_on_feature_maps_sees_those_of_the_rooms(
    tmp_path, monkeypatch, capsys, rooms_file, glove
):
    """Those of the rooms in which it is shown, its own or others."""
    monkeypatch.setenv("TDANET_CACHE", str(tmp_path / "cache"))
    rooms = importer.read_folder(original.write_all(tmp_path / "original"), lambda *_: None)
    maps = np.random.default_rng(0).normal(size=(rooms.tables.num_states, 512, 7, 7))
    for name, share in (("own", 1.0), ("other", 3.0)):
        dataset.save_rooms(rooms, tmp_path / f"{name}.npz")
        np.save(tmp_path / f"{name}.features.npy", (share * maps).astype(np.float16))
    network = dataclasses.replace(TINY.network, image="features")
    config = dataclasses.replace(
        TINY, model="baseline", network=network, data=str(tmp_path / "own.npz")
    )
    run = tmp_path / "run"
    save_untrained(config, run, rooms.tables, glove, maps)
    chosen = ["--scene", "FloorPlan21", "--target", "Mug", "--start", "0", "0", "180"]
    values = []
    for rooms_of in ("own", "own", "other"):
        out, given = tmp_path / "page.html", ["--data", str(tmp_path / f"{rooms_of}.npz")]
        replay.main(
            ["--checkpoint", str(run), *chosen, "--out", str(out)]
            + (given if rooms_of == "other" else [])
        )
        text = re.search(r'type="application/json">(.*?)</script>', out.read_text(), re.S).group(1)
        values.append(json.loads(text)["players"][0]["steps"][0]["value"])
    assert values[0] == values[1] != values[2]
    elsewhere = ["--data", str(rooms_file), "--scene", "FloorPlan229", "--target", "Painting"]
    with pytest.raises(SystemExit):
        trajectories.main(["--checkpoint", str(run), *elsewhere])
    assert "features.npy: no such file; import with --features" in capsys.readouterr().err


@pytest.mark.slow
def test_the_page_of_a_real_room_as_a_user_asks_for_it(opinionated_run, tmp_path):
    """Through the whole command, into a browser."""
    out = tmp_path / "replay.html"
    done = subprocess.run(
        [sys.executable, "-m", "experiments.replay", "--checkpoint", str(opinionated_run),
         "--scene", "FloorPlan228", "--target", "Laptop", "--policy", "greedy", "--out", str(out)],
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "Laptop in FloorPlan228\n  my-run: " in done.stdout
    assert out.stat().st_size < 1_000_000
    html = out.read_text()
    assert "http" not in html.replace("http://www.w3.org/2000/svg", "").replace("http-equiv", "")
    with browser.launch() as chromium:
        complaints = []
        page = chromium.new_page()
        page.on("console", lambda message: complaints.append(message.text))
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.goto(out.as_uri())
        assert page.locator("h1").inner_text() == "Looking for Laptop in FloorPlan228 (living room)"
        page.keyboard.press("End")
        assert page.locator("#count").inner_text() == "end"
        assert complaints == []


def test_failures_are_sorted_and_some_can_be_looked_at(
    tmp_path, capsys, rooms_file, opinionated_run
):
    rows = [json.loads(row) for row in (opinionated_run / "episodes.jsonl").open()]
    failed = [i for i, row in enumerate(rows) if not row["success"]]
    assert 0 < len(failed) < 8
    out = tmp_path / "why"
    words = ["--checkpoint", str(opinionated_run), "--data", str(rooms_file), "--out", str(out)]
    failures.main([*words, "--replays", "3"])
    (out / "episode-99999.html").write_text("my own")
    capsys.readouterr()
    failures.main([*words, "--replays", "2"])  # the old pages go, and no others
    said = " ".join(capsys.readouterr().out.split())
    assert f"my-run, split 18/4 episodes 8 seen failed {len(failed)} seen Done with" in said
    assert said.endswith(f"wrote {out}/failures.md, .json and .png and 2 replays")
    written = json.loads((out / "failures.json").read_text())
    assert [failure["episode"] for failure in written["failures"]] == failed
    assert (out / "episode-99999.html").read_text() == "my own"
    (out / "episode-99999.html").unlink()
    pages = sorted(out.glob("*.html"))
    assert len(pages) == 2
    for page in pages:
        index = int(page.stem.removeprefix("episode-"))
        assert index in failed
        assert f"]({page.name}): " in (out / "failures.md").read_text()
        text = re.search(r'type="application/json">(.*?)</script>', page.read_text(), re.S)
        shown = json.loads(text.group(1))
        assert shown["target"] == rows[index]["target"]
        assert not shown["players"][0]["success"]
    with Image.open(out / "failures.png") as picture:
        assert picture.width > 500


def test_failures_of_a_row_of_the_scoreboard_go_into_runs(
    tmp_path, monkeypatch, rooms_file, opinionated_run
):
    row = tmp_path / "results" / "my-row"
    row.mkdir(parents=True)
    for name in ("config.json", "episodes.jsonl"):
        shutil.copy(opinionated_run / name, row)
    (row / "run.json").write_text("{}")
    held = sorted(row.iterdir())
    monkeypatch.chdir(tmp_path)
    words = ["--checkpoint", str(row), "--data", str(rooms_file), "--replays", "0"]
    failures.main(words)
    assert sorted(row.iterdir()) == held
    assert (tmp_path / "runs" / "my-row" / "failures" / "failures.md").is_file()


def test_failures_of_a_point_of_the_history_are_refused(tmp_path, capsys, opinionated_run):
    point = opinionated_run / "history" / "000001.npz"
    with pytest.raises(SystemExit):
        failures.main(["--checkpoint", str(point), "--out", str(tmp_path / "out")])
    assert "give the run" in capsys.readouterr().err


@pytest.mark.parametrize(
    "changed", [{"validation": True}, {"targets": "Kettle,Mug,Book"}, {"split": "open"}, {}]
)
def test_the_demo_shows_any_run(opinionated_run, tmp_path, changed):
    """Its rooms for training and validation, and its targets, need not be the paper's."""
    run, page = shutil.copytree(opinionated_run, tmp_path / "run"), tmp_path / "page.html"
    configs.save(dataclasses.replace(TINY, **changed), run / CONFIG_FILE)
    if not changed:  # a point of its history
        run = history.write(run, newest(run))
    demo.main(["--checkpoint", str(run), "--no-show", "--out", str(page), "--target", "Book",
               "--scene", "FloorPlan305"])  # fmt: skip
    assert "FloorPlan305" in page.read_text()
