"""Traces: the same poses, and the same outputs of the network, as when the episode was played."""

from __future__ import annotations

import dataclasses
import json

import jax
import numpy as np
import pytest
from flax import linen as nn

from tdanet_jax.analysis import attention, episode_lookup, replay, trace
from tdanet_jax.analysis.trace import Player
from tdanet_jax.env.params import TEST_STEP_LIMITS, make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.evaluation import episodes, rollout
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.encoder import Encoder
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import camera_view
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.vocabulary import TARGETS, Action
from tests.conftest import TINY, save_untrained
from tests.support import equations, oracle, samples
from tests.support.oracle import Episode, World, pose_of


@pytest.fixture(scope="module")
def player(opinionated_run, some_rooms):
    return trace.load_player(opinionated_run, Rooms(some_rooms, None))


@pytest.fixture(scope="module")
def chosen(some_rooms, player):
    return episodes.draw(some_rooms, player.task.split.eval_scenes, TARGETS, 3, seed=5)


def one(chosen, i):
    return dataclasses.replace(chosen, pose=chosen.pose[i : i + 1], target=chosen.target[i : i + 1])


@pytest.fixture(scope="module")
def triangulating_player(some_rooms, glove, tmp_path_factory):
    """A player with odometry and triangulation, which estimates reach."""
    network = dataclasses.replace(
        TINY.network, odometry=True, triangulation=True, reach_threshold=0.5
    )
    config = dataclasses.replace(TINY, network=network)
    folder = tmp_path_factory.mktemp("runs") / "triangulating"
    save_untrained(config, folder, some_rooms, glove)
    return trace.load_player(folder, Rooms(some_rooms, None))


@pytest.mark.parametrize(
    "who", [pytest.param("player", marks=pytest.mark.slow), "triangulating_player"]
)
def test_sampled_episodes_come_from_the_probabilities_and_the_stream_of_the_evaluation(
    some_rooms, who, chosen, request
):
    """The batch's actions, drawn again from the traces' probabilities with the same keys."""
    player, key = request.getfixturevalue(who), jax.random.key(3)
    sensors = () if who == "player" else ("odometry", "triangulation")
    assert player.model.spec.sensors == sensors
    records = rollout.evaluate(player.policy, player.weights, player.task.eval_params, chosen, key)
    traces = [
        trace.retrace(player, some_rooms, one(chosen, i), records.actions[i, : records.length[i]])
        for i in range(len(chosen))
    ]
    np.testing.assert_array_equal([t.success for t in traces], records.success)
    np.testing.assert_array_equal([t.shortest for t in traces], records.shortest)
    drawn = 0
    for step in range(30):
        alive = [i for i, t in enumerate(traces) if step < len(t.actions)]
        if not alive:
            break
        logits = np.zeros((len(traces), 6))
        with np.errstate(divide="ignore"):  # of Done out of reach
            logits[alive] = np.log([traces[i].probabilities[step] for i in alive])
        again = np.asarray(jax.random.categorical(jax.random.fold_in(key, step), logits))
        np.testing.assert_array_equal(again[alive], [traces[i].actions[step] for i in alive])
        drawn += len(alive)
    assert drawn > 50


def test_a_greedy_player_takes_the_most_probable_action_and_walks_as_the_slow_world_says(
    some_rooms, player, chosen
):
    world = World(some_rooms, {}, TEST_STEP_LIMITS, oracle.walk_on_grid(some_rooms))
    seen = trace.play(dataclasses.replace(player, greedy=True), some_rooms, one(chosen, 4))
    np.testing.assert_array_equal(seen.actions, seen.probabilities.argmax(axis=1))
    assert len(seen.pose) == len(seen.actions) + 1
    episode = Episode(pose_of(int(seen.pose[0])), seen.target)
    for action, pose in zip(seen.actions, seen.pose[1:], strict=True):
        outcome = world.act(episode, int(action))
        assert episode.pose == pose_of(int(pose))
    assert outcome.success == seen.success


