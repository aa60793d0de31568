"""Failures by cause, against a plain walk through the rooms."""

from __future__ import annotations

import dataclasses
import json
import math
from collections import Counter

import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax.analysis import failures, figures
from tdanet_jax.analysis.episode_lookup import Recorded, read_records
from tdanet_jax.analysis.failures import CAUSES, Failure, Summary
from tdanet_jax.evaluation import episodes
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.io import bundled_agents
from tdanet_jax.io.bundled_agents import find_run
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.task import make_task, task_in
from tdanet_jax.vocabulary import ACTION_NAMES
from tests.conftest import SOME_ROOMS, TINY
from tests.support.oracle import World

DONE = ACTION_NAMES.index("Done")
REACH = 1.48  # metres


def walks(task, count=150):
    """Episodes of which one in two ends with Done, after anything from 0 to 60 random actions."""
    rng, records = np.random.default_rng(0), []
    for group, targets in (("seen", task.split.seen), ("unseen", task.split.unseen)):
        drawn = episodes.draw(task.tables, SOME_ROOMS, targets, count, seed=1)
        for pose, target in zip(drawn.pose, drawn.target, strict=True):
            actions = rng.choice(DONE, int(rng.integers(1, 60)), p=[0.6, 0.15, 0.15, 0.05, 0.05])
            if rng.random() < 0.5:
                actions = np.append(actions, DONE)
            records.append(Recorded(Episodes(np.array([pose]), np.array([target])), actions, group))
    return records


@pytest.fixture(scope="module")
def world(some_rooms):
    return World(some_rooms, {}, (100,) * 4)


@pytest.fixture(scope="module")
def task(some_rooms, glove):
    return make_task(TINY, some_rooms, glove)


@pytest.fixture(scope="module")
def records(task):
    return walks(task)


@pytest.fixture(scope="module")
def found(task, records):
    return failures.find(records, task.tables, task.eval_params)


def expected(world, record):
    """The cause and the missing metres of one episode, or None if it is a success."""
    target = world.tables.targets[int(record.episode.target[0])]
    pose = world.pose_of(int(record.episode.pose[0]))
    path = [pose]
    for action in record.actions:
        pose = world.moved(pose, int(action))
        path.append(pose)
    states = [world.state_of(p) for p in path]
    reach = [target in world.visible(s) for s in states]
    view = [target in {d.name for d in world.detections(s, merge=False)} for s in states]
    if record.actions[-1] != DONE:
        if any(reach):
            return "limit_in_reach", None
        return "limit_in_view" if any(view) else "limit_never_in_view", None
    if reach[-1]:
        return None
    if not view[-1]:
        return "done_lost" if any(view) else "done_never_in_view", None
    x, _, z = world.tables.position[path[-1].position]
    away = []
    for row in world.rows(states[-1]):
        if world.class_of(row) == target:
            x1, _, z1, x2, _, z2 = world.tables.object_box[world.tables.row_object[row]]
            away.append(math.hypot(max(x1 - x, 0, x - x2), max(z1 - z, 0, z - z2)))
    return "done_out_of_reach", max(min(away) - REACH, 0.0)


def test_causes_and_missing_metres_are_those_of_a_plain_walk(world, records, found):
    by_index = {failure.episode: failure for failure in found}
    for i, record in enumerate(records):
        said = expected(world, record)
        assert (said is None) == (i not in by_index)
        if said is not None:
            failure = by_index[i]
            assert failure.cause == said[0]
            assert failure.missing_metres == pytest.approx(said[1])
            assert failure.length == len(record.actions)
            assert failure.group == record.group
            assert failure.target == world.tables.targets[int(record.episode.target[0])]
    assert {failure.cause for failure in found} == set(CAUSES)
    assert any(failure.missing_metres == 0 for failure in found)
    assert any((failure.missing_metres or 0) > 1 for failure in found)


