"""Runs a trained agent in AI2-THOR itself (requires Unity and `pip install ai2thor`).

controller = Controller(scene="FloorPlan228", **SETTINGS)  # from ai2thor.controller
episode = play(controller, tdanet_jax.load("runs/my-run"), "Laptop")

The controller is an argument: this module itself needs neither Unity nor the `ai2thor` package.
docs/analysis.md lists what it relies on, and what was never tested with Unity.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import jax

from tdanet_jax.agent.agent import Agent
from tdanet_jax.agent.base import Decision
from tdanet_jax.agent.detection import Detection
from tdanet_jax.labels import Labels
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.vocabulary import (
    ACTION_NAMES,
    FIELD_OF_VIEW,
    IMAGE_SIZE,
    VISIBILITY_DISTANCE,
    Action,
)
from tdanet_jax.vocabulary import STRUCTURE as STRUCTURE  # its former place


def settings(grid: PoseGrid = ITHOR) -> dict[str, Any]:
    """Arguments of AI2-THOR's `Controller` that match the rooms in which agents are trained."""
    return {
        "width": IMAGE_SIZE,
        "height": IMAGE_SIZE,
        "fieldOfView": FIELD_OF_VIEW,
        "visibilityDistance": VISIBILITY_DISTANCE,
        "gridSize": grid.grid_size,
        "rotateStepDegrees": grid.turn,
        "snapToGrid": False,  # AI2-THOR refuses to combine it with turns of 45 degrees
        "renderInstanceSegmentation": True,
    }


#: Those of iTHOR's rooms.
SETTINGS = settings()

#: What AI2-THOR's LookUp and LookDown tilt the camera by, unless they are told.
LOOK_DEGREES = 30

#: Metres and degrees by which AI2-THOR's pose may differ from the expected one.
NEAR, ALIGNED = 0.05, 1.0


class Event(Protocol):
    """The used part of AI2-THOR's `Event`: the frame after an action."""

    metadata: Any  # agent, objects, lastActionSuccess, errorMessage
    instance_detections2D: Any  # object's id -> x1, y1, x2, y2: first and last pixel, y down
    screen_width: int  # pixels
    screen_height: int


class Controller(Protocol):
    """The used part of AI2-THOR's `Controller`."""

    last_event: Any

    def step(self, action: str, **arguments: Any) -> Any:
        """Executes an action and returns its `Event`."""


class Place(NamedTuple):
    """The pose of AI2-THOR's agent."""

    x: float  # metres
    z: float  # metres
    rotation: float  # degrees clockwise from +z
    horizon: float  # degrees down

    def __str__(self) -> str:
        """As in error messages."""
        x, z, rotation, horizon = (round(value, 2) for value in self)
        return f"x {x:g}, z {z:g}, rotation {rotation:g}, horizon {horizon:g}"


class Episode(NamedTuple):
    """An episode of T actions."""

    decisions: tuple[Decision, ...]  # T
    places: tuple[Place, ...]  # T + 1, before each action and at the end
    success: bool  # Done while an object of the target's type is `visible` in AI2-THOR
    unnamed: frozenset[str]  # object types in view that were left out: they have no word vector

    @property
    def actions(self) -> tuple[Action, ...]:
        """The T actions."""
        return tuple(decision.action for decision in self.decisions)


def detections(event: Event) -> list[Detection]:
    """The objects in view, labelled by their type, without parts of the building.

    Segments that are not among the metadata's objects (walls, the ceiling) are left out.

    Raises:
      ValueError: the frame has no detections, since its controller was made without them.
    """
    boxes = getattr(event, "instance_detections2D", None)
    if boxes is None:
        raise ValueError(
            "no instance_detections2D in this frame: make the controller with "
            "renderInstanceSegmentation=True, for one agent"
        )
    kinds = {item["objectId"]: item["objectType"] for item in event.metadata["objects"]}
    wide, high = event.screen_width, event.screen_height
    return [
        # The last pixel belongs to the box, so its far side is one pixel further.
        Detection(kinds[name], x1 / wide, y1 / high, (x2 + 1) / wide, (y2 + 1) / high)
        for name, (x1, y1, x2, y2) in boxes.items()
        if name in kinds and kinds[name] not in STRUCTURE
    ]


def is_visible(event: Event, target: str, labels: Labels | None = None) -> bool:
    """Whether an object of this type is `visible` in AI2-THOR: in view and within 1.5 m.

    Args:
      target: a label that means the type; by default according to the bundled table.
    """
    same = (labels or Labels()).same
    return any(
        item["visible"] and same(item["objectType"], target) for item in event.metadata["objects"]
    )


