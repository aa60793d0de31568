"""Counters: runs of modules along walls, with sinks, stoves, drawers and cabinets."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from tdanet_jax.scenes.generation.floor import AHEAD, WALL, Wall
from tdanet_jax.scenes.generation.furnish import Furnisher
from tdanet_jax.scenes.generation.pieces import Piece, box_of
from tdanet_jax.scenes.placement import shifted
from tdanet_jax.scenes.scene import SceneObject

HEIGHT, TOP = 0.9, 0.92  # metres: the lower and upper side of a counter
FRONT = 0.03  # metres by which a counter overhangs
INSIDE = 0.32  # metres: depth of the boxes of cabinets and drawers
BEFORE = 0.7  # metres in front of a counter
UPPER = (1.6, 2.35)  # metres: cabinets on walls
STOVE = 0.76  # metres: width of a stove
DOORS = (0.32, 0.56)  # metres: widths of cabinets
RUNS = 24  # tries for the counters of a kitchen
LEAST = 2.4  # metres of counters in a kitchen
HIGH = 0.35  # share of kitchens whose stove has its knobs at the back
MICROWAVES = 0.4  # share of kitchens whose microwave hangs above the stove
ISLANDS = 0.25  # share of kitchens with an island where there is room for one
LAYOUTS = (0.2, 0.55, 0.25)  # of kitchens: along a wall, around a corner, on both sides

Module = tuple[str, float]  # what it is, and metres along the wall
Run = tuple[list[Module], Wall, float]  # modules along a wall, from so many metres on


class Counters:
    """The counters of a room."""

    def __init__(self, room: Furnisher, depth: float) -> None:
        self._room, self.draw, self.depth = room, room.draw, depth
        self._sinks: list[Piece] = []
        self._knobs_at_back = bool(room.draw.random() < HIGH)

    def run(self, modules: Sequence[Module]) -> tuple[list[SceneObject], np.ndarray, np.ndarray]:
        """A run from x = 0 on, its back at z = 0: objects, the box that is taken, what is free."""
        found: list[SceneObject] = []
        at, first = 0.0, None
        for name, width in [*modules, ("end", 0.0)]:
            if name in ("fridge", "stove", "end") and first is not None:
                found.append(self._room.block(
                    "CounterTop", (first, HEIGHT, 0.0), (at, TOP, self.depth)
                ))  # fmt: skip
                first = None
            elif name not in ("fridge", "stove", "end") and first is None:
                first = at
            found += getattr(self, f"_{name}")(at, width)
            at += width
        taken = np.array([(0.0, 0.0, 0.0), (at, HEIGHT - 0.05, self.depth)])
        corner = modules[-1][1] if modules[-1][0] == "open" else 0.0  # another run is before it
        free = np.array([(0.0, 0.0, self.depth + 0.05), (at - corner, 0.3, self.depth + BEFORE)])
        return found, taken, free

    def _end(self, at: float, width: float) -> list[SceneObject]:
        return []

    def _fridge(self, at: float, width: float) -> list[SceneObject]:
        piece = self._fridge_piece
        unit = self._room.make("Fridge", piece)
        half = piece.size[2] / 2
        return [shifted(item, np.array([at + width / 2, 0.0, half])) for item in unit]

    def _choose_fridge(self) -> float:
        """Its width, with some room at its sides."""
        self._fridge_piece = self._room.library.choose("Fridge", self.draw)
        return float(self._fridge_piece.size[0]) + 0.06

    def _front(self, name: str, at: float, width: float, low: float, high: float) -> SceneObject:
        """The front of a cabinet or drawer between two heights."""
        z = self.depth - FRONT
        return self._room.block(name, (at + 0.02, low, z - INSIDE), (at + width - 0.02, high, z))

    def _base(self, at: float, width: float) -> list[SceneObject]:
        """A cabinet, mostly below a drawer."""
        if self.draw.random() < 0.6:
            return [self._front("Cabinet", at, width, 0.1, 0.68),
                    self._front("Drawer", at, width, 0.72, 0.85)]  # fmt: skip
        return [self._front("Cabinet", at, width, 0.1, 0.84)]

    def _drawers(self, at: float, width: float) -> list[SceneObject]:
        heights = (0.1, 0.36, 0.62, 0.85)
        return [self._front("Drawer", at, width, low + 0.02, high - 0.02)
                for low, high in itertools.pairwise(heights)]  # fmt: skip

    def _open(self, at: float, width: float) -> list[SceneObject]:
        return []

    def _sink(self, at: float, width: float) -> list[SceneObject]:
        """A sink with its basin and faucet, above two cabinets."""
        w, h, d = self._sinks.pop(0).size
        middle, z = at + width / 2, self.depth / 2 + 0.02
        depth = min(d, self.depth - 0.14)
        half = min(w, width - 0.04) / 2
        height = float(np.clip(h, 0.15, 0.25))
        found = [
            self._room.block("Sink", (middle - half, 0.915 - height, z - depth / 2),
                             (middle + half, 0.915, z + depth / 2)),
            self._room.block("SinkBasin", (middle - 0.8 * half, 0.925 - height, z - 0.37 * depth),
                             (middle + 0.8 * half, 0.9, z + 0.33 * depth)),
            self._faucet(middle, z - 0.37 * depth),
        ]  # fmt: skip
        return found + [
            self._front("Cabinet", at + k * width / 2, width / 2, 0.1, 0.64) for k in range(2)
        ]

    def _faucet(self, middle: float, edge: float) -> SceneObject:
        w, h, d = self._room.library.choose("Faucet", self.draw).size
        w, d = sorted((w, d))
        d = min(d, edge + 0.12)
        return self._room.block("Faucet", (middle - w / 2, 0.9, max(edge + 0.1 - d, 0.01)),
                                (middle + w / 2, 0.9 + min(h, 0.4), edge + 0.1))  # fmt: skip

    def add_sink(self) -> float:
        """The width of another sink's module."""
        self._sinks.append(self._room.library.choose("Sink", self.draw))
        return float(np.clip(self._sinks[-1].size[0] + 0.12, 0.6, 1.1))

    def _stove(self, at: float, width: float) -> list[SceneObject]:
        """Four burners and as many knobs, at the front or at the back."""
        found = []
        for x in (0.26, 0.74):
            for z in (0.32, 0.74):
                half = 0.11 if z > 0.5 else 0.095
                a, b = at + x * width, z * self.depth
                found.append(self._room.block(
                    "StoveBurner", (a - half, 0.92, b - half), (a + half, 0.95, b + half)
                ))  # fmt: skip
        for k in range(4):
            a = at + width * (0.2 + 0.2 * k)
            y, z = (1.05, 0.03) if self._knobs_at_back else (0.84, self.depth - 0.02)
            found.append(self._room.block("StoveKnob", (a - 0.035, y, z),
                                          (a + 0.035, y + 0.07, z + 0.06)))  # fmt: skip
        return found

    def fill(self, length: float) -> list[Module]:
        """Cabinets and drawers of equal width along a length."""
        count = max(round(length / self.draw.uniform(*DOORS)), 1)
        kinds = self.draw.random(count)
        return [("drawers" if kind < 0.2 else "base", length / count) for kind in kinds]

    def around(self, module: Module, length: float) -> list[Module]:
        """A module with cabinets and drawers to both sides, along a length besides its own."""
        share = self.draw.uniform(0.3, 0.7)
        return [*self.fill(share * length), module, *self.fill((1 - share) * length)]

    def appliances(self) -> tuple[Module, Module, Module]:
        """Sink, stove and fridge."""
        return ("sink", self.add_sink()), ("stove", STOVE), ("fridge", self._choose_fridge())

    def put(self, modules: Sequence[Module], wall: Wall, start: float) -> bool:
        """Puts a run at a wall, metres from its start; whether it has room."""
        unit, taken, free = self.run(modules)
        place = wall.at(start, 0.0)
        return self._room.floor.put(unit, [(wall.turns, place)], [free], [taken]) is not None

    def hang(self, modules: Sequence[Module], wall: Wall, start: float, microwave: bool) -> None:
        """Cabinets on the wall above a run, where nothing else is."""
        at = start
        bottom = UPPER[0] + self.draw.uniform(-0.15, 0.05)
        for name, width in modules:
            low, high = bottom, UPPER[1]
            items = []
            if name == "stove" and microwave and self._room.has("Microwave"):
                w, h, d = self._room.library.choose("Microwave", self.draw).size
                low = bottom + 0.45
                items.append(self._room.block("Microwave", (-w / 2, bottom, 0.04),
                                              (w / 2, bottom + h, 0.04 + d)))  # fmt: skip
            parts = 2 if width > 0.62 else 1
            if name != "fridge":
                for k in range(parts):
                    x1, x2 = (width * (share / parts - 0.5) for share in (k, k + 1))
                    items.append(self._room.block("Cabinet", (x1 + 0.015, low, 0.07),
                                                  (x2 - 0.015, high, 0.07 + INSIDE)))  # fmt: skip
            if items:
                self._room.floor.put(items, [(wall.turns, wall.at(at + width / 2))], on_wall=True)
            at += width


