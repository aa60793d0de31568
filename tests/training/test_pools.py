"""Rooms that take turns in training: whose turn it is, one program, and going on bit for bit."""

from __future__ import annotations

import dataclasses
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env import dynamics
from tdanet_jax.evaluation import episodes
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.scene import SceneError
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.task import Task, make_task
from tdanet_jax.training import devices, learner, pools
from tdanet_jax.training.callbacks import Callbacks
from tdanet_jax.training.journal import read_metrics
from tdanet_jax.training.pools import Pools
from tdanet_jax.training.run import Run, chunks_together
from tdanet_jax.workflows import train as workflow

#: Eight chunks of two updates of 8 x 5 steps; the rooms change after every two of them.
TINY = TrainConfig(
    steps=640,
    history=0,
    chunk_updates=2,
    pool_updates=4,
    generated=3,
    generated_only=True,
    learner=LearnerConfig(num_envs=8, rollout_steps=5, step_limit=6, noise="mix"),
    network=NetworkConfig(width=16, hidden=16, odometry=True),
)
#: A kitchen, a living room and two bedrooms with ever more in view, and one program for all of
#: them but for what a later one lacks room for.
ROOMS = (("FloorPlan1", "FloorPlan2"), ("FloorPlan201",), ("FloorPlan301",))


def named(tables: SceneTables) -> SceneTables:
    return dataclasses.replace(tables, scenes=tuple(f"{name}-v01" for name in tables.scenes))


def task_of(
    ithor: SceneTables,
    asked: list[int],
    rooms: tuple[tuple[str, ...], ...] = ROOMS,
) -> Task:
    """A task whose pools are some of the bundled rooms; notes which of them are loaded."""
    first, *others = (named(ithor.subset(names)) for names in rooms)

    def further(number: int, tables: SceneTables, progress: Progress) -> SceneTables:
        progress(0.0, 1)
        asked.append(number)
        return tables

    loads = [
        lambda progress, n=n, tables=tables: further(n, tables, progress)
        for n, tables in enumerate(others, start=1)
    ]
    return make_task(TINY, ithor, words.load_bundled(), added=first, further_pools=loads)


#: A run, its turns, the room types it was in, what was loaded, and after how many steps all of its
#: episodes began again.
Whole = tuple[Run, list[int], list[str], list[int], list[int]]


@pytest.fixture(scope="module")
def asked() -> list[int]:
    return []


@pytest.fixture(scope="module")
def task(ithor: SceneTables, asked: list[int]) -> Task:
    return task_of(ithor, asked)


@pytest.fixture(scope="module")
def whole(task: Task, asked: list[int], tmp_path_factory: pytest.TempPathFactory) -> Whole:
    """A run that nothing interrupted."""
    run = Run(tmp_path_factory.mktemp("whole"), TINY, task)
    turns, types, begun, begin_again = [], [], [], run._begin_again

    def counted(*given: Any) -> Any:
        begun.append(run.steps)
        return begin_again(*given)

    run._begin_again = counted
    for _ in run.chunks():
        turns.append(run._turn)
        position = np.asarray(run.state.env_state.pose) // run.pools.params.grid.views
        types.append("".join(map(str, np.unique(run.pools.params.position_room[position]))))
    run.save()
    return run, turns, types, [*asked], begun


def leaves(run: Run) -> list[np.ndarray]:
    plain = run.state.replace(key=jax.random.key_data(run.state.key))
    return [np.asarray(leaf) for leaf in jax.tree.leaves(plain)]


def test_pools_take_turns_and_only_those_that_the_budget_reaches_are_loaded(
    whole: Whole,
) -> None:
    _, turns, types, loaded, begun = whole
    assert turns == [0, 0, 1, 1, 2, 2, 3, 3]
    assert types == ["0", "0", "1", "1", "2", "2", "0", "0"]
    assert loaded == [1, 2]
    assert begun == [160, 320, 480]  # where they change, episodes of the former ones end


