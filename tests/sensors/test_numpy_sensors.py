"""The sensors in NumPy say what those in JAX say, on walks that meet every case."""

from __future__ import annotations

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import PoseGrid
from tdanet_jax.sensors import numpy_sensors, suite
from tdanet_jax.sensors.sensor import NO_SLIP, Frame, Motion, Start
from tdanet_jax.sensors.shared import measured_pose
from tdanet_jax.vocabulary import Action

BOTH = ObservationSpec(sensors=("odometry", "triangulation"))
ROBUST = ObservationSpec(sensors=("odometry", "robust-triangulation"))
THIRTY = dataclasses.replace(BOTH, grid=PoseGrid(0.4, 12, (-30, 0, 45)))
ALONE = ObservationSpec(sensors=("odometry",))
ROWS, STEPS = 4, 60


@functools.partial(jax.jit, static_argnums=0)
def step(spec, states, motion, changed, frame):
    states = suite.update(spec, states, motion)
    states = suite.observe(spec, suite.clear(spec, states, changed), frame)
    return states, suite.features(spec, suite.read(spec, states))


def draw_frame(rng, target):
    """Up to four boxes, of which some are the target's; often none is."""
    count = rng.integers(0, ROWS + 1)
    boxes = np.zeros((ROWS, 3))
    boxes[:count] = rng.uniform(0.1, 0.9, (count, 3)) * (1, 1, 0.1)
    classes = rng.integers(0, 3, ROWS) if rng.random() < 0.6 else np.full(ROWS, 9)
    mask = np.arange(ROWS) < count
    return Frame(np.where(mask, classes, 0), boxes, mask, np.int32(target))


@pytest.mark.parametrize("measured", [False, True])
@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(BOTH, id="ithor"),
        pytest.param(ROBUST, id="robust"),
        pytest.param(THIRTY, id="30-degrees", marks=pytest.mark.slow),
        pytest.param(ALONE, id="odometry", marks=pytest.mark.slow),
    ],
)
def test_they_say_what_those_in_jax_say(spec, measured):
    """In float64: in float32, nearly parallel rays leave few digits of the estimate."""
    rng, grid = np.random.default_rng(1), spec.grid
    rotation, horizon = 5, grid.level
    with jax.enable_x64():
        start = Start(jnp.int32(rotation), jnp.int32(horizon), NO_SLIP if measured else None)
        theirs = suite.init(spec, start)
        ours = numpy_sensors.init(spec, rotation, horizon, measured)
        action, target, place, seen = 6, 0, np.zeros(3), set()
        for number in range(STEPS):
            before = target
            target = number // 25  # two changes
            blocked = bool(action == Action.MOVE_AHEAD and rng.random() < 0.3)
            pose = measured_pose(grid, rotation, *place) if measured else None
            frame = draw_frame(rng, target)
            boxes = frame.boxes[frame.mask & (frame.classes == target)]
            changed = target != before
            motion = Motion(jnp.int32(action), jnp.asarray(blocked), measured=pose)
            theirs, expected = step(spec, theirs, motion, jnp.asarray(changed), frame)
            ours = numpy_sensors.after(spec, ours, action, blocked, pose, changed, boxes)
            found = numpy_sensors.features(spec, ours)
            assert found.dtype == np.float32
            np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)
            seen.add((action, blocked))
            action = int(rng.choice(5, p=(0.6, 0.12, 0.12, 0.08, 0.08)))
            place = place + rng.normal(size=3) * (0.2, 0.2, 20)
        assert len(seen) == 7  # every action, blocked and not, and none
    assert len(found) == sum(numpy_sensors.WIDTHS[name] for name in spec.sensors)
    assert len(found) == suite.width(spec)


def test_a_step_leaves_the_states_before_it_as_they_were():
    states = numpy_sensors.init(BOTH, 0, 0, False)
    cells = states["odometry"].cells.copy()
    boxes = np.array([[0.4, 0.4, 0.1]])
    after = numpy_sensors.after(BOTH, states, Action.MOVE_AHEAD, False, None, False, boxes)
    assert after["odometry"].cells[0, 1] == 1
    np.testing.assert_array_equal(states["odometry"].cells, cells)
    assert not states["triangulation"].normal.any()


@pytest.mark.parametrize("spec", [BOTH, ROBUST])
def test_an_agent_whose_measured_pose_wavers_has_not_moved(spec):
    """It turns in one place, and its bearings err by degrees: further rays do not count."""
    rng = np.random.default_rng(0)
    theirs = suite.init(spec, Start(jnp.int32(0), jnp.int32(0), NO_SLIP))
    ours, said = numpy_sensors.init(spec, 0, 0, True), []
    for number in range(7):
        turned = 22.5 * (number > 0) * (-1) ** number  # to and fro, the target always in view
        action = (6, Action.ROTATE_LEFT, Action.ROTATE_RIGHT)[(number > 0) * (1 + number % 2)]
        pose = measured_pose(spec.grid, 0, *rng.normal(scale=0.002, size=2), turned)
        right = -np.tan(np.radians(turned)) / 2 + rng.normal(scale=0.03)
        boxes = np.array([[0.5 + right, 0.5, 0.01]])
        frame = Frame(np.zeros(1, int), boxes, np.ones(1, bool), np.int32(0))
        motion = Motion(jnp.int32(action), jnp.array(False), measured=pose)
        theirs, features = step(spec, theirs, motion, jnp.array(False), frame)
        ours = numpy_sensors.after(spec, ours, action, False, pose, False, boxes)
        found = numpy_sensors.features(spec, ours)
        said += [found[-5], features[-5]]  # the certainty
    np.testing.assert_allclose(said, said[0], rtol=1e-3)
    assert np.linalg.norm(found[-9:-6]) == pytest.approx(1.5 / 4, rel=0.01)  # as after the first
