"""Small objects put elsewhere: where they rest in training rooms, and where they fit in a room.

A room's metadata says which receptacle each small (pickupable) object lies on. Over training rooms,
this tells which receptacles hold a class and how often, and how high and how far from the edge
things lie on a receptacle. `replace` draws new places for the small objects of a room from that.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping, Sequence

import numpy as np

from tdanet_jax.scenes.reachable import HEIGHT, RADIUS
from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.scenes.visibility.rules import RULES

LENGTH_DIGITS = 4  # lengths are rounded to tenths of a millimetre, as in the bundled rooms
SAME = 0.03  # metres within which two heights are the same
USUAL = 0.8  # share of the objects that rest at a class's usual height, if it has one
AROUND = 0.15  # metres around what lies on a surface of unknown extent that belong to it
TOUCHING = 0.01  # metres by which boxes may overlap: meshes are smaller than their boxes
ROUND = 0.1  # a table whose sides differ by less than this share may be round
SPOTS = 48  # drawn on a surface before another one is tried
DRAWS = 12  # of a surface for an object
TURNED = 3.0  # degrees off the axes from which on a box says little about what is in it
#: Nothing rests on these but in them: other things keep clear of what is cut into their support.
HOLES = frozenset(["BathtubBasin", "Sink", "SinkBasin", "StoveBurner"])
HOLE = 0.05  # metres above a hole that stay clear
LEVEL = [0, 2]  # the horizontal axes


@dataclasses.dataclass(frozen=True)
class Rest:
    """How objects lie on the receptacles of a class. Lengths in metres.

    Attributes:
      height: of their bottoms above the receptacle's lower (or upper) side; None if it varies.
      from_top: whether `height` counts from the upper side.
      margin: their distance from the receptacle's edge, which nine in ten keep.
      gap: likewise their distance from the nearest reachable point.
    """

    height: float | None
    from_top: bool
    margin: float
    gap: float

    def level(self, receptacle: SceneObject) -> float | None:
        """The y at which objects usually rest on a receptacle."""
        return None if self.height is None else receptacle.box[int(self.from_top), 1] + self.height


@dataclasses.dataclass(frozen=True)
class Statistics:
    """What lies where in some rooms.

    Attributes:
      holds: (room type, class) -> class of receptacle -> how many of the class lie on it.
      rest: class of receptacle -> how objects lie on it.
      overhangs: pairs (class, class of receptacle) of which most stick out or hang: pans on
        burners, towels on their holders.
    """

    holds: Mapping[tuple[str, str], Mapping[str, int]]
    rest: Mapping[str, Rest]
    overhangs: Collection[tuple[str, str]]


@dataclasses.dataclass(frozen=True, eq=False)
class Surface:
    """A level part of a receptacle on which objects can be put."""

    receptacle: SceneObject
    height: float  # metres, y
    area: np.ndarray  # [2, 2] metres, lower and upper x and z
    is_round: bool  # only what is in the ellipse inside `area`


def room_kind(scene: Scene) -> str:
    """The room type of a scene, or the types of a house in one name."""
    return (
        scene.room_type
        if isinstance(scene.room_type, str)
        else "+".join(sorted({*scene.room_type}))
    )


def supports(scene: Scene) -> dict[str, SceneObject]:
    """The object that each object rests on, by id: of its receptacles, the one nearest in height.

    A small container, such as a bowl, comes before what it stands on.
    """
    known = {item.object_id: item for item in scene.objects}
    found = {}
    for item in scene.objects:
        held_by = [known[name] for name in item.parents if name in known and known[name] != item]
        if held_by and np.isfinite([item.box, *(other.box for other in held_by)]).all():
            found[item.object_id] = min(
                held_by,
                key=lambda other: (
                    not (other.pickupable and _contains(other.box, item.box.mean(axis=0))),
                    float(np.abs(item.box[0, 1] - other.box[:, 1]).min()),
                ),
            )
    return found


def chain(item: SceneObject, support: Mapping[str, SceneObject]) -> list[SceneObject]:
    """What an object rests on, what that rests on, and so on."""
    found: list[SceneObject] = []
    while (below := support.get(item.object_id)) is not None and below not in found:
        found.append(below)
        item = below
    return found


def is_closed(item: SceneObject) -> bool:
    """Whether nobody sees what is in a receptacle."""
    return item.object_class in RULES.closed and not item.is_open


def statistics(scenes: Sequence[Scene], others: Collection[str] = ()) -> Statistics:
    """What lies where in these rooms: training rooms alone, for rooms to train in.

    Args:
      others: classes that stand on furniture as small objects do, although they cannot be picked
        up.
    """
    holds: dict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    rests: dict[str, list[tuple[float, float, float, float]]] = defaultdict(list)
    stuck_out: dict[tuple[str, str], list[bool]] = defaultdict(list)
    for scene in scenes:
        support = supports(scene)
        for item in scene.objects:
            below = support.get(item.object_id)
            small = item.pickupable or item.object_class in others
            if not small or below is None or below.pickupable or is_closed(below):
                continue
            holds[room_kind(scene), item.object_class][below.object_class] += 1
            margin = float(
                np.minimum(item.box[0] - below.box[0], below.box[1] - item.box[1])[LEVEL].min()
            )
            over = item.box[0, 1] - below.box[:, 1]
            out = margin < -TOUCHING / 2 or over[0] < -SAME
            stuck_out[item.object_class, below.object_class].append(out)
            gap = float(_gaps(item.box[None], scene.points)[0])
            rests[below.object_class].append((float(over[0]), float(over[1]), margin, gap))
    return Statistics(
        holds={key: dict(sorted(counts.items())) for key, counts in holds.items()},
        rest={name: _rest(np.array(rows)) for name, rows in rests.items()},
        overhangs=frozenset(pair for pair, out in stuck_out.items() if 2 * sum(out) > len(out)),
    )


def _rest(rows: np.ndarray) -> Rest:
    """How objects lie, from their heights over both sides, margins and gaps [n, 4]."""
    middle = np.median(rows[:, :2], axis=0)
    same = (np.abs(rows[:, :2] - middle) < SAME).mean(axis=0)
    side = int(same[1] >= same[0])
    height = float(middle[side]) if same[side] >= USUAL else None
    margin, gap = np.quantile(rows[:, 2:], 0.1, axis=0, method="lower")
    return Rest(height, bool(side), max(float(margin), 0.0), max(float(gap), RADIUS))


def rearrange(
    scene: Scene, known: Statistics, draw: np.random.Generator, left_out: float
) -> tuple[SceneObject, ...]:
    """The objects of a room, the small ones elsewhere: each on a receptacle that holds its class.

    What is in a closed receptacle stays there, and so does what lies on no receptacle. Contents
    move with their container. An object that fits nowhere stays where it is, or is left out if
    something else is there now.

    Args:
      known: from training rooms.
      left_out: the share of the small objects to leave out; one of them always stays.
    """
    support = supports(scene)
    units = _units(scene, support)
    gone = draw.random(len(units)) < left_out
    gone[: int(gone.all())] = False
    moved = {item.object_id for unit in units for item in unit}
    placed = {item.object_id: item for item in scene.objects if item.object_id not in moved}
    room = Room(scene, known, support, [*placed.values()])
    for unit, absent in zip(units, gone, strict=True):
        if not absent and (there := room.place(unit, draw)) is not None:
            placed |= {item.object_id: item for item in there}
    return tuple(
        dataclasses.replace(item, parents=tuple(p for p in item.parents if p in placed))
        for item in (placed[o.object_id] for o in scene.objects if o.object_id in placed)
    )


def _units(scene: Scene, support: Mapping[str, SceneObject]) -> list[list[SceneObject]]:
    """The small objects that move together, each with its contents, largest footprint first."""
    units: dict[str, list[SceneObject]] = {}
    for item in sorted(scene.objects, key=lambda item: not item.pickupable):
        below = chain(item, support)
        small = [item, *(other for other in below if other.pickupable)]
        if item.pickupable and not any(map(is_closed, below)) and np.isfinite(item.box).all():
            units.setdefault(small[-1].object_id, []).append(item)
    ordered = [
        sorted(unit, key=lambda item: item.object_id != root) for root, unit in units.items()
    ]
    return sorted(ordered, key=lambda unit: (-_footprint(unit[0].box), unit[0].object_id))


class Room:
    """A room that small objects are put into, one after the other."""

    def __init__(
        self,
        scene: Scene,
        known: Statistics,
        support: Mapping[str, SceneObject],
        there: Sequence[SceneObject],
        levels: Mapping[str, Sequence[float]] | None = None,
    ) -> None:
        """`there` are the objects that stay in their places, whatever the scene has besides.

        Args:
          levels: id of a receptacle -> heights (y) at which things lie on it, if they are not those
            that are usual for its class.
        """
        self._scene = scene
        self._levels = {} if levels is None else levels
        self._known = known
        self._support = support
        self._there = [item for item in there if np.isfinite(item.box).all()]
        self._surfaces = [
            surface
            for item in self._there
            if not (item.pickupable or is_closed(item) or any(map(is_closed, chain(item, support))))
            for surface in self._surfaces_of(item)
        ]

    def _surfaces_of(self, receptacle: SceneObject) -> list[Surface]:
        """Where objects can be put on a receptacle: as high as others lie on it, or usually do.

        At its upper side, and at the lower side of what does not stand on the floor, that is all
        of it but the margin; at other heights, only around what lies there.
        """
        rest = self._known.rest.get(receptacle.object_class)
        if rest is None:
            return []
        lying = [
            item
            for item in self._scene.objects
            if item.pickupable and self._support.get(item.object_id) is receptacle
        ]
        heights: dict[float, list[SceneObject]] = defaultdict(list)
        for item in lying:
            near = (h for h in heights if abs(h - item.box[0, 1]) < SAME)
            heights[next(near, float(item.box[0, 1]))].append(item)
        usual = rest.level(receptacle)
        for level in self._levels.get(receptacle.object_id, () if usual is None else (usual,)):
            if not any(abs(height - level) < SAME for height in heights):
                heights[level] = []
        return [self._surface(receptacle, rest, *level) for level in heights.items()]

    def _surface(
        self, receptacle: SceneObject, rest: Rest, height: float, lying: Sequence[SceneObject]
    ) -> Surface:
        margin = np.array([[rest.margin], [-rest.margin]])
        area = receptacle.box[:, LEVEL] + margin
        usual = rest.level(receptacle)
        flat = abs(height - receptacle.box[1, 1]) < 2 * SAME
        oblique = abs((receptacle.rotation[1] + 45) % 90 - 45) > TURNED
        as_usual = usual is not None and abs(height - usual) < SAME
        if lying and (oblique or not (flat or as_usual)):
            boxes = np.array([item.box[:, LEVEL] for item in lying])
            around = np.stack([boxes[:, 0].min(axis=0) - AROUND, boxes[:, 1].max(axis=0) + AROUND])
            area = np.stack([np.maximum(area[0], around[0]), np.minimum(area[1], around[1])])
        elif oblique:  # the middle of the box is on the receptacle, however it is turned
            area = area + np.array([[1], [-1]]) * (area[1] - area[0]) / 4
        sides = receptacle.box[1, LEVEL] - receptacle.box[0, LEVEL]
        square = abs(sides[0] - sides[1]) < ROUND * sides.max()
        return Surface(receptacle, height, area, bool(square and receptacle.object_class in TABLES))

    def place(
        self, unit: Sequence[SceneObject], draw: np.random.Generator
    ) -> list[SceneObject] | None:
        """An object and its contents in a new place, which is then taken; None if it has none."""
        found = self.put(unit, draw) if unit[0].object_id in self._support else None
        if found is None and self._free(_around(unit)[None], None).all():
            found = [*unit]
            self._there += unit
        return found

    def put(
        self, unit: Sequence[SceneObject], draw: np.random.Generator
    ) -> list[SceneObject] | None:
        """An object that is nowhere yet and its contents, on a receptacle; None if none has room.

        Its place is then taken.
        """
        if (found := self._find(unit, draw)) is not None:
            self._there += found
        return found

    def _find(
        self, unit: Sequence[SceneObject], draw: np.random.Generator
    ) -> list[SceneObject] | None:
        item, below = unit[0], self._support.get(unit[0].object_id)
        counts = self._known.holds.get((room_kind(self._scene), item.object_class), {})
        options = {
            name: surfaces
            for name in counts
            if (
                surfaces := [
                    surface
                    for surface in self._surfaces
                    if surface.receptacle.object_class == name
                    and (
                        not self._overhangs(item, name)
                        or _turns(item, below, surface.receptacle) is not None
                    )
                ]
            )
        }
        if not options:
            return None
        names, weights = [*options], np.array([counts[name] for name in options])
        for _ in range(DRAWS):
            name = names[
                int(np.searchsorted(weights.cumsum(), draw.random() * weights.sum(), "right"))
            ]
            surface = options[name][draw.integers(len(options[name]))]
            out = self._overhangs(item, name)
            turns = draw.integers(4) if not out else _turns(item, below, surface.receptacle) or 0
            there = [turned(other, int(turns), item.box.mean(axis=0)) for other in unit]
            shift = self._spot(there, surface, out, draw.random((SPOTS, 2)))
            if shift is not None:
                rest = (surface.receptacle.object_id,)
                first = dataclasses.replace(shifted(there[0], shift), parents=rest)
                return [first, *(shifted(other, shift) for other in there[1:])]
        return None

    def _overhangs(self, item: SceneObject, receptacle: str) -> bool:
        return (item.object_class, receptacle) in self._known.overhangs

    def _spot(
        self, unit: Sequence[SceneObject], surface: Surface, out: bool, shares: np.ndarray
    ) -> np.ndarray | None:
        """The shift [3] in metres that puts objects on a surface; None if none of the spots does.

        Args:
          out: put it over the middle of the surface, beyond whose edges it may stick out.
          shares: [N, 2] where to try, as shares of the surface.
        """
        box, whole = unit[0].box, _around(unit)
        low, high = surface.area[0] - box[0, LEVEL], surface.area[1] - box[1, LEVEL]
        if out:
            low = high = surface.receptacle.box[:, LEVEL].mean(axis=0) - box[:, LEVEL].mean(axis=0)
        elif (high < low).any():
            return None
        level = low + shares[: 1 if out else None] * (high - low)
        shift = np.insert(level, 1, surface.height - box[0, 1], axis=1).round(LENGTH_DIGITS)
        free = self._free(whole + shift[:, None], surface)
        if surface.is_round and not out:
            free &= _in_ellipse(box[:, LEVEL] + shift[:, None, LEVEL], surface.area)
        return shift[free.argmax()] if free.any() else None

    def _free(self, boxes: np.ndarray, surface: Surface | None) -> np.ndarray:
        """Whether each of `boxes` [N, 2, 3] on a surface meets nothing that is there: [N] bool."""
        below = None if surface is None else surface.receptacle
        free = np.ones(len(boxes), bool)
        if below is not None:
            points = self._scene.points
            gap = self._known.rest[below.object_class].gap
            if (_gaps(below.box[None], points) == 0).any():
                # A corner of floor lies in its box: its edge may be a step from where agents stand.
                gap = max(gap, RADIUS + self._scene.grid.grid_size)
            low = boxes[:, 0, 1] < np.median(points[:, 1]) + HEIGHT / 2
            free = ~low | (_gaps(boxes, points) >= gap - TOUCHING)
        for other in self._there:
            box = other.box
            if below is not None:
                hole = other.object_class in HOLES and below.object_class not in HOLES
                if other is below or (not hole and holds(other.box, below.box)):
                    continue
                if hole:
                    box = box + np.array([[0, 0, 0], [0, HOLE, 0]])
            overlap = np.minimum(boxes[:, 1], box[1]) - np.maximum(boxes[:, 0], box[0])
            thinner = np.minimum(boxes[:, 1] - boxes[:, 0], box[1] - box[0])
            free &= (overlap <= np.minimum(TOUCHING, thinner / 2)).any(axis=1)
        return free


#: Whose box may be that of a disc.
TABLES = RULES.plates | {"Ottoman", "Stool"}


def shifted(item: SceneObject, shift: np.ndarray) -> SceneObject:
    """An object moved by `shift` [3] metres."""
    return dataclasses.replace(
        item,
        box=(item.box + shift).round(LENGTH_DIGITS),
        corners=None if item.corners is None else (item.corners + shift).round(LENGTH_DIGITS),
        visible=None,
    )


def turned(item: SceneObject, turns: int, centre: np.ndarray) -> SceneObject:
    """An object turned clockwise by quarters about the vertical through `centre` [3]."""
    for _ in range(turns % 4):
        x, y, z = item.rotation
        item = dataclasses.replace(
            item,
            box=np.sort(_quarter(item.box, centre), axis=0).round(LENGTH_DIGITS),
            corners=None
            if item.corners is None
            else _quarter(item.corners, centre).round(LENGTH_DIGITS),
            rotation=(x, (y + 90) % 360, z),
        )
    return item


def _quarter(places: np.ndarray, centre: np.ndarray) -> np.ndarray:
    x, y, z = (places - centre).T
    return np.stack([z, y, -x], axis=1) + centre


def _turns(item: SceneObject, below: SceneObject | None, other: SceneObject) -> int | None:
    """Quarters from one receptacle to another of its class; None between other ones.

    What is nowhere yet is turned along its receptacle.
    """
    if below is None:
        lies, goes = (np.ptp(box[:, LEVEL], axis=0) for box in (item.box, other.box))
        return int((lies[0] > lies[1]) != (goes[0] > goes[1]))
    if below.object_class != other.object_class:
        return None
    turn = (other.rotation[1] - below.rotation[1]) / 90
    return round(turn) % 4 if abs(turn - round(turn)) * 90 < TURNED else None


def _around(unit: Sequence[SceneObject]) -> np.ndarray:
    """The box [2, 3] around several objects."""
    boxes = np.array([item.box for item in unit])
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def _footprint(box: np.ndarray) -> float:
    return float(np.prod((box[1] - box[0])[LEVEL]))


def _contains(box: np.ndarray, place: np.ndarray) -> bool:
    return bool(((box[0] <= place) & (place <= box[1]))[LEVEL].all())


def holds(box: np.ndarray, inner: np.ndarray) -> bool:
    """Whether a box has most of another's footprint over or in it, and reaches its height."""
    common = np.minimum(box[1], inner[1]) - np.maximum(box[0], inner[0])
    return bool((common > 0).all() and np.prod(common[LEVEL]) >= 0.8 * _footprint(inner))


def _gaps(boxes: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Distance [N] of `boxes` [N, 2, 3] from the nearest of `points` [P, 3], horizontally."""
    low, high, at = boxes[:, None, 0, LEVEL], boxes[:, None, 1, LEVEL], points[:, LEVEL]
    gap = np.maximum(np.maximum(low - at, at - high), 0)
    return np.sqrt((gap * gap).sum(axis=-1).min(axis=1))


def _in_ellipse(boxes: np.ndarray, area: np.ndarray) -> np.ndarray:
    """Whether each of `boxes` [N, 2, 2] is in the ellipse inside `area` [2, 2]: [N] bool."""
    middle, half = area.mean(axis=0), (area[1] - area[0]) / 2
    farthest = np.abs(boxes - middle).max(axis=1) / np.maximum(half, 1e-9)
    return (farthest * farthest).sum(axis=-1) <= 1.0
