"""AI2-THOR, played by a stand-in that answers from the rooms' tables, as the real one would."""

from __future__ import annotations

import dataclasses
import math
from types import SimpleNamespace
from typing import Any

import jax
import numpy as np
import pytest

import tdanet_jax
from tdanet_jax import poses
from tdanet_jax.agent import ai2thor
from tdanet_jax.agent.base import Decision
from tdanet_jax.agent.detection import Detection
from tdanet_jax.analysis import trace
from tdanet_jax.evaluation import episodes
from tdanet_jax.labels import Labels
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.vocabulary import TARGETS, Action
from tests.conftest import TINY, save_untrained

AHEAD, LEFT, RIGHT, UP, DOWN, DONE = Action


class StandIn:
    """Answers as AI2-THOR's controller does, in a room of tables with boxes of whole pixels.

    It knows metres and degrees, and looks up the tables only to see and to collide.
    """

    def __init__(self, tables, pose, extra=(), **settings: Any) -> None:
        settings = ai2thor.SETTINGS | settings
        assert not settings["snapToGrid"] or settings["rotateStepDegrees"] % 90 == 0
        assert settings["renderInstanceSegmentation"]
        self.tables, self.settings, self.asked = tables, settings, []
        self.extra = [("Floor", (0, 150, 299, 299)), *extra]
        at, rotation, horizon = poses.split(pose)
        self.scene = tables.position_scene[at]
        self.x, _, self.z = tables.position[at]
        # As in Unity, angles are not quite what they should be.
        self.rotation, self.horizon = 45 * rotation - 2e-5, 30 * horizon + 2e-6
        self.last_event = self._event(True)

    def step(self, action, **arguments):
        self.asked.append((action, {**arguments}))
        works = True
        if action == "MoveAhead":
            works = self._move(arguments.pop("moveMagnitude", self.settings["gridSize"]))
        elif action in ("RotateRight", "RotateLeft"):
            turn = self.settings["rotateStepDegrees"]
            self.rotation = (self.rotation + (turn if action == "RotateRight" else -turn)) % 360
        else:
            degrees = arguments.pop("degrees", 30)
            horizon = self.horizon + {"LookDown": degrees, "LookUp": -degrees}[action]
            works = -30.1 < horizon < 60.1
            self.horizon = horizon if works else self.horizon
        assert not arguments
        self.last_event = self._event(works)
        return self.last_event

    def _at(self, x, z):
        """The table's point at a place, or None."""
        here = self.tables.position_scene == self.scene
        offset = self.tables.position[:, [0, 2]] - (x, z)
        found = np.flatnonzero(here & (np.abs(offset).max(axis=1) < 1e-3))
        return int(found[0]) if len(found) else None

    def _move(self, metres):
        angle = math.radians(self.rotation)
        x, z = self.x + metres * math.sin(angle), self.z + metres * math.cos(angle)
        if self._at(x, z) is None:
            return False
        self.x, self.z = x, z
        return True

    def _event(self, works):
        t = self.tables
        pose = poses.from_degrees(
            self._at(self.x, self.z), round(self.rotation), 30 * (self.horizon > 29)
        )
        rows = range(t.row_start[pose], t.row_start[pose + 1])
        reach = {t.row_object[row] for row in rows if t.row_visible[row]}
        objects = [
            {"objectId": t.object_id[i], "objectType": t.classes[c], "visible": i in reach}
            for i, c in enumerate(t.object_class)
            if t.object_scene[i] == self.scene
        ]
        boxes = {t.object_id[t.row_object[row]]: pixels(t.row_box[row]) for row in rows}
        for kind, box in self.extra:
            objects.append({"objectId": f"{kind}|0|0|0", "objectType": kind, "visible": True})
            boxes[f"{kind}|0|0|0"] = box
        boxes["wall_1_2|0|1.5|2"] = (0, 0, 299, 150)  # no object of the metadata
        agent = {
            "position": {"x": self.x, "y": 0.9, "z": self.z},
            "rotation": {"x": 0.0, "y": self.rotation, "z": 0.0},
            "cameraHorizon": self.horizon,
        }
        return SimpleNamespace(
            metadata={
                "agent": agent,
                "objects": objects,
                "lastActionSuccess": works,
                "errorMessage": "" if works else "blocked",
            },
            instance_detections2D=boxes,
            screen_width=self.settings["width"],
            screen_height=self.settings["height"],
        )


