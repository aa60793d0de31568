"""A picture of a room: its plan, and what the camera sees from one state."""

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle, Wedge

from tdanet_jax import poses
from tdanet_jax.io import files
from tdanet_jax.scenes.floor_plan import area, footprint
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility.rules import RULES
from tdanet_jax.scenes.visibility.solids import void_boxes

VISIBLE, SEEN, QUIET = "#c0392b", "#2c6fbb", "#9aa5ad"


def most_telling_state(tables: SceneTables) -> int:
    """The level state with most classes visible; the first of equals."""
    pair = tables.row_state[tables.row_visible].astype(np.int64) * len(tables.classes)
    pair = np.unique(pair + tables.row_class[tables.row_visible])
    counts = np.bincount(pair // len(tables.classes), minlength=tables.num_states)
    counts[poses.split(np.arange(tables.num_states)).horizon > 0] = -1
    return int(counts.argmax())


def draw(scene: Scene, tables: SceneTables, state: int, path: Path) -> None:
    """Write the picture of `scene` with the view from `state`.

    Args:
        tables: those of this scene alone. path: ends in a format of matplotlib, say .png.
    """
    figure = Figure(figsize=(15, 7.2), layout="constrained")
    plan, view = figure.subplots(1, 2)
    rows = slice(tables.row_start[state], tables.row_start[state + 1])
    seen = {
        int(o): bool(v)
        for o, v in zip(tables.row_object[rows], tables.row_visible[rows], strict=True)
    }
    _draw_plan(plan, scene, tables, state, seen)
    _draw_view(view, tables, state)
    with files.replacing(path) as fresh:
        figure.savefig(fresh, dpi=110)


def _draw_plan(
    axes: Axes, scene: Scene, tables: SceneTables, state: int, seen: dict[int, bool]
) -> None:
    for box in void_boxes(scene, RULES):
        size = box[1] - box[0]
        axes.add_patch(Rectangle((box[0, 0], box[0, 2]), size[0], size[2], color="#e3e3e3", lw=0))
    spots = tables.position[:, [0, 2]]
    axes.scatter(spots[:, 0], spots[:, 1], s=7, color="#7fb77e", zorder=2)
    order = sorted(range(len(scene.objects)), key=lambda k: -area(footprint(scene, k)))
    for k in order:
        color = {True: VISIBLE, False: SEEN, None: QUIET}[seen.get(k)]
        axes.add_patch(
            Polygon(footprint(scene, k), facecolor=color + "22", edgecolor=color, lw=0.9, zorder=3)
        )
        if k in seen or area(footprint(scene, k)) > 0.15:
            x, z = footprint(scene, k).mean(axis=0)
            name = scene.objects[k].object_class
            axes.text(x, z, name, fontsize=6, color=color, ha="center", va="center", zorder=5)
    pose = poses.split(state)
    x, _, z = tables.position[pose.position]
    rotation, horizon = pose.degrees
    axes.add_patch(Wedge((x, z), 1.5, 45 - rotation, 135 - rotation, color="#f1c40f", alpha=0.3))
    axes.plot(x, z, "o", color="black", ms=6, zorder=6)
    axes.set_aspect("equal")
    axes.autoscale_view()
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    axes.set_title(
        f"{scene.name}: {len(spots)} points, {len(scene.objects)} objects; agent at x {x:.2f}, "
        f"z {z:.2f}, rotation {rotation}, horizon {horizon}",
        fontsize=9,
    )


def _draw_view(axes: Axes, tables: SceneTables, state: int) -> None:
    axes.set_xlim(0, tables.image)
    axes.set_ylim(tables.image, 0)
    axes.set_aspect("equal")
    axes.set_facecolor("#fbfbf8")
    rows = np.arange(tables.row_start[state], tables.row_start[state + 1])
    rows = rows[tables.row_box[rows, 0] >= 0]
    boxes = tables.row_box[rows] / tables.subpixel
    sizes = (boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])
    for i in np.argsort(-sizes):
        x1, y1, x2, y2 = boxes[i]
        color = VISIBLE if tables.row_visible[rows[i]] else SEEN
        axes.add_patch(
            Rectangle((x1, y1), x2 - x1, y2 - y1, facecolor=color + "10", edgecolor=color, lw=1)
        )
        name = tables.classes[tables.row_class[rows[i]]]
        axes.text(x1 + 1, y1 + 1, name, fontsize=6.5, color=color, va="top", clip_on=True)
    axes.set_title(
        f"the camera's view: {len(rows)} objects; red: visible (within reach), blue: farther",
        fontsize=9,
    )
    axes.set_xlabel("pixels")
