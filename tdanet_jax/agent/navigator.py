"""A trained agent in a robot's loop: frames in, names of actions out.

nav = Navigator(tdanet_jax.load("runs/my-run"), Camera(hfov=69, vfov=55))
nav.reset("coffee mug")
while not nav.finished:
    action = nav.step(detect(robot.image()), blocked=robot.is_blocked())
    robot.do(action)
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Literal, get_args

from tdanet_jax.agent import detectors
from tdanet_jax.agent.camera import Camera, turned
from tdanet_jax.agent.detection import Detection
from tdanet_jax.io.escaping import in_line
from tdanet_jax.labels import LabelError
from tdanet_jax.sensors.shared import measured_pose
from tdanet_jax.vocabulary import ACTION_NAMES, FIELD_OF_VIEW, Action

if TYPE_CHECKING:
    from tdanet_jax.agent.base import BaseAgent, Decision
    from tdanet_jax.sensors.shared import MeasuredPose

#: x and y in metres and yaw in radians counterclockwise, as in ROS (REP 103), in any fixed frame.
RobotPose = tuple[float, float, float]
ActionName = Literal["MoveAhead", "RotateLeft", "RotateRight", "LookUp", "LookDown", "Done"]
assert get_args(ActionName) == ACTION_NAMES


@dataclasses.dataclass(frozen=True)
class NavigatorConfig:
    """What a robot can do, what counts as seen, and when it gives up."""

    forbid: tuple[ActionName, ...] = ()
    """Actions that the robot cannot do, such as LookUp and LookDown without a tilting camera."""
    min_score: float = 0.25
    """Detections with a lower score are ignored; those without a score are not."""
    keep_frames: int = 0
    """Frames for which a thing that is detected no longer is kept, as long as the robot stays in
    one place: when it turns or tilts its camera, the box moves along. 0 keeps nothing."""
    max_steps: int = 200
    """Actions after which an episode ends without success."""
    seed: int | None = None
    """Seed of sampled actions, at the agent's temperature; None takes the most probable ones."""

    def check(self) -> None:
        """Raises ValueError, with one line that names the field, if a value is out of range."""
        if isinstance(self.forbid, str):
            raise ValueError(f"--forbid {self.forbid}: give a tuple of names")
        for name in self.forbid:
            if name not in ACTION_NAMES:
                raise ValueError(f"--forbid {name}: choose among {', '.join(ACTION_NAMES)}")
        if {*self.forbid} == {*ACTION_NAMES}:
            raise ValueError("--forbid: every action is forbidden")
        if not 0 <= self.min_score <= 1:
            raise ValueError(f"--min-score {self.min_score}: must be from 0 to 1")
        if self.keep_frames < 0:
            raise ValueError(f"--keep-frames {self.keep_frames}: must not be negative")
        if self.max_steps < 1:
            raise ValueError(f"--max-steps {self.max_steps}: must be positive")
        if self.seed is not None and not 0 <= self.seed < 2**32:
            raise ValueError(f"--seed {self.seed}: must be between 0 and {2**32 - 1}")


