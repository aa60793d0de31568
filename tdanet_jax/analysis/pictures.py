"""Pictures of rooms and episodes: a floor plan, paths, and the camera's view."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Rectangle
from matplotlib.ticker import MultipleLocator
from PIL import Image

from tdanet_jax.analysis import drawing
from tdanet_jax.analysis.drawing import BLUE, DASHED, FRAME, GREEN, ORANGE, SHADES
from tdanet_jax.io import files
from tdanet_jax.io.escaping import in_figure
from tdanet_jax.scenes import camera_view, floor_plan
from tdanet_jax.scenes.floor_plan import FloorPlan
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility.rules import RULES
from tdanet_jax.scenes.visibility.solids import void_boxes
from tdanet_jax.vocabulary import ACTION_NAMES

if TYPE_CHECKING:
    from tdanet_jax.analysis.trace import Trace


def attention_episode(trace: Trace, tables: SceneTables, path: Path, most: int = 6) -> None:
    """The camera's view at some steps of an episode, boxes shaded by attention, as in the paper."""
    count = len(trace.actions)
    steps = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
    title = f"{trace.player}: {trace.target} in {trace.scene}\n{trace.outcome}"
    widths = [3.9] * min(len(steps), 3)
    figure, panels = _panels(len(steps), widths, 3.9, title, _view_handles(trace))
    for axes, step in zip(panels, steps, strict=True):
        seen = camera_view.of_pose(tables, int(trace.pose[step]))
        weights = None if trace.attention is None else trace.attention[step]
        drawing.draw_view(axes, seen, weights, trace.target)
        axes.set_title(_decision(trace, step), fontsize=10)
    drawing.save(figure, path)


def trajectories(traces: Sequence[Trace], plan: FloorPlan, tables: SceneTables, path: Path) -> None:
    """The paths of one or several players through the same episode, a floor plan each."""
    x1, z1, x2, z2 = plan.extent
    scale = 5.2 / max(x2 - x1, z2 - z1)  # inches per metre
    dot: dict[str, Any] = {"color": ORANGE, "ls": "", "markeredgecolor": "black"}
    handles = [
        Line2D([], [], marker="o", mfc="white", color=ORANGE, mew=2, ls="", label="start"),
        Line2D([], [], color=ORANGE, lw=2.5, label="path, with numbers of steps"),
        _FIELD_OF_VIEW,
        Line2D([], [], marker="*", ms=13, **dot, label="success"),
        Line2D([], [], marker="X", ms=9, **dot, label="failure"),
        Patch(fill=False, edgecolor="black", lw=2.2, label=in_figure(traces[0].target)),
    ]
    widths = [max(scale * (x2 - x1), 3.2)] * min(len(traces), 3)
    title = f"{traces[0].target} in {traces[0].scene}"
    figure, panels = _panels(len(traces), widths, scale * (z2 - z1), title, handles)
    for axes, trace in zip(panels, traces, strict=True):
        drawing.draw_plan(axes, plan, trace.target)
        drawing.draw_path(axes, trace, plan, tables)
        axes.set_title(in_figure(f"{trace.player}\n{trace.outcome}"), fontsize=9.5)
    drawing.save(figure, path)


def animation(traces: Sequence[Trace], plan: FloorPlan, tables: SceneTables, path: Path) -> None:
    """The growing path next to the camera's view, a row for each player, as an animated GIF."""
    x1, z1, x2, z2 = plan.extent
    high = 4.1  # inches
    title = f"{traces[0].target} in {traces[0].scene}"
    handles = [_FIELD_OF_VIEW, *_view_handles(traces[0])]
    widths = [high * (x2 - x1) / (z2 - z1), high]
    figure, panels = _panels(2 * len(traces), widths, high, title, handles)
    figure.set_dpi(drawing.DPI)
    last, canvas = max(len(trace.actions) for trace in traces), FigureCanvasAgg(figure)
    frames = []
    for step in range(last + 1):
        for left, right, trace in zip(panels[::2], panels[1::2], traces, strict=True):
            _draw_step(left, right, trace, min(step, len(trace.actions)), plan, tables)
        canvas.draw()
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
    milliseconds = [*[500] * last, 3000]
    with files.replacing(path) as fresh:
        frames[0].save(
            fresh, "GIF", save_all=True, append_images=frames[1:], duration=milliseconds, loop=0
        )


