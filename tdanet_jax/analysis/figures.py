"""Pictures of a run."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from tdanet_jax.evaluation.comparison import MEASURES, Curve
from tdanet_jax.io import files
from tdanet_jax.splits import GROUPS

#: Colours (Okabe and Ito) that stay apart for the colour-blind and, with the dashes, in grey.
BLUE, ORANGE, GREEN = "#0072B2", "#D55E00", "#009E73"
PALETTE = (BLUE, ORANGE, GREEN, "#CC79A7", "#000000", "#E69F00", "#56B4E9", "#F0E442")
#: Shapes for many lines in one picture, so that they stay apart without colour.
MARKERS = "osD^vPX*"


def learning_curve(rows: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Success, SPL, episode length and entropy against training episodes, from metrics rows."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
    FigureCanvasAgg(figure)
    left, right = figure.subplots(1, 2)
    episodes = [row["episodes"] for row in rows]

    def column(name: str) -> np.ndarray:
        return np.array([row[name] for row in rows], float)  # None becomes NaN: a gap

    left.plot(episodes, 100 * column("success"), color=BLUE, label="SR")
    left.plot(episodes, 100 * column("spl"), "--", color=ORANGE, label="SPL")
    left.set(ylabel="per cent, training rooms", ylim=(0, 100))
    right.plot(episodes, column("length"), color=GREEN, label="actions per episode")
    right.set(ylabel="actions per episode", ylim=(0, None))
    entropy = right.twinx()
    entropy.plot(episodes, column("entropy"), ":", color="0.3", label="entropy")
    entropy.set(ylabel="entropy of the policy (nats)", ylim=(0, None))
    # Above the axes, where no line runs.
    place = {"loc": "lower center", "bbox_to_anchor": (0.5, 1.0), "ncols": 2, "frameon": False}
    left.legend(**place)
    right.legend(handles=[*right.get_lines(), *entropy.get_lines()], **place)
    for axis in (left, right):
        _episodes_along(axis)
    figure.suptitle(_in_lines(title))
    with files.replacing(path) as fresh:
        figure.savefig(fresh, dpi=130)


def scaling(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Steps per second and memory of training against each `size` and its `value`."""
    sizes = list(dict.fromkeys(row["size"] for row in rows))
    figure = Figure(figsize=(3 * len(sizes), 5), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(2, len(sizes), sharey="row", sharex="col", squeeze=False)
    for column, size in zip(axes.T, sizes, strict=True):
        chosen = [row for row in rows if row["size"] == size]
        values = [row["value"] for row in chosen]
        column[0].plot(values, [row["steps_per_second"] for row in chosen], "o-", color=BLUE)
        for name, style, color in (("temporary_mb", "s-", ORANGE), ("arguments_mb", "^--", GREEN)):
            memory = [row[name] for row in chosen]
            column[1].plot(values, memory, style, color=color, label=_MEMORY[name])
        column[1].set(xscale="log", yscale="log", xlabel=size, xticks=values)
        column[1].xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:,.0f}"))
        column[1].minorticks_off()
        column[1].tick_params(axis="x", rotation=45)
        for axis in column:
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set(ylabel="environment steps / s", ylim=(0, None))
    axes[0, 0].yaxis.set_major_formatter(FuncFormatter(lambda y, _: f"{y:,.0f}"))
    axes[1, 0].set_ylabel("memory (MB)")
    axes[1, -1].legend(frameon=False, loc="upper center")
    with files.replacing(path) as fresh:
        figure.savefig(fresh, dpi=130)


_MEMORY = {"temporary_mb": "rollout and tape", "arguments_mb": "rooms, parameters, state"}


def evaluated_curves(curves: Sequence[Curve], title: str, path: Path) -> None:
    """SR and SPL in the test rooms against training episodes, from evaluated histories.

    Seen targets are solid lines, unseen ones dashed; a band is one deviation over seeds.
    """
    figure = Figure(figsize=(9, 4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2)
    for axis, measure in zip(axes, MEASURES, strict=True):
        for i, curve in enumerate(curves):
            style = PALETTE[i % len(PALETTE)], MARKERS[i % len(MARKERS)]
            for group in GROUPS:
                _draw_curve(axis, curve, group, measure, *style)
        axis.set(ylabel=f"{measure}, per cent, test rooms", ylim=(0, None), xlim=(0, None))
        _episodes_along(axis)
    figure.suptitle(_in_lines(title))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    with files.replacing(path) as fresh:
        figure.savefig(fresh, dpi=130)


def _in_lines(title: str) -> str:
    """A title over two panels; the name of a split may be longer than they are wide."""
    return textwrap.fill(re.sub(r",(?! )", ", ", title), 90)


def _draw_curve(
    axis: Axes, curve: Curve, group: str, measure: str, colour: str, marker: str
) -> None:
    """One line of a learning curve, with its band, if there is anything to draw."""
    points = zip(curve.episodes, curve.values[group, measure], strict=True)
    known = [(x, y.mean, y.sd or 0.0) for x, y in points if y is not None]
    if not known:
        return
    x, mean, sd = np.array(known).T
    seen = group == "seen"
    axis.plot(
        x, mean, "-" if seen else "--", color=colour, marker=marker, markersize=4, linewidth=1.5,
        markerfacecolor=colour if seen else "white", label=f"{curve.label}, {group}",
    )  # fmt: skip
    if sd.any():
        axis.fill_between(x, mean - sd, mean + sd, color=colour, alpha=0.15, linewidth=0)


def _episodes_along(axis: Axes) -> None:
    """Training episodes along the x axis; a light grid and no upper border."""
    axis.set_xlabel("training episodes")
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1000:,.0f}k"))
    axis.grid(alpha=0.3)
    axis.spines[["top"]].set_visible(False)
