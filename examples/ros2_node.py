"""A ROS 2 node that looks for what it is told to: detections and odometry in, actions out.

    python examples/ros2_node.py --ros-args -p agent:=agents/18-4-best -p horizon:=0.0

| Topic | Type | |
|---|---|---|
| `target` | `std_msgs/String` | what to look for; begins an episode |
| `detections` | `vision_msgs/Detection2DArray` | of the robot's detector |
| `camera_info` | `sensor_msgs/CameraInfo` | of the camera that the detector looks through |
| `odom` | `nav_msgs/Odometry` | where the robot is |
| `action_done` | `std_msgs/Empty` | the last action has ended, even if something was in the way |
| `action` | `std_msgs/String` | published: MoveAhead, RotateLeft, ... or Done |

The robot's driver subscribes to `action` and publishes `action_done`. The node decides from the
first frame that was taken after that.
"""

from __future__ import annotations

import math

import rclpy
from nav_msgs.msg import Odometry
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from rclpy.time import Time
from sensor_msgs.msg import CameraInfo
from std_msgs.msg import Empty, String
from vision_msgs.msg import Detection2DArray

import tdanet_jax
from tdanet_jax import Camera, Navigator, NavigatorConfig
from tdanet_jax.agent import detectors
from tdanet_jax.labels import LabelError


class NavigatorNode(Node):
    """Publishes the next action once the last one is done and something new was seen."""

    def __init__(self) -> None:
        super().__init__("navigator")
        self.agent = tdanet_jax.load(self.declare_parameter("agent", "agents/18-4-best").value)
        #: Degrees that the camera looks down.
        number = ParameterDescriptor(dynamic_typing=True)  # 30 or 30.0
        self.horizon = float(self.declare_parameter("horizon", 0.0, number).value)
        #: What the robot can do: without the actions in `forbid`.
        forbid = self.declare_parameter("forbid", [""]).value
        self.config = NavigatorConfig(forbid=tuple(filter(None, forbid)))
        self.config.check()
        #: What class_id means where it is a number.
        self.names = [*filter(None, self.declare_parameter("names", [""]).value)] or None
        self.nav: Navigator | None = None
        self.info = self.pose = None
        self.moving = False  # whether an action is under way
        self.since: Time | None = None  # when the last action ended; None while one is under way
        self.actions = self.create_publisher(String, "action", 10)
        self.create_subscription(String, "target", self.on_target, 10)
        self.create_subscription(Empty, "action_done", self.on_action_done, 10)
        for kind, topic, callback in (
            (CameraInfo, "camera_info", self.on_camera_info),
            (Odometry, "odom", self.on_odom),
            (Detection2DArray, "detections", self.on_detections),
        ):
            self.create_subscription(kind, topic, callback, qos_profile_sensor_data)

    def on_camera_info(self, info: CameraInfo) -> None:
        """Takes the camera from the first message."""
        if self.nav is None:
            camera = Camera.from_camera_info(info, horizon=self.horizon)
            self.info = info
            self.nav = Navigator(self.agent, camera, self.config)
            self.get_logger().info("; ".join(camera.limits()))

    def on_odom(self, odometry: Odometry) -> None:
        """Remembers where the robot is."""
        place, q = odometry.pose.pose.position, odometry.pose.pose.orientation
        yaw = math.atan2(2 * (q.w * q.z + q.x * q.y), 1 - 2 * (q.y**2 + q.z**2))
        self.pose = place.x, place.y, yaw

    def on_target(self, target: String) -> None:
        """Begins to look for something."""
        if self.nav is None or self.pose is None:
            self.get_logger().error("waiting for camera_info and odom")
            return
        try:
            self.nav.reset(target.data)
        except LabelError as error:
            self.get_logger().error(str(error))
            return
        self.since = None if self.moving else self.get_clock().now()

    def on_action_done(self, _: Empty) -> None:
        """From now on, frames show what the action has led to."""
        self.moving = False
        if self.nav is not None and self.nav.target and not self.nav.finished:
            self.since = self.get_clock().now()

    def on_detections(self, message: Detection2DArray) -> None:
        """Decides, if an action has ended before this frame was taken."""
        if self.since is None or Time.from_msg(message.header.stamp) < self.since:
            return
        try:
            seen = detectors.read(message, self.info, self.names)
            action = self.nav.step(seen, pose=self.pose)
        except ValueError as error:
            self.get_logger().error(str(error))
            return
        self.since, self.moving = None, action != "Done"
        self.actions.publish(String(data=action))
        if self.nav.finished:
            self.get_logger().info(f"{self.nav.target}: {self.nav.outcome}")


def main() -> None:
    """Runs the node until it is stopped."""
    rclpy.init()
    try:
        rclpy.spin(NavigatorNode())
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except (ValueError, ParameterException) as error:  # no such agent, an uncalibrated camera
        raise SystemExit(f"error: {error}") from None


if __name__ == "__main__":
    main()
