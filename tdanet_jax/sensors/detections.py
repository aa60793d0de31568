"""What an agent is told of a box: x and y of a centre and the area S, one row an object or a class.

Boxes are corners [N, 4], x1, y1, x2, y2 as shares of the image, y down.
"""

from __future__ import annotations

import numpy as np


def centre_and_area(corners: np.ndarray) -> np.ndarray:
    """A row x, y, S of each box: [N, 3]."""
    return _rows((corners[:, :2] + corners[:, 2:]) / 2, corners)


def merge_classes(key: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Boxes of one key as one row: the mean of their corners, and the extent over all of them.

    As in the code of MJOLNIR and SSNet.

    Args:
      key: [N] int, not below 0 and nondecreasing; equal for instances of a class in a frame.

    Returns:
      Where each of the M keys begins [M], and its row x, y, S: [M, 3].
    """
    first = np.flatnonzero(np.diff(key, prepend=-1))
    members = np.diff(first, append=len(key))[:, None]
    centre = np.add.reduceat((corners[:, :2] + corners[:, 2:]) / 2, first) / members
    least = np.minimum.reduceat(corners[:, :2], first)
    return first, _rows(centre, np.hstack([least, np.maximum.reduceat(corners[:, 2:], first)]))


def _rows(centre: np.ndarray, extent: np.ndarray) -> np.ndarray:
    area = (extent[:, 2] - extent[:, 0]) * (extent[:, 3] - extent[:, 1])
    return np.column_stack([centre, area])
