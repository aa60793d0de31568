"""The floor of a room while it is furnished: walls, what is taken, and where an agent can stand."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy import ndimage

from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes import reachable
from tdanet_jax.scenes.placement import LEVEL, TOUCHING, shifted, turned
from tdanet_jax.scenes.reachable import RADIUS
from tdanet_jax.scenes.scene import SceneObject

STANDING = 0.9  # metres of an agent's y above the floor
CLEAR = 0.65  # metres in front of furniture: wide enough for a row of reachable points
NEAR = 0.9  # metres from where an agent can stand to anything on the floor, at most
SEEN = 1.3  # metres, likewise, to anything on a wall
#: Share of the free points that must be connected once something is put down.
CONNECTED = 0.93
#: Where the front (+z) and the right side (+x) point after quarters of a turn, as x and z.
AHEAD = np.array([(0, 1), (1, 0), (0, -1), (-1, 0)], np.float64)
RIGHT = np.roll(AHEAD, -1, axis=0)
ROUNDED = 1e-3  # metres by which coordinates may be off a wall
TALL = 3.0  # metres: the height of a room
WALL = 0.04  # metres between walls and what stands at them


@dataclasses.dataclass(frozen=True, eq=False)
class Wall:
    """A straight wall, seen from inside: it leads from `start` along `along`.

    Attributes:
      start: [2] x and z, metres.
      along: [2] of length 1, to the left of the inside.
      length: metres.
      turns: quarters, clockwise from +z, of the direction to the inside.
    """

    start: np.ndarray
    along: np.ndarray
    length: float
    turns: int

    @property
    def inward(self) -> np.ndarray:
        """Direction to the inside of the room, [2]."""
        return AHEAD[self.turns]

    def at(self, along: float, inward: float = 0.0) -> np.ndarray:
        """A place [3] on the floor, metres along the wall and away from it."""
        x, z = self.start + along * self.along + inward * self.inward
        return np.array([x, 0.0, z])


class Floor:
    """A rectangular or L-shaped room: where things are, and where an agent can stand."""

    def __init__(self, size: np.ndarray, notch: np.ndarray | None) -> None:
        """A room of `size` [2] metres around the origin.

        Args:
          notch: [2, 2], lower and upper corner of a part at a corner of the rectangle that does not
            belong to the room.
        """
        half = size / 2
        self.area = np.stack([-half, half])
        self.notch = notch
        self.items: list[SceneObject] = []
        #: Boxes [2, 3] in which nothing else is and no agent stands.
        self._solid = [] if notch is None else [_raised(notch, TALL)]
        self._zones: list[np.ndarray] = []  # boxes [2, 3] that stay free
        self._access: list[np.ndarray] = []  # areas [2, 2], one of whose points an agent reaches
        self.walls = [*_walls(self.area, notch)]
        low, high = self.area[0] + RADIUS, self.area[1] - RADIUS
        axes = [
            np.arange(np.ceil(a / GRID_SIZE - 1e-6), np.floor(b / GRID_SIZE + 1e-6) + 1) * GRID_SIZE
            for a, b in zip(low, high, strict=True)
        ]
        self._shape = (len(axes[0]), len(axes[1]))
        self._places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
        self._free = np.ones(len(self._places), bool)
        if notch is not None:
            self._free &= _gap(self._places, notch) >= RADIUS

    @property
    def points(self) -> np.ndarray:
        """Where an agent can stand: the largest connected part of the free points, [P, 3]."""
        level = self._places[self._largest(self._free)]
        return np.insert(level, 1, STANDING, axis=1)

    def put(
        self,
        unit: Sequence[SceneObject],
        places: Iterable[tuple[int, np.ndarray]],
        zones: Sequence[np.ndarray] = (),
        solid: Sequence[np.ndarray] = (),
        on_wall: bool = False,
    ) -> list[SceneObject] | None:
        """Puts objects down together at the first place that has room for them.

        Args:
          unit: the objects around the origin.
          places: where to try: quarters to turn it by, and where its origin goes [3].
          zones: boxes [2, 3] around the origin that must be and stay free, whose floor an agent
            must reach.
          solid: boxes [2, 3] around the origin in which nothing else is and no agent stands.
          on_wall: they hang on a wall, into which they may reach.

        Returns:
          The objects in their places; None if there is none.
        """
        boxes = np.array([*(item.box for item in unit), *solid])
        free = np.reshape([*zones], (-1, 2, 3))
        for turns, place in places:
            taken, kept = (_moved_boxes(some, turns, place) for some in (boxes, free))
            if not self._has_room(taken, kept, on_wall):
                continue
            there = [shifted(turned(item, turns, np.zeros(3)), place) for item in unit]
            if self._stays_connected(there, kept, taken[len(unit) :], on_wall):
                self.items += there
                self._zones += [*kept]
                self._solid += [*taken[len(unit) :]]
                return there
        return None

    def keep_free(self, zone: np.ndarray) -> None:
        """Leaves a box [2, 3] free from now on."""
        self._zones.append(zone)

    def _has_room(self, boxes: np.ndarray, zones: np.ndarray, on_wall: bool) -> bool:
        """Whether `boxes` [N, 2, 3] and `zones` [M, 2, 3] are in the room and meet nothing."""
        every = np.concatenate([boxes, zones])
        level = every[:, :, LEVEL]
        beyond = np.maximum(self.area[0] - level[:, 0], level[:, 1] - self.area[1])
        if not on_wall and beyond.max() > ROUNDED:
            return False
        there = [*self._solid, *(item.box for item in self.items)]
        return not (_overlap(every, there) or _overlap(boxes, self._zones))

    def _stays_connected(
        self, there: Sequence[SceneObject], zones: np.ndarray, solid: np.ndarray, on_wall: bool
    ) -> bool:
        """Whether an agent still reaches everything; if so, blocked points are noted."""
        free = self._free & reachable.clear(self._places, STANDING, there)
        for box in solid:
            free &= _gap(self._places, box[:, LEVEL]) >= RADIUS
        part = self._largest(free)
        if part.sum() < CONNECTED * max(free.sum(), 1) or not part.any():
            return False
        near = there[0].box[:, LEVEL] + _AROUND * (SEEN if on_wall else NEAR)
        around = [near] if on_wall or not len(zones) else [*zones[:, :, LEVEL]]
        access = np.array([*self._access, *around])[:, :, None]  # [N, 2, 1, 2]
        reached = self._places[part]
        inside = ((access[:, 0] <= reached) & (reached <= access[:, 1])).all(axis=-1)
        if not inside.any(axis=-1).all():
            return False
        self._free, self._access = free, [*self._access, *around]
        return True

    def copy(self) -> Floor:
        """The same floor, to try something on."""
        other = copy.copy(self)
        for name in ("items", "_solid", "_zones", "_access"):
            setattr(other, name, [*getattr(self, name)])
        return other

    def _largest(self, free: np.ndarray) -> np.ndarray:
        """Of the free places [n] bool, those in the largest connected part."""
        label, count = ndimage.label(free.reshape(self._shape))
        if count == 0:
            return np.zeros(len(free), bool)
        sizes = np.bincount(label.reshape(-1))[1:]
        result: np.ndarray = label.reshape(-1) == int(sizes.argmax()) + 1
        return result

    def against(
        self,
        span: np.ndarray,
        draw: np.random.Generator,
        tries: int,
        gap: float = WALL,
        corner: bool = False,
    ) -> Iterator[tuple[int, np.ndarray]]:
        """Places against a wall for something whose area around the origin is `span` [2, 2].

        Args:
          tries: the number of places.
          corner: at an end of a wall.
        """
        for wall, share in self.spots(span[1, 0] - span[0, 0], draw, tries):
            share = float(share < 0.5) if corner else share
            yield wall.turns, self.beside(wall, span, share, gap)

    def spots(
        self, width: float, draw: np.random.Generator, tries: int
    ) -> Iterator[tuple[Wall, float]]:
        """Walls that have room for a width, and a share of the way along them."""
        room = np.array([max(wall.length - width - 2 * WALL, 0) for wall in self.walls])
        if room.any():
            for _ in range(tries):
                wall = self.walls[int(draw.choice(len(room), p=room / room.sum()))]
                yield wall, float(draw.random())

    def beside(self, wall: Wall, span: np.ndarray, share: float, gap: float = WALL) -> np.ndarray:
        """Where at a wall the origin of something with area `span` [2, 2] goes: [3].

        Args:
          share: of the way from the wall's start to its end.
        """
        width = span[1, 0] - span[0, 0]
        # Seen from inside, walls lead to the left, which is +x of what stands at them.
        along = WALL + share * (wall.length - width - 2 * WALL) - span[0, 0]
        return wall.at(along, gap - span[0, 1])

    def middle(
        self, span: np.ndarray, draw: np.random.Generator, tries: int
    ) -> Iterator[tuple[int, np.ndarray]]:
        """Places anywhere on the floor for something whose area around the origin is `span`."""
        for _ in range(tries):
            turns = int(draw.integers(4))
            area = _moved_area(span, turns, np.zeros(3))
            room = self.area - area
            if (room[1] < room[0]).any():
                continue
            x, z = room[0] + draw.random(2) * (room[1] - room[0])
            yield turns, np.array([x, 0.0, z])


_AROUND = np.array([[-1.0, -1.0], [1.0, 1.0]])


def span_of(unit: Sequence[SceneObject]) -> np.ndarray:
    """The area [2, 2] around objects."""
    boxes = np.array([item.box for item in unit])[:, :, LEVEL]
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def zone_before(unit: Sequence[SceneObject], depth: float = CLEAR) -> np.ndarray:
    """The box [2, 3] in front of the first of some objects."""
    (x1, _, _), (x2, _, z) = unit[0].box
    return np.array([(x1, 0.0, z + TOUCHING), (x2, 0.3, z + depth)])


def _walls(area: np.ndarray, notch: np.ndarray | None) -> Iterator[Wall]:
    """The walls around an area, without those of a notch, and with the notch's own."""
    corners = _outline(area, notch)
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        way = end - start
        length = float(np.abs(way).max())
        along = way / length
        inward = np.array([-along[1], along[0]])
        turns = int((AHEAD @ inward).argmax())
        yield Wall(start, along, length, turns)