def kitchen(room: Furnisher) -> bool:
    """The counters of a kitchen; whether there is room for sink, stove and fridge."""
    before, floor = room.left.copy(), room.floor
    for _ in range(RUNS):
        room.left, room.floor = before.copy(), floor.copy()
        counters = Counters(room, room.draw.uniform(0.62, 0.72))
        if _kitchen(room, counters):
            if room.left["CounterTop"] > 0 or room.draw.random() < ISLANDS:
                _island(room, counters)
            return True
    room.left, room.floor = before, floor
    return False


def _kitchen(room: Furnisher, counters: Counters) -> bool:
    """Runs in a layout that is drawn, then what hangs above them; whether they have room."""
    layout = (_along_a_wall, _around_a_corner, _on_both_sides)[int(room.draw.choice(3, p=LAYOUTS))]
    runs = layout(counters, room.floor.walls, max(room.plan.counter, LEAST))
    if not runs or not all(counters.put(*run) for run in runs):
        return False
    microwave = bool(room.draw.random() < MICROWAVES)
    for run in runs:
        counters.hang(*run, microwave)
    return True


def _along_a_wall(counters: Counters, walls: Sequence[Wall], total: float) -> list[Run]:
    draw, wall = counters.draw, walls[int(counters.draw.integers(len(walls)))]
    sink, stove, fridge = counters.appliances()
    length = min(total + fridge[1], wall.length - 2 * WALL)
    rest = length - sink[1] - stove[1] - fridge[1]
    if rest < 0.8:
        return []
    modules = [fridge, *counters.fill(0.35 * rest), sink, *counters.fill(0.4 * rest), stove,
               *counters.fill(0.25 * rest)]  # fmt: skip
    start = WALL + draw.random() * (wall.length - length - 2 * WALL)
    return [(modules[:: 1 if draw.random() < 0.5 else -1], wall, start)]