def test_missing_actions_are_the_distance_of_the_last_pose(world, records, found):
    early = [failure for failure in found if failure.cause == "done_out_of_reach"]
    for failure in early:
        record = records[failure.episode]
        pose = world.pose_of(int(record.episode.pose[0]))
        for action in record.actions:
            pose = world.moved(pose, int(action))
        expected = world.distance(world.state_of(pose), failure.target)
        assert failure.missing_actions == expected > 0
    others = [failure for failure in found if failure not in early]
    assert {(f.missing_metres, f.missing_actions) for f in others} == {(None, None)}


def failure(episode, cause="done_lost", target="Mug", group="seen", **fields):
    """A failure in a kitchen."""
    chosen = {"shortest": 3, "length": 4, "missing_metres": None, "missing_actions": None} | fields
    return Failure(episode, group, "FloorPlan1", "kitchen", target, cause, **chosen)


@pytest.fixture
def summary():
    early = "done_out_of_reach"
    metres = [0.0, 0.1, 0.10001, 3.0]
    listed = [
        *(failure(i, early, missing_metres=m, missing_actions=i + 1) for i, m in enumerate(metres)),
        failure(4, early, "Vase", missing_metres=0.7, missing_actions=9),
        failure(5, "limit_in_view", "Vase"),
        failure(6, "limit_in_view", "Toaster", "unseen"),
    ]
    played = {
        ("seen", "kitchen", "Mug"): 10,
        ("seen", "kitchen", "Vase"): 4,
        ("seen", "kitchen", "Bread"): 6,
        ("unseen", "kitchen", "Toaster"): 5,
    }
    return Summary("mine", "18/4", listed, played, {})


def test_counts(summary):
    assert summary.episodes(group="seen") == 20
    assert summary.episodes(target="Mug") == 10
    assert summary.count(group="seen", cause="limit_in_view") == 1
    assert summary.missing("seen").tolist() == [1, 1, 1, 0, 1, 1, 0]
    assert summary.missing("unseen").tolist() == [0] * 7
    # 2 of 4, 4 of 10, 1 of 5; Bread never failed.
    assert [key["target"] for key in summary.targets()] == ["Vase", "Mug", "Toaster"]


def test_examples_are_of_every_cause_and_target_in_turn(summary):
    chosen = failures.examples(summary, 4)
    assert [(f.cause, f.target) for f in chosen] == [
        ("done_out_of_reach", "Vase"),
        ("limit_in_view", "Vase"),
        ("done_out_of_reach", "Mug"),
        ("limit_in_view", "Toaster"),
    ]
    assert failures.examples(summary, 0) == []
    everything = failures.examples(summary, 99)
    assert sorted(f.episode for f in everything) == list(range(7))


def test_the_page_says_what_was_counted(summary):
    page = failures.markdown(summary, "f.png", {"episode-4.html": summary.failures[4]})
    assert "Failed episodes: 6 of 20 seen, 1 of 5 unseen." in page
    assert "| Done out of reach | Done with the target in view, out of reach | 5 | 0 |" in page
    assert "| up to 0.10 m | 1 | 0 |" in page
    assert "| more actions, median | 3 | - |" in page
    assert "| kitchen | seen | 20 | 6 | 30.0 | 5 |  |  |  | 1 |  |" in page
    assert "[Vase in FloorPlan1](episode-4.html): Done out of reach; 4 actions" in page
    assert "Bread" not in page


def test_the_picture_is_drawn_with_and_without_failures(summary, tmp_path):
    figures.failures(summary, tmp_path / "some.png")
    figures.failures(Summary("mine", "18/4", [], summary.played, {}), tmp_path / "none.png")
    assert (tmp_path / "some.png").stat().st_size > (tmp_path / "none.png").stat().st_size > 1000


