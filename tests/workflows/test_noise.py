"""Agents at levels of noise, and the report on them."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from typing import Any

import pytest

import tdanet_jax
from tdanet_jax.commands import evaluate
from tdanet_jax.eval_config import EvalConfig
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sense_noise import NONE, SenseNoise
from tdanet_jax.words import WordVectors
from tdanet_jax.workflows import noise
from tests.conftest import TINY, save_untrained

PLAN = [
    (None, "0", NONE),
    ("failed turns", "1", SenseNoise(failed_turns=1.0)),
    ("nothing", "0", NONE),
]
NAMES = ["no noise 0", "failed turns 1", "nothing 0"]


@pytest.mark.slow
@pytest.mark.usefixtures("few_episodes")
def test_a_sweep_compares_each_level_with_the_agent_without_noise(
    ithor: SceneTables, glove: WordVectors, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, out, test = tmp_path / "my_run", tmp_path / "out", EvalConfig(step_limit=40)
    save_untrained(TINY, run, ithor, glove)
    shown: list[str] = []

    def show(share: float, name: str) -> None:
        shown.append(name)

    def sweep(**options: Any) -> list[noise.Row]:
        return noise.evaluate_noise(
            [run], "sample", test, out=out, plan=PLAN, on_network=show, **options
        )

    rows = sweep()
    clean, stuck, again = rows
    official = tdanet_jax.evaluate(run, policy="sample", test=test)
    for group in ("seen", "unseen"):
        assert clean[group] == again[group] == official[group]
        assert stuck[group] != clean[group]
        change = stuck["change"][group]["L>=1"]["SPL"]
        points = stuck[group]["L>=1"]["SPL"] - clean[group]["L>=1"]["SPL"]
        assert change == pytest.approx(points, abs=0.011)
        assert not any(again["change"][group]["L>=1"][m] for m in ("SR", "CF-SPL"))
    assert json.loads((out / "noise.json").read_text()) == rows
    assert (out / "noise.png").stat().st_size > 1000
    page = (out / "noise.md").read_text()
    assert "## Failed turns" in page
    assert "| 1 | my_run | " in page
    assert "at most 40 actions" in page
    assert shown == ["0 of 3 levels are there", *(f"my_run, {n}" for n in NAMES)]

    # Stopped after the second level, it plays the third, and the first to compare it with.
    path = out / "noise.json"
    path.write_text(json.dumps(rows[:2]))
    shown.clear()
    assert sweep() == rows == json.loads(path.read_text())
    assert shown == ["2 of 3 levels are there", f"my_run, {NAMES[2]}"]
    with monkeypatch.context() as nothing_is_played:
        nothing_is_played.setattr(noise.saved_networks, "evaluate", lambda *_: iter(()))
        assert sweep() == rows

    other = {**rows[0], "seen": rows[1]["seen"]}
    for there, message in [
        ([other, rows[1]], "my_run: plays the episodes otherwise"),
        ([{**clean, "updates": 1}], "my_run was played with other values of updates"),
        ([{**clean, "agent": "a"}], "holds a, no noise 0, which is not asked for"),
        ([{**clean, "seen": {}}], "a row, seen, L>=1: missing"),
        ([3], "a row: not an object"),
        ({}, "not the rows of a sweep"),
    ]:
        path.write_text(json.dumps(there))
        with pytest.raises(ValueError, match=message):
            sweep()
        assert json.loads(path.read_text()) == there
    path.write_text(json.dumps(rows))
    with pytest.raises(ValueError, match="other values of evaluation_seed"):
        sweep(seed=5)
    shutil.rmtree(run)  # another agent in the place of this one
    network = dataclasses.replace(TINY.network, done_bias=1.0)
    save_untrained(dataclasses.replace(TINY, network=network), run, ithor, glove)
    with pytest.raises(ValueError, match="other values of network"):
        sweep(seed=TINY.seed)


@pytest.mark.parametrize(("there", "continues"), [("noise.json", True), ("results.json", False)])
def test_the_command_continues_a_sweep_alone(
    there: str, continues: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / there).touch()
    played: list[Path] = []
    monkeypatch.setattr(evaluate, "play_noise", lambda *given: played.append(given[-1]))
    words = ["--noise", "sweep", "--checkpoint", "x", "--out", str(tmp_path)]
    if continues:
        evaluate.main(words)
    else:
        with pytest.raises(SystemExit):
            evaluate.main(words)
    assert played == [tmp_path] * continues


@pytest.mark.parametrize("other", [["--history", "--checkpoint", "x"], ["--policy", "random"]])
def test_a_sweep_plays_the_newest_networks_of_runs(
    other: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        evaluate.main(["--noise", "sweep", *other])
    assert "--noise sweep: plays the newest networks of runs" in capsys.readouterr().err
