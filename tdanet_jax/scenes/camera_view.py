"""What the camera shows from a pose: a box for each object in view."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from tdanet_jax.scenes.tables import SceneTables


class CameraView(NamedTuple):
    """The n detections from a pose, one for each object, in the tables' order."""

    classes: tuple[str, ...]
    boxes: np.ndarray  # [n, 4] x1, y1, x2, y2 as shares of the image, y down
    visible: np.ndarray  # [n] bool, in the sense of the task: within 1.5 m

    @property
    def areas(self) -> np.ndarray:
        """Areas [n] of the boxes, as shares of the image."""
        x1, y1, x2, y2 = self.boxes.T
        return (x2 - x1) * (y2 - y1)


def of_pose(tables: SceneTables, pose: int) -> CameraView:
    """What is in view from a pose."""
    rows = rows_of_pose(tables, pose)
    return CameraView(
        classes=tuple(tables.classes[c] for c in tables.row_class[rows]),
        boxes=tables.row_box[rows] / (tables.image * tables.subpixel),
        visible=tables.row_visible[rows],
    )


def rows_of_pose(tables: SceneTables, pose: int) -> np.ndarray:
    """The tables' rows of a pose that are detections: those with a box."""
    rows = np.arange(tables.row_start[pose], tables.row_start[pose + 1])
    return rows[tables.row_box[rows, 0] >= 0]