def test_sides_that_a_file_of_rooms_does_not_tell_are_unknown(
    some_rooms, task, records, found, tmp_path
):
    early = [f for f in found if f.missing_metres is not None]
    boxes = some_rooms.object_box.copy()
    targets = [some_rooms.classes.index(name) for name in {f.target for f in early}]
    of_targets = np.flatnonzero(np.isin(some_rooms.object_class, targets))
    boxes[of_targets[::2]] = np.nan
    boxes[of_targets[1::2], 3:] = boxes[of_targets[1::2], :3]  # a point
    tables = dataclasses.replace(some_rooms, object_box=boxes)
    summary = failures.summarise("mine", "18/4", records, tables, task.eval_params)
    assert [f.cause for f in summary.failures] == [f.cause for f in found]
    assert {f.missing_metres for f in summary.failures} == {None}
    counts = sum(summary.missing(group) for group in ("seen", "unseen"))
    assert counts.tolist() == [0] * 6 + [len(early)]
    assert f"| unknown | {summary.missing('seen')[-1]} |" in failures.markdown(summary, "", {})
    figures.failures(summary, tmp_path / "unknown.png")
    json.loads(json.dumps(failures.to_json(summary), allow_nan=False))


def test_an_object_without_a_box_in_the_image_is_not_the_nearest_in_view(some_rooms, task):
    """It can be visible where imported data say so, but nobody sees it."""
    goal = some_rooms.targets.index("Painting")
    shown = some_rooms.row_class == some_rooms.classes.index("Painting")
    per_state = np.bincount(some_rooms.row_state[shown & ~some_rooms.row_visible])
    pose = int(per_state.argmax())
    rows = np.arange(some_rooms.row_start[pose], some_rooms.row_start[pose + 1])[
        shown[some_rooms.row_start[pose] : some_rooms.row_start[pose + 1]]
    ]
    assert len(rows) > 1
    x, z = some_rooms.position[some_rooms.grid.split(pose).position][[0, 2]]
    b = some_rooms.object_box[some_rooms.row_object[rows]]
    away = np.hypot(
        np.maximum(np.maximum(b[:, 0] - x, x - b[:, 3]), 0),
        np.maximum(np.maximum(b[:, 2] - z, z - b[:, 5]), 0),
    )
    hidden = some_rooms.row_box.copy()
    hidden[rows[away.argmin()]] = -1
    tables = dataclasses.replace(some_rooms, row_box=hidden)
    start = Episodes(np.array([pose]), np.array([goal]))
    (failed,) = failures.find([Recorded(start, np.array([DONE]), "seen")], tables, task.eval_params)
    assert failed.missing_metres == pytest.approx(max(np.sort(away)[1] - REACH, 0))


def test_json_holds_every_failure(summary):
    out = json.loads(json.dumps(failures.to_json(summary)))
    assert out["episodes"] == {"seen": 20, "unseen": 5}
    assert out["causes"]["seen"]["done_out_of_reach"] == 5
    assert out["failures"][3]["missing_metres"] == 3.0
    assert len(out["failures"]) == 7


@pytest.mark.parametrize("agent", bundled_agents.names())
def test_the_bundled_agents_fail_as_often_as_their_results_say(ithor, agent):
    run = find_run(agent)
    split = configs.load(run / "config.json").split
    task = task_in(Rooms(ithor, None), dataclasses.replace(TINY, split=split))
    records = read_records(run, task.tables)
    summary = failures.summarise(agent, split, records, task.tables, task.eval_params)
    results = json.loads((run / "results.json").read_text())
    present = [group for group in ("seen", "unseen") if results[group] is not None]
    assert present[0] == "seen"
    for group in present:
        whole = results[group]["L>=1"]
        assert summary.episodes(group=group) == whole["n"]
        assert summary.count(group=group) == round(whole["n"] * (1 - whole["SR"] / 100))
    failed = Counter((f.group, f.target) for f in summary.failures)
    for target, groups in results["by_target"].items():
        for group, buckets in groups.items():
            whole = buckets["L>=1"]
            assert failed[group, target] == round(whole["n"] * (1 - whole["SR"] / 100))
