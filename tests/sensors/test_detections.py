"""Rows of detections, by hand and against a plain loop."""

from __future__ import annotations

import numpy as np
import pytest

from tdanet_jax.sensors.detections import centre_and_area, merge_classes


def test_a_row_is_centre_and_area() -> None:
    rows = centre_and_area(np.array([[0.0, 0.2, 0.5, 0.4], [0.0, 0.0, 1.0, 1.0]]))
    np.testing.assert_allclose(rows, [[0.25, 0.3, 0.1], [0.5, 0.5, 1.0]])


@pytest.mark.parametrize("count", [0, 1, 2, 40])
def test_a_class_is_the_mean_of_corners_and_the_extent_of_its_boxes(count: int) -> None:
    draw = np.random.default_rng(count)
    key = np.sort(draw.integers(0, 12, count))
    corners = np.hstack([draw.uniform(0, 0.5, (count, 2)), draw.uniform(0.5, 1, (count, 2))])
    first, rows = merge_classes(key, corners)
    assert key[first].tolist() == sorted(set(key.tolist()))
    for name, row in zip(key[first], rows, strict=True):
        own = corners[key == name]
        x, y = own[:, [0, 2]], own[:, [1, 3]]
        area = (x.max() - x.min()) * (y.max() - y.min())
        np.testing.assert_allclose(row, [x.mean(), y.mean(), area])
    assert rows.shape == (len(first), 3)


def test_boxes_of_their_own_keys_stay_as_they_are() -> None:
    corners = np.array([[0.0, 0.2, 0.5, 0.4], [0.1, 0.1, 0.3, 0.9]])
    _, rows = merge_classes(np.array([0, 7]), corners)
    assert (rows == centre_and_area(corners)).all()
