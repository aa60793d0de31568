"""What a room has: its size, its shape and how many objects of each class, as in known rooms."""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from tdanet_jax.scenes.generation.pieces import PARTS
from tdanet_jax.scenes.placement import LEVEL, holds
from tdanet_jax.scenes.scene import Scene

MIXED = 0.25  # share of the classes whose number is that of another room
#: Classes whose numbers are always those of the same room.
TOGETHER = (
    frozenset(["Chair", "Desk", "DiningTable", "Stool"]),
    frozenset(["Dresser", "Shelf", "ShelvingUnit", "TVStand", "Television"]),
    frozenset(["Blinds", "Curtains", "Window"]),
    frozenset(["Bathtub", "BathtubBasin", "CounterTop", "Faucet", "ShowerCurtain", "ShowerDoor",
               "ShowerGlass", "ShowerHead", "Sink", "SinkBasin"]),
    frozenset(["Bed", "Pillow"]),
)  # fmt: skip
JITTER = 0.08  # share by which sides differ from those of a known room, at most
CELL = 0.1  # metres: of the raster in which a room's shape is measured
SQUARE = 0.85  # a room that covers this share of its rectangle is rectangular
WALLS = 0.2  # metres by which objects on walls, taken together, reach into them
LEAST = 2.4  # metres of a side


@dataclasses.dataclass(frozen=True, eq=False)
class Plan:
    """What a room has.

    Attributes:
      room_type: its type.
      size: [2] metres.
      notch: share of the rectangle that is cut off at a corner; 0 for a rectangle.
      counts: class -> number of objects that are no parts of others.
      counter: metres of counters.
      points: number of reachable points, about.
    """

    room_type: str
    size: np.ndarray
    notch: float
    counts: Counter[str]
    counter: float
    points: int

    def scaled(self, factor: float) -> Plan:
        """The same with sides that are longer by a factor."""
        return dataclasses.replace(self, size=np.maximum(self.size * factor, LEAST))


@dataclasses.dataclass(frozen=True, eq=False)
class _Known:
    size: np.ndarray
    covered: float
    counts: Counter[str]
    counter: float
    points: int


class Plans:
    """Plans drawn after known rooms."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        self._known: dict[str, list[_Known]] = defaultdict(list)
        bottoms: dict[tuple[str, str], list[float]] = defaultdict(list)
        for scene in scenes:
            if not isinstance(scene.room_type, str):
                continue  # a house
            self._known[scene.room_type].append(_measure(scene))
            floor = float(np.median(scene.points[:, 1])) - 0.9
            for item in scene.objects:
                if np.isfinite(item.box).all():
                    bottoms[scene.room_type, item.object_class].append(item.box[0, 1] - floor)
        #: (room type, class) -> heights above the floor of the lower sides of such objects.
        self.bottoms: Mapping[tuple[str, str], np.ndarray] = {
            key: np.array(values) for key, values in bottoms.items()
        }

    @property
    def room_types(self) -> list[str]:
        """The room types of the known rooms."""
        return [*self._known]

    def on_floor(self, room_type: str, name: str) -> float:
        """The share of the objects of a class that stand on the floor."""
        bottoms = self.bottoms.get((room_type, name), np.zeros(0))
        return float((np.abs(bottoms) < 0.05).mean()) if len(bottoms) else 0.0

    def choose(self, room_type: str, draw: np.random.Generator) -> Plan:
        """The plan of a new room: size and contents of a known one, each a little different."""
        rooms = self._known[room_type]
        like = rooms[draw.integers(len(rooms))]
        counts: Counter[str] = Counter()
        sources: dict[object, _Known] = {}
        for name in sorted({name for room in rooms for name in room.counts}):
            key = next((names for names in TOGETHER if name in names), name)
            other = rooms[draw.integers(len(rooms))]
            sources.setdefault(key, other if draw.random() < MIXED else like)
            counts[name] = sources[key].counts[name]
        size = like.size * draw.uniform(1 - JITTER, 1 + JITTER, 2)
        notch = 0.0
        if like.covered < SQUARE:
            notch = float(np.clip((1 - like.covered) * draw.uniform(0.6, 1.0), 0.08, 0.35))
        return Plan(
            room_type,
            np.maximum(size[:: 1 if draw.random() < 0.5 else -1], LEAST),
            notch,
            counts,
            like.counter * draw.uniform(0.85, 1.15),
            round(like.points * draw.uniform(0.9, 1.1)),
        )


def _measure(scene: Scene) -> _Known:
    items = [item for item in scene.objects if np.isfinite(item.box).all()]
    areas = np.array(
        [
            *(item.box[:, LEVEL] for item in items),
            *(at + np.array([[-0.2], [0.2]]) for at in scene.points[:, LEVEL]),
        ]
    )
    low, high = areas[:, 0].min(axis=0), areas[:, 1].max(axis=0)
    covered = np.zeros(np.maximum(np.ceil((high - low) / CELL), 1).astype(int), bool)
    for area in areas:
        first, last = np.floor((area - low) / CELL).astype(int)
        covered[first[0] : last[0] + 1, first[1] : last[1] + 1] = True
    parts = {
        part.object_id
        for part in items
        if part.object_class in PARTS
        and any(
            holds(item.box, part.box)
            for item in items
            if item.object_class not in PARTS and not item.pickupable
        )
    }
    tops = [np.ptp(i.box, axis=0)[LEVEL].max() for i in items if i.object_class == "CounterTop"]
    return _Known(
        size=high - low - WALLS,
        covered=float(covered.mean()),
        counts=Counter(item.object_class for item in items if item.object_id not in parts),
        counter=float(sum(tops)),
        points=len(scene.points),
    )
