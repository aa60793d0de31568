"""The evaluation command, as a user types it."""

import dataclasses
import json
import os
import shutil
from pathlib import Path
from types import SimpleNamespace

import jax
import pytest

import tdanet_jax
from tdanet_jax import config as configs
from tdanet_jax.commands import evaluate
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.decisions import Decisions
from tdanet_jax.eval_config import EvalConfig
from tdanet_jax.evaluation import report, saved_networks
from tdanet_jax.evaluation.saved_networks import SavedNetwork
from tdanet_jax.io import bundled_agents
from tdanet_jax.io.files import check_empty
from tdanet_jax.task import make_task
from tdanet_jax.training import history
from tdanet_jax.training.history import Snapshot
from tdanet_jax.vocabulary import ROOM_TYPES
from tdanet_jax.workflows.evaluate import short_names
from tdanet_jax.workflows.noise import evaluate_noise
from tests.conftest import save_untrained
from tests.evaluation.test_comparison import result as made_up
from tests.support import samples
from tests.support.pages import block
from tests.system.test_faults import full_disk


def test_the_shortest_path_policy_scores_100(ithor, tmp_path):
    """Through the whole command: every test episode can be solved, in exactly L actions."""
    out = tmp_path / "oracle"
    evaluate.main(["--policy", "shortest_path", "--split", "14/8", "--out", str(out)])
    results = json.loads((out / "results.json").read_text())
    assert [results[name] for name in ("seed", "evaluation_seed", "data")] == [0, 0, None]
    for group in ("seen", "unseen"):
        assert results[group]["L>=1"]["SR"] == results[group]["L>=1"]["SPL"] == 100
        assert results[group]["L>=1"]["n"] == 1000
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert len(records) == 2000
    assert all(record["e"] == record["L"] == len(record["actions"]) for record in records)


TINY = TrainConfig(
    learner=LearnerConfig(num_envs=2),
    network=NetworkConfig(width=8, hidden=8, precision="float32"),
)


@pytest.fixture(scope="module")
def runs(ithor, glove, tmp_path_factory):
    """Two runs of two seeds, each with two points of history that differ."""
    out = tmp_path_factory.mktemp("runs")
    task = make_task(TINY, ithor, glove)
    weights = samples.parameters(task.model, task.words)
    for seed in (0, 1):
        folder = out / f"seed{seed}"
        folder.mkdir()
        config = dataclasses.replace(TINY, seed=seed)
        (folder / "config.json").write_text(json.dumps(configs.to_json(config)))
        for k in (1, 2):
            scaled = jax.tree.map(lambda x, by=k + seed: by * x, weights)
            history.write(folder, Snapshot(scaled, 10 * k, 100 * k, 1.0, k, ithor.data_version))
    return out


@pytest.mark.slow
def test_the_history_of_two_runs_gives_a_curve_and_all_records(runs, few_episodes, tmp_path):
    out = tmp_path / "curve"
    chosen = [f"--checkpoint={runs / name}" for name in ("seed0", "seed1")]
    evaluate.main([*chosen, "--history", "--out", str(out)])
    names = {"evaluations.json", "evaluations.md", "episodes.jsonl", "learning_curve.png"}
    assert {path.name for path in out.iterdir()} == names
    found = json.loads((out / "evaluations.json").read_text())
    places = [(os.path.basename(r["run"]), r["point"], r["episodes_trained"]) for r in found]
    assert places == [("seed0", 1, 100), ("seed0", 2, 200), ("seed1", 1, 100), ("seed1", 2, 200)]
    assert [r["steps"] for r in found] == [400, 800, 400, 800]  # 2 environments, 20 steps
    assert [r["evaluation_seed"] for r in found] == [0, 0, 1, 1]  # each run's own
    assert [r["settings"]["--num-envs"] for r in found] == [2] * 4
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert len(records) == 4 * 200
    for result in found:
        own = [
            r["success"] for r in records
            if (r["run"], r["updates"], r["group"]) == (result["run"], result["updates"], "unseen")
        ]  # fmt: skip
        assert result["unseen"]["L>=1"]["SR"] == pytest.approx(100 * sum(own) / 100)


