"""Pictures show what the trace holds: shades, outlines, ends."""

import numpy as np
from matplotlib.figure import Figure
from matplotlib.image import imread

from tdanet_jax.analysis import pictures
from tdanet_jax.analysis.attention import ClassPairs
from tdanet_jax.analysis.trace import Trace, View
from tdanet_jax.scenes import floor_plan

SEEN = View(
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


def test_boxes_are_shaded_by_attention_and_the_target_is_outlined():
    axes = Figure().subplots()
    pictures.draw_view(axes, SEEN, np.array([0.7, 0.25, 0.05]), "Mug")
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
    pictures.draw_view(axes, SEEN, None, "Sofa")
    shades, _ = boxes_of(axes)
    assert {patch.get_alpha() for patch in shades.values()} == {0.0}
    assert {text.get_text() for text in axes.texts} == {"Mug", "Sofa"}


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


def test_a_way_ends_with_a_star_or_a_cross(some_rooms, tmp_path):
    plan = floor_plan.load(some_rooms, "FloorPlan229")
    for success, marker in ((True, "*"), (False, "X")):
        made = walk(some_rooms, success)
        axes = Figure().subplots()
        pictures.draw_way(axes, made, plan, some_rooms, 50)
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
    made = walk(some_rooms, True)
    pictures.trajectories([made, made], plan, some_rooms, tmp_path / "way.png")
    pixels = imread(tmp_path / "way.png")[..., :3]
    assert pixels.shape[1] > 800
    orange = (np.abs(pixels - np.array([213, 94, 0]) / 255) < 0.02).all(axis=-1)
    half = pixels.shape[1] // 2
    assert orange[:, :half].sum() > 100
    assert orange[:, half:].sum() > 100


def test_more_attention_is_darker_in_grey():
    grey = [
        np.dot(pictures.SHADES(share)[:3], (0.3, 0.59, 0.11)) for share in (0.0, 0.25, 0.5, 1.0)
    ]
    assert (np.diff(grey) < -0.1).all()


def test_pictures_of_an_episode_and_of_pairs_are_written(some_rooms, tmp_path):
    pictures.attention_episode(walk(some_rooms, True), some_rooms, "A", tmp_path / "views.png")
    rng = np.random.default_rng(0)
    frames = rng.integers(0, 60, (3, 50))
    classes = tuple(f"Class{i}" for i in range(50))
    pairs = ClassPairs(classes[:3], classes, frames, rng.random((3, 50)), rng.random((3, 50)))
    pictures.class_pairs(pairs, {"Class1"}, "Pairs", tmp_path / "pairs.png")
    empty = ClassPairs(classes[:3], classes, 0 * frames, np.nan * frames, np.nan * frames)
    pictures.class_pairs(empty, set(), "Nothing", tmp_path / "none.png")
    for name in ("views.png", "pairs.png", "none.png"):
        assert imread(tmp_path / name).std() > 0.01
