"""Pictures of episodes and of attention: what was in view and how it was weighed, and the way."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colors import LinearSegmentedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon, Rectangle, Wedge
from matplotlib.patheffects import withStroke

from tdanet_jax import poses
from tdanet_jax.analysis import labels
from tdanet_jax.analysis.attention import MIN_FRAMES, ClassPairs
from tdanet_jax.analysis.figures import BLUE, ORANGE
from tdanet_jax.analysis.trace import Trace, View, view
from tdanet_jax.scenes.floor_plan import FloorPlan
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.vocabulary import ACTION_NAMES

#: White to blue, lighter to darker in grey as well; the shade of a box, and of a pair.
SHADES = LinearSegmentedColormap.from_list("attention", ["#ffffff", BLUE])
FRAME, FILL = "0.55", "0.93"
MOST_SECTORS, MOST_NUMBERS = 6, 8
DASHED = (0, (2.5, 1.3))
REACH = 1.5  # metres, of the field of view that is drawn
DPI = 110


def formats() -> list[str]:
    """Endings of the files that pictures can be written to."""
    return sorted(FigureCanvasBase.get_supported_filetypes())


def draw_view(axes: Axes, seen: View, attention: np.ndarray | None, target: str) -> None:
    """The camera's image: boxes shaded by attention [n], the target outlined.

    The outline is dashed while the target is not visible within 1.5 m.
    """
    axes.set(xlim=(0, 1), ylim=(1, 0), xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_color(FRAME)
    size = (seen.boxes[:, 2] - seen.boxes[:, 0]) * (seen.boxes[:, 3] - seen.boxes[:, 1])
    for i in sorted(range(len(size)), key=lambda i: (seen.classes[i] == target, -size[i])):
        x1, y1, x2, y2 = seen.boxes[i]
        sought = seen.classes[i] == target
        alpha = 0.0 if attention is None else min(float(attention[i]), 1.0)
        color, width = ("black", 2.6) if sought else (FRAME, 0.9)
        dash = DASHED if sought and not seen.within_reach[i] else "-"
        box = ((x1, y1), x2 - x1, y2 - y1)
        axes.add_patch(Rectangle(*box, color=BLUE, alpha=alpha, lw=0))
        axes.add_patch(Rectangle(*box, fill=False, edgecolor=color, lw=width, ls=dash))
    points = axes.get_window_extent().width / axes.figure.dpi * 72
    for label in labels.of_view(seen, attention, target):
        bold = "bold" if seen.classes[label.of] == target else "normal"
        _write(axes, label.text, label.x, label.y, points * labels.VIEW_FONT, bold)


def _write(axes: Axes, text: str, x: float, y: float, points: float, weight: str) -> None:
    """A name whose left upper corner is at (x, y), readable on any shade."""
    # Letters are narrower than the room that was kept for them, so that bold ones fit as well.
    halo = [withStroke(linewidth=2, foreground="white")]
    style: dict[str, Any] = {"va": "top", "weight": weight, "path_effects": halo, "zorder": 9}
    axes.text(x, y, text, fontsize=0.92 * points, **style)


def attention_episode(
    trace: Trace, tables: SceneTables, title: str, path: Path, most: int = 6
) -> None:
    """What was in view at some steps of an episode, shaded by attention, as in the paper."""
    count = len(trace.actions)
    steps = np.unique(np.linspace(0, count - 1, min(most, count)).round().astype(int))
    columns = min(len(steps), 3)
    rows = -(-len(steps) // columns)
    figure = Figure(figsize=(3.9 * columns + 0.4, 4.1 * rows + 0.9))
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(
        left=0.01, right=0.99, wspace=0.04, hspace=0.13,
        bottom=0.62 / (4.1 * rows + 0.9), top=1 - 0.75 / (4.1 * rows + 0.9),
    )  # fmt: skip
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, step in zip(grid.flat, steps, strict=False):
        axes.set_axis_on()
        weights = None if trace.attention is None else trace.attention[step]
        draw_view(axes, view(tables, int(trace.pose[step])), weights, trace.target)
        said = f"step {step + 1}: {ACTION_NAMES[trace.actions[step]]}"
        if trace.probabilities is not None:
            said += f" ({100 * trace.probabilities[step, trace.actions[step]]:.0f} %)"
        axes.set_title(said, fontsize=10)
    figure.suptitle(f"{title}\n{trace.outcome}", fontsize=11, y=0.995, va="top")
    _view_legend(figure, trace)
    figure.savefig(path, dpi=DPI)


def _view_legend(figure: Figure, trace: Trace) -> None:
    near = Patch(fill=False, edgecolor="black", lw=2.6, label=f"{trace.target}, within 1.5 m")
    far = Patch(fill=False, edgecolor="black", lw=2.6, ls=DASHED, label=f"{trace.target}, farther")
    handles = [near, far]
    if trace.attention is None:
        handles.append(Patch(fill=False, edgecolor=FRAME, label="this agent has no attention"))
    else:
        for share in (0.1, 0.5, 1.0):
            shade = Patch(facecolor=SHADES(share), edgecolor=FRAME, label=f"{100 * share:.0f} %")
            handles.append(shade)
        handles[2].set_label("attention 10 %")
    figure.legend(handles=handles, loc="lower center", ncols=5, frameon=False, fontsize=9)


def class_pairs(pairs: ClassPairs, unseen: Collection[str], title: str, path: Path) -> None:
    """Mean attention by class pair; columns are the classes that any target attends to most."""
    value = np.where(pairs.frames >= MIN_FRAMES, pairs.attention, np.nan)
    kept = [g for g in range(len(pairs.targets)) if np.isfinite(value[g]).any()]
    value = value[kept]
    # The seen classes with the greatest mean attention for any target, in the order of the targets
    # that attend to them.
    best = np.nan_to_num(value, nan=-1.0).max(axis=0, initial=-1.0)
    columns = np.sort(np.argsort(-best, kind="stable")[: min(40, (best >= 0).sum())])
    own = {name: i for i, name in enumerate(pairs.targets[g] for g in kept)}
    order = sorted(columns, key=lambda c: (own.get(pairs.classes[c], len(own)), pairs.classes[c]))
    value = value[:, order]
    figure = Figure(figsize=(2.2 + 0.36 * len(order), 2.6 + 0.3 * len(kept)), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.patch.set(facecolor="white", hatch="////", edgecolor="0.8", linewidth=0)
    if value.size:
        axes.imshow(value, cmap=SHADES, vmin=0, vmax=1, aspect="auto")
    for g, c in zip(*np.nonzero(value >= 0.095), strict=True):
        color = "white" if value[g, c] > 0.85 else "black"
        text = f"{100 * value[g, c]:.0f}"
        axes.text(c, g, text, ha="center", va="center", fontsize=7.5, color=color)
    for row, g in enumerate(kept):
        if pairs.targets[g] in (names := [pairs.classes[c] for c in order]):
            column = names.index(pairs.targets[g])
            corner = (column - 0.5, row - 0.5)
            axes.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor="black", lw=1.6))
    named = [pairs.targets[g] + ("*" if pairs.targets[g] in unseen else "") for g in kept]
    axes.set_yticks(range(len(kept)), named, fontsize=9)
    axes.set_xticks(range(len(order)), [pairs.classes[c] for c in order], fontsize=9, rotation=90)
    axes.set(xlabel="class in view", ylabel="target")
    axes.spines[:].set_visible(False)
    bar = figure.colorbar(ScalarMappable(Normalize(0, 100), SHADES), ax=axes, pad=0.01, aspect=30)
    bar.set_label("mean attention, per cent")
    note = (
        "framed: the target, where in view; others: in frames without the target; "
        f"hatched: fewer than {MIN_FRAMES} frames"
    )
    if unseen:
        note += "; * never a target in training"
    axes.set_title(f"{title}\n{note}", fontsize=10)
    figure.savefig(path, dpi=DPI)


def trajectories(traces: Sequence[Trace], plan: FloorPlan, tables: SceneTables, path: Path) -> None:
    """The way of one or several players through the same episode, from above, a panel each."""
    x1, z1, x2, z2 = plan.extent
    columns = min(len(traces), 3)
    rows = -(-len(traces) // columns)
    scale = 5.2 / max(x2 - x1, z2 - z1)  # inches a metre
    wide, high = max(scale * (x2 - x1), 3.2), scale * (z2 - z1)
    size = (columns * (wide + 0.1), rows * (high + 0.5) + 0.85)
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    grid = figure.subplots(rows, columns, squeeze=False)
    figure.subplots_adjust(
        left=0.01, right=0.99, wspace=0.03, hspace=0.5 / high,
        bottom=0.55 / size[1], top=1 - 0.72 / size[1],
    )  # fmt: skip
    for axes in grid.flat:
        axes.set_axis_off()
    for axes, trace in zip(grid.flat, traces, strict=False):
        draw_plan(axes, plan, trace.target, 72 * scale)
        draw_way(axes, trace, plan, tables, 72 * scale)
        axes.set_title(f"{trace.player}\n{trace.outcome}", fontsize=9.5)
    first = traces[0]
    figure.suptitle(f"{first.target} in {first.scene}", fontsize=12, y=0.995, va="top")
    dot: dict[str, Any] = {"color": ORANGE, "ls": "", "markeredgecolor": "black"}
    figure.legend(
        handles=[
            Line2D([], [], marker="o", mfc="white", color=ORANGE, mew=2, ls="", label="start"),
            Line2D([], [], color=ORANGE, lw=2.5, label="path, with numbers of steps"),
            Patch(facecolor=ORANGE, alpha=0.25, label="field of view to 1.5 m"),
            Line2D([], [], marker="*", ms=13, **dot, label="success"),
            Line2D([], [], marker="X", ms=9, **dot, label="failure"),
            Patch(fill=False, edgecolor="black", lw=2.2, label=first.target),
        ],
        loc="lower center", ncols=6 if columns > 1 else 3, frameon=False, fontsize=8.5,
    )  # fmt: skip
    figure.savefig(path, dpi=DPI)


def draw_plan(axes: Axes, plan: FloorPlan, target: str, points_a_metre: float) -> None:
    """A room from above: furniture, reachable points, the target's objects outlined."""
    x1, z1, x2, z2 = plan.extent
    axes.set(xlim=(x1, x2), ylim=(z1, z2), xticks=[], yticks=[], aspect="equal")
    axes.set_axis_on()
    axes.spines[:].set_color(FRAME)
    for name, outline in zip(plan.classes, plan.outlines, strict=True):
        axes.add_patch(Polygon(outline, facecolor=FILL, edgecolor="0.7", lw=0.8, alpha=0.7))
        if name == target:
            edge: dict[str, Any] = {"fill": False, "edgecolor": "black", "lw": 2.2, "zorder": 6}
            axes.add_patch(Polygon(outline, **edge))
    axes.plot(*plan.points.T, ".", color="0.6", ms=1.5, zorder=2)
    size = points_a_metre * labels.plan_font(plan)
    for label in labels.of_plan(plan, target):
        weight = "bold" if plan.classes[label.of] == target else "normal"
        _write(axes, label.text, label.x, -label.y, size, weight)


