"""The example that measures cameras: its boxes are those of a robot with such a camera."""

from __future__ import annotations

import dataclasses
import importlib

import numpy as np
import pytest

from tdanet_jax.agent.camera import Camera
from tdanet_jax.agent.simulated import SimulatedRobot
from tdanet_jax.evaluation.episodes import Episodes
from tests.support.pages import ROOT

SCENE = "FloorPlan7"


@pytest.fixture
def robot_limits(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "examples")
    return importlib.import_module("robot_limits")


@pytest.mark.parametrize("mapped", [False, True])
def test_the_tables_show_what_the_camera_sees(robot_limits, some_rooms, mapped):
    room, camera = some_rooms.subset([SCENE]), Camera(69, 55)
    shown = robot_limits.through(room, 69, 55, mapped)
    count = 0
    for seed in range(9):
        expected = SimulatedRobot(SCENE, camera, seed, room).detect()
        if mapped:
            expected = camera.to_agent(expected)
        found = SimulatedRobot(SCENE, None, seed, shown).detect()
        for one, other in zip(found, expected, strict=True):
            assert one.label == other.label
            boxes = [[*dataclasses.astuple(box)[1:5]] for box in (one, other)]
            np.testing.assert_allclose(*boxes, atol=1 / room.image)
        count += len(found)
    assert count > 100


def test_episodes_begin_as_the_camera_looks(robot_limits, some_rooms):
    grid = some_rooms.grid
    chosen = Episodes(np.array([200, 301], np.int32), np.zeros(2, np.int32))
    lower = robot_limits.looking(some_rooms, chosen, 30)
    assert lower.pose.dtype == np.int32
    for before, after in zip(chosen.pose, lower.pose, strict=True):
        assert grid.split(after) == (*grid.split(before)[:2], 1)
