"""Furnishes a room: doors and windows, then what is built in, groups, furniture, small objects."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from tdanet_jax.scenes.generation.catalogue import Catalogue, Member
from tdanet_jax.scenes.generation.floor import AHEAD, RIGHT, Floor, span_of, zone_before
from tdanet_jax.scenes.generation.pieces import Library, Piece, box_of, yawed
from tdanet_jax.scenes.generation.plan import Plan, Plans
from tdanet_jax.scenes.placement import LEVEL, Room, Statistics, shifted
from tdanet_jax.scenes.scene import Scene, SceneObject

TRIES = 60  # places for a piece of furniture
#: Furniture that stands at a wall; an agent can stand in front of it.
FACED = frozenset(["ArmChair", "Desk", "Dresser", "Fridge", "ShelvingUnit", "Sofa", "TVStand"])
#: Stand on furniture, as small objects do, although they cannot be picked up.
ON_FURNITURE = ("CoffeeMachine", "DeskLamp", "Desktop", "HousePlant", "Microwave", "Television",
                "Toaster")  # fmt: skip
#: Hang on walls, in the order in which they are hung.
ON_WALLS = ("Mirror", "Television", "Painting", "Poster", "TowelHolder", "HandTowelHolder",
            "ToiletPaperHanger", "Shelf")  # fmt: skip
#: What is on some of these.
HELD = {"TowelHolder": "Towel", "HandTowelHolder": "HandTowel"}
HIGHEST = 2.6  # metres of an upper side on a wall
DOOR = 1.0  # metres: what is free before a door
SWITCH = 0.2  # metres from a door to its light switch
RARE = 0.2  # share of the objects of a class on the floor, up to which none is put there
SLANTED = 0.5  # share of the small objects that are turned by other than quarters
SLANT = 40.0  # degrees, at most


class Furnisher:
    """A room that is being furnished."""

    def __init__(
        self,
        plan: Plan,
        plans: Plans,
        library: Library,
        usual: Statistics,
        catalogue: Catalogue,
        draw: np.random.Generator,
    ) -> None:
        self.plan, self.plans, self.library, self.usual = plan, plans, library, usual
        self.catalogue, self.draw = catalogue, draw
        self.left = plan.counts.copy()
        self.levels: dict[str, tuple[float, ...]] = {}
        self._ids = itertools.count(1)
        self.floor = Floor(plan.size, _notch(plan, draw))

    # Objects

    def make(
        self, name: str, piece: Piece | None = None, degrees: float = 0.0
    ) -> list[SceneObject]:
        """A piece of a class, with its parts, around the origin; it is one less to be placed."""
        piece = piece or self.library.choose(name, self.draw)
        number = next(self._ids)
        unit = self.library.objects(piece, 1000 * number, self.draw, degrees)
        self.levels[unit[0].object_id] = self.library.heights(piece)
        self.left[name] -= 1
        return unit

    def block(self, name: str, low: Sequence[float], high: Sequence[float]) -> SceneObject:
        """An object of a class between two corners; it is one less to be placed."""
        self.left[name] -= 1
        box = np.array([low, high], np.float64)
        return self.library.object(name, 1000 * next(self._ids), box, self.draw)

    def has(self, name: str) -> bool:
        """Whether there is another object of a class to place."""
        return self.left[name] > 0 and name in self.library

    # Walls

    def openings(self) -> None:
        """A door with its light switch, and the windows."""
        for wall, share in self.floor.spots(DOOR + 4 * SWITCH, self.draw, 1):
            along = 2 * SWITCH + DOOR / 2 + share * (wall.length - DOOR - 4 * SWITCH)
            ends = np.array([wall.at(along - DOOR / 2), wall.at(along + DOOR / 2, DOOR)])
            ends[:, 1] = 0.0, 2.1
            self.floor.keep_free(np.sort(ends, axis=0))
            if self.has("LightSwitch"):
                side = (DOOR / 2 + SWITCH) * (1 if self.draw.random() < 0.5 else -1)
                self.hang("LightSwitch", [(wall.turns, wall.at(along + side))])
        while self.has("Window"):
            self._window()

    def _window(self) -> None:
        window = self._hanging("Window", 0.3)
        (x1, y1, z1), (x2, y2, _) = window.box
        unit = [window]
        for name in ("Blinds", "Curtains"):
            if self.has(name) and self.left[name] > self.left["Window"]:
                piece = self.library.choose(name, self.draw)
                height, depth = float(piece.size[1]), float(min(piece.size[2], 0.2))
                top, wider = (y2, 0.0) if name == "Blinds" else (min(y2 + 0.2, HIGHEST), 0.25)
                unit.append(self.block(
                    name, (x1 - wider, max(top - height, 0.05), 0.0), (x2 + wider, top, depth)
                ))  # fmt: skip
        zone = np.array([(x1, y1 + 0.35, z1), (x2, y2, 0.25)])
        self.floor.put(unit, self._along_walls(unit), [zone], on_wall=True)

    def _hanging(self, name: str, inside: float = 1.0) -> SceneObject:
        """What hangs on a wall at z = 0, as high as such things hang.

        Args:
          inside: the share of its depth that is inside the room.
        """
        piece = self.library.choose(name, self.draw)
        bottoms = self.plans.bottoms.get((self.plan.room_type, name), np.array([1.2]))
        width, height, depth = piece.size
        bottom = float(np.clip(self.draw.choice(bottoms), 0, max(HIGHEST - height, 0.05)))
        front = min(depth, 0.5) if inside == 1.0 else inside * min(depth, 0.15)
        low = (-width / 2, bottom, front - min(depth, 0.5))
        return self.block(name, low, (width / 2, bottom + height, front))

    def _along_walls(self, unit: Sequence[SceneObject]) -> Iterator[tuple[int, np.ndarray]]:
        span = span_of(unit)
        span[0, 1] = 0.0
        return self.floor.against(span, self.draw, TRIES, 0.01)

    def hang(
        self, name: str, places: Iterable[tuple[int, np.ndarray]] | None = None
    ) -> list[SceneObject] | None:
        """Hangs something on a wall, at the first place that has room for it."""
        unit = [self._hanging(name)]
        if name in HELD and self.has(HELD[name]):
            unit.append(self._held(HELD[name], unit[0]))
        return self.floor.put(unit, places or self._along_walls(unit), on_wall=True)

    def _held(self, name: str, holder: SceneObject) -> SceneObject:
        """A towel on its holder."""
        (x1, _, z1), (x2, top, z2) = holder.box
        rest = self.usual.rest.get(holder.object_class)
        height = 0.0 if rest is None or rest.height is None else rest.height
        base = top + height if rest is None or rest.from_top else holder.box[0, 1] + height
        (width, tall, depth), x, z = self.library.choose(name, self.draw).size, x1 + x2, z1 + z2
        back = max((z - depth) / 2, 0)
        item = self.block(
            name, ((x - width) / 2, base, back), ((x + width) / 2, base + tall, back + depth)
        )
        return dataclasses.replace(item, parents=(holder.object_id,))

    # Furniture

    def group(self, members: Sequence[Member]) -> list[list[SceneObject]]:
        """The objects of a group, member by member; those of a class are of the same model."""
        pieces: dict[str, Piece] = {}
        found: list[list[SceneObject]] = []
        for member in members:
            name, spread = member.object_class, np.array(member.spread)
            piece = pieces.setdefault(name, self.library.choose(name, self.draw))
            dx, dz, dturn = self.draw.uniform(-1, 1, 3) * spread * np.array([0.5, 0.5, 1.0])
            unit = self.make(name, piece, member.turn + dturn)
            if member.parent >= 0:
                parent = found[member.parent][0]
                half = np.ptp(parent.box, axis=0)[LEVEL] / 2
                middle = parent.box.mean(axis=0)[LEVEL]
                own = np.ptp(unit[0].box, axis=0)[LEVEL] / 2
                at = middle + np.array(member.side) * half + np.array(member.offset)
                at = at - np.array(member.align) * own
                # Whatever is beside a parent stays beside it.
                room = np.maximum(half - own * 0.7, 0)
                at += np.where(np.array(member.side) == 0, np.clip((dx, dz), -room, room), 0.0)
                y = 0.0
                if member.above:
                    heights = self.levels.get(parent.object_id, ())
                    y = parent.box[0, 1] + (heights[-1] if heights else np.ptp(parent.box[:, 1]))
                unit = [shifted(item, np.array([at[0], y, at[1]])) for item in unit]
                if member.above:
                    unit[0] = dataclasses.replace(unit[0], parents=(parent.object_id,))
            found.append(unit)
        return found

    def put_group(
        self, members: Sequence[Member], zones: Sequence[int], where: Sequence[str]
    ) -> bool:
        """Puts a group down; without effect if there is no room for it.

        Args:
          zones: the members in front of which an agent must be able to stand.
          where: corner, edge or middle, in the order in which they are tried.
        """
        before = self.left.copy()
        found = self.group(members)
        unit = [item for part in found for item in part]
        free = [zone_before(found[i]) for i in zones]
        if self.floor.put(unit, self.places(unit, where), free) is not None:
            return True
        self.left = before
        return False

    def places(
        self, unit: Sequence[SceneObject], where: Sequence[str]
    ) -> Iterator[tuple[int, np.ndarray]]:
        """Places for objects: at corners, at walls (`edge`), or anywhere (`middle`)."""
        span = span_of(unit)
        for spot in where:
            if spot == "middle":
                yield from self.floor.middle(span, self.draw, TRIES)
            else:
                yield from self.floor.against(span, self.draw, TRIES, corner=spot == "corner")

    def stand(self, name: str) -> bool:
        """Puts a piece of furniture where its class stands; without effect if there is no room."""
        before = self.left.copy()
        unit = self.make(name)
        spots = self.catalogue.spots.get(name, frozenset(["edge"]))
        first = ["corner"] if "corner" in spots and self.draw.random() < 0.3 else []
        where = [*first, *(spot for spot in ("edge", "corner", "middle") if spot in spots)]
        zones = [zone_before(unit)] if name in FACED else []
        if self.floor.put(unit, self.places(unit, where), zones) is not None:
            return True
        self.left = before
        return False

    def beside(self, name: str, others: Sequence[str]) -> bool:
        """Puts a piece next to one of other classes, as deep at the wall, to its left or right."""
        hosts = [item for item in self.floor.items if item.object_class in others]
        for k in self.draw.permutation(len(hosts)):
            host = hosts[int(k)]
            turns = round(host.rotation[1] / 90) % 4
            if abs((host.rotation[1] + 45) % 90 - 45) > 1:
                continue
            before = self.left.copy()
            unit = self.make(name)
            spans = np.ptp(host.box, axis=0)[LEVEL]
            width, depth = spans if turns % 2 == 0 else spans[::-1]
            own = np.ptp(unit[0].box, axis=0)[LEVEL]
            middle = host.box.mean(axis=0)
            places = []
            for side in self.draw.permutation(np.array([-1, 1])):
                away = side * (width / 2 + own[0] / 2 + 0.03) * RIGHT[turns]
                x, z = middle[LEVEL] + away + AHEAD[turns] * (own[1] - depth) / 2
                places.append((turns, np.array([x, 0.0, z])))
            if self.floor.put(unit, places) is not None:
                return True
            self.left = before
        return False

    def furnish(self) -> None:
        """All furniture that is still left, largest first, then what hangs on walls and lies on
        the floor."""
        names = [
            n for n in sorted(self.left) if self.has(n) and n not in (*ON_WALLS, *ON_FURNITURE)
        ]
        standing = [n for n in names if self.plans.on_floor(self.plan.room_type, n) > 0.5]
        areas = {n: float(np.prod(self.library.known(n)[0].size[[0, 2]])) for n in standing}
        pickup = {n: self.library.flags[n][1] for n in standing}
        for name in sorted(standing, key=lambda n: (pickup[n], -areas[n], n)):
            while self.has(name):
                near = {"SideTable": ("Bed", "Sofa", "ArmChair"), "Ottoman": ("Sofa", "ArmChair"),
                        "FloorLamp": ("Sofa", "ArmChair"), "Chair": ()}.get(name, ())  # fmt: skip
                if near and self.draw.random() < 0.7 and self.beside(name, near):
                    continue
                if pickup[name]:
                    if not self._drop(name):
                        break
                elif not self.stand(name):
                    break
        for name in ON_WALLS:
            while self.has(name):
                self.hang(name)

    def _drop(self, name: str) -> bool:
        """Puts a small object on the floor, near a wall."""
        before = self.left.copy()
        [item, *_] = self.make(name)
        unit = [yawed(item, self.draw.uniform(-SLANT, SLANT)) if self._slants() else item]
        if self.floor.put(unit, self.places(unit, ("edge", "middle"))) is not None:
            return True
        self.left = before
        return False

    def _slants(self) -> bool:
        return bool(self.draw.random() < SLANTED)

    # Small objects

    def scatter(self, name: str) -> Scene:
        """Small objects, on what holds their class; the room with all that is in it."""
        known = self.library.flags
        pickupable = [n for n in sorted(self.left) if n in known and known[n][1]]
        for n in pickupable:
            share = self.plans.on_floor(self.plan.room_type, n)
            for _ in range(max(self.left[n], 0) if share > RARE else 0):
                if self.draw.random() < share and self.has(n):
                    self._drop(n)
        for names in (ON_FURNITURE, pickupable):
            scene = self.scene(name)
            room = Room(scene, self.usual, {}, scene.objects, self.levels)
            small = [self._small(n) for n in names for _ in range(self.left[n]) if self.has(n)]
            small.sort(key=lambda item: (-np.prod(np.ptp(item.box, axis=0)[LEVEL]), item.object_id))
            for item in small:
                there = room.put([item], self.draw)
                self.floor.items += there or []
                self.left[item.object_class] += there is None
        return self.scene(name)

    def _small(self, name: str) -> SceneObject:
        piece = self.library.choose(name, self.draw)
        self.left[name] -= 1
        item = self.library.object(name, 1000 * next(self._ids), box_of(piece.size), self.draw)
        hangs = any(pair[0] == name for pair in self.usual.overhangs)
        if item.pickupable and not hangs and self._slants():
            return yawed(item, self.draw.uniform(-SLANT, SLANT))
        return item

    @property
    def missing(self) -> float:
        """The share of the plan's objects that have found no place."""
        return sum(n for n in self.left.values() if n > 0) / sum(self.plan.counts.values())

    def scene(self, name: str) -> Scene:
        """The room as it is."""
        return Scene(
            name,
            self.plan.room_type,
            self.floor.points,
            tuple(sorted(self.floor.items, key=lambda item: (item.object_class, item.object_id))),
            part="train",
        )

    def groups_of(self, root: str) -> list[tuple[Member, ...]]:
        """The groups around a class of which all members are still to be placed, largest first."""
        found = []
        for members in self.catalogue.groups:
            names = [member.object_class for member in members]
            if names[0] == root and all(self.left[n] >= names.count(n) for n in {*names}):
                found.append(members)
        order = self.draw.permutation(len(found))
        return sorted((found[i] for i in order), key=len, reverse=True)


def _notch(plan: Plan, draw: np.random.Generator) -> np.ndarray | None:
    """The part that is cut off at a corner of a room, [2, 2]."""
    corner, share = draw.integers(2, size=2), draw.uniform(0.35, 0.65)
    if not plan.notch:
        return None
    half = plan.size / 2
    sides = plan.size * np.array([plan.notch**share, plan.notch ** (1 - share)])
    sides = np.minimum(sides, plan.size - 1.6)
    if (sides < 0.4).any():
        return None
    low = np.where(corner == 0, -half, half - sides)
    return np.stack([low, low + sides])
