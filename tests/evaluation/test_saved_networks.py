"""What is passed on of a trained agent, and the agent that comes with the project."""

from __future__ import annotations

import shutil
from pathlib import Path

import chex
import jax
import numpy as np
import pytest

import tdanet_jax
from experiments.train_zero_shot import main as train
from tdanet_jax.agent.agent import Detection
from tdanet_jax.evaluation import report, saved_networks
from tdanet_jax.scenes import SceneTables
from tdanet_jax.training import history
from tdanet_jax.training.checkpoint import newest

#: The agent that comes with the project.
BUNDLED = Path(__file__).parents[2] / "agents" / "18-4-best"


def decision(run: Path) -> np.ndarray:
    """Action probabilities of a run's agent that sees a mug."""
    agent = tdanet_jax.load(run)
    seen = [Detection("mug", 0.4, 0.4, 0.5, 0.5)]
    return agent.act(agent.start(rotation=45), seen, target="mug")[1].probabilities


def test_what_is_shared_is_the_network(opinionated_run: Path, tmp_path: Path) -> None:
    run, shared = tmp_path / "run", tmp_path / "shared"
    shutil.copytree(opinionated_run, run)
    (run / report.RESULTS_PAGE).write_text("results")
    saved_networks.share(run, shared)
    whole, half = newest(run), newest(shared)
    chex.assert_trees_all_close(half.weights, whole.weights, rtol=2**-10, atol=2**-24)
    assert {leaf.dtype for leaf in jax.tree.leaves(half.weights)} == {np.dtype(np.float32)}
    assert (half.updates, half.data_version) == (whole.updates, whole.data_version)
    np.testing.assert_allclose(decision(shared), decision(run), atol=1e-2)
    for name in (report.RESULTS_PAGE, report.EPISODES_FILE):
        assert (shared / name).read_text() == (run / name).read_text()
    # And on from there.
    saved_networks.share(shared, tmp_path / "again")
    chex.assert_trees_all_equal(newest(tmp_path / "again").weights, half.weights)


def test_a_parameter_that_does_not_fit_is_one_clear_error(
    opinionated_run: Path, tmp_path: Path
) -> None:
    snapshot = newest(opinionated_run)
    snapshot.weights["actor"]["bias"] = np.full(6, 1e6, np.float32)
    with pytest.raises(ValueError, match="a parameter does not fit into float16"):
        history.save(tmp_path / "network.npz", snapshot, half=True)


def test_the_agent_of_the_project_plays_in_the_rooms_of_the_project(ithor: SceneTables) -> None:
    assert newest(BUNDLED).data_version == ithor.data_version
    assert decision(BUNDLED).sum() == pytest.approx(1.0)


def test_a_shared_agent_is_not_resumed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        train(["--resume", str(BUNDLED)])
    assert "there is nothing to continue from" in capsys.readouterr().err
    assert newest(BUNDLED).updates
