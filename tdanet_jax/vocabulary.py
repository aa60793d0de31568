"""Actions, room types and target classes: the vocabulary of the task.

Sources: as in MJOLNIR (Qiu et al. 2020), SSNet (Zhao et al. 2023) and TDANet (Lian and Zhang 2024).
"""

from __future__ import annotations

import re
import unicodedata
from enum import IntEnum


class Action(IntEnum):
    """The six actions, in the order of the policy's outputs."""

    MOVE_AHEAD = 0
    ROTATE_LEFT = 1
    ROTATE_RIGHT = 2
    LOOK_UP = 3
    LOOK_DOWN = 4
    DONE = 5


ACTION_NAMES = ("MoveAhead", "RotateLeft", "RotateRight", "LookUp", "LookDown", "Done")
NUM_ACTIONS = len(ACTION_NAMES)
#: The logit of `Done` where the estimate of reach forbids it: below all but what a caller forbids.
OUT_OF_REACH = -1e9

#: Settings of AI2-THOR.
VISIBILITY_DISTANCE = 1.5  # metres, horizontal, within which an object can be visible
FIELD_OF_VIEW = 90.0  # degrees, horizontal and vertical
IMAGE_SIZE = 300  # pixels, width and height of a frame
#: Classes that are left out of all rooms: their boxes span the room, and they hide nothing.
IGNORED = frozenset({"Ceiling", "Floor", "Room"})
#: Classes that are parts of the building: they hide things, and are never detections.
WALLS, DOORS = frozenset({"Wall"}), frozenset({"Door", "Doorframe", "Doorway"})
#: All that is never a detection, nor a target.
STRUCTURE = IGNORED | WALLS | DOORS

ROOM_TYPES = ("kitchen", "living_room", "bedroom", "bathroom")

#: The 22 target classes by room type.
TARGETS: dict[str, tuple[str, ...]] = {
    "kitchen": ("Toaster", "Spatula", "Bread", "Mug", "CoffeeMachine", "Apple"),
    "living_room": ("Painting", "Laptop", "Television", "RemoteControl", "Vase", "ArmChair"),
    "bedroom": ("Blinds", "DeskLamp", "Pillow", "AlarmClock", "CD"),
    "bathroom": ("Mirror", "ToiletPaper", "SoapBar", "Towel", "SprayBottle"),
}
ALL_TARGETS = tuple(name for room in ROOM_TYPES for name in TARGETS[room])


def class_words(name: str) -> tuple[str, ...]:
    """The lower-case words of a class name or label: "CoffeeMachine" -> ("coffee", "machine").

    A run of capitals is one word ("CD", "TVStand" -> tv, stand); spaces, underscores and hyphens
    separate as well. Letters lose their accents: "café table" -> cafe, table.
    """
    pattern = r"[A-Z]+(?![a-z])|[A-Z][a-z]+|[a-z]+|[0-9]+"
    return tuple(word.lower() for word in re.findall(pattern, without_accents(name)))


def without_accents(text: str) -> str:
    """Text whose letters have lost their accents: "café" -> "cafe"."""
    if text.isascii():
        return text
    return "".join(c for c in unicodedata.normalize("NFKD", text) if not unicodedata.combining(c))
