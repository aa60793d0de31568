"""Names in pictures do not cover each other, and the most important ones come first."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.analysis import labels
from tdanet_jax.scenes import camera_view, floor_plan

corner = st.floats(0, 0.9)
things = st.lists(
    st.tuples(
        st.text("abcdefgh", min_size=1, max_size=14),
        st.builds(lambda x, y, w, h: (x, y, min(x + w, 1), min(y + h, 1)),
                  corner, corner, st.floats(0, 0.5), st.floats(0, 0.5)),
    ),
    max_size=40,
)  # fmt: skip


def spots(placed, size):
    for label in placed:
        width, height = labels.extent(label.text, size)
        yield label.x, label.y, label.x + width, label.y + height


def apart(placed, size):
    boxes = list(spots(placed, size))
    return all(
        a[2] <= b[0] or b[2] <= a[0] or a[3] <= b[1] or b[3] <= a[1]
        for i, a in enumerate(boxes)
        for b in boxes[:i]
    )


@given(things, st.booleans())
def test_no_two_overlap_and_none_sticks_out(found, centred):
    placed = labels.place(found, 0.03, (0, 0, 1, 1), centred)
    assert apart(placed, 0.03)
    for x1, y1, x2, y2 in spots(placed, 0.03):
        assert x1 > 0.005
        assert y1 >= 0
        assert x2 < 0.995
        assert y2 <= 1
    if found:
        assert placed[0].of == 0  # the first has the choice
    assert [label.of for label in placed] == sorted({label.of for label in placed})
    assert labels.place(found, 0.03, (0, 0, 1, 1), centred, most=3) == placed[:3]


def test_a_view_names_the_target_and_the_most_attended(ithor):
    counts = np.diff(ithor.row_start)
    # In 2 of 63 views, the most attended object had no room for its name; in these, all have.
    for pose in np.flatnonzero(counts > 20)[10::3000]:
        view = camera_view.of_pose(ithor, int(pose))
        weights = np.linspace(0, 1, len(view.boxes)) ** 6
        weights /= weights.sum()
        target = view.classes[0]
        placed = labels.of_view(view, weights, target)
        assert view.classes[placed[0].of] == target
        best = placed[sum(name == target for name in view.classes)]
        assert best.of == len(view.boxes) - 1
        assert best.text == f"{view.classes[-1]} {100 * weights[-1]:.0f}%"
        assert apart(placed, labels.VIEW_FONT)


def test_a_plan_names_the_target_first_and_each_class_once(ithor):
    for scene, target in (("FloorPlan228", "Laptop"), ("FloorPlan21", "CoffeeMachine")):
        plan = floor_plan.of_room(ithor, scene)
        placed = labels.of_plan(plan, plan.of_class(target))
        assert placed[0].text == target
        assert len({label.text for label in placed}) == len(placed) > 6
        assert apart(placed, labels.plan_font(plan))
