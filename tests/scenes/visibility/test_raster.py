"""The class raster against painting cell by cell."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.scenes.visibility.raster import CELLS, paint

SIZE = 4800
edge = st.integers(0, SIZE)
boxes = st.tuples(st.integers(0, 2), edge, edge, edge, edge, st.integers(0, 126))


@given(st.lists(boxes, max_size=12))
def test_agrees_with_painting_by_hand(cases: list[tuple[int, ...]]) -> None:
    state = np.array([case[0] for case in cases], np.int32)
    corners = np.array([case[1:5] for case in cases], np.int16).reshape(-1, 4)
    box = np.concatenate(
        [np.minimum(corners[:, :2], corners[:, 2:]), np.maximum(corners[:, :2], corners[:, 2:])],
        axis=1,
    )
    label = np.array([case[5] for case in cases], np.int16)
    found = paint(state, box, label, 3, SIZE)
    for s in range(3):
        for row in range(CELLS):
            for column in range(CELLS):
                x, y = (column + 0.5) * SIZE / CELLS, (row + 0.5) * SIZE / CELLS
                best, want = np.inf, -1
                for k in np.flatnonzero(state == s):
                    x1, y1, x2, y2 = box[k].astype(int)
                    area = (x2 - x1) * (y2 - y1)
                    if x1 <= x < x2 and y1 <= y < y2 and area <= best:
                        best, want = area, label[k]
                assert found[s, row, column] == want