def draw_way(
    axes: Axes, trace: Trace, plan: FloorPlan, tables: SceneTables, points_a_metre: float
) -> None:
    """Path, start, some fields of view, numbers of steps, and a star or a cross at the end."""
    pose = poses.split(trace.pose)
    places = tables.position[pose.position][:, [0, 2]]
    size = points_a_metre * labels.plan_font(plan)
    turns, _ = pose.degrees
    level = poses.join(pose.position, pose.rotation)[:-1]  # the horizon left out
    _, first = np.unique(level, return_index=True)
    few = np.sort(first)[np.linspace(0, len(first) - 1, min(len(first), MOST_SECTORS)).astype(int)]
    for k in [*few, len(places) - 1]:
        sector = (tuple(places[k]), REACH, 45 - turns[k], 135 - turns[k])
        alpha = 0.3 if k == len(places) - 1 else 0.1
        axes.add_patch(Wedge(*sector, color=ORANGE, alpha=alpha, lw=0))
    axes.plot(*places.T, "-", color=ORANGE, lw=2.5, zorder=5, solid_joinstyle="round")
    axes.plot(*places.T, "o", color=ORANGE, ms=3.5, zorder=5)
    axes.plot(*places[0], "o", mfc="white", color=ORANGE, mew=2, ms=9, zorder=7)
    for label in _step_numbers(places, plan):
        _write(axes, label.text, label.x, -label.y, size, "bold")
    end: dict[str, Any] = {"marker": "*", "ms": 17} if trace.success else {"marker": "X", "ms": 11}
    axes.plot(*places[-1], color=ORANGE, markeredgecolor="black", zorder=8, **end)


def _step_numbers(places: np.ndarray, plan: FloorPlan) -> list[labels.Label]:
    """Numbers of some steps [T + 1, 2] and the last, beside the path, one a place."""
    font = labels.plan_font(plan)
    last = len(places) - 1
    every = 5 * -(-last // (5 * MOST_NUMBERS))
    numbered: dict[tuple[float, float], int] = {}
    for k in (last, *range(every, last, every)):
        numbered.setdefault((float(places[k, 0]), float(places[k, 1])), k)
    # Blanks keep neighbours apart.
    spots = [(x + font / 2, -z - font / 2) for x, z in numbered]
    things = [(f" {k} ", spot + spot) for k, spot in zip(numbered.values(), spots, strict=True)]
    x1, z1, x2, z2 = plan.extent
    return labels.place(things, font, (x1, -z2, x2, -z1))