def _draw_step(
    left: Axes, right: Axes, trace: Trace, step: int, plan: FloorPlan, tables: SceneTables
) -> None:
    """A step's floor plan and camera view; at the end, the outcome."""
    left.clear()
    right.clear()
    decided = min(step, len(trace.actions) - 1)
    same = trace.pose[decided] == trace.pose[step]  # as at the end, after Done
    weights = trace.attention[decided] if trace.attention is not None and same else None
    drawing.draw_plan(left, plan, trace.target)
    drawing.draw_path(left, trace, plan, tables, step)
    seen = camera_view.of_pose(tables, int(trace.pose[step]))
    drawing.draw_view(right, seen, weights, trace.target)
    left.set_title(in_figure(trace.player), fontsize=10)
    right.set_title(_decision(trace, step) if step == decided else trace.outcome, fontsize=10)


def _decision(trace: Trace, step: int) -> str:
    """A step's number and action, with its probability if there is one."""
    action = trace.actions[step]
    said = f"step {step + 1}: {ACTION_NAMES[action]}"
    if trace.probabilities is not None:
        said += f" ({100 * trace.probabilities[step, action]:.0f} %)"
    return said


_FIELD_OF_VIEW = Patch(facecolor=ORANGE, alpha=0.25, label="field of view to 1.5 m")


def _view_handles(trace: Trace) -> list[Patch]:
    """The legend of a camera's view."""
    target = in_figure(trace.target)
    near = Patch(fill=False, edgecolor="black", lw=2.6, label=f"{target}, within 1.5 m")
    far = Patch(fill=False, edgecolor="black", lw=2.6, ls=DASHED, label=f"{target}, farther")
    if trace.attention is None:
        return [near, far, Patch(fill=False, edgecolor=FRAME, label="this agent has no attention")]
    shades = ((0.1, "attention 10 %"), (0.5, "50 %"), (1.0, "100 %"))
    return [near, far, *(Patch(fc=SHADES(share), ec=FRAME, label=label) for share, label in shades)]


