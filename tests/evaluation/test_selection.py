"""A part of the test episodes, other limits, and that reports say so."""

from __future__ import annotations

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import EvalConfig, sense_noise
from tdanet_jax.commands import evaluate
from tdanet_jax.config import TrainConfig
from tdanet_jax.decisions import Decisions
from tdanet_jax.env.params import TEST_STEP_LIMITS
from tdanet_jax.eval_config import OWN_TASK, describe_departures
from tdanet_jax.evaluation import comparison, episodes, selection
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sense_noise import SenseNoise
from tdanet_jax.splits import make_split
from tdanet_jax.words import WordVectors
from tests.conftest import TINY, save_untrained


@pytest.fixture(scope="module")
def lists(ithor: SceneTables) -> dict[str, Episodes]:
    """The test episodes of split 18/4."""
    return episodes.load(ithor, make_split("18/4"))


def chosen(
    lists: dict[str, Episodes], tables: SceneTables, **values: object
) -> dict[str, list[tuple[str, str]]]:
    """Rooms and targets of the chosen episodes."""
    found = selection.choose(lists, tables, EvalConfig(**values))  # type: ignore[arg-type]
    return {
        group: [
            (tables.scenes[tables.state_scene[pose]], tables.targets[target])
            for pose, target in zip(one.pose, one.target, strict=True)
        ]
        for group, one in found.items()
    }


def test_without_a_choice_all_are_played(lists: dict[str, Episodes], ithor: SceneTables) -> None:
    found = selection.choose(lists, ithor, OWN_TASK)
    assert found.keys() == lists.keys()
    for group, one in found.items():
        np.testing.assert_array_equal(one.pose, lists[group].pose)
        np.testing.assert_array_equal(one.target, lists[group].target)


@pytest.mark.parametrize(("count", "kept"), [(4, [0, 250, 500, 750]), (3, [0, 333, 666])])
def test_some_episodes_are_evenly_spaced(
    lists: dict[str, Episodes], ithor: SceneTables, count: int, kept: list[int]
) -> None:
    found = selection.choose(lists, ithor, EvalConfig(episodes=count))
    for group, one in found.items():
        np.testing.assert_array_equal(one.pose, lists[group].pose[kept])
        np.testing.assert_array_equal(one.target, lists[group].target[kept])
    many = selection.choose(lists, ithor, EvalConfig(episodes=5000))
    assert [len(one) for one in many.values()] == [1000, 1000]


def test_rooms_and_targets_are_chosen_by_name(
    lists: dict[str, Episodes], ithor: SceneTables
) -> None:
    everything = chosen(lists, ithor)
    rooms, targets = ("FloorPlan228", "FloorPlan30"), ("Laptop", "Television", "Toaster")
    there = chosen(lists, ithor, scenes=rooms)
    assert there == {g: [p for p in pairs if p[0] in rooms] for g, pairs in everything.items()}
    both = chosen(lists, ithor, scenes=rooms[:1], targets=targets, episodes=5)
    assert set(both["unseen"]) == {("FloorPlan228", "Laptop")}
    assert set(both["seen"]) == {("FloorPlan228", "Television")}
    assert len(both["unseen"]) == 5
    assert list(chosen(lists, ithor, targets=["Laptop"])) == ["unseen"]  # never a seen one
    by_label = chosen(lists, ithor, targets=["laptops", "tv"])  # as a detector calls them
    assert by_label == chosen(lists, ithor, targets=["Laptop", "Television"])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"targets": ("Laptpo",)}, "--targets Laptpo: in no test episode; did you mean Laptop?"),
        ({"targets": ("Oxygen",)}, "--targets Oxygen: in no test episode; there are AlarmClock, "),
        (
            {"scenes": (__file__,)},
            f"--scenes {__file__}: in no test episode; rooms of your own are",
        ),
        (
            {"targets": ("Laptop,Pillow",)},
            "--targets Laptop,Pillow: in no test episode; separate names with spaces",
        ),
        ({"scenes": ("a" * 9999,)}, f"--scenes {'a' * 9999}: in no test episode; there are"),
        ({"scenes": ("FloorPlan1",)}, "--scenes FloorPlan1: in no test episode; did you mean"),
        (
            {"scenes": ("FloorPlan1",), "training_rooms": True},
            "--scenes FloorPlan1: in no episode in a training room; ",  # of these lists
        ),
        (
            {"scenes": ("FloorPlan228",), "targets": ("Toaster",)},
            "--scenes, --targets: no test episode has one of these targets there",
        ),
    ],
)
def test_an_unknown_name_is_one_clear_error(
    lists: dict[str, Episodes], ithor: SceneTables, values: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}"):
        chosen(lists, ithor, **values)


