"""A coarse image of a view: the class in each cell of a 7 x 7 grid.

It replaces the convolutional feature maps that image-based models expect.
"""

from __future__ import annotations

import numpy as np

CELLS = 7  # along each side of the image


def paint(
    state: np.ndarray, box: np.ndarray, label: np.ndarray, states: int, size: int
) -> np.ndarray:
    """Class of the smallest box over the middle of each cell, or -1: [states, 7, 7] int8.

    Small objects stand on or in front of large ones, so boxes are painted from the largest down;
    among boxes of equal area, later rows cover earlier ones.

    Args:
      state: [N] state of each box.
      box: [N, 4] x1, y1, x2, y2.
      label: [N] class, below 128.
      states: number of states.
      size: width and height of the image in the units of `box`.
    """
    box = box.astype(np.int32)
    # Cell c is covered if its middle, (c + 1/2) * size / 7, lies in [low, high).
    first = -((size - box[:, :2] * (2 * CELLS)) // (2 * size))
    stop = -((size - box[:, 2:] * (2 * CELLS)) // (2 * size))
    width, height = (stop - first).T
    area = (box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1])
    order = np.argsort(-area, kind="stable")
    order = order[(width * height)[order] > 0]
    count = (width * height)[order]
    row = np.repeat(order, count)
    step = np.arange(len(row)) - np.repeat(np.cumsum(count) - count, count)
    across, down = step % width[row] + first[row, 0], step // width[row] + first[row, 1]
    raster = np.full(states * CELLS * CELLS, -1, np.int8)
    raster[(state[row] * CELLS + down) * CELLS + across] = label[row].astype(np.int8)
    return raster.reshape(states, CELLS, CELLS)