def play(
    controller: Controller,
    agent: Agent,
    target: str,
    key: jax.Array | None = None,
    step_limit: int = 100,
) -> Episode:
    """Plays one episode from the present pose of AI2-THOR's agent.

    Actions have the same effects as in the environment: MoveAhead along a diagonal moves one cell
    along both axes, and the camera stays within the grid's horizons, in iTHOR between level and 30
    degrees down. Done is not sent to AI2-THOR; it ends the episode, and success is judged by the
    last frame.

    Args:
      controller: made with `SETTINGS` or, for an agent of another grid, `settings(agent.grid)`; its
        agent on the grid, at a multiple of its turn.
      target: what to look for, in English; for `success`, a label that means an object type, such
        as "laptop".
      key: samples the actions, at the agent's temperature; None takes the most probable ones.
      step_limit: actions after which the episode ends without success. Test episodes have 100, and
        200 in living rooms.

    Raises:
      LabelError: the target means nothing known, and has a word without a word vector.
      ValueError: the agent's grid lacks the start's rotation or horizon, or has turns other than 45
        and 90 degrees, along which AI2-THOR's MoveAhead leaves the grid; a frame has no detections;
        an action led to an unexpected pose, as with other settings; or the agent requires an image.
    """
    if agent.grid.turn not in (45, 90):
        raise ValueError(
            f"turns of {agent.grid.turn} degrees: AI2-THOR's MoveAhead leaves the grid along them; "
            "only agents with turns of 45 or 90 degrees can play in it"
        )
    if step_limit < 1:
        raise ValueError(f"step_limit {step_limit}: must be at least 1")
    event = controller.last_event
    places, decisions, unnamed = [_place(event)], [], set[str]()
    state = agent.start(places[0].rotation, places[0].horizon)
    # With its angles rounded, as Unity's are never exact.
    view = agent.grid.nearest_view(places[0].rotation, places[0].horizon)
    rotation, horizon = agent.grid.turn * view[0], agent.grid.horizons[view[1]]
    expected, blocked = places[0]._replace(rotation=rotation, horizon=horizon), False
    for step in range(step_limit):
        seen = detections(event)
        named = [found for found in seen if agent.knows(found.label)]
        unnamed |= {found.label for found in seen} - {found.label for found in named}
        now = None if key is None else jax.random.fold_in(key, step)
        state, decision = agent.act(state, named, target, now, blocked)
        decisions.append(decision)
        event, expected, blocked = _take(controller, event, expected, decision.action, agent.grid)
        places.append(_place(event))
        if decision.action == Action.DONE:
            break
    success = decisions[-1].action == Action.DONE and is_visible(event, target, agent.labels)
    return Episode(tuple(decisions), tuple(places), success, frozenset(unnamed))


def _place(event: Event) -> Place:
    agent = event.metadata["agent"]
    position = agent["position"]
    return Place(position["x"], position["z"], agent["rotation"]["y"], agent["cameraHorizon"])


def _take(
    controller: Controller, event: Event, before: Place, action: Action, grid: PoseGrid
) -> tuple[Event, Place, bool]:
    """The frame after an action, the expected place, and whether the agent was blocked.

    Args:
      before: the expected place before the action, so that deviations do not add up.

    Raises:
      ValueError: AI2-THOR's agent is not at the expected place.
    """
    heading = round(before.rotation) // grid.turn
    down = grid.horizons.index(round(before.horizon))
    right = (action == Action.ROTATE_RIGHT) - (action == Action.ROTATE_LEFT)
    turned = (heading + right) % grid.rotations
    lower = (action == Action.LOOK_DOWN) - (action == Action.LOOK_UP)
    looking = min(max(down + lower, 0), len(grid.horizons) - 1)
    ahead = action == Action.MOVE_AHEAD
    if not ahead and (turned, looking) == (heading, down):
        return event, before, False
    dx, dz = (grid.grid_size * int(cells) for cells in grid.steps[heading])
    arguments = {"moveMagnitude": math.hypot(dx, dz)} if ahead else {}
    tilt = abs(grid.horizons[looking] - grid.horizons[down])
    if tilt not in (0, LOOK_DEGREES):
        arguments["degrees"] = tilt
    event = controller.step(action=ACTION_NAMES[action], **arguments)
    moved = ahead and bool(event.metadata["lastActionSuccess"])
    x, z = (before.x + dx, before.z + dz) if moved else (before.x, before.z)
    after = _place(event)
    expected = Place(x, z, grid.turn * turned, grid.horizons[looking])
    turn = (expected.rotation - after.rotation + 180) % 360 - 180
    away = math.hypot(expected.x - after.x, expected.z - after.z)
    if not (away < NEAR and max(abs(turn), abs(expected.horizon - after.horizon)) < ALIGNED):
        raise ValueError(
            f"{ACTION_NAMES[action]} from {before} led to {after} and not to {expected}; is the "
            f"controller made with SETTINGS? {event.metadata['errorMessage']}".rstrip()
        )
    return event, expected, ahead and not moved