@pytest.mark.parametrize("values", [{"step_limit": 0}, {"episodes": -1}, {"step_limit": 1.5}])
def test_a_value_out_of_range_is_named(values: dict[str, int]) -> None:
    [(name, value)] = values.items()
    with pytest.raises(ValueError, match=f"--{name.replace('_', '-')} {value}: must be "):
        tdanet_jax.evaluate(policy="random", test=EvalConfig(**values))


def test_a_step_limit_replaces_that_of_every_room_type(ithor: SceneTables) -> None:
    limits = jnp.asarray(TEST_STEP_LIMITS)
    kept: dict[str, object] = {}
    params = SimpleNamespace(step_limit=limits, replace=lambda **values: kept.update(values))
    task = SimpleNamespace(tables=ithor, split=make_split("18/4"), extras=None, eval_params=params)
    selection.select(task, EvalConfig(step_limit=7))  # type: ignore[arg-type]
    assert kept["step_limit"].tolist() == [7] * len(limits)  # type: ignore[attr-defined]
    assert selection.select(task, OWN_TASK)[0] is params  # type: ignore[arg-type]


@pytest.mark.usefixtures("ithor")
def test_the_results_say_that_it_is_not_the_test(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The optimum cannot be reached in three actions where L is larger."""
    out = tmp_path / "out"
    evaluate.main(
        ["--policy", "shortest_path", "--step-limit", "3", "--episodes", "1_0", "--targets",
         "Laptop", "Television", "--scenes", "FloorPlan228", "FloorPlan229", "--out", str(out)]
    )  # fmt: skip
    said = (
        "Not the official test: at most 3 actions per episode; at most 10 episodes of each list, "
        "evenly spaced; only in FloorPlan228, FloorPlan229; only for Laptop, Television"
    )
    assert said in capsys.readouterr().out
    page = (out / "results.md").read_text()
    assert f"**{said}.**" in page
    assert "(paper)" not in page
    results = json.loads((out / "results.json").read_text())
    assert results["departures"] == {
        "step_limit": 3, "episodes": 10, "scenes": ["FloorPlan228", "FloorPlan229"],
        "targets": ["Laptop", "Television"],
    }  # fmt: skip
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert len(records) == 20
    assert all(record["success"] == (record["L"] <= 3) for record in records)
    assert max(record["e"] for record in records) == 3


def test_a_policy_is_tested_on_any_targets(
    tmp_path: Path, few_episodes: None, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    given = ["--policy", "random", "--split", "Kettle", "--test-targets"]
    evaluate.main([*given, "kettle, mug,book", "--out", str(out)])
    results = json.loads((out / "results.json").read_text())
    assert {*results["by_target"]} == {"Kettle", "Mug", "Book"}
    assert (results["split"], results["targets"]) == ("Kettle", "Mug,Book,Kettle")
    assert results["departures"] is None
    for targets, error in {
        "Mug,Book": "--split Kettle: choose one of",
        "ketle": "--test-targets ketle: no class of these rooms; did you mean Kettle",
    }.items():
        with pytest.raises(SystemExit):
            evaluate.main([*given, targets, "--out", str(tmp_path / "no")])
        assert error in capsys.readouterr().err
    with pytest.raises(ValueError, match="--test-targets Mug: --split open has targets of its own"):
        tdanet_jax.evaluate(
            None, "random", config=TrainConfig(split="open"), test=EvalConfig(test_targets="Mug")
        )


@pytest.mark.usefixtures("ithor")
def test_as_many_episodes_are_played_in_the_training_rooms(tmp_path: Path) -> None:
    out = tmp_path / "out"
    evaluate.main(["--policy", "shortest_path", "--training-rooms", "--out", str(out)])
    results = json.loads((out / "results.json").read_text())
    assert results["departures"] == {"training_rooms": True}
    assert "**Not the official test: in the training rooms.**" in (out / "results.md").read_text()
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    split = make_split("18/4")
    assert {record["scene"] for record in records} <= {*split.train_scenes}
    for group, targets in (("seen", split.seen), ("unseen", split.unseen)):
        rooms = [r["room"] for r in records if r["group"] == group]
        assert {room: rooms.count(room) for room in targets} == dict.fromkeys(targets, 250)
        assert all(r["target"] in targets[r["room"]] for r in records if r["group"] == group)
        assert results[group]["L>=1"]["SR"] == 100


@pytest.mark.slow
def test_a_run_is_evaluated_with_another_threshold_of_reach(
    ithor: SceneTables, glove: WordVectors, tmp_path: Path
) -> None:
    network = dataclasses.replace(
        TINY.network, odometry=True, triangulation=True, reach_threshold=0.7
    )
    run = tmp_path / "run"
    save_untrained(dataclasses.replace(TINY, network=network), run, ithor, glove)
    ended = {}
    for threshold in (0.0, 0.999):
        out = tmp_path / str(threshold)
        test = EvalConfig(
            episodes=30, step_limit=20, decisions=Decisions(reach_threshold=threshold)
        )
        tdanet_jax.evaluate(run, test=test, out=out)
        said = f"Done with a probability of reach of {threshold} or more"
        assert said in (out / "results.md").read_text()
        assert json.loads((out / "results.json").read_text())["departures"] == test.departures
        records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
        ended[threshold] = sum(record["actions"][-1] == "Done" for record in records)
    assert ended[0.0] > 10
    assert ended[0.999] == 0
    decisions = Decisions(reach_threshold=0.0, done_bias=-100.0)
    tdanet_jax.evaluate(
        run, test=EvalConfig(episodes=30, decisions=decisions), out=tmp_path / "biased"
    )
    lines = (tmp_path / "biased" / "episodes.jsonl").read_text().splitlines()
    assert not any(json.loads(line)["actions"][-1] == "Done" for line in lines)


def test_a_threshold_needs_an_estimate_of_reach(opinionated_run: Path) -> None:
    test = EvalConfig(decisions=Decisions(reach_threshold=0.5))
    with pytest.raises(ValueError, match=r"--reach-threshold: .*my-run was trained without it"):
        tdanet_jax.evaluate(opinionated_run, test=test)
    for name in ("reach_threshold", "temperature", "done_bias"):
        flag, test = name.replace("_", "-"), EvalConfig(decisions=Decisions(**{name: 0.5}))
        with pytest.raises(ValueError, match=f"--{flag}: is for trained agents"):
            tdanet_jax.evaluate(policy="random", test=test)
    with pytest.raises(ValueError, match="--reach-threshold 1: must be at least 0 and below 1"):
        tdanet_jax.evaluate(
            opinionated_run, test=EvalConfig(decisions=Decisions(reach_threshold=1))
        )


def test_every_departure_is_said_in_words() -> None:
    test = EvalConfig(training_rooms=True, decisions=Decisions(0.7, 0.5, 0.0))
    assert describe_departures(test.departures) == (
        "Not the official test: in the training rooms; Done with a probability of reach of 0.7 or "
        "more; a temperature of 0.5; 0.0 added to the logit of Done"
    )


def test_a_page_on_several_networks_says_so_too() -> None:
    departures = EvalConfig(episodes=20).departures
    assert OWN_TASK.departures == EvalConfig(data="rooms.npz").departures == {}
    result = {
        "split": "18/4", "model": "tdanet", "policy": "sample", "seed": 0, "data": None,
        "data_version": "a", "updates": 1, "episodes_trained": 1, "seen": None, "unseen": None,
        "by_room": {}, "departures": departures,
    }  # fmt: skip
    page = comparison.markdown("2 checkpoints", [result, result], ["a", "b"])
    assert f"**{describe_departures(departures)}.**" in page
    assert "(paper)" not in page
    assert "SR and SPL in percent, test rooms." in page
    result["departures"] = EvalConfig(training_rooms=True).departures
    page = comparison.markdown("2 checkpoints", [result, result], ["a", "b"])
    assert "SR and SPL in percent, training rooms." in page
    assert "test rooms" not in page
    result |= {"departures": None, "split": "18/4-validation"}
    page = comparison.markdown("2 checkpoints", [result, result], ["a", "b"])
    assert "SR and SPL in percent, validation rooms." in page
    assert "test rooms" not in page
    other = {**result, "split": "14/8"}
    page = comparison.markdown("2 checkpoints", [result, other], ["a", "b"])
    assert "SR and SPL in percent, test and validation rooms." in page


@pytest.mark.parametrize("noise", ["detector", "mix", "misses=0:0.1", "truncation=0.1", "scores=1"])
def test_what_a_detector_gets_wrong_is_refused_to_models_that_look_at_an_image(noise: str) -> None:
    """The image stays as it is, so results would be those without noise, called noisy."""
    task, levels = SimpleNamespace(), sense_noise.parse(noise)
    params = SimpleNamespace(spec=ObservationSpec(image="raster"), replace=None)
    with pytest.raises(ValueError, match=r"^--noise [a-z_]+: is of detections, and"):
        selection.with_senses(task, params, [sense_noise.NONE, levels])


def test_only_noise_of_motion_is_left_to_models_that_look_at_an_image() -> None:
    motion = {
        "distance_bias", "distance_noise", "turn_bias", "turn_noise", "heading_drift",
        "heading_error", "short_steps", "failed_turns",
    }  # fmt: skip
    for field in dataclasses.fields(SenseNoise):
        noise = SenseNoise(**{field.name: 0.1})
        if field.name in motion:
            noise.check_image()
        else:
            with pytest.raises(ValueError, match=f"^--noise {field.name}: is of detections"):
                noise.check_image()
