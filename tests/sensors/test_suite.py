"""Sensors run together, and custom ones in environment, network and training."""

from __future__ import annotations

import sys
import types
from collections.abc import Mapping
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sensors import suite
from tdanet_jax.sensors.sensor import Frame, Motion, Sensor, Start
from tdanet_jax.task import make_task
from tdanet_jax.training import learner
from tdanet_jax.words import WordVectors
from tests.support import step_counter
from tests.support.oracle import MOVE_AHEAD, ROOMS

CUSTOM = ObservationSpec(sensors=("odometry", step_counter.NAME))
START = Start(jnp.int32(3), jnp.int32(1))
FRAME = Frame(jnp.array([2, 5]), jnp.zeros((2, 3)), jnp.array([True, False]), jnp.int32(2))


class Log(Sensor):
    """Its state is the tuple of what happened to it; each entry tells what it saw of the others."""

    def __init__(self, name: str, width: int = 1) -> None:
        self.name, self.width = name, width

    def init(self, start: Start) -> Any:
        return (("init",),)

    def update(self, state: Any, motion: Motion, others: Mapping[str, Any]) -> Any:
        return (*state, ("update", dict(others)))

    def observe(self, state: Any, frame: Frame, others: Mapping[str, Any]) -> Any:
        return (*state, ("observe", dict(others)))

    def clear(self, state: Any, changed: Any) -> Any:
        return (*state, ("clear", changed))

    def read(self, state: Any, others: Mapping[str, Any]) -> Any:
        return self.name, {name: others[name] for name in others if name != self.name}

    def features(self, reading: Any) -> jax.Array:
        return jnp.full(self.width, reading)