def pixels(box):
    """The first and last pixel of a table's box along both axes, as AI2-THOR has them."""
    x1, y1, x2, y2 = (int(part) // 16 for part in box)
    return x1, y1, x2 - 1, y2 - 1


@pytest.fixture(scope="module")
def rooms(some_rooms):
    """Eight rooms with boxes of whole pixels, each pixel that the finer box touches."""
    box = some_rooms.row_box
    low, high = box[:, :2] // 16, -(-box[:, 2:] // 16)
    low = np.minimum(low, 299)
    high = np.maximum(high, low + 1)
    return dataclasses.replace(some_rooms, row_box=(16 * np.hstack([low, high])).astype(np.int16))


@pytest.fixture(scope="module", params=[pytest.param("plain", marks=pytest.mark.slow), "sensing"])
def run(request, rooms, glove, tmp_path_factory):
    """The folder of a run with random parameters."""
    senses = request.param == "sensing"
    network = dataclasses.replace(TINY.network, odometry=senses, triangulation=senses)
    folder = tmp_path_factory.mktemp("runs") / request.param
    save_untrained(dataclasses.replace(TINY, network=network), folder, rooms, glove)
    return folder


@pytest.fixture(scope="module")
def agent(run):
    """Its agent; one for all tests, as it compiles for seconds."""
    return tdanet_jax.load(run)


def test_the_pixels_of_a_box_are_those_that_it_touches(rooms, some_rooms):
    grown = (rooms.row_box.astype(int) - some_rooms.row_box) * [-1, -1, 1, 1]
    assert grown.min() >= 0
    assert grown.max() <= 16


@pytest.mark.slow
def test_an_episode_is_the_one_of_the_environment(run, agent, rooms):
    player = trace.load_player(run, Rooms(rooms, None))
    chosen = episodes.draw(rooms, player.task.split.eval_scenes, TARGETS, 5, seed=1)
    actions, outcomes, stopped, ignored = [], [], 0, 0
    for i, (pose, goal) in enumerate(zip(chosen.pose, chosen.target, strict=True)):
        simulator = StandIn(rooms, pose)
        key = None if i == 0 else jax.random.key(i)
        played = ai2thor.play(simulator, agent, rooms.targets[goal], key, step_limit=40)
        one = dataclasses.replace(chosen, pose=chosen.pose[i : i + 1], target=chosen.target[i:][:1])
        expected = trace.retrace(player, rooms, one, np.array(played.actions))
        compare(played, expected, rooms)
        actions += played.actions
        outcomes.append(played.success)
        there = expected.pose
        stopped += sum(there[t + 1] == there[t] for t, a in enumerate(played.actions) if a == AHEAD)
        ignored += len(played.actions) - len(simulator.asked) - (played.actions[-1] == DONE)
    assert {*actions} == {*Action}
    assert stopped > 5
    assert ignored > 5
    assert {*outcomes} == {False, True}


def compare(played, expected, rooms):
    at, rotation, horizon = poses.split(expected.pose)
    places = np.array(played.places)
    np.testing.assert_allclose(places[:, :2], rooms.position[at][:, [0, 2]], atol=1e-3)
    off = (places[:, 2] - 45 * rotation + 180) % 360 - 180
    np.testing.assert_allclose(off, 0, atol=1e-3)
    np.testing.assert_allclose(places[:, 3], 30 * horizon, atol=1e-3)
    thought = np.array([decision.probabilities for decision in played.decisions])
    np.testing.assert_allclose(thought, expected.probabilities, rtol=2e-3, atol=1e-6)
    values = [decision.value for decision in played.decisions]
    np.testing.assert_allclose(values, expected.value, rtol=2e-3, atol=1e-5)
    assert played.success == expected.success
    assert not played.unnamed


class Script:
    """An agent that takes the given actions, and remembers what it was shown and told."""

    def __init__(self, *actions: Action, grid: poses.PoseGrid = poses.ITHOR) -> None:
        self.grid, self.labels = grid, Labels(synonyms={"CoffeeMachine": ["brewing unit"]})
        self.actions, self.seen, self.blocked, self.keys = list(actions), [], [], []

    def start(self, rotation, horizon):
        self.began = rotation, horizon

    def knows(self, label):
        return label.isalpha()

    def act(self, state, detections, target, key=None, blocked=None):
        self.seen.append(detections)
        self.blocked.append(blocked)
        self.keys.append(key)
        return state, Decision(self.actions[len(self.seen) - 1], np.full(6, 1 / 6), 0.0, None)


def where(rooms, rotation, free):
    """A pose from which a step along a heading leads somewhere, or nowhere."""
    ahead = rooms.next_position[:, rotation // 45]
    position = np.flatnonzero((ahead != np.arange(len(ahead))) == free)[20]
    return poses.from_degrees(int(position), rotation, 0)


@pytest.mark.parametrize(
    ("rotation", "dx", "dz"), [(0, 0, 1), (45, 1, 1), (90, 1, 0), (225, -1, -1), (315, -1, 1)]
)
def test_a_step_goes_one_cell_along_each_axis(rooms, rotation, dx, dz):
    simulator, script = StandIn(rooms, where(rooms, rotation, True)), Script(AHEAD, DONE)
    first, second, last = ai2thor.play(simulator, script, "Mug").places
    assert (second.x - first.x, second.z - first.z) == pytest.approx((dx / 4, dz / 4), abs=1e-4)
    assert last == second
    assert script.blocked == [False, False]
    assert script.began == pytest.approx((rotation, 0), abs=1e-3)
    ((action, arguments),) = simulator.asked  # Done is the agent's own
    assert action == "MoveAhead"
    assert arguments == {"moveMagnitude": pytest.approx(0.25 * math.hypot(dx, dz))}


@pytest.mark.parametrize("rotation", [0, 45])
def test_only_a_move_ahead_that_failed_was_blocked(rooms, rotation):
    simulator = StandIn(rooms, where(rooms, rotation, False))
    script = Script(AHEAD, LEFT, RIGHT, AHEAD, UP, DONE)
    played = ai2thor.play(simulator, script, "Mug")
    assert script.blocked == [False, True, False, False, True, False]
    assert len({(place.x, place.z) for place in played.places}) == 1
    assert played.actions == (AHEAD, LEFT, RIGHT, AHEAD, UP, DONE)


def test_looks_and_turns_as_in_the_environment(rooms):
    """AI2-THOR could look up and 60 degrees down; agents never do."""
    simulator = StandIn(rooms, where(rooms, 0, True))
    actions = [UP, DOWN, DOWN, LEFT, LEFT, RIGHT, UP, UP, DONE]
    played = ai2thor.play(simulator, Script(*actions), "Mug")
    assert [round(place.horizon) for place in played.places] == [0, 0, 30, 30, 30, 30, 30, 0, 0, 0]
    turns = [round(place.rotation) % 360 for place in played.places]
    assert turns == [0, 0, 0, 0, 315, 270, 315, 315, 315, 315]
    assert simulator.asked == [
        (name, {}) for name in ("LookDown", "RotateLeft", "RotateLeft", "RotateRight", "LookUp")
    ]


def test_boxes_are_shares_of_the_image_and_the_last_pixel_counts():
    """A frame that is wider than high, so that the axes cannot be mixed up."""
    objects = [
        {"objectId": f"{kind}|1|2|3{part}", "objectType": kind + part, "visible": False}
        for kind, part in (("Mug", ""), ("Sink", "Basin"), ("Floor", ""), ("Doorway", ""))
    ]
    objects[1]["objectId"] = "Sink|1|2|3|SinkBasin"
    boxes = {
        "Mug|1|2|3": (40, 10, 79, 19),
        "Sink|1|2|3|SinkBasin": (0, 0, 399, 99),
        "Floor|1|2|3": (0, 50, 399, 99),
        "Doorway|1|2|3": (0, 50, 399, 99),
        "wall_2|1|2|3": (0, 0, 10, 10),
    }
    frame = SimpleNamespace(
        metadata={"objects": objects},
        instance_detections2D=boxes,
        screen_width=400,
        screen_height=100,
    )
    assert ai2thor.detections(frame) == [
        Detection("Mug", 0.1, 0.1, 0.2, 0.2),
        Detection("SinkBasin", 0.0, 0.0, 1.0, 1.0),
    ]
    frame.instance_detections2D = {}
    assert ai2thor.detections(frame) == []
    for nothing in (
        SimpleNamespace(metadata=frame.metadata, instance_detections2D=None),
        SimpleNamespace(metadata=frame.metadata),  # an event of several agents
    ):
        with pytest.raises(ValueError, match="renderInstanceSegmentation=True, for one agent"):
            ai2thor.detections(nothing)


def test_no_class_of_the_rooms_is_taken_for_a_part_of_the_building(ithor):
    assert not ai2thor.STRUCTURE & {*ithor.classes}


def test_a_type_without_a_word_is_left_out_and_said(agent, rooms):
    pose = where(rooms, 90, True)
    odd = ("Xyzzyq", (10, 10, 20, 20))
    plain = ai2thor.play(StandIn(rooms, pose), agent, "Mug", step_limit=2)
    played = ai2thor.play(StandIn(rooms, pose, [odd]), agent, "Mug", step_limit=2)
    assert (plain.unnamed, played.unnamed) == (frozenset(), {"Xyzzyq"})
    for one, other in zip(plain.decisions, played.decisions, strict=True):
        np.testing.assert_array_equal(one.probabilities, other.probabilities)
    # What has a name is seen, be it of a class that no room has.
    other = ai2thor.play(StandIn(rooms, pose, [("Horse", odd[1])]), agent, "Mug", step_limit=1)
    change = other.decisions[0].probabilities - plain.decisions[0].probabilities
    assert np.abs(change).max() > 1e-5
    with pytest.raises(KeyError, match="xyzzyq"):
        ai2thor.play(StandIn(rooms, pose), agent, "Xyzzyq")


def test_a_frame_without_objects(agent, rooms):
    pose = int(np.flatnonzero(np.diff(rooms.row_start) == 0)[0])
    played = ai2thor.play(StandIn(rooms, pose), agent, "Mug", step_limit=1)
    assert np.isfinite(played.decisions[0].probabilities).all()


def test_success_is_what_ai2thor_calls_visible(rooms):
    """Whichever way the target is written; and only at Done."""
    goal = rooms.targets.index("CoffeeMachine")
    seen, unseen = (int(np.flatnonzero(rooms.distance[:, goal] == away)[3]) for away in (0, 9))
    for target in ("CoffeeMachine", "coffee machine", "Coffeemaker_1", "brewing unit"):
        assert ai2thor.play(StandIn(rooms, seen), Script(DONE), target).success
    assert not ai2thor.play(StandIn(rooms, unseen), Script(DONE), "CoffeeMachine").success
    assert not ai2thor.play(StandIn(rooms, seen), Script(DONE), "machine").success
    assert ai2thor.is_visible(StandIn(rooms, seen).last_event, "coffee maker")
    limited = ai2thor.play(StandIn(rooms, seen), Script(UP, UP, UP), "CoffeeMachine", step_limit=3)
    assert not limited.success
    assert limited.actions == (UP, UP, UP)
    assert len(limited.places) == 4


def test_every_step_has_a_key_of_its_own(rooms):
    script = Script(LEFT, LEFT, LEFT, DONE)
    ai2thor.play(StandIn(rooms, where(rooms, 0, True)), script, "Mug", jax.random.key(0))
    assert len({tuple(jax.random.key_data(key).tolist()) for key in script.keys}) == 4
    script = Script(DONE)
    ai2thor.play(StandIn(rooms, where(rooms, 0, True)), script, "Mug")
    assert script.keys == [None]


def test_an_episode_ends_after_a_hundred_actions(rooms):
    simulator = StandIn(rooms, where(rooms, 0, True))
    assert len(ai2thor.play(simulator, Script(*[LEFT] * 101), "Mug").actions) == 100
    with pytest.raises(ValueError, match="step_limit 0: must be at least 1"):
        ai2thor.play(simulator, Script(), "Mug", step_limit=0)


@pytest.mark.parametrize(
    ("rotation", "horizon", "message"),
    [(30, 0, "rotation 30: not a multiple of 45"), (0, 60, "horizon 60: not among 0, 30 degrees")],
)
def test_a_start_off_the_poses_is_refused(agent, rooms, rotation, horizon, message):
    simulator = StandIn(rooms, where(rooms, 0, True))
    there = simulator.last_event.metadata["agent"]
    there["rotation"]["y"], there["cameraHorizon"] = rotation, horizon
    with pytest.raises(ValueError, match=message):
        ai2thor.play(simulator, agent, "Mug")
    assert not simulator.asked


@pytest.mark.parametrize(
    ("settings", "action", "led"),
    [
        ({"rotateStepDegrees": 90}, RIGHT, "rotation 90, horizon 0 and not to .*rotation 45"),
        ({"rotateStepDegrees": 90, "snapToGrid": True}, LEFT, "rotation 270, horizon 0 and not to"),
    ],
)
def test_a_controller_with_other_settings_is_noticed(rooms, settings, action, led):
    simulator = StandIn(rooms, where(rooms, 0, True), **settings)
    with pytest.raises(ValueError, match=led) as caught:
        ai2thor.play(simulator, Script(action), "Mug")
    assert "is the controller made with SETTINGS?" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_agents_of_another_grid_play_on_it(rooms):
    """Quarter turns and horizons that AI2-THOR's own steps of 30 degrees do not have."""
    grid = poses.PoseGrid(0.25, 4, (0, 15, 60))
    settings = ai2thor.settings(grid)
    assert settings["rotateStepDegrees"] == 90
    simulator = StandIn(rooms, where(rooms, 90, True), **settings)
    actions = (RIGHT, LEFT, AHEAD, DOWN, DOWN, DOWN, UP, Action.DONE)
    episode = ai2thor.play(simulator, Script(*actions, grid=grid), "Mug")
    turns = [(round(place.rotation), round(place.horizon)) for place in episode.places]
    down = [(90, 0), (90, 15), (90, 60), (90, 60), (90, 15), (90, 15)]
    assert turns == [(90, 0), (180, 0), (90, 0), *down]
    assert [ask for ask in simulator.asked if ask[0].startswith("Look")] == [
        ("LookDown", {"degrees": 15}), ("LookDown", {"degrees": 45}), ("LookUp", {"degrees": 45})
    ]  # fmt: skip
    for rotations in (6, 12, 24):
        with pytest.raises(ValueError, match=r"turns of .* degrees: AI2-THOR's MoveAhead leaves"):
            ai2thor.play(simulator, Script(grid=poses.PoseGrid(rotations=rotations)), "Mug")


def test_an_action_that_leads_elsewhere_is_noticed(rooms):
    """A step that does not move, or goes too far, and a turn that fails."""
    pose = where(rooms, 0, True)

    class Slipping(StandIn):
        def _move(self, metres):
            self.x += 0.1
            return True

        def _at(self, x, z):
            return poses.split(pose).position

    class Stuck(StandIn):
        def _event(self, works):
            self.rotation = 0.0
            return super()._event(False)

    with pytest.raises(ValueError, match=r"MoveAhead from x .* led to x"):
        ai2thor.play(Slipping(rooms, pose), Script(AHEAD), "Mug")
    with pytest.raises(ValueError, match=r"RotateLeft from .* made with SETTINGS\? blocked"):
        ai2thor.play(Stuck(rooms, pose), Script(LEFT), "Mug")


def test_the_settings_are_those_of_the_rooms(ithor):
    """As AI2-THOR calls them; it moves by `gridSize`, and turns by `rotateStepDegrees`."""
    assert ai2thor.SETTINGS == {
        "width": 300,
        "height": 300,
        "fieldOfView": 90,
        "visibilityDistance": 1.5,
        "gridSize": 0.25,
        "rotateStepDegrees": 45,
        "snapToGrid": False,
        "renderInstanceSegmentation": True,
    }
    assert (ithor.image, ithor.field_of_view) == (300, 90)