def _around_a_corner(counters: Counters, walls: Sequence[Wall], total: float) -> list[Run]:
    number, depth = int(counters.draw.integers(len(walls))), counters.depth
    wall, other = walls[number], walls[(number + 1) % len(walls)]
    sink, stove, fridge = counters.appliances()
    share = counters.draw.uniform(0.4, 0.6)
    one = min(share * total + depth, wall.length - WALL)
    two = min((1 - share) * total + fridge[1], other.length - depth - WALL)
    a, b = one - sink[1] - depth, two - stove[1] - fridge[1]
    if min(a, b) < 0.4 or other.turns != (wall.turns - 1) % 4:  # a corner that juts into the room
        return []
    return [
        ([*counters.around(sink, a), ("open", depth)], wall, wall.length - one),
        ([*counters.around(stove, b), fridge], other, depth),
    ]


def _on_both_sides(counters: Counters, walls: Sequence[Wall], total: float) -> list[Run]:
    draw, wall = counters.draw, walls[int(counters.draw.integers(len(walls)))]
    other = next(w for w in walls if w.turns == (wall.turns + 2) % 4)
    sink, stove, fridge = counters.appliances()
    one = min(total / 2, wall.length - 2 * WALL)
    two = min(total / 2 + fridge[1], other.length - 2 * WALL)
    a, b = one - sink[1], two - stove[1] - fridge[1]
    if min(a, b) < 0.6:
        return []
    starts = [WALL + draw.random() * (w.length - length - 2 * WALL)
              for w, length in ((wall, one), (other, two))]  # fmt: skip
    return [
        (counters.around(sink, a), wall, starts[0]),
        ([*counters.around(stove, b), fridge], other, starts[1]),
    ]