def test_attention_and_difference_are_those_of_the_printed_equations(
    some_rooms, player, chosen, opinionated_run, glove
):
    seen = trace.play(player, some_rooms, one(chosen, 0))
    weights = jax.tree.map(lambda x: np.asarray(x, np.float64), player.weights["encoder"])
    words = np.asarray(player.task.words, np.float64)
    target = np.concatenate([equations.TARGET_BOX, words[some_rooms.classes.index(seen.target)]])
    compared = 0
    for step, pose in enumerate(seen.pose[:-1]):
        view = camera_view.of_pose(some_rooms, pose)
        assert seen.attention[step].shape == seen.correspondence[step].shape == (len(view.boxes),)
        if not len(view.boxes):
            continue
        x1, y1, x2, y2 = view.boxes.T
        boxes = np.stack([(x1 + x2) / 2, (y1 + y2) / 2, (x2 - x1) * (y2 - y1)], axis=1)
        rows = np.hstack([boxes, words[[some_rooms.classes.index(name) for name in view.classes]]])
        printed = equations.attention(np, weights, rows, target)
        np.testing.assert_allclose(seen.attention[step], printed, rtol=1e-3, atol=1e-6)
        query = equations.linear(weights["attention"], target)
        inner = equations.linear(weights["attention"], rows) @ query
        np.testing.assert_allclose(seen.correspondence[step], inner, rtol=1e-3, atol=1e-4)

        def branch(row):
            hidden = np.maximum(equations.linear(weights["linear1"], row), 0)
            return np.maximum(equations.linear(weights["linear2"], hidden), 0)

        apart = np.abs(branch(printed @ rows) - branch(target)).mean()
        np.testing.assert_allclose(seen.difference[step], apart, rtol=1e-3, atol=1e-6)
        compared += 1
    assert compared >= 3


def test_the_estimate_of_reach_is_told_where_the_target_is_in_view(
    some_rooms, triangulating_player, chosen
):
    told = 0
    for i in range(6):
        seen = trace.play(triangulating_player, some_rooms, one(chosen, i))
        for pose, probability, actions in zip(
            seen.pose, seen.reach, seen.probabilities, strict=False
        ):
            in_view = seen.target in camera_view.of_pose(some_rooms, pose).classes
            assert np.isfinite(probability) == in_view
            assert (actions[Action.DONE] > 0) == (in_view and probability >= 0.5)
            told += in_view
        page = replay.page([seen], some_rooms)
        assert page.count('"reach":') == np.isfinite(seen.reach).sum()
        assert ":NaN" not in page
    assert told


def test_objects_of_a_class_share_the_weight_of_its_merged_row(some_rooms, player, chosen):
    task = player.task
    spec = ObservationSpec("class")
    merged = make_params(some_rooms, TARGETS, no_parents(some_rooms), TEST_STEP_LIMITS, spec)
    other = dataclasses.replace(player, task=dataclasses.replace(task, eval_params=merged))
    seen = trace.play(other, some_rooms, one(chosen, 1))
    several = 0
    for pose, weights in zip(seen.pose, seen.attention, strict=False):
        names = np.array(camera_view.of_pose(some_rooms, pose).classes)
        total = 0.0
        for name in set(names):
            own = weights[names == name]
            several += len(own) > 1
            assert (own == own[0]).all()
            total += own[0]
        assert total == pytest.approx(1, abs=1e-5) or not len(names)
    assert several


def test_the_shortest_path_has_poses_and_no_outputs(some_rooms, player, chosen):
    best = Player("shortest path", player.task)
    for i in range(0, len(chosen), 3):
        seen = trace.play(best, some_rooms, one(chosen, i))
        assert seen.success
        assert len(seen.actions) == seen.shortest
        assert seen.probabilities is seen.value is seen.attention is seen.difference is None
    assert player.attends
    assert not best.attends


