"""Agents at levels of noise, and the report on them."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import tdanet_jax
from experiments import evaluate
from tdanet_jax.config import EvalConfig
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


@pytest.mark.usefixtures("few_episodes")
def test_a_sweep_compares_each_level_with_the_agent_without_noise(
    ithor: SceneTables, glove: WordVectors, tmp_path: Path
) -> None:
    run, out, test = tmp_path / "my_run", tmp_path / "out", EvalConfig(step_limit=40)
    save_untrained(TINY, run, ithor, glove)
    shown: list[str] = []
    rows = noise.evaluate_noise(
        [run], "sample", test, out=out, plan=PLAN, on_network=lambda _, name: shown.append(name)
    )
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
    assert shown[1] == "my_run, failed turns 1"


@pytest.mark.parametrize("other", [["--history", "--checkpoint", "x"], ["--policy", "random"]])
def test_a_sweep_plays_the_newest_networks_of_runs(
    other: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        evaluate.main(["--noise", "sweep", *other])
    assert "--noise sweep: plays the newest networks of runs" in capsys.readouterr().err