def test_two_runs_are_compared_episode_by_episode(
    opinionated_run, rooms_file, few_episodes, tmp_path, monkeypatch
):
    """Another seed of sampled actions, and the very same agent under another name."""
    copies = []
    for name, seed in (("seed1", 1), ("again", 0)):
        copies.append(shutil.copytree(opinionated_run, tmp_path / name))
        config = json.loads((copies[-1] / "config.json").read_text()) | {"seed": seed}
        (copies[-1] / "config.json").write_text(json.dumps(config))
    out, runs = tmp_path / "out", [opinionated_run, *copies]
    chosen = [word for run in runs for word in ("--checkpoint", str(run))]
    evaluate.main([*chosen, "--data", str(rooms_file), "--out", str(out)])
    first, other, same = json.loads((out / "evaluations.json").read_text())
    assert first["difference"] is None
    for group in ("seen", "unseen"):
        part = other["difference"][group]["L>=1"]
        for name in ("SR", "SPL"):
            apart = other[group]["L>=1"][name] - first[group]["L>=1"][name]
            assert part[name] == pytest.approx(apart, abs=0.011)
            assert part[f"{name}_ci"][0] <= part[name] <= part[f"{name}_ci"][1]
            assert same["difference"][group]["L>=1"][name] == 0
            assert same["difference"][group]["L>=1"][f"{name}_ci"] == [0, 0]
    assert other["difference"]["to"] == same["difference"]["to"] == str(opinionated_run)
    page = (out / "evaluations.md").read_text()
    cells = " | ".join(["0.0 (0.0 to 0.0)"] * 8)
    assert f"| again minus {opinionated_run.name} |  |  | sample | {cells} |" in page
    assert f"| seed1 minus {opinionated_run.name} |" in page
    # From Python, and as bundled agents, by their names.
    monkeypatch.setattr(bundled_agents, "folder", lambda: tmp_path)
    out, names = tmp_path / "by name", ["seed1", "again"]
    ours = tdanet_jax.evaluate(names, data=str(rooms_file), out=out)
    assert [row["seen"] for row in ours] == [other["seen"], same["seen"]]
    assert "| again minus seed1 |" in (out / "evaluations.md").read_text()


def test_a_run_is_no_folder_for_other_results(opinionated_run):
    with pytest.raises(ValueError, match="is a run with results of its own; choose another"):
        tdanet_jax.evaluate(opinionated_run, policy="greedy", out=opinionated_run)


@pytest.mark.parametrize("play", [tdanet_jax.evaluate, evaluate_noise])
def test_seeds_and_decisions_are_checked_before_anything_is_played(opinionated_run, play):
    with pytest.raises(ValueError, match="--seed -1: must be between 0 and 4294967295"):
        play([opinionated_run], seed=-1)
    colder = EvalConfig(decisions=Decisions(temperature=0.5))
    with pytest.raises(ValueError, match="--temperature: has no effect on --policy greedy"):
        play([opinionated_run], "greedy", test=colder)


def test_one_run_gives_the_files_of_a_single_result_beside_it(ithor, glove, few_episodes, tmp_path):
    run = tmp_path / "run"
    save_untrained(TINY, run, ithor, glove, updates=3, episodes=7)
    evaluate.main(["--checkpoint", str(run), "--policy", "greedy", "--seed", "5"])
    assert {path.name for path in (run / "greedy").iterdir()} == {
        "results.json", "results.md", "episodes.jsonl"
    }  # fmt: skip
    out = json.loads((run / "greedy" / "results.json").read_text())
    assert [out[k] for k in ("policy", "seed", "steps", "episodes_trained")] == [
        "greedy", 0, 3 * 40, 7
    ]  # fmt: skip
    assert out["evaluation_seed"] == 5