def _panels(
    count: int, widths: Sequence[float], high: float, title: str, handles: Sequence[Artist],
    margin: float = 0.0,
) -> tuple[Figure, Sequence[Axes]]:  # fmt: skip
    """A figure with rows of panels, `widths` and `high` inches in size, and a legend.

    Args:
      margin: inches for the ticks to the left of the panels and below them.
    """
    columns, rows, wide = len(widths), -(-count // len(widths)), sum(widths)
    ncols, below = (6, 0.4 + margin) if wide > 7 else (3, 0.55 + margin)
    above = 0.45 + 0.25 * len(title.splitlines())
    size = (margin + wide + 0.1 * (columns + 1), rows * (high + 0.5) - 0.5 + below + above)
    figure = Figure(figsize=size)
    grid = figure.subplots(rows, columns, squeeze=False, width_ratios=widths)
    figure.subplots_adjust(
        left=(margin + 0.1) / size[0], right=1 - 0.1 / size[0], wspace=0.1 * columns / wide,
        bottom=below / size[1], top=1 - above / size[1], hspace=0.5 / high,
    )  # fmt: skip
    figure.suptitle(in_figure(title), fontsize=12, y=1 - 0.05 / size[1], va="top")
    figure.legend(handles=handles, loc="lower center", ncols=ncols, frameon=False, fontsize=8.5)
    for axes in grid.flat[count:]:
        axes.set_axis_off()
    return figure, list(grid.flat[:count])


def most_telling_state(tables: SceneTables) -> int:
    """The level state with most classes visible; the first of equals."""
    pair = tables.row_state[tables.row_visible].astype(np.int64) * len(tables.classes)
    pair = np.unique(pair + tables.row_class[tables.row_visible])
    counts = np.bincount(pair // len(tables.classes), minlength=tables.num_states)
    views = tables.grid.split(np.arange(tables.num_states))
    counts[views.horizon != tables.grid.level] = -1
    return int(counts.argmax())


def room(scene: Scene, tables: SceneTables, state: int, path: Path) -> None:
    """A room's floor plan and the camera's view from a state; colours say what is visible.

    Args:
      tables: those of this scene alone.
      path: ends in a format of Matplotlib, say .png.
    """
    plan, seen = floor_plan.of_scene(scene), camera_view.of_pose(tables, state)
    pose = tables.grid.split(state)
    x, _, z = tables.position[pose.position]
    rotation, horizon = tables.grid.degrees(pose)
    rows = slice(tables.row_start[state], tables.row_start[state + 1])
    visible = dict(zip(tables.row_object[rows], tables.row_visible[rows], strict=True))
    colors = {i: _COLORS[visible[k]] for i, k in enumerate(plan.objects) if k in visible}
    x1, z1, x2, z2 = plan.extent
    high = 6.0  # inches
    handles = [
        Patch(fill=False, edgecolor=GREEN, lw=1.5, label="visible within 1.5 m"),
        Patch(fill=False, edgecolor=BLUE, lw=1.5, label="in view, farther"),
    ]
    widths = [high * (x2 - x1) / (z2 - z1), high]
    title = f"{scene.name}, {tables.room_at(state).replace('_', ' ')}"
    figure, (left, right) = _panels(2, widths, high, title, handles, margin=0.5)
    drawing.draw_plan(left, plan, None, colors, scale=0.75)
    for low, top in void_boxes(scene, RULES):
        left.add_patch(Rectangle(low[[0, 2]], *(top - low)[[0, 2]], color="0.85", lw=0))
    drawing.draw_agent(left, (x, z), rotation)
    left.xaxis.set_major_locator(MultipleLocator())
    left.yaxis.set_major_locator(MultipleLocator())
    left.set(xlabel="x, m", ylabel="z, m")
    left.set_title(f"{len(plan.points)} reachable points, {len(scene.objects)} objects")
    drawing.draw_view(right, seen, None, None, [_COLORS[near] for near in seen.visible], 0.7)
    where = f"x {x:.2f}, z {z:.2f}, rotation {rotation}, horizon {horizon}"
    right.set_title(f"{len(seen.classes)} objects in view from {where}")
    drawing.save(figure, path)


#: Of objects in view, by whether they are visible.
_COLORS = {True: GREEN, False: BLUE}


def plans(scenes: Sequence[Scene], path: Path) -> None:
    """The floor plans of some rooms side by side, small objects in colour and with their names.

    Args:
      path: ends in a format of Matplotlib, say .png.
    """
    drawn = [floor_plan.of_scene(scene) for scene in scenes]
    spans = [(plan.extent[2] - plan.extent[0], plan.extent[3] - plan.extent[1]) for plan in drawn]
    high = 4.6  # inches
    widths = [high * max(x / z for x, z in spans)] * min(len(scenes), 2)
    handle = Patch(facecolor=(BLUE, 0.13), edgecolor=BLUE, label="small objects")
    figure, panels = _panels(len(scenes), widths, high, scenes[0].name, [handle])
    for axes, scene, plan in zip(panels, scenes, drawn, strict=True):
        small = {i: BLUE for i, k in enumerate(plan.objects) if scene.objects[k].pickupable}
        drawing.draw_plan(axes, plan, None, small, scale=0.7)
        counts = f"{len(plan.points)} reachable points, {len(scene.objects)} objects"
        axes.set_title(in_figure(f"{scene.name}: {counts}"), fontsize=9.5)
    drawing.save(figure, path)
