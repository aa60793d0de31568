"""A robot's loop: what the agent is shown, what it is told of its motion, and when it ends."""

from __future__ import annotations

import math
import warnings
from types import SimpleNamespace as Fields

import jax
import numpy as np
import pytest

from tdanet_jax.agent.base import Decision
from tdanet_jax.agent.camera import Camera
from tdanet_jax.agent.detection import Detection
from tdanet_jax.agent.navigator import Navigator, NavigatorConfig
from tdanet_jax.config import NetworkConfig
from tdanet_jax.labels import LabelError, Labels
from tdanet_jax.poses import ITHOR
from tdanet_jax.vocabulary import ACTION_NAMES, Action
from tests.agent.test_agent import moving_by_odometry

MUG, SINK = Detection("mug", 0.4, 0.4, 0.6, 0.6, 0.9), Detection("sink", 0.0, 0.5, 0.2, 0.7)
SINK_BOX = (0.0, 0.5, 0.2, 0.7)


class Scripted:
    """An agent that does what it is told, and remembers what it was shown."""

    grid = ITHOR

    def __init__(self, glove, *actions):
        self.labels = Labels((), glove.index)
        self.actions, self.calls, self.starts = [*actions], [], []

    def start(self, rotation, horizon, measured):
        self.starts.append((rotation, horizon, measured))
        return "a state"

    def check_input(self):
        pass

    def key(self, seed, step):
        return seed, step

    def act(self, state, detections, target, key=None, blocked=None, *, forbidden=(), pose=None):
        self.calls.append((detections, target, key, blocked, forbidden, pose))
        action = Action(ACTION_NAMES.index(self.actions[len(self.calls) - 1]))
        return f"after {action}", Decision(action, np.zeros(6), 0.0, None)

    def shown(self):
        """Labels and boxes of the last frame."""
        return {d.label: (d.x1, d.y1, d.x2, d.y2) for d in self.calls[-1][0]}


@pytest.fixture
def navigator(glove):
    """A navigator whose agent does some actions, looking for a mug."""

    def made(*actions, camera=None, target="mug", **config):
        return Navigator(Scripted(glove, *actions), camera, NavigatorConfig(**config)).reset(target)

    return made


@pytest.fixture(scope="module")
def moving_agent(glove):
    return moving_by_odometry(glove, NetworkConfig(odometry=True, triangulation=True))


def test_it_decides_as_its_agent_does(moving_agent):
    """With the same frames, the same memory and the same keys."""
    config = NavigatorConfig(forbid=("LookUp", "LookDown", "Done"), seed=3)
    nav = Navigator(moving_agent, Camera(90, 90), config).reset("coffee mug", rotation=45)
    state, moves = moving_agent.start(45), 0
    for step in range(6):
        frame = [MUG, SINK][: step % 3]
        told = step % 2 == 1
        key = jax.random.fold_in(jax.random.key(3), step)
        state, decision = moving_agent.act(
            state, frame, "mug", key, told, forbidden=[3, 4, 5]
        )  # fmt: skip
        assert nav.step(frame, blocked=told) == ACTION_NAMES[decision.action]
        np.testing.assert_allclose(nav.decision.probabilities, decision.probabilities, atol=1e-6)
        assert len(nav.decision.attention) == len(nav.seen) == len(frame)
        moves += decision.action == Action.MOVE_AHEAD
    assert 0 < moves < 6
    nav.reset("sink")
    assert nav.seen == []
    assert nav.step([]) in ACTION_NAMES  # it need not know what stopped its last episode


def test_boxes_are_those_of_an_agents_camera(navigator):
    nav = navigator("MoveAhead", "Done", camera=Camera(60, 40, horizon=20))
    nav.step([MUG])
    assert nav.agent.starts == [(0, 30, False)]  # the nearest that the agent knows
    (expected,) = Camera(60, 40, horizon=20).to_agent([MUG], 30)
    assert nav.seen == [expected]
    level = navigator("Done", camera=Camera(60, 40, horizon=14))
    level.step([MUG])
    assert level.agent.starts == [(0, 0, False)]
    given = navigator("Done", camera=Camera(60, 40, horizon=14))
    given.reset("mug", rotation=90, horizon=25).step([MUG])
    assert given.agent.starts == [(90, 30, False)]
    assert given.seen == Camera(60, 40).to_agent([MUG], 5)


