"""Floor plans, camera views and paths, drawn with Matplotlib; the colours of every figure."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backend_bases import FigureCanvasBase
from matplotlib.colors import LinearSegmentedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Polygon, Rectangle, Wedge
from matplotlib.patheffects import withStroke

from tdanet_jax.analysis import labels
from tdanet_jax.io import files
from tdanet_jax.io.escaping import in_figure
from tdanet_jax.scenes.camera_view import CameraView
from tdanet_jax.scenes.floor_plan import FloorPlan
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.vocabulary import FIELD_OF_VIEW, VISIBILITY_DISTANCE

if TYPE_CHECKING:
    from tdanet_jax.analysis.trace import Trace

#: Okabe and Ito's colours, which the colour-blind can tell apart; with dashes also legible in grey.
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
PALETTE = (BLUE, ORANGE, GREEN, "#CC79A7", "#000000", "#E69F00", "#56B4E9", "#F0E442")
#: Shapes that tell many lines apart without colour.
MARKERS = "osD^vPX*"
#: Attention from white to blue; darker means more in grey, too.
SHADES = LinearSegmentedColormap.from_list("attention", ["#ffffff", BLUE])
FRAME, FILL = "0.55", "0.93"
DASHED = (0, (2.5, 1.3))
MOST_SECTORS, MOST_NUMBERS = 6, 8
DPI = 110


def formats() -> list[str]:
    """Endings of the files that pictures can be written to."""
    return sorted({*FigureCanvasBase.get_supported_filetypes()} - {"pgf"})  # it needs LaTeX


def save(figure: Figure, path: Path, dpi: int = DPI, comment: str | None = None) -> None:
    """Writes a figure, whole or not at all; the ending of `path` says in which format.

    Args:
      comment: unseen, in a PNG file.
    """
    with files.replacing(path) as fresh:
        figure.savefig(fresh, dpi=dpi, metadata=None if comment is None else {"Comment": comment})


def draw_view(
    axes: Axes, seen: CameraView, attention: np.ndarray | None, target: str | None,
    colors: Sequence[str] | None = None, scale: float = 1.0,
) -> None:  # fmt: skip
    """The camera's view: boxes shaded by attention, the target outlined.

    The outline is dashed while the target is not visible within 1.5 m.

    Args:
      attention: [n] weight of each box, or None.
      colors: [n] colours of the boxes' sides; by default grey.
      scale: of the names' font.
    """
    axes.set(xlim=(0, 1), ylim=(1, 0), xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_color(FRAME)
    sought, areas = np.array(seen.classes) == target, seen.areas
    for i in sorted(range(len(areas)), key=lambda i: (sought[i], -areas[i])):
        x1, y1, x2, y2 = seen.boxes[i]
        alpha = 0.0 if attention is None else min(float(attention[i]), 1.0)
        color, width = ("black", 2.6) if sought[i] else (colors[i] if colors else FRAME, 0.9)
        dash = DASHED if sought[i] and not seen.visible[i] else "-"
        box = ((x1, y1), x2 - x1, y2 - y1)
        axes.add_patch(Rectangle(*box, color=BLUE, alpha=alpha, lw=0))
        axes.add_patch(Rectangle(*box, fill=False, edgecolor=color, lw=width, ls=dash))
    size = axes.get_window_extent().width / axes.figure.dpi * 72 * scale * labels.VIEW_FONT
    for label in labels.of_view(seen, attention, target, scale):
        color = colors[label.of] if colors else "black"
        _write(axes, label.text, label.x, label.y, size, sought[label.of], color)


def draw_plan(
    axes: Axes, plan: FloorPlan, target: str | None,
    colors: Mapping[int, str] | None = None, scale: float = 1.0,
) -> None:  # fmt: skip
    """A room from above: furniture, reachable points, the target's objects outlined.

    Args:
      colors: of some of the outlines, by index; those have names, too.
      scale: of the names' font.
    """
    colors, sought = colors or {}, plan.of_class(target)
    x1, z1, x2, z2 = plan.extent
    axes.set(xlim=(x1, x2), ylim=(z1, z2), xticks=[], yticks=[], aspect="equal")
    axes.spines[:].set_color(FRAME)
    for i, outline in enumerate(plan.outlines):
        face, edge = ((colors[i], 0.13), colors[i]) if i in colors else ((FILL, 0.7), ("0.7", 0.7))
        axes.add_patch(Polygon(outline, facecolor=face, edgecolor=edge, lw=0.8))
        if i in sought:
            axes.add_patch(Polygon(outline, fill=False, edgecolor="black", lw=2.2, zorder=6))
    axes.plot(*plan.points.T, ".", color="0.6", ms=1.5, zorder=2)
    size = scale * _font(axes, plan)
    for label in labels.of_plan(plan, [*sought, *colors], scale):
        color = colors.get(label.of, "black")
        _write(axes, label.text, label.x, -label.y, size, label.of in sought, color)


def draw_agent(axes: Axes, place: Sequence[float], rotation: float) -> None:
    """The agent at (x, z), looking `rotation` degrees clockwise from +z, and its field of view."""
    _draw_field_of_view(axes, place, rotation, 0.3)
    heading = (3, 0, -rotation)  # a triangle, turned counterclockwise
    axes.plot(*place, color=ORANGE, marker=heading, ms=13, markeredgecolor="black", zorder=8)


def draw_path(
    axes: Axes, trace: Trace, plan: FloorPlan, tables: SceneTables, step: int | None = None
) -> None:
    """A trace on its floor plan, with a star (success) or a cross (failure) at the end.

    Args:
      step: draws the path up to this step and the agent there; by default the whole path, with
        numbers of steps and some fields of view.
    """
    grid = tables.grid
    pose = grid.split(trace.pose if step is None else trace.pose[: step + 1])
    places, (turns, _) = tables.position[pose.position][:, [0, 2]], grid.degrees(pose)
    if step is None:
        level = grid.join(pose.position, pose.rotation)[:-1]  # the horizon left out
        first = np.sort(np.unique(level, return_index=True)[1])
        for k in first[np.linspace(0, len(first) - 1, min(len(first), MOST_SECTORS)).astype(int)]:
            _draw_field_of_view(axes, places[k], turns[k], 0.1)
        for label in _step_numbers(places, plan):
            _write(axes, label.text, label.x, -label.y, _font(axes, plan), True)
    axes.plot(*places.T, "-", color=ORANGE, lw=2.5, zorder=5, solid_joinstyle="round")
    axes.plot(*places.T, "o", color=ORANGE, ms=3.5, zorder=5)
    axes.plot(*places[0], "o", mfc="white", color=ORANGE, mew=2, ms=9, zorder=7)
    if step is not None and step < len(trace.actions):
        draw_agent(axes, places[-1], turns[-1])
        return
    _draw_field_of_view(axes, places[-1], turns[-1], 0.3)
    end: dict[str, Any] = {"marker": "*", "ms": 17} if trace.success else {"marker": "X", "ms": 11}
    axes.plot(*places[-1], color=ORANGE, markeredgecolor="black", zorder=8, **end)


def _draw_field_of_view(axes: Axes, place: Sequence[float], rotation: float, alpha: float) -> None:
    half, x, z = FIELD_OF_VIEW / 2, *place
    sides = (90 - rotation - half, 90 - rotation + half)
    axes.add_patch(Wedge((x, z), VISIBILITY_DISTANCE, *sides, color=ORANGE, alpha=alpha, lw=0))


def _step_numbers(places: np.ndarray, plan: FloorPlan) -> list[labels.Label]:
    """Numbers of some steps [T + 1, 2] and of the last, next to the path, one for each place."""
    font, last = labels.plan_font(plan), len(places) - 1
    every = 5 * -(-last // (5 * MOST_NUMBERS))
    numbered: dict[tuple[float, float], int] = {}
    for k in (last, *range(every, last, every)):
        numbered.setdefault((float(places[k, 0]), float(places[k, 1])), k)
    # Blanks keep neighbours apart.
    spots = [(x + font / 2, -z - font / 2) for x, z in numbered]
    things = [(f" {k} ", spot + spot) for k, spot in zip(numbered.values(), spots, strict=True)]
    x1, z1, x2, z2 = plan.extent
    return labels.place(things, font, (x1, -z2, x2, -z1))


def _font(axes: Axes, plan: FloorPlan) -> float:
    """Font size of the names on a plan that fills these axes, in points."""
    x1, z1, x2, z2 = plan.extent
    box = axes.get_window_extent()
    pixels_per_metre = min(box.width / (x2 - x1), box.height / (z2 - z1))
    return labels.plan_font(plan) * pixels_per_metre / axes.figure.dpi * 72


def _write(
    axes: Axes, text: str, x: float, y: float, points: float, bold: bool, color: str = "black"
) -> None:
    """A name whose upper left corner is at (x, y), legible on any shade."""
    axes.text(
        x, y, in_figure(text), va="top", color=color, weight="bold" if bold else "normal", zorder=9,
        # Letters are narrower than `labels` assumes, so that bold ones fit as well.
        fontsize=0.92 * points, path_effects=[withStroke(linewidth=2, foreground="white")],
    )  # fmt: skip