@pytest.fixture
def custom(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Makes a sensor importable under a name; its module has the given attributes."""

    def add(name: str, **attributes: Any) -> None:
        monkeypatch.setitem(sys.modules, name, types.ModuleType(name))
        for key, value in attributes.items():
            setattr(sys.modules[name], key, value)

    return add


def test_sensors_run_in_order_and_see_those_before_them_as_they_are_then(custom: Any) -> None:
    # The order is the spec's, not that of the alphabet.
    custom("order.z", make=lambda: Log("z"))
    custom("order.a", make=lambda: Log("a", width=2))
    spec = ObservationSpec(sensors=("order.z", "order.a"))
    states = suite.init(spec, START)
    assert list(states) == ["order.z", "order.a"]
    motion = Motion(jnp.int32(0), jnp.array(False))
    for name, call, what in (("update", suite.update, motion), ("observe", suite.observe, FRAME)):
        states = call(spec, states, what)
        assert list(states) == ["order.z", "order.a"]
        assert states["order.z"][-1] == (name, {})
        assert states["order.a"][-1] == (name, {"order.z": states["order.z"]})
    states = suite.clear(spec, states, True)
    assert [state[-1] for state in states.values()] == [("clear", True)] * 2
    readings = suite.read(spec, states)
    assert readings["order.a"][1]["order.z"] == states["order.z"]
    features = suite.features(spec, {"order.a": 7.0, "order.z": 5.0})
    assert features.tolist() == [5.0, 7.0, 7.0]
    assert suite.width(spec) == 3


def test_without_sensors_there_are_no_states_and_readings() -> None:
    spec = ObservationSpec()
    states = suite.init(spec, START)
    states = suite.observe(spec, suite.update(spec, states, Motion(0, False)), FRAME)  # type: ignore[arg-type]
    states = suite.clear(spec, states, jnp.array(True))
    assert states == suite.read(spec, states) == suite.blank(spec, 3) == {}
    assert suite.width(spec) == 0


def test_what_a_sensor_does_not_define_changes_nothing(custom: Any) -> None:
    class Direction(Sensor):
        width = 1

        def init(self, start: Start) -> Any:
            return start.rotation[..., None].astype(jnp.float32)

    custom("my_lab.direction", make=Direction)
    spec = ObservationSpec(sensors=("my_lab.direction",))
    states = suite.init(spec, START)
    after = suite.update(spec, states, Motion(jnp.int32(2), jnp.array(False)))
    after = suite.clear(spec, suite.observe(spec, after, FRAME), jnp.array(True))
    chex.assert_trees_all_equal(after, states)
    assert suite.features(spec, suite.read(spec, after)).tolist() == [3.0]
    assert suite.blank(spec, 2)["my_lab.direction"].tolist() == [[0.0], [0.0]]


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (("no_such.module",), "--sensors no_such.module: No module named 'no_such'"),
        ((".relative",), "--sensors .relative: "),
        (("json.decoder",), "--sensors json.decoder: the module has no function `make`"),
        (("my_lab.wrong",), "--sensors my_lab.wrong: `make` gives no Sensor"),
        ((step_counter.NAME,), f"--sensors {step_counter.NAME}: needs odometry before it"),
        (
            (step_counter.NAME, "odometry"),
            f"--sensors {step_counter.NAME}: needs odometry before it",
        ),
        (("triangulation", "odometry"), "--sensors triangulation: needs odometry before it"),
    ],
)
def test_a_sensor_that_cannot_be_made_is_one_clear_error(
    custom: Any, names: tuple[str, ...], message: str
) -> None:
    custom("my_lab.wrong", make=lambda: "no sensor")
    with pytest.raises(ValueError, match=f"^{message.replace('.', '[.]')}") as caught:
        suite.make(ObservationSpec(sensors=names))
    assert "\n" not in str(caught.value)


def counted(start_pose: int, actions: list[int], seen: list[bool], cells: Any) -> list[dict]:
    """The readings of the custom sensor at the start and after each action, by plain counting."""
    out = [{"actions": 0, "frames": int(seen[0]), "path": 0, "rotation": start_pose // 2 % 8}]
    for t in range(len(actions)):
        before = out[-1]
        path = before["path"] + abs(int(cells[t + 1][0])) + abs(int(cells[t + 1][1]))
        frames = before["frames"] + int(seen[t + 1])
        out.append({**before, "actions": t + 1, "frames": frames, "path": path})
    return out


def test_a_custom_sensor_runs_in_the_environment(some_rooms: SceneTables) -> None:
    """Compiled, in a batch and through automatic resets, as counted one by one."""
    targets = dict.fromkeys(ROOMS, some_rooms.targets)
    nobody = no_parents(some_rooms)
    params = make_params(some_rooms, targets, nobody, (5,) * 4, CUSTOM)
    batch, steps, rng = 16, 12, np.random.default_rng(0)
    reset = jax.jit(jax.vmap(dynamics.reset, (0, None)))
    step = jax.jit(jax.vmap(dynamics.step, (0, 0, 0, None)))
    obs, state = reset(jax.random.split(jax.random.key(0), batch), params)
    episodes: list[list[tuple]] = [[] for _ in range(batch)]  # pose, action, seen, cell
    taken = np.full(batch, -1)
    for t in range(steps):
        readings = obs.sensors[step_counter.NAME]
        seen = np.asarray(obs.mask & (obs.classes == obs.target[:, None])).any(axis=1)
        for b in range(batch):
            if int(state.steps[b]) == 0:
                episodes[b] = []
            cell = np.asarray(state.sensors["odometry"].cell[b])
            episodes[b].append((int(state.pose[b]), int(taken[b]), bool(seen[b]), cell))
            poses, actions, views, cells = zip(*episodes[b], strict=True)
            expected = counted(poses[0], list(actions[1:]), list(views), cells)[-1]
            assert {name: int(value[b]) for name, value in readings.items()} == expected
        taken = rng.choice(5, batch, p=[0.6, 0.1, 0.2, 0.05, 0.05])
        keys = jax.random.split(jax.random.fold_in(jax.random.key(1), t), batch)
        obs, state, *_ = step(keys, state, jnp.asarray(taken), params)
    one = jax.tree.map(lambda x: x[0], state)
    action = jnp.int32(MOVE_AHEAD)
    chex.assert_trees_all_equal(
        jax.jit(dynamics.transition)(one, action, params), dynamics.transition(one, action, params)
    )


def task_with(some_rooms: SceneTables, glove: WordVectors, *names: str, odometry: bool) -> Any:
    network = NetworkConfig(
        width=8, hidden=6, precision="float32", odometry=odometry, sensors=names
    )
    learning = LearnerConfig(num_envs=8, rollout_steps=6, step_limit=4)
    config = TrainConfig(network=network, learner=learning)
    config.check()
    return config, make_task(config, some_rooms, glove)


@pytest.mark.slow
def test_a_custom_sensor_is_trained_with(some_rooms: SceneTables, glove: WordVectors) -> None:
    config, task = task_with(some_rooms, glove, step_counter.NAME, odometry=True)
    assert task.spec.sensors == ("odometry", step_counter.NAME)
    assert task.train_params.spec == task.eval_params.spec == task.spec
    known = task.train_words, task.train_params
    state = learner.init(jax.random.key(0), config.learner, task.model, *known)
    before = np.asarray(state.params["way"]["kernel"])
    assert before.shape[0] == 741 + 4
    _, steps, _ = learner.rollout(state, jax.random.key(1), config.learner, task.model, *known)
    counts = jax.device_get(steps.obs.sensors[step_counter.NAME])
    assert not counts["actions"][0].any()
    for t in range(1, config.learner.rollout_steps):
        expected = np.where(steps.is_first[t], 0, counts["actions"][t - 1] + 1)
        np.testing.assert_array_equal(counts["actions"][t], expected)
    assert counts["actions"].max() == 4
    assert counts["frames"].max() > 0
    chunk = learner.make_train(config.learner, task.model, 2)
    state, metrics = chunk(state, jnp.zeros(2), *known)
    assert int(state.skipped) == 0
    chex.assert_tree_all_finite((state.params, metrics))
    change = np.abs(np.asarray(state.params["way"]["kernel"]) - before)
    assert (change[-4:].max(axis=1) > 0).all(), "every feature of the sensor should be learnt from"


@pytest.mark.parametrize(
    ("names", "odometry", "message"),
    [
        (("no_such.module",), False, "--sensors no_such.module: No module named"),
        ((step_counter.NAME,), False, "needs odometry before it"),
        (("json.decoder",), True, "--sensors json.decoder: the module has no function `make`"),
    ],
)
def test_a_task_with_a_sensor_that_cannot_be_made_is_refused_at_once(
    some_rooms: SceneTables,
    glove: WordVectors,
    names: tuple[str, ...],
    odometry: bool,
    message: str,
) -> None:
    with pytest.raises(ValueError, match=message):
        task_with(some_rooms, glove, *names, odometry=odometry)
