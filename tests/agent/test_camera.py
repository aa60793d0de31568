"""Boxes of any camera, mapped onto the image that agents were trained with."""

from __future__ import annotations

import dataclasses
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.agent.camera import Camera, turned
from tdanet_jax.agent.detection import Detection

shares = st.floats(0.01, 0.99)


def corners(found):
    return np.array([found.x1, found.y1, found.x2, found.y2])


def boxes(x, y):
    """A detection between two points."""
    return Detection("mug", min(x), min(y), max(x), max(y), 0.7)


def project(x, y, hfov, vfov, down=0.0, right=0.0, looks=0.0):
    """Where a point of an image is in that of an agent, by matrices.

    The camera looks `looks` degrees down and the agent `looks - down`, turned `right` degrees.
    """

    def about_x(degrees):
        a = math.radians(degrees)
        return np.array([[1, 0, 0], [0, math.cos(a), math.sin(a)], [0, -math.sin(a), math.cos(a)]])

    a = math.radians(right)
    about_y = np.array([[math.cos(a), 0, -math.sin(a)], [0, 1, 0], [math.sin(a), 0, math.cos(a)]])
    ray = [(2 * x - 1) * math.tan(math.radians(hfov / 2)),
           (2 * y - 1) * math.tan(math.radians(vfov / 2)), 1]  # fmt: skip
    r, d, a = about_x(down - looks) @ about_y @ about_x(looks) @ ray
    return (0.5 + r / a / 2, 0.5 + d / a / 2) if a > 0 else None


@given(shares, shares, shares, shares)
def test_a_camera_of_90_degrees_changes_nothing(x1, x2, y1, y2):
    found = boxes((x1, x2), (y1, y2))
    (same,) = Camera(90, 90).to_agent([found], horizon=0)
    np.testing.assert_allclose(corners(same), corners(found), atol=1e-12)
    assert (same.label, same.score) == ("mug", 0.7)


@given(shares, shares, shares, shares, st.floats(30, 89), st.floats(30, 89))
def test_a_narrow_camera_shows_the_middle(x1, x2, y1, y2, hfov, vfov):
    found = boxes((x1, x2), (y1, y2))
    (mapped,) = Camera(hfov, vfov).to_agent([found])
    wide, high = math.tan(math.radians(hfov / 2)), math.tan(math.radians(vfov / 2))
    scale = np.array([wide, high, wide, high])
    np.testing.assert_allclose(corners(mapped), 0.5 + (corners(found) - 0.5) * scale, atol=1e-12)


@pytest.mark.parametrize("share", [0.5, 0.25 + 1e-17, 1 / 3])
def test_what_only_touches_the_border_is_left_out(share):
    border = 0.5 - 0.5 / math.tan(math.radians(55))
    touching = Detection("mug", border * share, share, border, 0.7)
    assert Camera(110, 60).to_agent([touching]) == []
    (line,) = Camera(110, 60).to_agent([Detection("rod", 0.4, 0.2, 0.4, 0.7)])
    assert line.x1 == line.x2


def test_what_a_wide_camera_sees_beside_the_agents_image_is_left_out_or_clipped():
    camera = Camera(110, aspect=16 / 9)
    assert camera.to_agent([Detection("mug", 0.02, 0.5, 0.1, 0.6)]) == []
    (clipped,) = camera.to_agent([Detection("mug", 0.05, 0.5, 0.3, 0.6)])
    assert clipped.x1 == pytest.approx(0, abs=1e-12)
    assert clipped.x2 == pytest.approx(0.5 - 0.2 * math.tan(math.radians(55)))


@given(shares, shares, shares, shares, st.floats(-20, 20), st.floats(40, 100))
def test_a_tilted_camera_is_looked_through_as_by_the_agent(x1, x2, y1, y2, down, hfov):
    """Boxes are those around the four corners, clipped."""
    found = boxes((x1, x2), (y1, y2))
    mapped = Camera(hfov, hfov, horizon=30 + down).to_agent([found], horizon=30)
    points = [project(x, y, hfov, hfov, down) for x in (x1, x2) for y in (y1, y2)]
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    if (low >= 0).all() and (high <= 1).all():
        np.testing.assert_allclose(corners(mapped[0]), [*low, *high], atol=1e-9)
    elif (high < 0).any() or (low > 1).any():
        assert mapped == []
    for one in mapped:  # never more than the box around all of it
        assert (corners(one)[:2] >= np.clip(low, 0, 1) - 1e-9).all()
        assert (corners(one)[2:] <= np.clip(high, 0, 1) + 1e-9).all()


@given(shares, shares, shares, shares, st.sampled_from([(45, 0, 0), (-45, 30, 30), (0, 30, 0)]))
def test_a_turn_moves_what_was_seen(x1, x2, y1, y2, motion):
    right, horizon, before = motion
    found = boxes((x1, x2), (y1, y2))
    points = [
        project(x, y, 90, 90, before - horizon, right, before) for x in (x1, x2) for y in (y1, y2)
    ]
    moved = turned(found, right, horizon, before)
    if all(point is not None and 0 <= min(point) <= max(point) <= 1 for point in points):
        low, high = np.min(points, axis=0), np.max(points, axis=0)
        np.testing.assert_allclose(corners(moved), [*low, *high], atol=1e-9)