class Navigator:
    """One robot that looks for one thing after another.

    Attributes:
      agent: the trained agent.
      camera: the robot's; None for one with 90 degrees in both directions.
      config: what the robot can do, what counts as seen, and when it gives up.
      target: what it looks for; None before the first `reset`.
      steps: actions so far.
      outcome: "done" once the agent has said Done, "step limit" if it never did, else None.
      seen: the detections that the last decision is based on, in the agent's image.
      decision: the last decision; its attention is that on each of `seen`.
    """

    def __init__(
        self,
        agent: BaseAgent,
        camera: Camera | None = None,
        config: NavigatorConfig = NavigatorConfig(),
    ) -> None:
        config.check()
        agent.check_input()
        self.agent = agent
        self.camera = camera or Camera(FIELD_OF_VIEW, FIELD_OF_VIEW)
        self.config = config
        self.target: str | None = None
        self.steps = 0
        self.outcome: str | None = None
        self.seen: list[Detection] = []
        self.decision: Decision | None = None
        self._forbidden = tuple(Action(ACTION_NAMES.index(name)) for name in config.forbid)
        self._unknown: set[str] = set()
        self._drawn = 0
        self._look = agent.grid.level  # index of the horizon that the agent believes in
        self._off = self.camera.horizon  # degrees that the camera looks further down than that

    @property
    def finished(self) -> bool:
        """Whether the episode is over."""
        return self.outcome is not None

    def reset(self, target: str, rotation: float = 0.0, horizon: float | None = None) -> Navigator:
        """Begins to look for something, here and now.

        Args:
          target: what to look for, in English.
          rotation: how the robot faces, in degrees clockwise: 0 unless its steps are to lie on a
            known grid; a multiple of the turns of the agent's grid.
          horizon: degrees that the camera looks down now; by default as it did after the last
            action, or at first as `camera` says.

        Returns:
          This navigator.

        Raises:
          LabelError: the target means nothing known; the message says how to add a word.
          ValueError: the agent's grid has no such rotation, or the horizon is out of range.
        """
        grid = self.agent.grid
        down = self._tilt if horizon is None else horizon
        if not abs(down) < 90:
            raise ValueError(f"horizon {down}: must be between -90 and 90 degrees")
        nearest = min(grid.horizons, key=lambda degrees: abs(degrees - down))
        turn, look = grid.nearest_view(rotation, nearest)
        self.agent.labels.resolve(target)
        self.target, self.steps, self.outcome = target, 0, None
        self.seen, self.decision = [], None
        self._start, self._look, self._off = turn, look, down - nearest
        self._state: Any = None
        self._origin: RobotPose | None = None
        self._before: RobotPose | None = None
        self._kept: list[tuple[Detection, int]] = []  # in the image before the last action; age
        return self

    def step(
        self,
        frame: Any,
        blocked: bool | None = None,
        pose: RobotPose | None = None,
    ) -> ActionName:
        """What to do next.

        Args:
          frame: what is detected now: a list of `Detection`, boxes as shares of the camera's image;
            or an output that `detectors.read` knows without further arguments.
          blocked: whether the last action was a MoveAhead that did not move the robot. If it is not
            given, a measured pose tells it; agents with odometry need one of them.
          pose: where the robot is, measured: in every step of an episode or in none. The agent then
            does not depend on its turns and steps being exact.

        Returns:
          MoveAhead (0.25 m, or 0.35 m on a diagonal of the grid), RotateLeft, RotateRight (45
          degrees), LookUp, LookDown (30 degrees) or Done: the target is in view, within 1.5 m.

        Raises:
          ValueError: there is no episode, or it is over; the frame cannot be read; a pose is
            missing, or not three numbers; or it is not known whether a MoveAhead was blocked. The
            navigator stays as it was.
        """
        if self.target is None or self.finished:
            over = "no episode has begun" if self.target is None else "the episode is over"
            raise ValueError(f"{over}; begin one with reset(target)")
        if self.steps and (pose is None) != (self._origin is None):
            raise ValueError("pose: give one in every step of an episode, or in none")
        measured = None
        if pose is not None:
            measured = self._measure(pose)
            pose = (float(pose[0]), float(pose[1]), float(pose[2]))  # an array is no truth value
        moved, right = self._motion(blocked, pose)
        if blocked is None and pose is not None:
            blocked = not moved
        look, seen = self._now_looking(), self._detected(detectors.read(frame))
        kept = [(found, 0) for found in seen]
        if not moved:
            kept += self._still_there({*map(self._name, seen)}, right, look)
        state = self._state or self.agent.start(
            self.agent.grid.turn * self._start,
            self.agent.grid.horizons[look],
            measured=pose is not None,
        )
        state, decision = self.agent.act(
            state, [found for found, _ in kept], self.target, self._key(), blocked,
            forbidden=self._forbidden, pose=measured,
        )  # fmt: skip
        self._state, self._kept, self._before, self._look = state, kept, pose, look
        self._origin = pose if self._origin is None else self._origin
        self.seen, self.decision = [found for found, _ in kept], decision
        self.steps, self._drawn = self.steps + 1, self._drawn + 1
        if decision.action == Action.DONE:
            self.outcome = "done"
        elif self.steps >= self.config.max_steps:
            self.outcome = "step limit"
        name: ActionName = get_args(ActionName)[decision.action]
        return name

    def _measure(self, pose: RobotPose) -> MeasuredPose:
        """A robot's pose in the axes of the agent's odometry."""
        try:
            known = len(pose) == 3 and all(map(math.isfinite, pose))
        except TypeError:
            known = False
        if not known:
            raise ValueError(f"pose {in_line(pose)}: must be x, y and yaw, three finite numbers")
        x, y, yaw = pose if self._origin is None else self._origin
        ahead = (pose[0] - x) * math.cos(yaw) + (pose[1] - y) * math.sin(yaw)
        left = (pose[1] - y) * math.cos(yaw) - (pose[0] - x) * math.sin(yaw)
        degrees = -math.degrees(pose[2] - yaw)
        return measured_pose(self.agent.grid, self._start, ahead, -left, degrees)

    def _motion(self, blocked: bool | None, pose: RobotPose | None) -> tuple[bool, float]:
        """Whether the last action moved the robot, and by how many degrees it turned it right."""
        last, grid = self._last(), self.agent.grid
        if pose is not None and self._before is not None:
            far = math.dist(pose[:2], self._before[:2]) > grid.grid_size / 2
            return far, -math.degrees(pose[2] - self._before[2])
        turns = (last == Action.ROTATE_RIGHT) - (last == Action.ROTATE_LEFT)
        return last == Action.MOVE_AHEAD and not blocked, float(grid.turn * turns)

    def _last(self) -> Action | None:
        return None if self.decision is None else self.decision.action

    @property
    def _tilt(self) -> float:
        """Degrees that the camera looks down after the last action."""
        return self.agent.grid.horizons[self._now_looking()] + self._off

    def _now_looking(self) -> int:
        """The index of the horizon after the last action."""
        lower = (self._last() == Action.LOOK_DOWN) - (self._last() == Action.LOOK_UP)
        return min(max(self._look + lower, 0), len(self.agent.grid.horizons) - 1)

    def _detected(self, frame: Sequence[Detection]) -> list[Detection]:
        """What counts of a frame, in the agent's image."""
        known = []
        for found in frame:
            unlikely = found.score is not None and found.score < self.config.min_score
            if not unlikely and self._name(found) is not None:
                known.append(found)
        return self.camera.to_agent(known, self.camera.horizon - self._off)

    def _name(self, found: Detection) -> str | None:
        """What a detection is; None, with one warning for each label, if that is unknown."""
        try:
            return self.agent.labels.resolve(found.label)
        except LabelError as error:
            if found.label not in self._unknown:
                self._unknown.add(found.label)
                warnings.warn(f"detections are ignored: {error}", stacklevel=4)
            return None

    def _still_there(
        self, names: set[str | None], right: float, look: int
    ) -> list[tuple[Detection, int]]:
        """What was seen before and is kept, with its age: things with other names."""
        horizons = self.agent.grid.horizons
        out = []
        for found, age in self._kept:
            if age < self.config.keep_frames and self._name(found) not in names:
                now = turned(found, right, horizons[look], horizons[self._look])
                if now is not None:
                    out.append((now, age + 1))
        return out

    def _key(self) -> Any:
        """The key of the next action, if actions are sampled."""
        return None if self.config.seed is None else self.agent.key(self.config.seed, self._drawn)