@pytest.mark.parametrize(
    "stop", [2, *(pytest.param(stop, marks=pytest.mark.slow) for stop in (1, 3, 4, 6))]
)
def test_a_run_goes_on_bit_for_bit_in_the_rooms_that_it_was_in(
    whole: Whole, task: Task, tmp_path: Path, stop: int
) -> None:
    begun = Run(tmp_path, TINY, task)
    for count, _ in enumerate(begun.chunks(), start=1):
        if count == stop:
            begun.save()
        if count == min(stop + 2, 7):  # what comes after the checkpoint is lost
            break
    again = Run(tmp_path, TINY, task)
    assert again.steps == 80 * stop
    list(again.chunks())
    for ours, theirs in zip(leaves(again), leaves(whole[0]), strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_one_program_serves_pools_that_fit(ithor: SceneTables) -> None:
    """A bedroom with fewer detections fits the program of one with more, not the other way."""
    large, small = "FloorPlan301", "FloorPlan302"
    sizes = {name: len(ithor.subset([name]).row_object) for name in (large, small)}
    if sizes[large] < sizes[small]:
        large, small = small, large
    for first, second, fits in ((large, small, True), (small, large, False)):
        entered = pools_of(task_of(ithor, [], ((first,), (second,))))
        before = entered.shapes
        entered.enter(1)
        assert (entered.shapes == before) == fits
        before = entered.shapes
        entered.enter(2)
        assert entered.shapes == before  # tables never become shorter


def test_padding_changes_nothing(ithor: SceneTables) -> None:
    """Episodes are the same with longer tables, and with noise that copies any detection."""
    task = task_of(ithor, [])
    plain = task.train_params
    longer = plain.padded(task.eval_params.replace(noise=plain.noise)).padded(plain, spare=0.1)
    assert len(longer.row_class) > 1.09 * len(task.eval_params.row_class)
    assert longer.max_detections == task.eval_params.max_detections > plain.max_detections
    assert len(longer.room_pool) == len(plain.room_pool)
    more_rows = longer.replace(noise=None)
    longer = plain.padded(plain, spare=0.5)
    assert longer.max_detections == plain.max_detections

    def walk(params: object) -> list[np.ndarray]:
        def step(state: object, key: jax.Array) -> tuple[object, object]:
            action = jax.random.randint(key, (), 0, 6)
            obs, state, *rest = dynamics.step(key, state, action, params)
            return state, (obs, rest[:3])

        _, state = dynamics.reset(jax.random.key(0), params)
        _, seen = jax.lax.scan(step, state, jax.random.split(jax.random.key(1), 100))
        return jax.tree.leaves(seen)

    walked = jax.jit(walk)
    for ours, theirs in zip(walked(plain), walked(longer), strict=True):
        np.testing.assert_array_equal(ours, theirs)
    for ours, theirs in zip(walked(plain.replace(noise=None)), walked(more_rows), strict=True):
        if ours.ndim > 1 and ours.shape != theirs.shape:  # rows of frames
            assert not theirs[:, ours.shape[1] :].any()
            theirs = theirs[:, : ours.shape[1]]
        np.testing.assert_array_equal(ours, theirs)


def test_nothing_hidden_is_in_further_pools(ithor: SceneTables) -> None:
    task = task_of(ithor, [])
    hidden = [ithor.classes.index(name) for name in task.split.hidden]
    for load in task.further_pools:
        params = load(lambda done, total: None)
        assert not np.isin(np.asarray(params.row_class)[:-1], hidden).any()
        assert params.noise is not None
        assert not np.isin(np.asarray(params.noise.known), hidden).any()
    # They are in these rooms.
    rooms = ithor.subset([name for names in ROOMS[1:] for name in names])
    assert np.isin(rooms.row_class, hidden).any()


@pytest.mark.parametrize(
    "error", [SceneError("no room"), pytest.param(MemoryError("no memory"), marks=pytest.mark.slow)]
)
def test_a_pool_that_cannot_be_built_loses_nothing(
    task: Task, tmp_path: Path, error: Exception
) -> None:
    def load(progress: Progress) -> None:
        raise error

    run = Run(tmp_path, TINY, dataclasses.replace(task, further_pools=(load,)))
    with pytest.raises(type(error), match="no "):
        list(run.chunks())
    assert len(read_metrics(tmp_path)) == 2
    assert run.checkpoints.latest() == 4


def test_if_another_process_has_no_rooms_this_one_stops_as_well(
    task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Run(tmp_path, TINY, task)
    chunks = run.chunks()
    assert next(chunks)
    assert next(chunks)
    monkeypatch.setattr(devices, "anywhere", lambda flag: True)
    with pytest.raises(ValueError, match="another process could not build the next rooms"):
        next(chunks)
    assert run.checkpoints.latest() == 4
    assert run.pools.entered == 0


@pytest.fixture
def slow() -> Iterator[threading.Event]:
    """Set when the rooms may be there."""
    event = threading.Event()
    yield event
    event.set()


def waiting(task: Task, event: threading.Event) -> Task:
    def load(progress: Progress) -> object:
        progress(3.0, 10)
        while not event.wait(0.01):
            progress(4.0, 10)
        return task.train_params.padded(task.train_params, pools.SPARE)

    return dataclasses.replace(task, further_pools=(load,))


class Watching(Callbacks):
    """Stops, or lets the rooms be there, when it has been told of them twice."""

    def __init__(self, event: threading.Event, stop: bool) -> None:
        self.event, self.stop = event, stop
        self.told: list[tuple[float, int]] = []
        self.stopped = False
        self.notes: list[str] = []

    def on_note(self, text: str) -> None:
        self.notes.append(text)

    def on_rooms(self, done: float, total: int) -> None:
        self.told.append((done, total))
        if len(self.told) == 2 and not self.stop:
            self.event.set()

    def should_stop(self) -> bool:
        return self.stop and len(self.told) >= 2

    def on_stop(self) -> None:
        self.stopped = True


@pytest.mark.parametrize(("steps", "unreached"), [(640, 0), (321, 0), (320, 1), (160, 2), (1, 2)])
def test_a_run_says_which_pools_its_budget_leaves_out(
    task: Task, steps: int, unreached: int
) -> None:
    """Turns of 160 steps, in three pools."""
    assert pools_of(task, dataclasses.replace(TINY, steps=steps)).unreached == unreached
    timed = dataclasses.replace(TINY, steps=None, minutes=1.0)
    assert pools_of(task, timed).unreached == 0


@pytest.mark.parametrize("stop", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_run_that_waits_for_rooms_says_so_and_can_be_stopped(
    task: Task, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow: threading.Event, stop: bool
) -> None:
    monkeypatch.setattr(workflow, "SECONDS_OF_WAITING", 0.02)
    slow_task = waiting(task, slow)
    config = TINY
    if stop:  # two further pools, of which the budget reaches one
        slow_task = dataclasses.replace(slow_task, further_pools=slow_task.further_pools * 2)
        config = dataclasses.replace(TINY, steps=320)
    monkeypatch.setattr(workflow, "load_task", lambda *_: slow_task)
    monkeypatch.setattr(workflow, "_report", lambda *_: {})
    monkeypatch.setattr(episodes, "load", lambda *_: {})
    watching = Watching(slow, stop)
    workflow.train(config, tmp_path / "run", callbacks=watching)
    assert len(watching.told) >= 2
    assert {*watching.told} <= {(0.0, 1), (3.0, 10), (4.0, 10)}
    assert watching.notes.count("waiting for the next pool of rooms ...") == 1
    left_out = "note: the budget ends before the turn of 1 of 3 pools of rooms;"
    assert any(note.startswith(left_out) for note in watching.notes) == stop
    assert watching.stopped == stop
    assert len(read_metrics(tmp_path / "run")) == (2 if stop else 8)
    if stop:  # it waits again, and is stopped again
        watching = Watching(slow, stop)
        workflow.train(None, tmp_path / "run", resume=True, callbacks=watching)
        assert watching.stopped
        # Nothing loads on until Python ends, which could crash it.
        assert "rooms" not in [thread.name for thread in threading.enumerate()]
        assert len(read_metrics(tmp_path / "run")) == 2


def test_what_is_loaded_in_the_background_stops_when_the_run_does(
    task: Task, slow: threading.Event, tmp_path: Path
) -> None:
    run = Run(tmp_path, TINY, waiting(task, slow))
    chunks = run.chunks()
    next(chunks)
    assert run.pools._loading is not None
    thread = run.pools._loading._thread
    assert thread.is_alive()
    chunks.close()
    thread.join(10)
    assert not thread.is_alive()


def pools_of(task: Task, config: TrainConfig = TINY) -> Pools:
    return Pools(task, config, devices.everywhere(devices.first()))


def test_turns_are_whole_chunks_and_one_pool_has_no_turns(task: Task) -> None:
    config = dataclasses.replace(TINY, pool_updates=5, chunk_updates=2)
    assert [pools_of(task, config).turn(updates) for updates in (0, 2, 4, 6, 8)] == [0, 0, 1, 1, 2]
    config = dataclasses.replace(TINY, pool_updates=1, chunk_updates=10)
    assert [pools_of(task, config).turn(updates) for updates in (0, 10, 20)] == [0, 1, 2]
    alone = pools_of(dataclasses.replace(task, further_pools=()))
    assert alone.turn(1000) == 0
    assert alone.unreached == 0
    chex.assert_trees_all_equal(alone.params, task.train_params)


def test_keys_of_new_episodes_are_those_of_no_update(
    whole: Whole,
) -> None:
    run = whole[0]
    model, params = run.model, run.pools.params
    begin = jax.jit(lambda state: learner.begin_again(state, TINY.learner, model, params))
    again = begin(run.state)
    other = begin(run.state.replace(updates=run.state.updates + 1))
    assert not np.array_equal(again.env_state.pose, other.env_state.pose)
    key = jax.random.fold_in(run.state.key, run.state.updates)
    update = jax.jit(lambda key: learner._reset(key, params, TINY.learner.num_envs))(key)
    assert not np.array_equal(again.env_state.pose, update.pose)
    assert not again.bootstrap_only.any()
    assert again.recurrent.is_first.all()


def test_targets_of_new_episodes_have_not_been_seen(
    whole: Whole,
) -> None:
    run = whole[0]
    learning = dataclasses.replace(TINY.learner, imitation_weight=0.3)
    state = run.state.replace(target_seen=jnp.ones(learning.num_envs, bool))
    begin = jax.jit(lambda state: learner.begin_again(state, learning, run.model, run.pools.params))
    again = begin(state)
    assert again.target_seen.shape == (learning.num_envs,)
    assert not again.target_seen.any()


def together(folder: Path, task: Task, config: TrainConfig = TINY) -> list[Run]:
    """Two seeds that share their pools, new or continued."""
    runs: list[Run] = []
    for seed in (0, 1):
        path = folder / str(seed)
        path.mkdir(parents=True, exist_ok=True)
        shared = runs[0].pools if runs else None
        runs.append(Run(path, dataclasses.replace(config, seed=seed), task, pools=shared))
    return runs


@pytest.mark.slow
def test_seeds_that_train_together_change_rooms_together(task: Task, tmp_path: Path) -> None:
    runs = together(tmp_path, task, dataclasses.replace(TINY, steps=240))
    turns = [[run._turn for run in runs] for _ in chunks_together(runs)]
    assert turns == [[0, 0], [0, 0], [1, 1]]
    assert not np.array_equal(*(run.state.env_state.pose for run in runs))


@pytest.mark.slow
def test_seeds_that_stop_stop_loading(task: Task, slow: threading.Event, tmp_path: Path) -> None:
    runs = together(tmp_path, waiting(task, slow))
    chunks = chunks_together(runs)
    next(chunks)
    assert runs[0].pools._loading is not None
    thread = runs[0].pools._loading._thread
    chunks.close()
    assert not thread.is_alive()


@pytest.mark.slow
@pytest.mark.parametrize("order", [(0, 1, 2), (2, 0, 1)])
def test_seeds_that_train_together_go_on_bit_for_bit(
    ithor: SceneTables, tmp_path: Path, order: tuple[int, ...]
) -> None:
    """Seeds were saved after so many chunks, or are new: before a change of rooms and after it, or
    (if the second pool has longer frames than the first) on both sides of it. One that catches up
    alone runs another program, which rounds otherwise.
    """
    task = task_of(ithor, [], tuple(ROOMS[i] for i in order))
    whole = together(tmp_path / "whole", task)
    list(chunks_together(whole))
    longer = order[0] == 2
    for saved in [(1, 3), (3, 1), (0, 3), (3, 0)] if longer else [(4, 5)]:
        folder = tmp_path / f"{saved[0]}-{saved[1]}"
        begun = together(folder, task)
        for count, _ in enumerate(chunks_together(begun), start=1):
            for run, at in zip(begun, saved, strict=True):
                if count == at:
                    run.save()
            if count == 6:
                break
        begun = together(folder, task)
        rows = [run.pools.params.max_detections for run in begun]
        assert (rows[0] != rows[1]) == longer
        assert (begun[0].pools is not begun[1].pools) == longer
        widths = [len(rows) for rows in chunks_together(begun)]
        assert widths == [1] * abs(saved[0] - saved[1]) + [2] * (8 - max(saved))
        ahead = saved.index(max(saved))
        for one, other in zip(leaves(whole[ahead]), leaves(begun[ahead]), strict=True):
            np.testing.assert_array_equal(one, other)
        assert [run._turn for run in begun] == [3, 3]
        assert [run.steps for run in begun] == [TINY.steps] * 2
        assert begun[0].pools is begun[1].pools


def test_flags_of_pools_must_be_positive() -> None:
    for name in ("pool_rooms", "pool_updates"):
        with pytest.raises(ValueError, match=f"--{name.replace('_', '-')} 0: must be positive"):
            dataclasses.replace(configs.TrainConfig(), **{name: 0}).check()


def test_a_further_pool_is_as_a_first_one_would_be(ithor: SceneTables, task: Task) -> None:
    alone = task_of(ithor, [], ROOMS[1:2])
    further = task.further_pools[0](lambda done, total: None)
    chex.assert_trees_all_equal(further, alone.train_params)