class Blind(Encoder):
    """Knows which target it is to find, and looks at nothing."""

    def prepare(self, words):
        return words

    @nn.compact
    def __call__(self, table, obs, action, dropout_mask=None):
        return self.param("scale", nn.initializers.ones, ()) * table[obs.target]


def test_a_network_without_attention_has_the_rest(some_rooms, player, chosen):
    model = ActorCritic(Blind(), hidden=16)
    weights = samples.parameters(model, player.task.words)
    blind = dataclasses.replace(player, model=model, weights=weights)
    assert not blind.attends
    seen = trace.play(blind, some_rooms, one(chosen, 0))
    assert seen.attention is seen.correspondence is seen.difference is None
    np.testing.assert_allclose(seen.probabilities.sum(axis=1), 1, rtol=1e-5)
    assert np.isfinite(seen.value).all()
    page = replay.page([seen], some_rooms)
    assert '"attends":false' in page
    assert '"attention":' not in page
    with pytest.raises(ValueError, match="no attention"):
        attention.class_pairs(
            model, weights, player.task.words, seen.pose[:1], chosen.target[:1],
            player.task.eval_params, some_rooms.targets, some_rooms.classes,
        )  # fmt: skip


def test_what_has_no_box_is_not_in_view(some_rooms):
    pose = int(np.diff(some_rooms.row_start).argmax())
    boxes = some_rooms.row_box.copy()
    boxes[some_rooms.row_start[pose] + 2] = -1
    with_gap = dataclasses.replace(some_rooms, row_box=boxes)
    whole, gap = camera_view.of_pose(some_rooms, pose), camera_view.of_pose(with_gap, pose)
    assert gap.classes == whole.classes[:2] + whole.classes[3:]
    np.testing.assert_array_equal(gap.boxes, np.delete(whole.boxes, 2, axis=0))


def test_a_recorded_episode_is_shown_as_it_happened(some_rooms, player, opinionated_run):
    outcomes = set()
    rows = [json.loads(row) for row in (opinionated_run / "episodes.jsonl").open()]
    for i, row in enumerate(rows):
        record = episode_lookup.read_record(opinionated_run, i, some_rooms)
        seen = trace.retrace(player, some_rooms, record.episode, record.actions)
        assert seen.success == row["success"]
        np.testing.assert_array_equal(seen.actions, record.actions)
        outcomes.add(seen.outcome.split(",")[0])
    assert len(outcomes) > 1


def test_frames_in_which_an_action_was_chosen(some_rooms, player, chosen):
    params = player.task.eval_params
    records = rollout.evaluate(player.policy, player.weights, params, chosen, jax.random.key(1))
    pose, target = trace.visited(chosen, records, params)
    assert len(pose) == len(target) == records.length.sum()
    first = np.concatenate([[0], np.cumsum(records.length)[:-1]])
    np.testing.assert_array_equal(pose[first], chosen.pose)
    np.testing.assert_array_equal(target, np.repeat(chosen.target, records.length))


def test_outcomes_in_words(some_rooms, player, chosen):
    seen = trace.play(player, some_rooms, one(chosen, 0))
    variants = {
        (True, Action.DONE): "success, 1 action, shortest 2",
        (False, Action.DONE): "failure (Done without the target), 1 action, shortest 2",
        (False, Action.LOOK_UP): "failure (step limit), 1 action, shortest 2",
    }
    for (success, last), words in variants.items():
        made = dataclasses.replace(seen, success=success, actions=np.array([last]), shortest=2)
        assert made.outcome == words


def test_a_folder_without_a_checkpoint_is_refused(some_rooms, tmp_path, opinionated_run):
    with pytest.raises(ValueError, match="is this the folder of a run"):
        trace.load_player(tmp_path, Rooms(some_rooms, None))
    (tmp_path / "config.json").write_text((opinionated_run / "config.json").read_text())
    with pytest.raises(ValueError, match="no checkpoint"):
        trace.load_player(tmp_path, Rooms(some_rooms, None))
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
