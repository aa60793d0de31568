"""What is passed on of a trained agent, and the agent that comes with the project."""

from __future__ import annotations

import dataclasses
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import chex
import jax
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import Agent, Callbacks, words
from tdanet_jax import config as configs
from tdanet_jax.agent.detection import Detection
from tdanet_jax.analysis import trace
from tdanet_jax.commands import share
from tdanet_jax.commands.train_zero_shot import main as train
from tdanet_jax.config import CONFIG_FILE, WORD_VECTORS_FILE, TrainConfig
from tdanet_jax.decisions import Decisions
from tdanet_jax.eval_config import EvalConfig, describe_departures
from tdanet_jax.evaluation import report, saved_networks
from tdanet_jax.io import bundled_agents
from tdanet_jax.scenes import SceneTables, dataset
from tdanet_jax.splits import GROUPS
from tdanet_jax.training import devices, history
from tdanet_jax.training.checkpoint import newest
from tdanet_jax.training.run_file import RUN_FILE
from tdanet_jax.words import WordVectors
from tdanet_jax.workflows import train as training
from tests.conftest import TINY, save_untrained

#: The agent that comes with the project.
BUNDLED = Path(__file__).parents[2] / "agents" / "18-4-best"


def decision(run: Path, agent: Agent | None = None) -> np.ndarray:
    """Action probabilities of a run's agent that sees a mug."""
    agent = agent or tdanet_jax.load(run)
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
    for name in bundled_agents.names():
        run = BUNDLED.parent / name
        sought = configs.load(run / CONFIG_FILE).sought
        tables = dataset.find_targets(sought, dataset.Rooms(ithor, None))[0]
        assert newest(run).data_version == tables.data_version
        assert decision(run).sum() == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", bundled_agents.names())
def test_the_agents_of_the_project_have_their_figures(name: str) -> None:
    recorded = json.loads((BUNDLED.parent / name / report.RESULTS_FILE).read_text())
    found = tdanet_jax.evaluate(name)
    for group in GROUPS:
        assert found[group] == recorded[group]


def test_a_shared_agent_is_not_resumed(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit):
        train(["--resume", str(BUNDLED)])
    assert "there is nothing to continue from" in capsys.readouterr().err
    assert newest(BUNDLED).updates


def test_a_run_is_tested_on_the_targets_of_another(
    some_rooms: SceneTables,
    glove: WordVectors,
    rooms_file: Path,
    few_episodes: None,
    tmp_path: Path,
) -> None:
    """The same network, in runs with other targets, plays the same episodes of the same targets."""
    found = {}
    for name, targets in {"paper": "paper", "others": "Mug,Kettle"}.items():
        config = dataclasses.replace(TINY, data=str(rooms_file), targets=targets)
        save_untrained(config, tmp_path / name, some_rooms, glove)
        other = {"paper": "mug, kettle", "others": "paper"}[name]
        for test in (None, other):
            done = tdanet_jax.evaluate(tmp_path / name, test=EvalConfig(test_targets=test))
            found[name, test] = {
                key: done[key] for key in (*GROUPS, "by_target", "targets", "data_version")
            }
            assert done["departures"] is None
            assert done["trained_targets"] == (config.targets if test == other else None)
    assert found["paper", None] == found["others", "paper"]
    assert found["others", None] == found["paper", "mug, kettle"]
    assert {*found["paper", "mug, kettle"]["by_target"]} == {"Kettle", "Mug"}
    assert found["paper", "mug, kettle"]["targets"] == "Mug,Kettle"


def test_other_targets_hide_no_other_rooms(
    some_rooms: SceneTables, glove: WordVectors, rooms_file: Path, tmp_path: Path
) -> None:
    """The rooms still have to be those of the run."""
    fewer = some_rooms.subset([name for name in some_rooms.scenes if name != "FloorPlan7"])
    save_untrained(TINY, tmp_path / "run", fewer, glove)
    with pytest.raises(ValueError, match=r"run: trained on scene tables \w+, these are \w+"):
        tdanet_jax.evaluate(tmp_path / "run", test=EvalConfig(test_targets="Mug"))


