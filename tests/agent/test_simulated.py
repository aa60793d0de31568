"""A simulated robot moves and sees as the environment does."""

from __future__ import annotations

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.agent.camera import Camera
from tdanet_jax.agent.detection import Detection
from tdanet_jax.agent.simulated import SimulatedRobot
from tdanet_jax.env import dynamics
from tdanet_jax.env.params import TEST_STEP_LIMITS, make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.vocabulary import ACTION_NAMES, TARGETS
from tests.agent.test_agent import detections_of

SCENE = "FloorPlan7"


@pytest.fixture(scope="module")
def room(some_rooms):
    return some_rooms.subset([SCENE])


def test_it_goes_where_the_environment_goes(room):
    params = make_params(room, TARGETS, no_parents(room), TEST_STEP_LIMITS, ObservationSpec())
    move, visible = jax.jit(dynamics.move), jax.jit(dynamics.is_visible)
    robot = SimulatedRobot(SCENE, tables=room)
    bumps, seen = 0, 0
    mug = room.classes.index("Mug")
    for action in np.random.default_rng(0).choice(6, 300, p=[0.5, 0.1, 0.15, 0.1, 0.1, 0.05]):
        before, (ahead, left, yaw) = robot.state, robot.pose
        robot.do(ACTION_NAMES[action])
        assert robot.state == int(move(jnp.int32(before), jnp.int32(action), params))
        assert robot.blocked == (action == 0 and robot.state == before)
        assert robot.sees("mugs") == bool(visible(robot.state, mug, params))
        x, _, z = room.position[room.grid.split(robot.state).position]
        assert robot.pose[:2] == (z, -x)
        if action == 0 and not robot.blocked:  # it moves where it faces
            ahead, left = robot.pose[0] - ahead, robot.pose[1] - left
            assert math.cos(math.atan2(left, ahead) - yaw) == pytest.approx(1)
        bumps, seen = bumps + robot.blocked, seen + robot.sees("mug")
    assert bumps > 5
    assert 0 < seen < 300


def test_it_sees_what_the_tables_say_through_its_camera(room):
    camera = Camera(69, 55)
    wide, narrow = (SimulatedRobot(SCENE, one, 7, room) for one in (None, camera))
    assert wide.state == narrow.state != SimulatedRobot(SCENE, None, 4, room).state
    expected = detections_of(room, wide.state)
    for one, other in zip(wide.detect(), expected, strict=True):
        assert one.label == other.label
        assert (one.x1, one.y1) == pytest.approx((other.x1, other.y1))
    assert 0 < len(narrow.detect()) < len(expected)
    x, y = (math.tan(math.radians(angle / 2)) / 2 for angle in (69, 55))
    clipped = {(d.label, *np.round([max(d.x1, 0.5 - x), max(d.y1, 0.5 - y)], 6)) for d in expected}
    shown = camera.to_agent(narrow.detect())
    assert {(d.label, *np.round([d.x1, d.y1], 6)) for d in shown} <= clipped


def test_the_axis_of_its_camera_need_not_meet_the_middle(room):
    """What it shows is mapped back to where the rooms' camera sees it."""
    camera = Camera(60, 60, centre=(0.4, 0.55))
    shown = camera.to_agent(SimulatedRobot(SCENE, camera, 7, room).detect())
    (whole,) = camera.to_agent([Detection("", 0, 0, 1, 1)])
    seen = detections_of(room, SimulatedRobot(SCENE, None, 7, room).state)
    inside = {(d.label, *np.round([max(d.x1, whole.x1), max(d.y1, whole.y1)], 6)) for d in seen}
    assert len(shown) > 2
    assert {(d.label, *np.round([d.x1, d.y1], 6)) for d in shown} <= inside


def test_it_begins_level_and_along_an_axis(room):
    begun = {room.grid.split(SimulatedRobot(SCENE, None, s, room).state)[1:] for s in range(20)}
    assert begun == {(rotation, room.grid.level) for rotation in (0, 2, 4, 6)}


@pytest.mark.parametrize(
    "camera",
    [Camera(69, 55, horizon=5), Camera(91, 55), Camera(50, 100), Camera(85, 60, centre=(0.6, 0.5))],
)
def test_a_camera_that_the_rooms_cannot_give_is_refused(room, camera):
    with pytest.raises(ValueError, match="simulated robot: its camera must be level and see 90"):
        SimulatedRobot(SCENE, camera, tables=room)


def test_what_is_not_there_is_refused(room):
    with pytest.raises(ValueError, match="action Jump: choose among MoveAhead, RotateLeft"):
        SimulatedRobot(SCENE, tables=room).do("Jump")
    with pytest.raises(ValueError, match="FloorPlan999: no such scene"):
        SimulatedRobot("FloorPlan999", tables=room)
