"""A robot in one of the rooms, to try a robot's loop without a robot.

robot = SimulatedRobot("FloorPlan228", Camera(hfov=69, vfov=55))
action = nav.step(robot.detect(), blocked=robot.blocked)
robot.do(action)
"""

from __future__ import annotations

import math

import numpy as np

from tdanet_jax.agent import detectors
from tdanet_jax.agent.camera import Camera
from tdanet_jax.agent.detection import Detection
from tdanet_jax.agent.navigator import RobotPose
from tdanet_jax.labels import Labels
from tdanet_jax.scenes import camera_view, dataset
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.vocabulary import ACTION_NAMES, FIELD_OF_VIEW, Action


class SimulatedRobot:
    """Sees, moves and bumps as the room's tables say; its detector makes no mistakes.

    Attributes:
      state: where it is, a state of the scene's tables.
      blocked: whether the last action was a MoveAhead that did not move it.
    """

    def __init__(
        self,
        scene: str,
        camera: Camera | None = None,
        seed: int = 0,
        tables: SceneTables | None = None,
    ) -> None:
        """A robot at a random place, which looks level along an axis of the grid.

        Args:
          scene: such as FloorPlan228.
          camera: its camera; by default that of the rooms.
          seed: draws the place.
          tables: of rooms, with this scene; by default the bundled ones.

        Raises:
          ValueError: there is no such scene; or the camera looks down where it is not tilted, or
            sees more than the rooms' 90 degrees.
        """
        camera = camera or Camera(FIELD_OF_VIEW, FIELD_OF_VIEW)
        view = np.tan(np.radians([camera.hfov / 2, (camera.vfov or 0) / 2]))
        centre = np.array(camera.centre)
        widest = 2 * view * np.maximum(centre, 1 - centre)  # tangents, to the farther side
        if camera.horizon or widest.max() > math.tan(math.radians(FIELD_OF_VIEW / 2)) + 1e-9:
            raise ValueError("simulated robot: its camera must be level and see 90 degrees at most")
        rooms = dataset.load_rooms(None).tables if tables is None else tables
        self._tables = rooms.subset([scene])
        self._labels = Labels(self._tables.classes)
        # Half the image's sides at a depth of 1, and its optical axis, for x1, y1, x2, y2.
        self._view, self._centre = np.tile(view, 2), np.tile(centre, 2)
        grid, rng = self._tables.grid, np.random.default_rng(seed)
        along = math.lcm(grid.turn, 90) // grid.turn  # turns from one axis to the next
        place = rng.integers(len(self._tables.position))
        rotation = along * rng.integers(grid.rotations // along)
        self.state = int(grid.look_level(place, rotation))
        self.blocked = False

    def detect(self) -> list[Detection]:
        """The objects in the image of its camera."""
        view = camera_view.of_pose(self._tables, self.state)
        boxes = self._centre + (view.boxes - 0.5) / self._view
        return detectors.in_image((*one, None) for one in zip(view.classes, boxes, strict=True))

    def do(self, action: str) -> None:
        """Takes an action; `blocked` then says whether it bumped into something.

        Raises:
          ValueError: there is no such action.
        """
        if action not in ACTION_NAMES:
            raise ValueError(f"action {action}: choose among {', '.join(ACTION_NAMES)}")
        grid, number = self._tables.grid, ACTION_NAMES.index(action)
        place, rotation, horizon = (int(part) for part in grid.split(self.state))
        ahead = int(self._tables.next_position[place, rotation])
        self.blocked = number == Action.MOVE_AHEAD and ahead == place
        if number == Action.MOVE_AHEAD:
            place = ahead
        rotation += (number == Action.ROTATE_RIGHT) - (number == Action.ROTATE_LEFT)
        horizon += (number == Action.LOOK_DOWN) - (number == Action.LOOK_UP)
        horizon = min(max(horizon, 0), len(grid.horizons) - 1)
        self.state = int(grid.join(place, rotation % grid.rotations, horizon))

    @property
    def pose(self) -> RobotPose:
        """Its pose as ROS gives it: x and y in metres, yaw in radians counterclockwise from x."""
        pose = self._tables.grid.split(self.state)
        x, _, z = self._tables.position[pose.position]
        return float(z), float(-x), -math.radians(self._tables.grid.turn * pose.rotation)

    def sees(self, target: str) -> bool:
        """Whether a target is in view, within 1.5 m: `Done` here is a success."""
        tables, name = self._tables, self._labels.find(target)
        rows = slice(tables.row_start[self.state], tables.row_start[self.state + 1])
        visible = tables.row_class[rows][tables.row_visible[rows]]
        return name in {tables.classes[cls] for cls in visible}