def test_a_run_is_evaluated_in_rooms_of_a_file(
    opinionated_run, rooms_file, few_episodes, some_rooms, tmp_path, capsys
):
    run, out = str(opinionated_run), tmp_path / "there"
    evaluate.main(["--checkpoint", run, "--data", str(rooms_file), "--out", str(out)])
    results = json.loads((out / "results.json").read_text())
    assert results["data_version"] == some_rooms.data_version
    assert results["data"] == str(rooms_file)
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert len(records) == results["seen"]["L>=1"]["n"] + results["unseen"]["L>=1"]["n"] == 200
    # Of the file's rooms, those that are test rooms.
    there = {"FloorPlan29", "FloorPlan229", "FloorPlan321", "FloorPlan428"}
    assert {record["scene"] for record in records} == there
    page = (out / "results.md").read_text()
    assert f"These rooms are those of {rooms_file}." in page

    with pytest.raises(SystemExit):  # without the file, these are other rooms than in training
        evaluate.main(["--checkpoint", run, "--out", str(tmp_path / "here")])
    assert f"{run}: trained on scene tables {some_rooms.data_version}" in capsys.readouterr().err
    assert not (tmp_path / "here").exists()


def test_what_was_half_written_is_no_obstacle(tmp_path, monkeypatch):
    """Files appear whole or not at all: the same command works again."""

    class Done:
        saved = SavedNetwork(tmp_path / "a", TINY)
        snapshot = SimpleNamespace(updates=10)
        task = SimpleNamespace(tables=SimpleNamespace(room_types=ROOM_TYPES, targets=()))
        played = None

        def results(self):
            return made_up()

        def columns(self):
            return {}

    monkeypatch.setattr(saved_networks, "find", lambda run, with_history, data: [Done.saved])
    monkeypatch.setattr(saved_networks, "evaluate", lambda networks, greedy, seed: [Done()])
    monkeypatch.setattr(report, "all_rows", lambda tables, played: 1000 * [{"group": "seen"}])
    out = tmp_path / "out"
    with pytest.raises(OSError, match="File too large"), full_disk(5000):
        tdanet_jax.evaluate([tmp_path / "a"], out=out)
    check_empty(out)
    tdanet_jax.evaluate([tmp_path / "a"], out=out)
    assert json.loads((out / "evaluations.json").read_text()) == [made_up() | {"difference": None}]
    assert len((out / "episodes.jsonl").read_text().splitlines()) == 1000


def test_a_custom_policy_as_the_page_shows_it(ithor, few_episodes, capsys):
    names = {}
    exec(block("evaluation.md", "own_policy.py"), names)
    groups = {group: names["results"][group]["L>=1"] for group in ("seen", "unseen")}
    said = [f"{group} {found}" for group, found in groups.items()]
    assert capsys.readouterr().out.splitlines() == said
    for found in groups.values():
        assert found["n"] == 100
        assert 10 < found["SR"] < 50
    assert names["results"]["policy"] == "custom"


@pytest.mark.parametrize(
    ("steps", "point", "share"),
    [
        (6400, None, None),
        (6400, Path("history/00000040.npz"), 0.25),  # point 5 of 20
        (12800, Path("history/00000040.npz"), 0.125),  # it was, of a budget half as large
    ],
)
def test_only_a_point_of_a_history_has_a_share_of_the_budget(tmp_path, steps, point, share):
    snapshot = Snapshot(None, 40, 100, 1.0, 0 if point is None else 5, "d")
    config = dataclasses.replace(TINY, steps=steps)
    assert config.steps_per_update * 40 == 1600
    provenance = report.Provenance("18/4", "tdanet", "sample", 100, 0, 0, 1600, "d")
    done = saved_networks.Evaluated(
        SavedNetwork(tmp_path, config, point),
        snapshot,
        SimpleNamespace(tables=SimpleNamespace(room_types=ROOM_TYPES, targets=())),
        provenance,
        {},
    )
    found = done.results()
    assert (found["point"], found["share"]) == (None if point is None else 5, share)


def test_runs_of_folders_that_are_called_alike_have_their_paths_for_names():
    a, b, other = Path("x/run"), Path("y/run"), Path("x/other")
    assert short_names([a, b, other]) == {a: "x/run", b: "y/run", other: "other"}


def test_a_run_without_history_is_named(runs, capsys, tmp_path):
    (tmp_path / "config.json").write_text((runs / "seed0" / "config.json").read_text())
    with pytest.raises(SystemExit):
        evaluate.main([f"--checkpoint={tmp_path}", "--history"])
    assert "history: no history" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
