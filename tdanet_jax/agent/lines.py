"""A navigator that is asked in lines of JSON: a frame in, an action out.

{"target": "mug", "detections": [{"label": "mug", "box": [0.2, 0.3, 0.25, 0.4], "score": 0.9}]}
{"action": "RotateLeft", "steps": 1, "finished": false, "outcome": null}

docs/robots.md lists the fields.
"""

from __future__ import annotations

from typing import Any

from tdanet_jax.agent import detectors
from tdanet_jax.agent.detection import OVERHANG, Detection
from tdanet_jax.agent.navigator import Navigator
from tdanet_jax.io.untrusted import FileError, jsons

#: Fields of a frame, and of those in `detections`.
FRAME = ("target", "rotation", "horizon", "detections", "image_size", "blocked", "pose")
DETECTION = ("label", "box", "score")
#: Largest number that is taken for a coordinate or an angle.
LARGEST = 1e9


def answer(navigator: Navigator, line: str, source: str = "line") -> dict[str, Any]:
    """The answer to a line, as an object of JSON; {"error": ...} if it is not a frame.

    After an error the navigator is as it was before.

    Args:
      navigator: it goes one step on.
      line: a frame in JSON.
      source: what errors call the line.
    """
    try:
        action = _step(navigator, _object(source, jsons.parse(source, line), FRAME), source)
    except (ValueError, KeyError) as error:  # LabelError is a KeyError
        text = str(error)
        return {"error": text if text.startswith(f"{source}: ") else f"{source}: {text}"}
    return {
        "action": action,
        "steps": navigator.steps,
        "finished": navigator.finished,
        "outcome": navigator.outcome,
    }


def _step(navigator: Navigator, frame: dict[str, Any], source: str) -> str:
    """One step, if the whole frame is valid."""
    found, pose, blocked = _detections(frame, source), frame.get("pose"), frame.get("blocked")
    if blocked is not None and not isinstance(blocked, bool):
        raise FileError(source, "blocked is not true, false or null")
    measured = None
    if pose is not None:
        x, y, yaw = _numbers(source, pose, "pose", 3)
        measured = x, y, yaw
    if "target" in frame:
        if not isinstance(frame["target"], str):
            raise FileError(source, "target is not a text")
        where = {
            name: jsons.number(source, frame[name], name, LARGEST)
            for name in ("rotation", "horizon")
            if name in frame
        }
        navigator.reset(frame["target"], **where)
    elif given := [name for name in ("rotation", "horizon") if name in frame]:
        raise FileError(source, f"{given[0]}: only together with target, which begins an episode")
    elif navigator.target is None or navigator.finished:
        raise FileError(source, "no episode has begun, or it is over: give a target")
    return navigator.step(found, blocked, measured)


def _detections(frame: dict[str, Any], source: str) -> list[Detection]:
    """The detections of a frame, as shares of its image."""
    if not isinstance(frame.get("detections"), list):
        raise FileError(source, "detections is missing, or not a list")
    size = frame.get("image_size")
    width, height = (1.0, 1.0) if size is None else _numbers(source, size, "image_size", 2)
    if min(width, height) <= 0:
        raise FileError(source, "image_size is not above 0")
    rows = []
    for i, item in enumerate(frame["detections"]):
        one, what = _object(source, item, DETECTION, f"detection {i}"), f"detection {i}"
        if not isinstance(one.get("label"), str):
            raise FileError(source, f"{what}: label is not a text")
        box, score = _numbers(source, one.get("box"), f"{what}: box", 4), one.get("score")
        if size is None and not all(abs(corner - 0.5) <= 0.5 + OVERHANG for corner in box):
            raise FileError(
                source,
                f"{what}: box is not within the image, from 0 to 1; give image_size if it is in "
                "pixels, or [1, 1] if it may reach beyond",
            )
        if score is not None:
            score = jsons.number(source, score, f"{what}: score", LARGEST)
        rows.append((one["label"], box, score))
    return detectors.in_image(rows, width, height)


def _object(source: str, value: Any, fields: tuple[str, ...], what: str = "") -> dict[str, Any]:
    """A JSON object that has no other fields than these."""
    name = f"{what}: " if what else ""
    if not isinstance(value, dict):
        raise FileError(source, f"{name}not an object of JSON")
    for key in value:
        if key not in fields:
            raise FileError(source, f"{name}{key}: no such field; there are {', '.join(fields)}")
    return value


def _numbers(source: str, value: Any, what: str, count: int) -> list[float]:
    """A list of numbers of this length."""
    if not isinstance(value, list) or len(value) != count:
        raise FileError(source, f"{what} is not a list of {count} numbers")
    return [jsons.number(source, number, what, LARGEST) for number in value]