def _island(room: Furnisher, counters: Counters) -> None:
    """A counter that stands free, if there is room for one."""
    length = room.draw.uniform(1.1, 1.9)
    before = room.left.copy()
    unit, taken, free = counters.run(counters.fill(length))
    middle = np.array([length / 2, 0.0, counters.depth / 2])
    behind = np.array([(0.0, 0.0, -0.7), (length, 0.3, -0.05)])
    boxes = [box - middle for box in (taken, free, behind)]
    for box in boxes:
        box[:, 1] += middle[1]
    unit = [shifted(item, -middle) for item in unit]
    places = room.floor.middle(boxes[0][:, [0, 2]], room.draw, 40)
    if room.floor.put(unit, places, boxes[1:], boxes[:1]) is None:
        room.left = before


def vanity(room: Furnisher) -> bool:
    """A counter with the sinks of a bathroom and a mirror above it."""
    draw, sinks = room.draw, max(min(room.left["Sink"], 2), 1)
    before, floor = room.left.copy(), room.floor
    for _ in range(RUNS):
        room.left, room.floor = before.copy(), floor.copy()
        counters = Counters(room, draw.uniform(0.5, 0.65))
        length = float(np.clip(room.plan.counter, 0.9 * sinks, 2.4))
        widths = [counters.add_sink() for _ in range(sinks)]
        rest = max(length - sum(widths), 0.1)
        filled = [counters.fill(rest / (sinks + 1)) if rest > 0.5 else
                  [("open", rest / (sinks + 1))] for _ in range(sinks + 1)]  # fmt: skip
        modules = [*filled[0]]
        for k, width in enumerate(widths):
            modules += [("sink", width), *filled[k + 1]]
        length = sum(width for _, width in modules)
        for wall, share in room.floor.spots(length, draw, 3):
            start = WALL + share * (wall.length - length - 2 * WALL)
            if counters.put(modules, wall, start):
                _mirror(room, wall.turns, wall.at(start + length / 2), length)
                return True
            counters._sinks = [room.library.choose("Sink", draw) for _ in range(sinks)]
    room.left, room.floor = before, floor
    return False


def _mirror(room: Furnisher, turns: int, place: np.ndarray, longest: float) -> None:
    """A mirror on the wall at a place [3] on the floor."""
    if room.has("Mirror"):
        piece = room.library.choose("Mirror", room.draw)
        width, bottom = min(float(piece.size[0]), longest), room.draw.uniform(1.2, 1.3)
        height = min(float(piece.size[1]), 1.1)
        unit = [room.block("Mirror", (-width / 2, bottom, 0.0), (width / 2, bottom + height, 0.05))]
        room.floor.put(unit, [(turns, place)], on_wall=True)


def pedestal(room: Furnisher) -> bool:
    """A sink of its own at a wall, with basin, faucet and mirror."""
    width, _, depth = room.library.choose("Sink", room.draw).size
    size = np.array([max(width, 0.5), 0.9, max(min(depth, 0.6), 0.45)])
    x, z = size[0] / 2, size[2] / 2
    before = room.left.copy()
    unit = [
        room.block("Sink", *box_of(size)),
        room.block("SinkBasin", (-0.75 * x, 0.74, -0.6 * z), (0.75 * x, 0.88, 0.75 * z)),
        room.block("Faucet", (-0.08, 0.9, -z + 0.01), (0.08, 1.06, -z + 0.2)),
    ]
    free = np.array([(-x, 0.0, z + 0.02), (x, 0.3, z + 0.65)])
    for turns, place in room.places(unit, ("edge",)):
        if room.floor.put(unit, [(turns, place)], [free]) is not None:
            inward = np.insert(AHEAD[turns], 1, 0.0)
            _mirror(room, turns, place - inward * (z + WALL), 2 * x)
            return True
    room.left = before
    return False
