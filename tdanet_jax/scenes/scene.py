"""A room as plain records: what every source of rooms delivers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tdanet_jax.io.escaping import in_line
from tdanet_jax.poses import ITHOR, PoseGrid

MOST_CLASSES = 127  # in all rooms together: the raster stores a class as int8
MOST_ROOM_TYPES = 127  # in all rooms together: the tables store a type as int8
MOST_ROOMS = 32_767  # the tables store a room as int16
MOST_POINTS = MOST_OBJECTS = 20_000  # of a room
LONGEST = 400  # characters of an error's message
SUBPIXEL = 16  # boxes are stored in sixteenths of a pixel
CAMERA_ABOVE_AGENT = 0.675  # metres from the agent's y to its camera, AI2-THOR's default agent


class SceneError(ValueError):
    """A scene breaks a rule; the message is one line that names scene, object and rule."""

    def __init__(self, message: str) -> None:
        super().__init__(in_line(message, LONGEST))  # names come from files


@dataclass(frozen=True, eq=False)
class SceneObject:
    """One object of a room. Lengths in metres, y up, AI2-THOR's left-handed world axes."""

    object_id: str
    object_class: str
    box: np.ndarray  # [2, 3] float64, lower and upper corner of the axis-aligned box
    corners: np.ndarray | None = None  # [8, 3] float64, corners of the oriented box if known
    rotation: tuple[float, float, float] = (0.0, 0.0, 0.0)  # degrees about x, y, z
    openable: bool = False
    is_open: bool = False
    pickupable: bool = False
    parents: tuple[str, ...] = ()  # object ids of the receptacles that hold it
    visible: bool | None = None  # AI2-THOR's flag in the scene's default pose, if known


@dataclass(frozen=True, eq=False)
class Scene:
    """A room: where an agent can stand, and the objects around it."""

    name: str
    room_type: str | tuple[str, ...]  # one of vocabulary.ROOM_TYPES or a type of its own; of a
    # house with rooms of several types, that of the room at each point [P]
    points: np.ndarray  # [P, 3] float64, reachable agent positions; metres
    objects: tuple[SceneObject, ...]  # sorted by (class, id)
    default_position: np.ndarray | None = None  # [3] float64, agent in the metadata's frame
    default_rotation: int | None = None  # degrees clockwise from +z, horizon 0
    part: str | None = None  # "train" or "test" in every split; None if the name decides
    targets: tuple[str, ...] = ()  # classes to look for in rooms of its types, if the scene says it
    grid: PoseGrid = ITHOR

    @property
    def point_types(self) -> list[str]:
        """The room type at each point: P names."""
        names: list[str] = np.broadcast_to(self.room_type, len(self.points)).tolist()
        return names
