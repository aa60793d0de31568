"""A detection is a label and the part of a box that is inside the image."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.agent.detection import OVERHANG, Detection

finite = st.floats(allow_nan=False, allow_infinity=False)


def sides(within):
    return st.tuples(within, within).map(sorted)


@given(sides(st.floats(0, 1)), sides(st.floats(0, 1)))
def test_a_box_inside_the_image_stays_as_it_is(x, y):
    for make in (Detection, Detection.clipped):
        found = make("mug", x[0], y[0], x[1], y[1])
        assert (found.x1, found.y1, found.x2, found.y2) == (x[0], y[0], x[1], y[1])
        assert found == Detection("mug", x[0], y[0], x[1], y[1])


@given(sides(st.floats(-OVERHANG, 1 + OVERHANG)), sides(finite), st.booleans())
def test_the_box_of_a_detection_is_its_part_inside_the_image(near, far, turned):
    """If it is nearly inside, always; if asked for, however far it reaches beyond."""
    for make, x in ((Detection, near), (Detection.clipped, near), (Detection.clipped, far)):
        box = (0.25, x[0], 0.75, x[1]) if turned else (x[0], 0.25, x[1], 0.75)
        inside = np.clip(box, 0, 1)
        if (inside[:2] == inside[2:]).any() and x[0] != x[1]:
            with pytest.raises(ValueError, match="the box is outside of the image"):
                make("mug", *box)
        else:
            found = make("mug", *box)
            assert (found.x1, found.y1, found.x2, found.y2) == tuple(inside)


def test_a_box_that_a_detector_rounded():
    assert Detection("mug", 0.1, -0.00027, 0.9, 0.4) == Detection("mug", 0.1, 0, 0.9, 0.4)
    rounded = Detection("mug", np.float32(0.5), np.float16(0.25), np.float32(1.005), np.float32(1))
    assert rounded == Detection("mug", 0.5, 0.25, 1, 1)
    assert type(rounded.x1) is float


@pytest.mark.parametrize(
    ("box", "message"),
    [
        ((120, 80, 160, 130), "corners must be shares of the image; for boxes that reach beyond"),
        ((0.1, -0.02, 0.9, 0.4), "corners must be shares of the image"),
        ((0.1, 0.1, 0.9, 1.011), "corners must be shares of the image"),
        ((0.1, 0.1, float("nan"), 0.4), "corners must be shares of the image"),
        ((0.6, 0.1, 0.5, 0.4), "corners must be finite, x1 <= x2 and y1 <= y2"),
        ((1.005, 0.1, 1.002, 0.4), "corners must be finite, x1 <= x2 and y1 <= y2"),
        ((1.002, 0.1, 1.005, 0.4), "the box is outside of the image"),
        ((0.1, -0.005, 0.4, 0.0), "the box is outside of the image"),
    ],
)
def test_what_is_no_box_is_refused_in_one_line(box, message):
    with pytest.raises(ValueError, match=message) as refused:
        Detection("mug", *box)
    assert "\n" not in str(refused.value)
    if "shares" not in message or box[0] > 1:
        outside = "outside" if box[0] > 1 and "finite" not in message else message
        with pytest.raises(ValueError, match=outside):
            Detection.clipped("mug", *box)


@pytest.mark.parametrize("corner", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("which", range(4))
def test_no_corner_is_infinite(corner, which):
    box = [0.1, 0.1, 0.9, 0.9]
    box[which] = corner
    with pytest.raises(ValueError, match="corners must be shares"):
        Detection("mug", *box)
    with pytest.raises(ValueError, match="corners must be finite"):
        Detection.clipped("mug", *box)


@pytest.mark.parametrize("score", [-0.1, 1.1, 80, float("nan")])
def test_a_score_is_a_share(score):
    with pytest.raises(ValueError, match=r"mug: score .*: must be from 0 to 1"):
        Detection("mug", 0.1, 0.1, 0.3, 0.4, score)
    with pytest.raises(ValueError, match=r"mug: score .*: must be from 0 to 1"):
        Detection.clipped("mug", 0.1, 0.1, 0.3, 1.4, score)
    assert Detection.clipped("mug", 0.1, 0.1, 0.3, 1.4, 1).score == 1
