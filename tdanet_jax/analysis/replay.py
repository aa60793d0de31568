"""Replays of an episode: one self-contained HTML page."""

from __future__ import annotations

import importlib.resources
from collections.abc import Sequence
from typing import Any

import numpy as np

from tdanet_jax.analysis import labels
from tdanet_jax.analysis.trace import Trace
from tdanet_jax.io.escaping import in_script
from tdanet_jax.scenes import camera_view, floor_plan
from tdanet_jax.scenes.floor_plan import FloorPlan
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.vocabulary import ACTION_NAMES

#: Where the template takes the episode.
SLOT = "{{EPISODE}}"
#: Units of the page's drawings: the width of the camera's view, and a metre on the plan.
IMAGE, METRE = 300, 100
#: Scale of a plan's font if there are several players, whose plans are smaller.
SMALL_PLAN = 1.3


def page(traces: Sequence[Trace], tables: SceneTables) -> str:
    """The page for one or several players of the same episode.

    Raises:
      ValueError: the traces are of different episodes.
    """
    first = traces[0]
    if any((t.pose[0], t.target) != (first.pose[0], first.target) for t in traces):
        raise ValueError("the traces start in different places or look for different targets")
    plan = floor_plan.of_room(tables, first.scene)
    episode = {
        "scene": first.scene,
        "room": tables.room_at(first.pose[0]).replace("_", " "),
        "target": first.target,
        "shortest": first.shortest,
        "actions": ACTION_NAMES,
        "plan": _plan(plan, first.target, SMALL_PLAN if len(traces) > 1 else 1.0),
        "players": [
            {
                "name": trace.player,
                "outcome": trace.outcome,
                "success": trace.success,
                "attends": trace.attention is not None,
                "steps": [_step(trace, tables, i) for i in range(len(trace.pose))],
            }
            for trace in traces
        ],
    }
    template = importlib.resources.files(__package__).joinpath("replay.html").read_text("utf-8")
    return template.replace(SLOT, in_script(episode))


def _plan(plan: FloorPlan, target: str, scale: float) -> dict[str, Any]:
    """The room in centimetres, y down (minus z)."""
    x1, z1, x2, z2 = plan.extent
    flip = np.array([METRE, -METRE])
    return {
        "extent": [round(METRE * v) for v in (x1, -z2, x2 - x1, z2 - z1)],
        "font": round(scale * METRE * labels.plan_font(plan), 1),
        "points": _rounded(plan.points * flip),
        "outlines": [
            {"name": name, "corners": _rounded(corners * flip)}
            for name, corners in zip(plan.classes, plan.outlines, strict=True)
        ],
        "labels": [
            [label.text, round(METRE * label.x), round(METRE * label.y), plan.classes[label.of]]
            for label in labels.of_plan(plan, plan.of_class(target), scale)
        ],
    }


def _step(trace: Trace, tables: SceneTables, i: int) -> dict[str, Any]:
    """What the page shows before action i, or at the end, where there is no decision."""
    pose, last = int(trace.pose[i]), i == len(trace.actions)
    parts = tables.grid.split(pose)
    x, _, z = tables.position[parts.position]
    rotation, horizon = tables.grid.degrees(parts)
    seen = camera_view.of_pose(tables, pose)
    weights = None if trace.attention is None or last else trace.attention[i]
    step: dict[str, Any] = {
        "place": [round(METRE * float(x)), round(-METRE * float(z))],
        "rotation": rotation,
        "horizon": int(horizon),
        "boxes": [
            [name, *_rounded(IMAGE * box), bool(near)]
            for name, box, near in zip(*seen, strict=True)
        ],
        "labels": [
            [label.text, round(IMAGE * label.x, 1), round(IMAGE * label.y, 1), label.of]
            for label in labels.of_view(seen, weights, trace.target)
        ],
    }
    if weights is not None:
        step["attention"] = _rounded(weights, 4)
    if not last:
        step["action"] = int(trace.actions[i])
        for name in ("probabilities", "value", "difference", "reach"):
            values = getattr(trace, name)
            if values is not None and not np.isnan(values[i]).any():
                step[name] = _rounded(values[i], 4)
    return step


def _rounded(values: np.ndarray, digits: int = 1) -> Any:
    return np.round(np.asarray(values, np.float64), digits).tolist()