def _outline(area: np.ndarray, notch: np.ndarray | None) -> np.ndarray:
    """The corners [n, 2] of a room, so that its inside is to the left of the way along them in a
    plan with z up."""
    (x1, z1), (x2, z2) = area
    if notch is None:
        return np.array([(x1, z1), (x2, z1), (x2, z2), (x1, z2)])
    (a1, b1), (a2, b2) = notch
    left, low = np.isclose(a1, x1), np.isclose(b1, z1)
    if left and low:
        return np.array([(a2, z1), (x2, z1), (x2, z2), (x1, z2), (x1, b2), (a2, b2)])
    if low:
        return np.array([(x1, z1), (a1, z1), (a1, b2), (x2, b2), (x2, z2), (x1, z2)])
    if left:
        return np.array([(x1, z1), (x2, z1), (x2, z2), (a2, z2), (a2, b1), (x1, b1)])
    return np.array([(x1, z1), (x2, z1), (x2, b1), (a1, b1), (a1, z2), (x1, z2)])


def _moved_boxes(boxes: np.ndarray, turns: int, place: np.ndarray) -> np.ndarray:
    """Boxes [N, 2, 3] turned clockwise by quarters around the origin, and shifted."""
    for _ in range(turns % 4):
        boxes = np.sort(boxes[..., [2, 1, 0]] * np.array([1, 1, -1]), axis=1)
    return boxes + place