@pytest.mark.parametrize(
    ("config", "targets", "error"),
    [
        (TINY, "ketle", "--test-targets ketle: no class of these rooms; did you mean Kettle"),
        (TINY, "Mug,,", "--test-targets Mug,,: a name is missing"),
        (TINY, "kitchen: Boots", "--test-targets Boots: can be found in no training room of type"),
        (
            dataclasses.replace(TINY, split="open"),
            "Mug",
            "--test-targets Mug: --split open has targets of its own",
        ),
        # Bread is what validation holds out; without it, the first of the kitchen's targets.
        (
            dataclasses.replace(TINY, validation=True),
            "kitchen: Spatula, Mug",
            "--test-targets kitchen: Spatula, Mug: would have Spatula as unseen, which training "
            "did not hide",
        ),
    ],
)
def test_test_targets_that_cannot_be_are_refused(
    opinionated_run: Path, tmp_path: Path, config: TrainConfig, targets: str, error: str
) -> None:
    shutil.copytree(opinionated_run, tmp_path / "run")
    configs.save(config, tmp_path / "run" / CONFIG_FILE)
    with pytest.raises(ValueError, match=f"^{error}"):
        tdanet_jax.evaluate(tmp_path / "run", test=EvalConfig(test_targets=targets))


@pytest.fixture
def run_of_files(
    some_rooms: SceneTables, glove: WordVectors, rooms_file: Path, tmp_path: Path
) -> Path:
    """A run that was trained in rooms and with word vectors from files in its own folder."""
    home = tmp_path / "home"
    home.mkdir()
    shutil.copy(rooms_file, home / "rooms.npz")
    kept = sorted(glove.index, key=lambda word: glove.index[word])
    np.savez(home / "vectors.npz", words=kept, vectors=glove.vectors * np.float32(1 + 1e-6))
    config = dataclasses.replace(
        TINY, data=str(home / "rooms.npz"), word_vectors=str(home / "vectors.npz")
    )
    vectors = words.load_word_vectors(config.word_vectors)
    task, _ = save_untrained(config, home / "run", some_rooms, vectors)
    where = {"folder": home / "run", "mesh": devices.first(), "progress": 1.0}
    training._prepare(SimpleNamespace(**where, config=config, task=task), Callbacks())
    return home / "run"


@pytest.mark.parametrize(
    "shared",
    [
        pytest.param(False, id="the run", marks=pytest.mark.slow),
        pytest.param(True, id="what is shared of it"),
    ],
)
def test_a_run_leaves_its_machine(
    run_of_files: Path,
    few_episodes: None,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    shared: bool,
) -> None:
    """Its files are gone, and where it goes, there are only its folder and the rooms."""
    before = decision(run_of_files)
    away = tmp_path / "away" / "agent"
    if shared:
        share.main(["--checkpoint", str(run_of_files), "--out", str(away)])
        said = capsys.readouterr().out
        assert "with a copy of its word vectors" in said
        assert f"without its rooms, {run_of_files.parent / 'rooms.npz'}: " in said
        assert (run_of_files / RUN_FILE).exists()
        assert not (away / RUN_FILE).exists()  # what was typed may name folders of its author
    else:
        shutil.copytree(run_of_files, away)
    rooms = shutil.copy(run_of_files.parent / "rooms.npz", away.parent / "elsewhere.npz")
    shutil.rmtree(run_of_files.parent)

    np.testing.assert_allclose(decision(away), before, atol=1e-2 if shared else 0)
    assert tdanet_jax.load(away).knows("yesterday")  # a word of no class
    with pytest.raises(ValueError, match=r"rooms.npz: no such file; .*with --data$"):
        tdanet_jax.evaluate(away)
    test_rooms = ("FloorPlan29", "FloorPlan229", "FloorPlan321", "FloorPlan428")  # all of them
    results = tdanet_jax.evaluate(away, test=EvalConfig(data=str(rooms), scenes=test_rooms))
    assert (results["seen"]["L>=1"]["n"], results["data"]) == (100, str(rooms))
    assert results["departures"] == {"scenes": [*test_rooms]}
    player = trace.load_player(away, dataset.load_rooms(rooms))
    assert player.task.vectors.vectors.shape[1] == 50
    saved_networks.share(away, tmp_path / "again")  # and on from there
    np.testing.assert_allclose(decision(tmp_path / "again"), before, atol=1e-2)