def test_the_next_episode_begins_as_the_camera_looks(navigator):
    nav = navigator(
        "LookDown", "Done", "LookUp", "LookUp", "Done", camera=Camera(60, 40, horizon=5)
    )
    assert [nav.step([]), nav.step([])] == ["LookDown", "Done"]
    nav.reset("sink").step([MUG])
    assert nav.agent.starts == [(0, 0, False), (0, 30, False)]
    assert nav.seen == Camera(60, 40).to_agent([MUG], -5)
    nav.step([])
    nav.reset("mug").step([])
    assert nav.agent.starts[2] == (0, 0, False)
    for horizon in (90, float("nan")):
        with pytest.raises(ValueError, match=r"horizon .*: must be between -90 and 90 degrees"):
            nav.reset("mug", horizon=horizon)


def test_what_is_unlikely_or_unknown_is_ignored(navigator):
    nav = navigator("MoveAhead", "MoveAhead", min_score=0.5)
    frame = [MUG, SINK, Detection("toaster", 0, 0, 1, 1, 0.49), Detection("qwertzu", 0, 0, 1, 1)]
    with pytest.warns(UserWarning, match=r"ignored: label 'qwertzu'.*agent\.add_words") as told:
        nav.step(frame)
    assert told[0].filename == __file__
    assert {*nav.agent.shown()} == {"mug", "sink"}  # the sink has no score
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # one warning for each label
        nav.step(frame, blocked=False)


def test_a_detectors_output_is_a_frame(navigator):
    nav = navigator("Done")
    boxes = Fields(xyxy=np.array([[40, 40, 60, 60]]), cls=np.array([0]), conf=np.array([0.9]))
    with pytest.raises(ValueError, match=r"detections: object is not known"):
        nav.step(object())
    nav.step([Fields(boxes=boxes, names={0: "mug"}, orig_shape=(100, 100))])
    assert nav.agent.shown() == {"mug": pytest.approx((0.4, 0.4, 0.6, 0.6))}


def test_the_target_must_have_a_meaning(navigator):
    nav = navigator("Done")
    with pytest.raises(LabelError, match=r"label 'qwertzu': no word vector.*agent\.add_words"):
        nav.reset("qwertzu")
    assert nav.target == "mug"
    assert nav.step([]) == "Done"
    with pytest.raises(ValueError, match="rotation 30: not a multiple of 45 degrees"):
        nav.reset("sink", rotation=30)


def test_an_episode_ends_with_done_or_at_its_limit(navigator):
    nav = navigator("LookUp", "Done", max_steps=2)
    assert [nav.step([]), nav.finished, nav.steps] == ["LookUp", False, 1]
    assert [nav.step([]), nav.finished, nav.outcome] == ["Done", True, "done"]
    with pytest.raises(ValueError, match=r"the episode is over; begin one with reset"):
        nav.step([])
    long = navigator("LookUp", "LookUp", max_steps=2)
    assert [long.step([]), long.step([]), long.outcome] == ["LookUp", "LookUp", "step limit"]
    assert not long.reset("sink").finished
    assert (long.steps, long.decision) == (0, None)
    with pytest.raises(ValueError, match="no episode has begun; begin one with reset"):
        Navigator(nav.agent).step([])


def test_what_is_forbidden_and_drawn_is_passed_on(navigator):
    nav = navigator("LookUp", "LookUp", "LookUp", forbid=("LookDown",), seed=5)
    for _ in range(2):
        nav.step([])
    nav.reset("mug").step([])
    assert [call[2] for call in nav.agent.calls] == [(5, 0), (5, 1), (5, 2)]
    assert {call[4] for call in nav.agent.calls} == {(Action.LOOK_DOWN,)}
    plain = navigator("LookUp")
    plain.step([])
    assert plain.agent.calls[0][2:5] == (None, None, ())


def test_what_is_not_seen_any_more_is_kept_while_the_robot_stays(navigator):
    turns = ("RotateRight", "LookDown", "MoveAhead", "MoveAhead", "RotateLeft")
    nav = navigator(*turns, keep_frames=2, min_score=0)
    nav.step([MUG])
    nav.step([SINK])
    shown = nav.agent.shown()
    assert shown["sink"] == pytest.approx(SINK_BOX)
    # 45 degrees to the left of its middle is its left border.
    assert shown["mug"][0] == 0
    assert shown["mug"][2] == pytest.approx(0.5 + 0.5 * math.tan(math.atan(0.2) - math.pi / 4))
    nav.step([SINK])
    higher = nav.agent.shown()["mug"]
    assert higher[1] < shown["mug"][1]
    assert nav.agent.shown()["sink"] == pytest.approx(SINK_BOX)  # seen again: where it is now
    nav.step([], blocked=True)
    assert nav.agent.shown() == {"sink": pytest.approx(SINK_BOX)}  # the mug is too old
    nav.step([], blocked=False)
    assert nav.agent.shown() == {}  # elsewhere, boxes are others


