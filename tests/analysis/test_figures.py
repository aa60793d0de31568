"""Charts of attention; those of learning curves are drawn where their numbers are tested."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread

from tdanet_jax.analysis import drawing, figures
from tdanet_jax.analysis.attention import ClassPairs


def test_class_pairs_are_drawn_even_if_there_are_none(tmp_path):
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 60, (3, 50))
    classes = tuple(f"Class{i}" for i in range(50))
    pairs = ClassPairs(classes[:3], classes, frames, rng.random((3, 50)), rng.random((3, 50)))
    figures.class_pairs(pairs, {"Class1"}, "Pairs", tmp_path / "pairs.png")
    empty = ClassPairs(classes[:3], classes, 0 * frames, np.nan * frames, np.nan * frames)
    figures.class_pairs(empty, set(), "Nothing", tmp_path / "none.png")
    for name in ("pairs.png", "none.png"):
        assert imread(tmp_path / name).std() > 0.01


def test_training_curves_have_room_for_many_agents_and_long_names(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(drawing, "save", lambda figure, *_: drawn.append(figure))
    rows = [{"steps": n, "success": 0.5, "spl": 0.25} for n in (1, 2)]
    names = [f"tdanet --preset best --seed {n}" + " --extra-targets None" * 8 for n in range(20)]
    figures.training_curves([(name, rows) for name in names], "Split", tmp_path / "a.png")
    [figure] = drawn
    figure.draw_without_rendering()
    left, _, legend_axis = figure.axes
    box = legend_axis.get_legend().get_window_extent()
    assert left.get_window_extent().x1 < box.x0 < box.x1 <= figure.bbox.width
    assert 0 <= box.y0 < box.y1 <= figure.bbox.height
    assert left.get_window_extent().height > 1.5 * figure.dpi
    looks = {(line.get_color(), line.get_linestyle()) for line in figure.axes[0].lines}
    assert len(looks) == len(names)


def test_a_training_curve_is_the_mean_over_runs_and_over_nearby_steps(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(drawing, "save", lambda figure, *_: drawn.append(figure))
    rows = [{"steps": 1000 * n, "success": n % 2, "spl": 0.25} for n in range(1, 10001)]
    first = {"steps": 1000, "success": None, "spl": None}  # no episode has finished
    other = [first, {"steps": 1_000_000, "success": 1.0, "spl": 1.0}]
    runs = [("a", rows), ("b", other), ("a", rows[:5000])]
    figures.training_curves(runs, "Split", tmp_path / "a.png")
    first_row, second_row = drawn[0].axes[0], drawn[0].axes[3]
    assert [axis.get_title(loc="left") for axis in (first_row, second_row)] == [
        "1 M steps", "10 M steps",
    ]  # fmt: skip
    [few], [many] = first_row.lines, second_row.lines
    assert 30 < len(many.get_xdata()) <= figures.PARTS
    late = [y for x, y in zip(*many.get_data(), strict=True) if x > 1]
    assert late == pytest.approx([50] * len(late), abs=1)
    assert [*zip(*few.get_data(), strict=True)] == [(1.0, 100.0)]


def test_agents_with_the_same_number_of_steps_are_sorted_by_their_last_rate(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(drawing, "save", lambda figure, *_: drawn.append(figure))
    rates = {"a": 0.25, "b": 0.75, "c": 0.5}
    runs = [
        (name, [{"steps": n, "success": rate, "spl": 0.1} for n in (10_000, 1_000_960)])
        for name, rate in rates.items()
    ]
    figures.training_curves(runs, "Split", tmp_path / "a.png")
    left, _, legend_axis = drawn[0].axes
    assert [text.get_text() for text in legend_axis.get_legend().get_texts()] == ["b", "c", "a"]
    assert [line.get_ydata()[-1] for line in left.lines] == [75, 50, 25]
    colors = [line.get_color() for line in legend_axis.get_legend().get_lines()]
    assert colors == [line.get_color() for line in left.lines]