def test_a_run_without_a_copy_says_where_its_word_vectors_were(
    run_of_files: Path, tmp_path: Path
) -> None:
    (run_of_files / WORD_VECTORS_FILE).unlink()  # as of earlier versions
    before = decision(run_of_files)
    moved = shutil.move(run_of_files.parent / "vectors.npz", tmp_path / "moved.npz")
    gone = r"vectors.npz: no such file; .* holds no copy: give the file's place with --word-vectors"
    with pytest.raises(ValueError, match=gone):
        tdanet_jax.load(run_of_files)
    with pytest.raises(ValueError, match=gone):
        saved_networks.share(run_of_files, tmp_path / "shared")
    assert not (tmp_path / "shared").exists()
    network = saved_networks.find(run_of_files, test=EvalConfig(word_vectors=str(moved)))[0]
    assert network.departures == {}
    agent = tdanet_jax.load(run_of_files, word_vectors=moved)
    np.testing.assert_array_equal(decision(run_of_files, agent), before)
    saved_networks.share(run_of_files, tmp_path / "shared", moved)
    assert decision(tmp_path / "shared").shape == before.shape


def test_other_word_vectors_than_those_of_the_training_are_no_official_test(
    opinionated_run: Path, run_of_files: Path
) -> None:
    """Neither for a run with the bundled ones nor for one with a copy of its own."""
    other = str(run_of_files.parent / "vectors.npz")
    for run in (opinionated_run, run_of_files):
        assert saved_networks.find(run)[0].departures == {}
        network = saved_networks.find(run, test=EvalConfig(word_vectors=other))[0]
        assert network.departures == {"word_vectors": other}
    departures = describe_departures({"word_vectors": "w.npz"})
    assert departures == "Not the official test: word vectors of w.npz"


def test_a_fingerprint_tells_networks_and_their_decisions_apart(opinionated_run: Path) -> None:
    network = saved_networks.find(opinionated_run)[0]
    snapshot = network.load()
    same = network.fingerprint(network.load())
    assert network.fingerprint(snapshot) == same
    other = jax.tree.map(lambda leaf: leaf + np.float32(1e-3), snapshot.weights)
    decisions = dataclasses.replace(network, test=EvalConfig(decisions=Decisions(done_bias=1.0)))
    found = {
        same,
        network.fingerprint(dataclasses.replace(snapshot, weights=other)),
        decisions.fingerprint(snapshot),
    }
    assert len(found) == 3


def test_word_vectors_of_another_width_are_refused(run_of_files: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "wide.npz", words=["mug"], vectors=np.ones((1, 300)))
    with pytest.raises(ValueError, match="trained with word vectors of another width than 300"):
        tdanet_jax.load(run_of_files, word_vectors=tmp_path / "wide.npz")


def test_a_shared_folder_is_there_as_a_whole_or_not_at_all(
    opinionated_run: Path, tmp_path: Path
) -> None:
    """A folder that holds a part would be refused the next time."""
    run, out = tmp_path / "run", tmp_path / "out"
    shutil.copytree(opinionated_run, run)
    (run / report.EPISODES_FILE).unlink()
    (run / report.EPISODES_FILE).symlink_to(opinionated_run / report.EPISODES_FILE)
    with pytest.raises(ValueError, match=r"episodes\.jsonl"):
        saved_networks.share(run, out)
    assert not out.exists()
    (run / report.EPISODES_FILE).unlink()
    saved_networks.share(run, out)
    assert newest(out).updates == newest(run).updates
