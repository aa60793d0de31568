"""Drawings show what is in view and where an agent went: shades, outlines, ends."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.figure import Figure

from tdanet_jax.analysis import drawing
from tdanet_jax.analysis.trace import Trace
from tdanet_jax.scenes import floor_plan
from tdanet_jax.scenes.camera_view import CameraView

SEEN = CameraView(
    ("Mug", "Sofa", "Mug"),
    np.array([[0.1, 0.1, 0.3, 0.4], [0.0, 0.3, 0.9, 1.0], [0.6, 0.6, 0.7, 0.7]]),
    np.array([True, False, False]),
)


def boxes_of(axes):
    """Shaded and outlined rectangles by place."""
    shades, outlines = {}, {}
    for patch in axes.patches:
        (outlines if not patch.get_fill() else shades)[patch.get_xy()] = patch
    return shades, outlines


def walk(tables, success):
    """Five points along a heading of FloorPlan229, then a turn and Done."""
    scene = tables.scenes.index("FloorPlan229")
    for position in np.flatnonzero(tables.position_scene == scene):
        places = [int(position)]
        for _ in range(4):
            places.append(int(tables.next_position[places[-1], 2]))
        if len(set(places)) == 5:
            break
    pose = np.array([place * 16 + 4 for place in places] + [places[-1] * 16 + 6] * 2)
    actions = np.array([0, 0, 0, 0, 2, 5])
    return Trace("someone", "FloorPlan229", "Laptop", pose, actions, success, shortest=4)


def test_boxes_are_shaded_by_attention_and_the_target_is_outlined():
    axes = Figure().subplots()
    drawing.draw_view(axes, SEEN, np.array([0.7, 0.25, 0.05]), "Mug")
    shades, outlines = boxes_of(axes)
    assert {place: patch.get_alpha() for place, patch in shades.items()} == {
        (0.1, 0.1): 0.7, (0.0, 0.3): 0.25, (0.6, 0.6): 0.05,
    }  # fmt: skip
    thick = {place for place, patch in outlines.items() if patch.get_linewidth() > 2}
    assert thick == {(0.1, 0.1), (0.6, 0.6)}
    assert outlines[0.1, 0.1].get_linestyle() in ("-", "solid")
    assert outlines[0.6, 0.6].get_linestyle() not in ("-", "solid")
    assert {text.get_text() for text in axes.texts} == {"Mug 70%", "Sofa 25%", "Mug 5%"}


def test_without_attention_boxes_are_plain():
    axes = Figure().subplots()
    drawing.draw_view(axes, SEEN, None, "Sofa")
    shades, _ = boxes_of(axes)
    assert {patch.get_alpha() for patch in shades.values()} == {0.0}
    assert {text.get_text() for text in axes.texts} == {"Mug", "Sofa"}


def test_coloured_objects_are_named_in_their_colours(some_rooms):
    axes = Figure().subplots()
    drawing.draw_view(axes, SEEN, None, None, ["red", "green", "blue"])
    _, outlines = boxes_of(axes)
    assert outlines[0.6, 0.6].get_edgecolor() == (0, 0, 1, 1)
    assert {text.get_color() for text in axes.texts} == {"red", "green", "blue"}
    plan = floor_plan.of_room(some_rooms, "FloorPlan229")
    axes, small = Figure().subplots(), len(plan.outlines) - 1
    drawing.draw_plan(axes, plan, "Sofa", {small: "red"})
    colors = {text.get_text(): text.get_color() for text in axes.texts}
    assert colors.pop(plan.classes[small]) == "red"
    assert set(colors.values()) == {"black"}
    assert sum(patch.get_linewidth() > 2 for patch in axes.patches) == plan.classes.count("Sofa")


def test_a_path_ends_with_a_star_or_a_cross(some_rooms):
    plan = floor_plan.of_room(some_rooms, "FloorPlan229")
    for success, marker in ((True, "*"), (False, "X")):
        made = walk(some_rooms, success)
        axes = Figure().subplots()
        drawing.draw_path(axes, made, plan, some_rooms)
        ends = [line for line in axes.lines if line.get_marker() == marker]
        assert len(ends) == 1
        x, _, z = some_rooms.position[made.pose[-1] >> 4]
        assert (ends[0].get_xdata()[0], ends[0].get_ydata()[0]) == (x, z)
        path = next(line for line in axes.lines if line.get_linestyle() == "-")
        np.testing.assert_array_equal(
            np.column_stack([path.get_xdata(), path.get_ydata()]),
            some_rooms.position[made.pose >> 4][:, [0, 2]],
        )
        assert {text.get_text().strip() for text in axes.texts} == {"6"}
        headings = {(round(w.theta1) % 360, round(w.theta2) % 360) for w in axes.patches}
        assert headings == {(315, 45), (270, 0)}  # rotation 90 looks along +x; then 135


def test_a_path_grows_step_by_step(some_rooms):
    plan, made = floor_plan.of_room(some_rooms, "FloorPlan229"), walk(some_rooms, True)
    for step, marker in ((0, (3, 0, -90)), (5, (3, 0, -135)), (6, "*")):
        axes = Figure().subplots()
        drawing.draw_path(axes, made, plan, some_rooms, step)
        path = next(line for line in axes.lines if line.get_linestyle() == "-")
        assert len(path.get_xdata()) == step + 1
        assert axes.lines[-1].get_marker() == marker
        assert len(axes.patches) == 1  # the present field of view
        assert not axes.texts


def test_more_attention_is_darker_in_grey():
    grey = [np.dot(drawing.SHADES(share)[:3], (0.3, 0.59, 0.11)) for share in (0.0, 0.25, 0.5, 1.0)]
    assert (np.diff(grey) < -0.1).all()


@pytest.mark.parametrize("ending", drawing.formats())
def test_pictures_are_written_in_every_format(tmp_path, ending):
    figure = Figure(figsize=(1, 1))
    drawing.draw_view(figure.subplots(), SEEN, None, "Mug")
    drawing.save(figure, tmp_path / f"view.{ending}")
    assert (tmp_path / f"view.{ending}").stat().st_size > 100
