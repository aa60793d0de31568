"""Which room of a house a point is in."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.path import Path

from tdanet_jax.scenes.house import Room, types_at


def test_points_in_rooms_of_any_form_agree_with_matplotlib() -> None:
    """Stars with as many corners as they like, and in both directions."""
    rng = np.random.default_rng(0)
    points = rng.uniform(-2, 2, (500, 2))
    for count in range(3, 12):
        angle = np.sort(rng.uniform(0, 2 * np.pi, count))[:: rng.choice([1, -1])]
        corners = np.stack([np.cos(angle), np.sin(angle)], axis=1) * rng.uniform(0.3, 2, (count, 1))
        far = np.array([[90.0, 90.0], [91.0, 90.0], [90.0, 91.0]])
        inside = Path(corners).contains_points(points)
        # The whole plane around the star, with the star first: what is outside is in the plane.
        plane = 100.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
        rooms = [Room("star", corners), Room("plane", plane), Room("far", far)]
        assert np.array_equal(np.array(types_at(points, rooms)) == "star", inside)


@pytest.mark.parametrize(
    ("x", "z", "room"),
    [
        (0.5, 0.5, "L"),
        (1.5, 1.5, "corner"),  # outside of the L, inside its bounding box
        (1.0, 0.0, "L"),  # on the border
        (0.5, 2.2, "L"),  # outside of both
        (2.4, 1.8, "corner"),
        (-3.0, 9.0, "L"),
    ],
)
def test_a_point_is_in_the_room_that_contains_it_or_in_the_nearest(
    x: float, z: float, room: str
) -> None:
    ell = np.array([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2), (0, 2)], float)
    corner = np.array([(1.2, 1.2), (2, 1.2), (2, 2), (1.2, 2)], float)
    rooms = [Room("L", ell), Room("corner", corner)]
    assert types_at(np.array([[x, z]]), rooms) == (room,)


def test_where_rooms_meet_or_overlap_the_first_counts() -> None:
    square = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    rooms = [Room("first", square), Room("second", square + np.array([0.5, 0.0]))]
    assert types_at(np.array([[0.75, 0.5], [1.0, 0.5], [1.2, 0.5]]), rooms) == (
        "first", "first", "second",
    )  # fmt: skip
