"""Charts of runs: learning curves, costs, and mean attention."""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import FuncFormatter

from tdanet_jax.analysis import drawing
from tdanet_jax.analysis.attention import MIN_FRAMES, ClassPairs
from tdanet_jax.analysis.drawing import BLUE, GREEN, MARKERS, ORANGE, PALETTE, SHADES
from tdanet_jax.analysis.failures import CAUSES, METRES, METRES_NAMES, Summary
from tdanet_jax.evaluation.comparison import MEASURES, Curve
from tdanet_jax.io.escaping import in_figure
from tdanet_jax.splits import GROUPS

DPI = 130
#: Points of a learning curve, at most: enough to see its shape, too few to see its noise.
PARTS = 60
#: x and y of a curve: million steps, per cent.
_Line = tuple[list[float], list[float]]
#: Line style, colour and label of what training keeps in memory.
_MEMORY = {
    "temporary_mb": ("s-", ORANGE, "rollout and activation cache"),
    "arguments_mb": ("^--", GREEN, "rooms, parameters, state"),
}

#: Of the causes of failures: blue and green with Done, the others at the step limit.
_CAUSE_COLORS = (BLUE, PALETTE[6], GREEN, PALETTE[3], ORANGE, PALETTE[5])


def learning_curve(rows: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """Success, SPL, episode length and entropy against training episodes, from metrics rows."""
    figure = Figure(figsize=(9, 3.6), layout="constrained")
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
    drawing.save(figure, path, DPI)


def training_curves(
    runs: Sequence[tuple[str, Sequence[dict[str, Any]]]],
    title: str,
    path: Path,
    comment: str | None = None,
) -> None:
    """SR and SPL in the training rooms against environment steps, a line for each agent.

    Agents trained for the same number of steps, to two digits, share a row of panels, sorted by SR
    at the end of training, highest first. Lines are means over an agent's runs and over steps, in
    `PARTS` parts of the logarithmic axis.

    Args:
      runs: a label and the rows of `metrics.jsonl` of each; runs of one label are one agent.
      title: above all panels.
      path: the picture's file.
      comment: unseen, in the file; it must be a PNG then.
    """
    agents: dict[str, list[dict[str, Any]]] = {}
    for label, own in runs:
        agents.setdefault(label, []).extend(own)
    every = [row["steps"] / 1e6 for own in agents.values() for row in own]
    edges = np.geomspace(min(every), max(every), PARTS + 1)
    budgets: dict[float, list[tuple[float, str, list[_Line]]]] = {}
    for label, own in agents.items():
        lines = [_by_part(own, name, edges) for name in ("success", "spl")]
        last = lines[0][1][-1] if lines[0][1] else 0.0
        millions = float(f"{max(row['steps'] for row in own) / 1e6:.2g}")
        listed = textwrap.fill(in_figure(label), 64)
        budgets.setdefault(millions, []).append((last, listed, lines))
    heights = [
        max(2.6, 0.9 + 0.16 * sum(listed.count("\n") + 1 for _, listed, _ in budgets[millions]))
        for millions in sorted(budgets)
    ]
    figure = Figure(figsize=(14, 0.5 + sum(heights)), layout="constrained")
    panels = figure.subplots(len(budgets), 3, height_ratios=heights, squeeze=False)
    for (*axes, legend_axis), millions in zip(panels, sorted(budgets), strict=True):
        members = sorted(budgets[millions], key=lambda member: -member[0])
        for index, (axis, measure) in enumerate(zip(axes, MEASURES, strict=True)):
            for (*_, lines), (color, dashes) in zip(members, _line_styles(), strict=False):
                axis.plot(*lines[index], dashes, color=color, linewidth=1.2)
            axis.set(xscale="log", xlim=(0.9 * edges[0], 1.1 * edges[-1]), ylim=(0, 100))
            axis.set(xlabel="million environment steps", ylabel=f"{measure}, per cent")
            axis.xaxis.set_major_formatter("{x:g}")
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
        axes[0].set_title(f"{millions:g} M steps", loc="left", fontsize=10)
        names = [listed for _, listed, _ in members]
        legend_axis.set_axis_off()
        legend_axis.legend(axes[0].lines, names, loc="center left", fontsize=8, frameon=False)
    figure.suptitle(_in_lines(title))
    drawing.save(figure, path, DPI, comment)


def _line_styles() -> Iterator[tuple[str, str]]:
    """Colours and dashes that tell lines apart, again and again."""
    return itertools.cycle(
        [(color, dashes) for dashes in ("-", "--", ":", "-.") for color in PALETTE]
    )


def _by_part(rows: Sequence[dict[str, Any]], name: str, edges: np.ndarray) -> _Line:
    """Million steps, and a column of `metrics.jsonl` in percent, as means between edges."""
    steps = np.array([row["steps"] / 1e6 for row in rows])
    rates = 100 * np.array([row[name] for row in rows], float)  # None becomes NaN
    known = ~np.isnan(rates)
    part = np.searchsorted(edges[1:-1], steps, side="right")
    parts = [known & (part == i) for i in np.unique(part[known])]
    return [steps[one].mean() for one in parts], [rates[one].mean() for one in parts]


def data_curve(
    points: Sequence[tuple[str, str, int, Mapping[str, Mapping[str, float]]]],
    path: Path,
    comment: str | None = None,
) -> None:
    """SR and SPL of seen and unseen targets against what agents were trained on.

    Args:
      points: of each run, what is counted, its kind, its number, and the results in percent by
        group and measure. A kind's line goes through the means of runs with the same number.
      path: the picture's file.
      comment: unseen, in the file; it must be a PNG then.
    """
    counted = [*dict.fromkeys(what for what, *_ in points)]
    figure = Figure(figsize=(4 * len(counted) * len(GROUPS), 6), layout="constrained")
    axes = figure.subplots(
        len(MEASURES), len(counted) * len(GROUPS), sharex="col", sharey="row", squeeze=False
    )
    kinds = [*dict.fromkeys(kind for _, kind, _, _ in points)]
    for row, measure in zip(axes, MEASURES, strict=True):
        for axis, (what, group) in zip(row, itertools.product(counted, GROUPS), strict=True):
            own = [(k, n, found[group][measure]) for w, k, n, found in points if w == what]
            for index, kind in enumerate(kinds):
                runs = [(count, rate) for k, count, rate in own if k == kind]
                if not runs:
                    continue
                counts = sorted({count for count, _ in runs})
                means = [np.mean([rate for n, rate in runs if n == count]) for count in counts]
                color = PALETTE[index % len(PALETTE)]
                axis.plot(counts, means, "-", color=color, linewidth=1)
                marker = MARKERS[index % len(MARKERS)]
                axis.plot(*zip(*runs, strict=True), marker, color=color, label=kind)
            axis.set(xscale="log", ylabel=f"{group} targets, {measure}, per cent")
            ticks: list[int] = []
            for count in sorted({count for _, count, _ in own}):
                if not ticks or count > 1.2 * ticks[-1]:  # labels would overlap
                    ticks.append(count)
            axis.margins(0.08)
            axis.set_xticks(ticks, [f"{count:,}" for count in ticks], minor=False, rotation=45)
            axis.set_xticks([], minor=True)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
            axis.set(xlabel=what if measure == MEASURES[-1] else "")
    labels = {
        label: line
        for axis in axes[0]
        for line, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(labels.values(), [*labels], loc="outside lower center", ncols=2, frameon=False)
    drawing.save(figure, path, DPI, comment)


def scaling(rows: Sequence[dict[str, Any]], path: Path) -> None:
    """Steps per second and memory of training against each `size` and its `value`."""
    sizes = list(dict.fromkeys(row["size"] for row in rows))
    figure = Figure(figsize=(3 * len(sizes), 5), layout="constrained")
    axes = figure.subplots(2, len(sizes), sharey="row", sharex="col", squeeze=False)
    for column, size in zip(axes.T, sizes, strict=True):
        chosen = [row for row in rows if row["size"] == size]
        values = [row["value"] for row in chosen]
        column[0].plot(values, [row["steps_per_second"] for row in chosen], "o-", color=BLUE)
        for name, (style, color, label) in _MEMORY.items():
            column[1].plot(values, [row[name] for row in chosen], style, color=color, label=label)
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
    drawing.save(figure, path, DPI)


def evaluated_curves(curves: Sequence[Curve], title: str, path: Path) -> None:
    """SR and SPL against training episodes, from evaluated histories.

    Seen targets are solid lines, unseen ones dashed; a band is one deviation over seeds.
    """
    figure = Figure(figsize=(9, 4), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, measure in zip(axes, MEASURES, strict=True):
        for i, curve in enumerate(curves):
            style = PALETTE[i % len(PALETTE)], MARKERS[i % len(MARKERS)]
            for group in GROUPS:
                _draw_curve(axis, curve, group, measure, *style)
        axis.set(ylabel=f"{measure}, per cent", ylim=(0, None), xlim=(0, None))
        _episodes_along(axis)
    figure.suptitle(_in_lines(title))
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    drawing.save(figure, path, DPI)


def noise(rows: Sequence[dict[str, Any]], title: str, path: Path) -> None:
    """SR and SPL against the level of each kind of noise; seen targets solid, unseen ones dashed.

    Args:
      rows: as `workflows.noise.evaluate_noise` gives them; the first of each agent is without
        noise.
    """
    kinds = [*dict.fromkeys(row["kind"] for row in rows if row["kind"] is not None)]
    agents = [*dict.fromkeys(row["agent"] for row in rows)]
    columns = 3
    lines = -(-len(kinds) // columns)
    figure = Figure(figsize=(15, 2.2 * lines + 1), layout="constrained")
    axes = figure.subplots(lines, 2 * columns, sharey=True, squeeze=False).reshape(-1, 2)
    for pair, kind in zip(axes, kinds, strict=False):
        for axis, measure in zip(pair, MEASURES, strict=True):
            for i, agent in enumerate(agents):
                own = [r for r in rows if r["agent"] == agent and r["kind"] in (None, kind)]
                for group in (group for group in GROUPS if own[0][group] is not None):
                    seen, color = group == "seen", PALETTE[i % len(PALETTE)]
                    axis.plot(
                        [row["level"] for row in own],
                        [row[group]["L>=1"][measure] for row in own],
                        "-" if seen else "--", color=color, marker=MARKERS[i % len(MARKERS)],
                        markersize=3, markerfacecolor=color if seen else "white",
                        label=in_figure(f"{agent}, {group}"),
                    )  # fmt: skip
            axis.set_title(f"{measure}: {kind}", fontsize=9)
            axis.set(ylim=(0, 100))
            axis.tick_params(labelsize=8)
            axis.grid(alpha=0.3)
            axis.spines[["top", "right"]].set_visible(False)
    for pair in axes[len(kinds) :]:
        for axis in pair:
            axis.set_visible(False)
    figure.suptitle(_in_lines(title))
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    drawing.save(figure, path, DPI)


def failures(summary: Summary, path: Path, most: int = 20) -> None:
    """Failures by cause, the missing distance of those that said Done out of reach, and the targets
    with most failures.

    Args:
      most: targets to draw.
    """
    targets = summary.targets()[:most]
    high = max(4.4, 0.8 + 0.26 * len(targets))
    figure = Figure(figsize=(13, high), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(1, 1.25))
    causes, metres = (figure.add_subplot(grid[i, 0]) for i in (0, 1))
    by_target = figure.add_subplot(grid[:, 1])
    groups = [{"group": group} for group in summary.groups]
    _draw_causes(causes, summary, groups, [*summary.groups])
    unseen = ("*" if key["group"] == "unseen" else "" for key in targets)
    names = [in_figure(k["target"]) + star for k, star in zip(targets, unseen, strict=True)]
    _draw_causes(by_target, summary, targets, names)
    causes.set_xlabel("episodes that failed, per cent")
    by_target.set_xlabel("the same by target; * never a target in training")
    width = 0.8 / len(groups)
    bins = len(METRES) + any(summary.missing(group)[-1] for group in summary.groups)
    for i, group in enumerate(summary.groups):
        middles = np.arange(bins) + (i - (len(groups) - 1) / 2) * width
        counts = summary.missing(group)[:bins]
        metres.bar(middles, counts, width, color=("0.7", "0.3")[i], label=group)
    wrapped = [textwrap.fill(name, 10) for name in METRES_NAMES[:bins]]
    metres.set_xticks(range(bins), wrapped, fontsize=8)
    metres.set(xlabel="Done out of reach: how much nearer it had to be", ylabel="episodes")
    metres.legend(frameon=False)
    for axis in (causes, metres, by_target):
        axis.spines[["top", "right"]].set_visible(False)
    if not summary.failures:
        for axis in (causes, by_target):
            axis.set_xlim(0, 1)
        metres.set_ylim(0, 1)
    figure.suptitle(_in_lines(f"Failures of {summary.agent}, split {summary.split}"))
    handles, labels = causes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, frameon=False)
    drawing.save(figure, path, DPI)


def _draw_causes(
    axis: Axes, summary: Summary, keys: Sequence[dict[str, str]], names: Sequence[str]
) -> None:
    """A bar for the episodes with each of these fields: the share that failed, by cause."""
    left = np.zeros(len(keys))
    for i, (key, cause) in enumerate(CAUSES.items()):
        counts = [summary.count(**chosen, cause=key) for chosen in keys]
        played = [summary.episodes(**chosen) for chosen in keys]
        share = 100 * np.divide(counts, played)
        axis.barh(range(len(keys)), share, left=left, color=_CAUSE_COLORS[i], label=cause.name)
        left += share
    axis.set_yticks(range(len(keys)), names)
    axis.invert_yaxis()


def _in_lines(title: str) -> str:
    """A title over two panels; the name of a split may be longer than they are wide."""
    return textwrap.fill(in_figure(re.sub(r",(?! )", ", ", title)), 90)


def _draw_curve(
    axis: Axes, curve: Curve, group: str, measure: str, color: str, marker: str
) -> None:
    """One line of a learning curve, with its band, if there is anything to draw."""
    points = zip(curve.episodes, curve.values[group, measure], strict=True)
    known = [(x, y.mean, y.sd or 0.0) for x, y in points if y is not None]
    if not known:
        return
    x, mean, sd = np.array(known).T
    seen = group == "seen"
    axis.plot(
        x, mean, "-" if seen else "--", color=color, marker=marker, markersize=4, linewidth=1.5,
        markerfacecolor=color if seen else "white", label=in_figure(f"{curve.label}, {group}"),
    )  # fmt: skip
    if sd.any():
        axis.fill_between(x, mean - sd, mean + sd, color=color, alpha=0.15, linewidth=0)


def _episodes_along(axis: Axes) -> None:
    """Training episodes along the x axis; a light grid and no upper border."""
    axis.set_xlabel("training episodes")
    axis.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x / 1000:,.0f}k"))
    axis.grid(alpha=0.3)
    axis.spines[["top"]].set_visible(False)


def class_pairs(pairs: ClassPairs, unseen: Collection[str], title: str, path: Path) -> None:
    """Mean attention by class pair; columns are the classes that any target attends to most."""
    value = np.where(pairs.frames >= MIN_FRAMES, pairs.attention, np.nan)
    kept = [g for g in range(len(pairs.targets)) if np.isfinite(value[g]).any()]
    value = value[kept]
    # The classes with the greatest mean attention for any target: first targets, then by name.
    best = np.nan_to_num(value, nan=-1.0).max(axis=0, initial=-1.0)
    columns = np.sort(np.argsort(-best, kind="stable")[: min(40, (best >= 0).sum())])
    rows = {pairs.targets[g]: row for row, g in enumerate(kept)}
    order = sorted(columns, key=lambda c: (rows.get(pairs.classes[c], len(rows)), pairs.classes[c]))
    value, seen = value[:, order], [pairs.classes[c] for c in order]
    figure = Figure(figsize=(2.2 + 0.36 * len(order), 2.6 + 0.3 * len(kept)), layout="constrained")
    axes = figure.subplots()
    axes.patch.set(facecolor="white", hatch="////", edgecolor="0.8", linewidth=0)
    if value.size:
        axes.imshow(value, cmap=SHADES, vmin=0, vmax=1, aspect="auto")
    for g, c in zip(*np.nonzero(value >= 0.095), strict=True):
        color = "white" if value[g, c] > 0.85 else "black"
        style: dict[str, Any] = {"ha": "center", "va": "center", "fontsize": 7.5, "color": color}
        axes.text(c, g, f"{100 * value[g, c]:.0f}", **style)
    for column, name in enumerate(seen):
        if name in rows:
            corner = (column - 0.5, rows[name] - 0.5)
            axes.add_patch(Rectangle(corner, 1, 1, fill=False, edgecolor="black", lw=1.6))
    axes.set_yticks(
        range(len(rows)), [in_figure(name) + "*" * (name in unseen) for name in rows], fontsize=9
    )
    axes.set_xticks(range(len(seen)), [*map(in_figure, seen)], fontsize=9, rotation=90)
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
    axes.set_title(f"{in_figure(title)}\n{note}", fontsize=10)
    drawing.save(figure, path)
