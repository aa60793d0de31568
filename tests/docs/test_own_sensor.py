"""The sensor of the documentation's example: trained, evaluated and loaded as its page says."""

from __future__ import annotations

import json
import shlex
import sys
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import __main__ as tdanet
from tdanet_jax import poses
from tdanet_jax.config import NetworkConfig, TrainConfig
from tests.support.command import TINY
from tests.support.pages import block


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the page's `my_lab/compass.py`, from which it can be imported."""
    (tmp_path / "my_lab").mkdir()
    (tmp_path / "my_lab" / "compass.py").write_text(block("sensors.md", "compass.py"))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def run(line: str, *more: str) -> None:
    """Runs a command of the page."""
    program, *given = shlex.split(line)
    assert program == "tdanet"
    tdanet.main([*given, *more])


@pytest.mark.slow
@pytest.mark.usefixtures("ithor", "few_episodes")
def test_the_example_on_the_page_is_a_sensor(
    lab: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run(block("sensors.md", "compass command"), "--steps", "400", "--history", "0", *TINY)
    assert "TDANET_TRUST=my_lab.compass" in capsys.readouterr().out.splitlines()[-1]
    written = json.loads((lab / "runs/compass/config.json").read_text())
    assert written["network"]["sensors"] == ["my_lab.compass"]
    monkeypatch.delitem(sys.modules, "my_lab.compass")  # as in another process
    with pytest.raises(ValueError, match=r"set TDANET_TRUST=my_lab\.compass"):
        tdanet_jax.load("runs/compass")
    export, evaluate = block("sensors.md", "compass trust").splitlines()
    monkeypatch.setenv(*export.removeprefix("export ").split("="))
    run(evaluate)
    results = json.loads((lab / "runs/compass/greedy/results.json").read_text())
    assert results["unseen"]["L>=1"]["n"] == 100
    names: dict[str, Any] = {}
    exec(block("sensors.md", "compass agent"), names)
    agent, seen = names["agent"], names["seen"]
    values = [
        agent.act(agent.start(rotation=rotation), seen, target="toaster")[1].value
        for rotation in (0, 90)
    ]
    assert values[0] != values[1]


def test_the_compass_shows_the_heading_of_the_environment(lab: Path) -> None:
    config = TrainConfig(network=NetworkConfig(sensors=("my_lab.compass",)))
    env, params = tdanet_jax.make("ithor-18/4", config=config)

    def episodes(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        """The pose and the compass over some random actions."""
        keys = jax.random.split(key, 20)

        def act(carried: Any, key: jax.Array) -> tuple[Any, tuple[jax.Array, jax.Array]]:
            obs, state = carried
            shown = state.pose, obs.sensors["my_lab.compass"]
            return env.step(key, state, jax.random.randint(key, (), 0, 6), params)[:2], shown

        return jax.lax.scan(act, env.reset(keys[0], params), keys)[1]

    pose, shown = jax.jit(jax.vmap(episodes))(jax.random.split(jax.random.key(0), 8))
    heading = np.asarray(poses.split(pose).rotation)
    assert len(np.unique(heading)) == 8
    angle = np.radians(45 * heading)
    np.testing.assert_allclose(shown, np.stack([np.sin(angle), np.cos(angle)], -1), atol=1e-6)
