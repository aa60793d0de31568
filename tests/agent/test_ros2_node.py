"""The example of a ROS 2 node, with modules that stand in for those of ROS."""

from __future__ import annotations

import importlib
import math
import sys
from types import ModuleType
from types import SimpleNamespace as Fields

import pytest

import tdanet_jax
from tests.agent.test_detectors import vision_msgs
from tests.agent.test_navigator import Scripted
from tests.support.pages import ROOT


class Node:
    """Records what is published, and calls who subscribes."""

    parameters = {"names": ["mug", "tv"], "forbid": ["LookUp"], "horizon": 0}  # noqa: RUF012

    def __init__(self, name):
        self.subscribers, self.published, self.log, self.time = {}, [], [], 0

    def declare_parameter(self, name, default, descriptor=None):
        return Fields(value=self.parameters.get(name, default))

    def create_publisher(self, kind, topic, qos):
        assert topic == "action"
        return Fields(publish=lambda message: self.published.append(message.data))

    def create_subscription(self, kind, topic, callback, qos):
        self.subscribers[topic] = callback

    def get_clock(self):
        return Fields(now=lambda: self.time)

    def get_logger(self):
        return Fields(info=self.log.append, error=self.log.append)


@pytest.fixture
def node(monkeypatch, glove):
    """The node, whose agent does some actions; `tell` sends it a message."""
    modules = {
        "rclpy": {},
        "rcl_interfaces.msg": {"ParameterDescriptor": Fields},
        "rclpy.exceptions": {"ParameterException": RuntimeError},
        "rclpy.executors": {"ExternalShutdownException": KeyError},
        "rclpy.node": {"Node": Node},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "rclpy.time": {"Time": Fields(from_msg=lambda stamp: stamp)},
        "nav_msgs.msg": {"Odometry": Fields},
        "sensor_msgs.msg": {"CameraInfo": Fields},
        "std_msgs.msg": {"Empty": Fields, "String": Fields},
        "vision_msgs.msg": {"Detection2DArray": Fields},
    }
    for name, values in modules.items():
        module = ModuleType(name)
        vars(module).update(values)
        monkeypatch.setitem(sys.modules, name.partition(".")[0], ModuleType("ros"))
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(tdanet_jax, "load", lambda run: Scripted(glove, "MoveAhead", "Done"))
    monkeypatch.syspath_prepend(ROOT / "examples")
    monkeypatch.delitem(sys.modules, "ros2_node", raising=False)
    made = importlib.import_module("ros2_node").NavigatorNode()
    made.tell = lambda topic, **fields: made.subscribers[topic](Fields(**fields))
    return made


def frame(stamp):
    return vars(vision_msgs("humble")) | {"header": Fields(stamp=stamp)}


def stand(node, x, y, yaw):
    turn = Fields(x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2))
    node.tell("odom", pose=Fields(pose=Fields(position=Fields(x=x, y=y), orientation=turn)))


def test_an_episode(node):
    focal = [320.0, 0, 320, 0, 320.0, 240, 0, 0, 1]
    node.tell("detections", **frame(0))
    node.tell("target", data="mug")
    assert (node.published, node.log.pop()) == ([], "waiting for camera_info and odom")
    node.tell("camera_info", width=640, height=480, k=focal)
    assert node.log.pop().startswith("sees 90 degrees across and 74 down")
    stand(node, 1.0, 2.0, math.pi / 2)
    node.tell("action_done")
    node.tell("detections", **frame(1))  # nothing to look for
    node.tell("target", data="qwertzu")
    assert "label 'qwertzu': no word vector" in node.log.pop()
    node.time = 5
    node.tell("target", data="mug")
    node.tell("detections", **frame(4))  # from before
    assert node.published == []
    node.tell("detections", **frame(5))
    node.tell("detections", **frame(6))  # while it moves
    assert node.published == ["MoveAhead"]
    assert [d.label for d in node.nav.seen] == ["mug", "tv"]
    assert [d.x1 for d in node.nav.seen] == pytest.approx([0.1, 0.5])
    assert node.agent.calls[0][4] == (3,)
    stand(node, 1.0, 2.25, math.pi / 2)
    node.time = 7
    node.tell("action_done")
    node.names = ["mug"]
    node.tell("detections", **frame(8))
    assert "class 1: is not among the 1 names" in node.log.pop()
    node.names = ["mug", "tv"]
    node.tell("detections", **frame(9))
    assert node.published == ["MoveAhead", "Done"]
    assert node.log == ["mug: done"]
    assert node.agent.calls[1][3] is False  # it was not blocked
    assert node.agent.calls[1][5].place.tolist() == pytest.approx([0, 1], abs=1e-6)
    node.tell("action_done")
    node.tell("detections", **frame(10))
    assert node.published == ["MoveAhead", "Done"]


def test_a_new_target_waits_for_the_action_under_way(node):
    """Else the next frame, taken in motion, would lead to a second action."""
    node.tell("camera_info", width=640, height=480, k=[320.0, 0, 320, 0, 320.0, 240, 0, 0, 1])
    stand(node, 0.0, 0.0, 0.0)
    node.tell("target", data="mug")
    node.tell("detections", **frame(1))
    assert node.published == ["MoveAhead"]
    node.time = 2
    node.tell("target", data="tv")
    node.tell("detections", **frame(3))  # it still moves
    assert node.published == ["MoveAhead"]
    node.time = 4
    node.tell("action_done")
    node.tell("detections", **frame(5))
    assert node.published == ["MoveAhead", "Done"]
    assert node.log[-1] == "tv: done"
    node.tell("target", data="mug")  # no driver need answer Done
    assert node.since == 4


def test_a_wrong_action_is_named_when_the_node_starts(node, monkeypatch):
    monkeypatch.setattr(Node, "parameters", Node.parameters | {"forbid": ["Jump"]})
    with pytest.raises(ValueError, match="--forbid Jump: choose among"):
        sys.modules["ros2_node"].NavigatorNode()


def test_it_ends_without_a_traceback(node, monkeypatch):
    module = sys.modules["ros2_node"]

    def end_with(error):
        def spin(_):
            raise error

        monkeypatch.setattr(module, "rclpy", Fields(init=lambda: None, spin=spin))
        module.main()

    end_with(KeyboardInterrupt())
    end_with(module.ExternalShutdownException())
    with pytest.raises(SystemExit, match="error: no number"):
        end_with(module.ParameterException("no number"))
