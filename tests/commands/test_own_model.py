"""The model of the documentation's example: trained, evaluated and loaded as its page says."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

import tdanet_jax
from tdanet_jax.agent.detection import Detection
from tdanet_jax.commands.running import how_to_continue
from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.factory import make_model
from tests.support import command
from tests.support.pages import block


@pytest.mark.slow
@pytest.mark.usefixtures("ithor")  # the rooms are there: no line about computing them
def test_the_example_on_the_page_is_a_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "my_lab").mkdir()
    (tmp_path / "my_lab" / "most_alike.py").write_text(block("models.md", "most_alike.py"))
    program, name, *given = shlex.split(block("models.md", "most_alike command"))
    assert (program, name) == ("tdanet", "train")
    small = ("--steps", "400", "--history", "0", *command.TINY)
    here = {"PYTHONSAFEPATH": ""}  # the model is in the working folder
    done = command.run("train_zero_shot", *given, *small, cwd=tmp_path, variables=here)
    assert done.returncode == 0, done.stderr
    assert "TDANET_TRUST=my_lab.most_alike" in done.stdout.splitlines()[-1]
    out = tmp_path / given[given.index("--out") + 1]
    results = json.loads((out / "results.json").read_text())
    assert results["unseen"]["L>=1"]["n"] == 1000
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ValueError, match=r"set TDANET_TRUST=my_lab\.most_alike"):
        tdanet_jax.load(out)
    monkeypatch.setenv("TDANET_TRUST", "my_lab.least_alike,my_lab.most_alike")
    agent = tdanet_jax.load(out)
    seen = [Detection("sink", 0.5, 0.6, 0.9, 0.9), Detection("toaster", 0.1, 0.4, 0.3, 0.7)]
    _, decision = agent.act(agent.start(), seen, target="toaster")
    assert sum(decision.probabilities) == pytest.approx(1, abs=1e-5)
    _, other = agent.act(agent.start(), seen[:1], target="toaster")
    assert other.value != decision.value


def test_who_stops_a_run_of_a_custom_model_learns_how_to_trust_it(tmp_path):
    (tmp_path / "config.json").touch()
    again = f"tdanet train --resume {tmp_path}"
    said = how_to_continue(tmp_path, TrainConfig(model="my_lab.most_alike"))
    assert said.endswith(f"continue with: TDANET_TRUST=my_lab.most_alike {again}")
    assert how_to_continue(tmp_path, TrainConfig(model="savn")).endswith(f"continue with: {again}")


def test_a_module_that_makes_no_model_is_refused(tmp_path, monkeypatch):
    (tmp_path / "no_model.py").write_text("def make(config, classes, dtype):\n    return 1\n")
    monkeypatch.syspath_prepend(tmp_path)
    for odometry in (False, True):
        config = TrainConfig(model="no_model", network=NetworkConfig(odometry=odometry))
        with pytest.raises(ValueError, match="--model no_model: `make` gives no ActorCritic"):
            make_model(config, ClassVocabulary())