def test_a_turn_to_the_right_moves_things_to_the_left():
    ahead = Detection("mug", 0.5, 0.45, 0.55, 0.55)
    moved = turned(ahead, 45, 0, 0)
    assert (moved.x1, moved.x2) == (pytest.approx(0), pytest.approx(0.0909, abs=1e-3))
    assert turned(ahead, 90, 0, 0) is None
    assert turned(ahead, 180, 0, 0) is None
    lower = turned(ahead, 0, 30, 0)
    assert lower.y2 < 0.3  # looking down, it is higher in the image


def test_what_it_cannot_see():
    camera = Camera(69, 55, height=0.4, horizon=10)
    wide, high = math.tan(math.radians(69 / 2)), math.tan(math.radians(55 / 2))
    assert camera.seen_share() == pytest.approx(wide * high)
    assert camera.limits() == (
        "sees 69 degrees across and 55 down, where agents are used to 90: 36 % of their image",
        "1.5 m ahead, sees what is between 0.00 and 0.87 m high",
        "is 0.4 m above the floor, where agents are used to 1.58 m: they see other sides of "
        "tables and shelves",
    )
    assert Camera(100, 100).seen_share() == pytest.approx(1)
    assert Camera(60, 60, horizon=80).seen_share(horizon=0) == 0
    assert len(Camera(90, 90, height=1.5).limits()) == 2


def test_the_aspect_gives_the_vertical_field_of_view():
    camera = Camera(90, aspect=4 / 3)
    assert camera.vfov == pytest.approx(73.74, abs=0.01)
    assert dataclasses.replace(camera, horizon=5) == Camera(90, camera.vfov, horizon=5)


def test_the_optical_axis_need_not_meet_the_middle():
    """Focal lengths of half of a side: what is on the axis is straight ahead."""
    camera = Camera(90, 90, height=1.5, centre=(0.6, 0.45))
    (seen,) = camera.to_agent([Detection("mug", 0.6, 0.45, 0.7, 0.55)])
    assert (seen.x1, seen.y1, seen.x2, seen.y2) == pytest.approx((0.5, 0.5, 0.6, 0.6))
    assert camera.seen_share() == pytest.approx(0.9 * 0.95)
    assert camera.limits(1.0)[-1] == "1 m ahead, sees what is between 0.40 and 2.40 m high"


@pytest.mark.parametrize("name", ["k", "K"])
def test_the_camera_of_a_message_of_ros(name):
    info = SimpleNamespace(width=640, height=480, **{name: [320.0, 0, 319, 0, 320.0, 239, 0, 0, 1]})
    camera = Camera.from_camera_info(info, horizon=20)
    assert (camera.hfov, camera.horizon) == (pytest.approx(90), 20)
    assert camera.vfov == pytest.approx(Camera(90, aspect=4 / 3).vfov)
    rectified = [160.0, 0, 319, 0, 0, 160.0, 239, 0, 0, 0, 1, 0]  # k is of the raw image
    info = SimpleNamespace(**vars(info), **{"p" if name == "k" else "P": rectified})
    assert Camera.from_camera_info(info).hfov == pytest.approx(2 * math.degrees(math.atan(2)))
    info = SimpleNamespace(**vars(info) | {"p" if name == "k" else "P": [0.0] * 12})
    assert Camera.from_camera_info(info).hfov == pytest.approx(90)
    assert camera.centre == pytest.approx((319 / 640, 239 / 480))
    empty = SimpleNamespace(width=0, height=0, k=[0.0] * 9)
    with pytest.raises(ValueError, match="CameraInfo: not calibrated"):
        Camera.from_camera_info(empty)


@pytest.mark.parametrize(
    ("given_", "message"),
    [
        ({"hfov": 1.2, "vfov": 50}, "camera: hfov 1.2: must be between 5 and 180"),
        ({"hfov": 180, "vfov": 50}, "camera: hfov 180: must be between"),
        ({"hfov": 69, "vfov": float("nan")}, "camera: vfov nan: must be between"),
        ({"hfov": 69}, "camera: give either vfov, in degrees, or aspect"),
        (
            {"hfov": 69, "vfov": 55, "aspect": 1.3},
            "camera: give either vfov, in degrees, or aspect",
        ),
        ({"hfov": 69, "aspect": 0}, "camera: aspect 0: must be between 0 and 100"),
        ({"hfov": 69, "vfov": 55, "height": -1}, "camera: height -1: must be between"),
        ({"hfov": 69, "vfov": 55, "horizon": 95}, "camera: horizon 95: must be between -90 and 90"),
        ({"hfov": 69, "vfov": 55, "centre": (0.5, 320)}, "camera: centre 320: must be between 0"),
    ],
)
def test_what_is_no_camera_is_refused_in_one_line(given_, message):
    with pytest.raises(ValueError, match=message):
        Camera(**given_)


def test_a_camera_needs_no_jax():
    code = "import sys\nfrom tdanet_jax import Camera, Detection\nprint('jax' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "False\n"
