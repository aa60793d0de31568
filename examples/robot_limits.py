"""What a robot's camera, and not tilting it, cost an agent on the test episodes.

    python examples/robot_limits.py agents/18-4-best 69 55
    python examples/robot_limits.py agents/18-4-best 69 55 1 0  # temperature, bias for Done

The rooms' boxes are clipped to what such a camera sees. The agent is shown them as they are in the
camera's own image, or mapped as `Camera` does. Success is judged as always: a target counts as
found if it is visible within 90 degrees.
"""

from __future__ import annotations

import dataclasses
import sys

import numpy as np

from tdanet_jax import Decisions
from tdanet_jax.analysis import trace
from tdanet_jax.evaluation import episodes, metrics, policies, report, rollout
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.scenes import dataset
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.vocabulary import Action

TILTS = (Action.LOOK_UP, Action.LOOK_DOWN)


def through(tables: SceneTables, hfov: float, vfov: float, mapped: bool) -> SceneTables:
    """The tables with the boxes of a level camera that sees less than 90 degrees."""
    side = tables.image * tables.subpixel
    view = np.tan(np.radians([hfov / 2, vfov / 2] * 2))
    boxes = 2 * tables.row_box / side - 1  # tangents of x1, y1, x2, y2
    inside = np.clip(boxes, -view, view)
    seen = (tables.row_box[:, 0] >= 0) & (inside[:, :2] < inside[:, 2:]).all(axis=1)
    shown = inside if mapped else inside / view
    corners = np.where(seen[:, None], np.rint((shown + 1) / 2 * side), -1)
    return dataclasses.replace(tables, row_box=corners.astype(tables.row_box.dtype))


def looking(tables: SceneTables, chosen: Episodes, horizon: int) -> Episodes:
    """The episodes, which begin with the camera at a horizon."""
    grid = tables.grid
    position, rotation, _ = grid.split(chosen.pose)
    pose = grid.join(position, rotation, grid.horizons.index(horizon))
    return dataclasses.replace(chosen, pose=pose.astype(chosen.pose.dtype))


def main(
    run: str = "agents/18-4-best",
    hfov: float = 69,
    vfov: float = 55,
    temperature: float | None = None,
    done_bias: float | None = None,
) -> None:
    """Prints success rate and SPL of each case, of sampled actions."""
    if not (0 < hfov <= 90 and 0 < vfov <= 90):
        raise SystemExit("the rooms' boxes show cameras of up to 90 degrees")
    rooms, decisions = dataset.load_rooms(None), Decisions(None, temperature, done_bias)
    raw, mapped = (through(rooms.tables, hfov, vfov, chosen) for chosen in (False, True))
    camera = f"{hfov:g} x {vfov:g} degrees"
    for case, tables, forbidden, horizon in (
        ("90 x 90 degrees", rooms.tables, (), 0),
        (f"{camera}, as they are", raw, (), 0),
        (f"{camera}, mapped", mapped, (), 0),
        ("90 x 90 degrees, no tilt", rooms.tables, TILTS, 0),
        (f"{camera}, mapped, no tilt", mapped, TILTS, 0),
        (f"{camera}, mapped, always 30 degrees down", mapped, TILTS, 30),
    ):
        shown = dataclasses.replace(rooms, tables=tables)
        player = trace.load_player(run, shown, decisions=decisions)
        task = player.task
        policy = policies.network(player.model, task.words, forbidden=forbidden)
        lists = {
            group: looking(rooms.tables, chosen, horizon)
            for group, chosen in episodes.load(rooms.tables, task.split, task.extras).items()
        }
        played = rollout.evaluate_lists(policy, player.weights, task.eval_params, lists, seed=0)
        for group, pair in played.items():
            columns = report.columns(rooms.tables, *pair)
            found = metrics.summarise(*(columns[name] for name in metrics.COLUMNS))["L>=1"]
            print(f"{case}, {group}: {found['SR']:.1f} / {found['SPL']:.1f}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:2], *map(float, sys.argv[2:6]))