def _moved_area(area: np.ndarray, turns: int, place: np.ndarray) -> np.ndarray:
    return _moved_boxes(_raised(area, 0.0)[None], turns, place)[0][:, LEVEL]


def _raised(area: np.ndarray, height: float) -> np.ndarray:
    """The box [2, 3] from the floor up over an area [2, 2]."""
    return np.insert(area, 1, [0.0, height], axis=1)


def _overlap(boxes: np.ndarray, others: Sequence[np.ndarray]) -> bool:
    """Whether any of `boxes` [N, 2, 3] gets into any of others by more than they may touch."""
    if not len(others):
        return False
    one, other = boxes[:, None], np.array(others)
    common = np.minimum(one[:, :, 1], other[:, 1]) - np.maximum(one[:, :, 0], other[:, 0])
    thinner = np.minimum(one[:, :, 1] - one[:, :, 0], other[:, 1] - other[:, 0])
    return bool((common > np.minimum(TOUCHING, thinner / 2)).all(axis=-1).any())


def _gap(places: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Distance of `places` [n, 2] from an area [2, 2]: [n] metres."""
    gap = np.maximum(np.maximum(area[0] - places, places - area[1]), 0)
    result: np.ndarray = np.sqrt((gap * gap).sum(axis=1))
    return result
