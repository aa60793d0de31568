"""The parts of paths, against a plain walk through the rooms."""

from __future__ import annotations

import numpy as np
import pytest

from tdanet_jax.analysis import failures, paths
from tdanet_jax.analysis.episode_lookup import Recorded
from tdanet_jax.evaluation import episodes
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.task import Task, make_task
from tdanet_jax.vocabulary import ACTION_NAMES
from tests.conftest import SOME_ROOMS, TINY
from tests.support.oracle import World

DONE = ACTION_NAMES.index("Done")


@pytest.fixture(scope="module")
def task(some_rooms, glove) -> Task:
    return make_task(TINY, some_rooms, glove)


@pytest.fixture(scope="module")
def world(some_rooms) -> World:
    return World(some_rooms, {}, (100,) * 4)


@pytest.fixture(scope="module")
def records(task: Task, world: World) -> list[Recorded]:
    """Wandering, then the shortest way, and turning on the spot; some give up before Done."""
    rng, found = np.random.default_rng(0), []
    drawn = episodes.draw(task.tables, SOME_ROOMS, task.split.seen, 60, seed=1)
    for pose, target in zip(drawn.pose, drawn.target, strict=True):
        name, here = task.tables.targets[target], world.pose_of(int(pose))
        actions = [int(a) for a in rng.choice(DONE, int(rng.integers(0, 8)))]
        for action in actions:
            here = world.moved(here, action)
        while (action := world.best_action(here, name)) != DONE:
            actions.append(action)
            here = world.moved(here, action)
        actions += [1, 2] * int(rng.integers(0, 3))
        if rng.random() < 0.8:
            actions.append(DONE)
        actions = actions or [0]
        found.append(
            Recorded(Episodes(np.array([pose]), np.array([target])), np.array(actions), "seen")
        )
    return found


def test_the_parts_are_those_of_a_plain_walk(
    task: Task, world: World, records: list[Recorded]
) -> None:
    each, more, won = [], [], []
    for record in records:
        name = task.tables.targets[int(record.episode.target[0])]
        here = world.pose_of(int(record.episode.pose[0]))
        least, counts = world.distance(world.state_of(here), name), {"view": None, "reach": None}
        for count, action in enumerate(record.actions):
            state = world.state_of(here)
            view = name in {d.name for d in world.detections(state, merge=False)}
            reach = name in world.visible(state)
            if counts["view"] is None and (view or reach):
                counts["view"], left = count, world.distance(state, name)
            if counts["reach"] is None and reach:
                counts["reach"] = count
            here = world.moved(here, int(action))
        if record.actions[-1] != DONE or name not in world.visible(world.state_of(here)):
            continue
        seen, reached, taken = counts["view"], counts["reach"], len(record.actions)
        each.append((seen, reached - seen, taken - 1 - reached))
        more.append((seen - (least - left), reached - seen - left, taken - 1 - reached))
        won.append((least + 1, taken))
    found = paths.parts(list(paths.follow(records, task.tables, task.eval_params)))
    assert found is not None
    assert 20 < found.successes == len(won) < len(records)
    np.testing.assert_allclose(found.actions, np.mean(each, axis=0))
    np.testing.assert_allclose(found.excess, np.mean(more, axis=0))
    assert (np.mean(more, axis=0) > 0.05).sum() >= 2
    shortest, taken = np.array(won).T
    assert found.excess.sum() == pytest.approx((taken - shortest).mean())
    assert found.spl == pytest.approx(100 * (shortest / taken).sum() / len(records))
    for part, excess in enumerate(np.array(more).T):
        spl = 100 * (shortest / (taken - excess)).sum() / len(records)
        assert found.spl_without[part] == pytest.approx(spl)


def test_a_group_without_a_success_has_no_parts(task: Task, records: list[Recorded]) -> None:
    gave_up = [record for record in records if record.actions[-1] != DONE]
    assert gave_up
    assert paths.parts(list(paths.follow(gave_up, task.tables, task.eval_params))) is None
    summary = failures.summarise("A", "18/4", gave_up, task.tables, task.eval_params)
    assert summary.parts == {}


def test_the_page_and_the_file_say_what_the_parts_are(task: Task, records: list[Recorded]) -> None:
    summary = failures.summarise("A", "18/4", records, task.tables, task.eval_params)
    parts = summary.parts["seen"]
    text = failures.markdown(summary, "failures.png", {})
    told = failures.to_json(summary)["paths"]["seen"]
    assert told["successes"] == parts.successes
    for i, name in enumerate(paths.PARTS):
        values = (parts.actions[i], parts.excess[i], parts.spl_without[i])
        row = [line for line in text.splitlines() if line.startswith(f"| {name}: ")]
        assert row[0].split(" | ")[1:] == [
            "seen",
            *(f"{v:.1f}" for v in values[:2]),
            f"{values[2]:.1f} |",
        ]
        assert [*told[name].values()] == [pytest.approx(v, abs=0.006) for v in values]