def test_by_default_nothing_is_kept(navigator):
    nav = navigator("MoveAhead", "Done")
    nav.step([MUG])
    nav.step([], blocked=True)
    assert nav.agent.shown() == {}


def test_a_measured_pose_is_told_relative_to_the_start(navigator):
    nav = navigator("MoveAhead", "MoveAhead", "RotateLeft", "Done")
    nav.step([], pose=(3.0, 1.0, math.pi / 2))  # facing the y axis
    assert nav.agent.starts == [(0, 0, True)]
    nav.step([], pose=(3.1, 1.25, math.pi / 2 - 0.1))
    nav.step([], pose=(3.1, 1.25, math.pi / 2 - 0.1))
    nav.step([], pose=(3.1, 1.25, math.pi / 2 + 0.7))
    places = [np.asarray(call[5].place) * 0.25 for call in nav.agent.calls]
    angles = [float(call[5].angle) for call in nav.agent.calls]
    # x is to the right of the start, z ahead of it; angles are clockwise.
    np.testing.assert_allclose(places, [(0, 0), *[(0.1, 0.25)] * 3], atol=1e-6)
    np.testing.assert_allclose(angles, [0, 0.1, 0.1, -0.7], atol=1e-6)
    # The second MoveAhead did not move it.
    assert [call[3] for call in nav.agent.calls][1:3] == [False, True]


def test_measured_turns_move_what_is_kept(navigator):
    nav = navigator("RotateRight", "MoveAhead", "Done", keep_frames=3)
    nav.step([MUG], pose=(0, 0, 0))
    nav.step([], pose=np.zeros(3))  # it did not turn; an array is a pose as well
    np.testing.assert_allclose(nav.agent.shown()["mug"], (0.4, 0.4, 0.6, 0.6), atol=1e-9)
    nav.step([], pose=(0.25, 0, 0))
    assert nav.agent.shown() == {}


@pytest.mark.parametrize(
    ("first", "second", "message"),
    [
        ((0, 0, 0), None, "pose: give one in every step of an episode, or in none"),
        (None, (0, 0, 0), "pose: give one in every step of an episode, or in none"),
        ((0, 0, 0), (0, float("nan"), 0), "must be x, y and yaw, three finite numbers"),
        ((0, 0, 0), (0, 0), "must be x, y and yaw, three finite numbers"),
        ((0, 0, 0), 5.0, "pose 5.0: must be x, y and yaw, three finite numbers"),
        ((0, 0, 0), ("a", 0, 0), "must be x, y and yaw, three finite numbers"),
        ((0, 0, 0), np.zeros((3, 3)), "must be x, y and yaw, three finite numbers"),
    ],
)
def test_a_bad_pose_changes_nothing(navigator, first, second, message):
    nav = navigator("LookUp", "LookUp")
    nav.step([MUG], pose=first)
    with pytest.raises(ValueError, match=message) as refused:
        nav.step([], pose=second)
    assert "\n" not in str(refused.value)
    assert (nav.steps, len(nav.agent.calls)) == (1, 1)
    assert nav.step([], pose=first) == "LookUp"


def test_a_step_that_fails_changes_nothing(moving_agent):
    others = tuple(name for name in ACTION_NAMES if name != "MoveAhead")
    nav = Navigator(moving_agent, config=NavigatorConfig(forbid=others, keep_frames=1)).reset("mug")
    assert nav.step([MUG]) == "MoveAhead"
    with pytest.raises(ValueError, match="whether its MoveAhead was `blocked`"):
        nav.step([])
    assert (nav.steps, nav.seen) == (1, [MUG])
    nav.step([], blocked=True)
    assert (nav.steps, nav.seen) == (2, [MUG])


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"forbid": ("Jump",)}, "--forbid Jump: choose among MoveAhead, RotateLeft"),
        ({"forbid": "LookUp"}, "--forbid LookUp: give a tuple of names"),
        ({"forbid": ACTION_NAMES}, "--forbid: every action is forbidden"),
        ({"min_score": 1.5}, "--min-score 1.5: must be from 0 to 1"),
        ({"min_score": float("nan")}, "--min-score nan: must be from 0 to 1"),
        ({"keep_frames": -1}, "--keep-frames -1: must not be negative"),
        ({"max_steps": 0}, "--max-steps 0: must be positive"),
        ({"seed": -1}, "--seed -1: must be between 0 and 4294967295"),
    ],
)
def test_settings_out_of_range_are_refused(glove, config, message):
    with pytest.raises(ValueError, match=message):
        Navigator(Scripted(glove), config=NavigatorConfig(**config))
