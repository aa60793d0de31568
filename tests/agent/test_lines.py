"""Frames in JSON, a line each: every line has an answer, and a bad one changes nothing."""

from __future__ import annotations

import json

import pytest

from tdanet_jax.agent import lines
from tdanet_jax.agent.navigator import Navigator
from tests.agent.test_navigator import Scripted

SINK = {"label": "sink", "box": [0.1, 0.3, 0.5, 0.8], "score": 0.9}


@pytest.fixture
def ask(glove):
    """A navigator that is asked in lines."""
    navigator = Navigator(Scripted(glove, "MoveAhead", "LookUp", "Done", "Done"))

    def asked(frame, source="line 7"):
        line = frame if isinstance(frame, str) else json.dumps(frame)
        return lines.answer(navigator, line, source)

    asked.navigator, asked.agent = navigator, navigator.agent
    return asked


def test_an_episode(ask):
    more = {"finished": False, "outcome": None}
    frame = {"target": "mug", "rotation": 90, "horizon": 0, "detections": [SINK]}
    assert ask(frame) == {"action": "MoveAhead", "steps": 1, **more}
    assert ask.agent.starts == [(90, 0, False)]
    assert ask.agent.shown() == {"sink": pytest.approx((0.1, 0.3, 0.5, 0.8))}
    assert ask.agent.calls[0][1] == "mug"
    pixels = {"label": "sink", "box": [-64, 144, 320, 384]}
    outside = {"label": "sink", "box": [650, 144, 700, 384]}
    frame = {"detections": [pixels, outside], "image_size": [640, 480], "blocked": True}
    assert ask(frame) == {"action": "LookUp", "steps": 2, **more}
    assert ask.agent.shown() == {"sink": pytest.approx((0, 0.3, 0.5, 0.8))}
    assert ask.agent.calls[1][3] is True
    rounded = [{"label": "sink", "box": [0.1, 0.3, 0.5, 1.004]}]
    beyond = [{"label": "sink", "box": [0.1, 0.3, 0.5, 1.7]}]
    assert [d.y2 for d in lines._detections({"detections": rounded}, "")] == [1]
    beyond_frame = {"detections": beyond, "image_size": [1, 1]}
    assert [d.y2 for d in lines._detections(beyond_frame, "")] == [1]
    done = ask({"detections": [], "blocked": None, "pose": None})
    assert done == {"action": "Done", "steps": 3, "finished": True, "outcome": "done"}
    assert "give a target" in ask({"detections": []})["error"]
    assert ask({"target": "sink", "detections": [], "pose": [1, 2, 0.5]})["steps"] == 1
    assert ask.agent.calls[3][1] == "sink"
    assert ask.agent.starts[-1] == (0, 0, True)


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ("", "line 7: not JSON (Expecting value"),
        ("[" * 1000, "line 7: lists and objects 1000 deep"),
        ('{"detections": [NaN]}', "line 7: not JSON (NaN is not a number in JSON)"),
        ("[]", "line 7: not an object of JSON"),
        ({}, "line 7: detections is missing, or not a list"),
        ({"detections": {}}, "line 7: detections is missing, or not a list"),
        ({"detections": [], "targt": "mug"}, "line 7: targt: no such field; there are target,"),
        ({"detections": [3]}, "line 7: detection 0: not an object of JSON"),
        ({"detections": [SINK, SINK | {"name": ""}]}, "line 7: detection 1: name: no such field"),
        ({"detections": [SINK | {"label": 3}]}, "line 7: detection 0: label is not a text"),
        (
            {"detections": [SINK | {"box": [1, 2, 3]}]},
            "detection 0: box is not a list of 4 numbers",
        ),
        (
            {"detections": [SINK, SINK | {"box": [64, 144, 320, 384]}]},
            "line 7: detection 1: box is not within the image, from 0 to 1; give image_size if it",
        ),
        ({"detections": [SINK | {"box": [0, 0, "a", 1]}]}, "detection 0: box is not a number"),
        ({"detections": [SINK | {"box": [0.5, 0, 0.4, 1]}]}, "line 7: sink at (0.5, 0.0, 0.4, 1"),
        ({"detections": [SINK | {"score": 80}]}, "line 7: sink: score 80.0: must be from 0 to 1"),
        ({"detections": [SINK | {"score": True}]}, "detection 0: score is not a number"),
        ({"detections": [], "image_size": 640}, "image_size is not a list of 2 numbers"),
        ({"detections": [], "image_size": [640, 0]}, "line 7: image_size is not above 0"),
        ({"detections": [], "blocked": 1}, "line 7: blocked is not true, false or null"),
        ({"detections": [], "pose": [0, 0]}, "line 7: pose is not a list of 3 numbers"),
        ({"detections": [], "pose": [0, 0, 1]}, "pose: give one in every step of an episode"),
        ({"detections": [], "target": None}, "line 7: target is not a text"),
        ({"detections": [], "target": "qwertzu"}, "line 7: label 'qwertzu': no word vector"),
        ({"detections": [], "target": "mug", "rotation": "x"}, "line 7: rotation is not a number"),
        ({"detections": [], "target": "mug", "rotation": 30}, "rotation 30.0: not a multiple of"),
        ({"detections": [], "target": "mug", "horizon": 99}, "horizon 99.0: must be between -90"),
        ({"detections": [], "horizon": 20}, "line 7: horizon: only together with target"),
    ],
)
def test_a_line_that_is_no_frame_is_answered_by_an_error_and_changes_nothing(ask, frame, message):
    assert "give a target" in ask({"detections": []})["error"]
    ask({"target": "mug", "detections": [SINK]})
    before = {**vars(ask.navigator)}
    reply = ask(frame)
    assert message in reply.pop("error")
    assert reply == {}
    assert vars(ask.navigator) == before
    assert ask({"detections": [], "blocked": False})["steps"] == 2
