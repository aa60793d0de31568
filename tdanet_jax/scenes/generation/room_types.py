"""What comes first in each of iTHOR's room types: what is built in, and groups."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from tdanet_jax.scenes.generation import counters
from tdanet_jax.scenes.generation.catalogue import Member
from tdanet_jax.scenes.generation.floor import WALL
from tdanet_jax.scenes.generation.furnish import Furnisher
from tdanet_jax.scenes.placement import LEVEL

#: What is built in, and not generated: a counter in a bedroom.
BUILT_IN = ("Cabinet", "CounterTop", "Drawer")
#: What is built in. The known rooms must have all that is built into kitchens.
IN_KITCHENS = ("Cabinet", "CounterTop", "Drawer", "Faucet", "Fridge", "Sink", "SinkBasin",
               "StoveBurner", "StoveKnob")  # fmt: skip
IN_BATHROOMS = ("Bathtub", "BathtubBasin", "Cabinet", "CounterTop", "Drawer", "Faucet",
                "ShowerCurtain", "ShowerDoor", "ShowerGlass", "ShowerHead", "Sink",
                "SinkBasin")  # fmt: skip
#: A coffee table in front of the sofa of a group, whose index is filled in.
COFFEE_TABLE = Member("CoffeeTable", -1, (0, -1), (0.0, -0.42), (0, 1), False, 0.0, (0.2, 0.0, 0.0))


def kitchen(room: Furnisher) -> bool:
    """Counters, then a dining table with chairs."""
    if not counters.kitchen(room):
        return False
    _leave(room, IN_KITCHENS)
    _dining(room)
    return True


def living_room(room: Furnisher) -> bool:
    """Television and sofa, a dining table with chairs."""
    _leave(room, BUILT_IN)
    _television(room)
    _dining(room)
    _desks(room)
    return True


def bedroom(room: Furnisher) -> bool:
    """Beds with their pillows and side tables, desks with chairs."""
    _leave(room, BUILT_IN)
    while room.has("Bed"):
        groups = [g for g in room.groups_of("Bed") if len(g) <= 1 + room.left["Pillow"]]
        tried = [*groups, (Member("Bed", -1, (0, 0), (0, 0), (0, 0), False, 0.0, (0, 0, 0)),)]
        if not any(room.put_group(group, (), ("edge", "corner")) for group in tried):
            return False
        while room.has("SideTable") and room.beside("SideTable", ["Bed"]):
            pass
    _desks(room)
    return True


def bathroom(room: Furnisher) -> bool:
    """Bathtub or shower, toilet, and sinks."""
    if room.has("Bathtub"):
        _bathtub(room)
    if room.plan.counts["CounterTop"]:
        done = counters.vanity(room)
    else:
        done = counters.pedestal(room)
        while done and room.left["Sink"] > 0:
            done = counters.pedestal(room)
    if room.has("ShowerDoor") or room.has("ShowerGlass"):
        _shower(room)
    while done and room.has("Toilet"):
        done = _toilet(room)
    _leave(room, IN_BATHROOMS)
    return done


BUILDERS: dict[str, Callable[[Furnisher], bool]] = {
    "kitchen": kitchen,
    "living_room": living_room,
    "bedroom": bedroom,
    "bathroom": bathroom,
}


def _leave(room: Furnisher, names: Sequence[str]) -> None:
    """Leaves out what is still left of some classes: their numbers follow from the room."""
    for name in names:
        room.left[name] = 0


def _dining(room: Furnisher) -> None:
    while room.has("DiningTable"):
        where = ("middle", "edge") if room.draw.random() < 0.6 else ("edge", "middle")
        groups = room.groups_of("DiningTable")
        grouped = any(room.put_group(group, (), where) for group in groups[:3])
        if not grouped and not room.stand("DiningTable"):
            break


def _desks(room: Furnisher) -> None:
    while room.has("Desk"):
        groups = room.groups_of("Desk")
        grouped = any(room.put_group(group, (), ("edge", "corner")) for group in groups)
        if not grouped and not room.stand("Desk"):
            break


def _television(room: Furnisher) -> None:
    """The largest group around the television that fits; on a dresser if there is no stand."""
    stand = "TVStand" if room.has("TVStand") else "Dresser" if room.has("Dresser") else None
    if stand is None or not room.has("Television"):
        return
    instead = room.left["TVStand"]
    room.left["TVStand"] = max(room.left[stand], instead)
    groups = room.groups_of("TVStand")
    room.left["TVStand"] = instead
    for group in groups:
        members = [
            *(m if m.object_class != "TVStand" else _as(m, stand) for m in group),
        ]
        names = [member.object_class for member in members]
        if "Sofa" in names and room.has("CoffeeTable"):
            sofa = names.index("Sofa")
            table = _as(COFFEE_TABLE, "CoffeeTable", sofa)
            if room.put_group([*members, table], (0,), ("edge", "corner")):
                return
        if room.put_group(members, (0,), ("edge", "corner")):
            return


def _as(member: Member, name: str, parent: int | None = None) -> Member:
    parent = member.parent if parent is None else parent
    return Member(name, parent, member.side, member.offset, member.align, member.above, member.turn,
                  member.spread)  # fmt: skip


def _toilet(room: Furnisher) -> bool:
    """A toilet at a wall, with the paper beside it."""
    before = room.left.copy()
    unit = room.make("Toilet")
    (x1, _, _), (x2, _, z2) = unit[0].box
    free = np.array([(x1, 0.0, z2 + 0.02), (x2, 0.3, z2 + 0.6)])
    there = room.floor.put(unit, room.places(unit, ("edge",)), [free])
    if there is None:
        room.left = before
        return False
    toilet = there[0]
    turns = round(toilet.rotation[1] / 90) % 4
    for wall in room.floor.walls:
        offset = toilet.box.mean(axis=0)[LEVEL] - wall.start
        along, inward = float(offset @ wall.along), float(offset @ wall.inward)
        if wall.turns == turns and 0 < along < wall.length and 0 < inward < 1:
            sides = along + np.array([-1, 1]) * room.draw.uniform(0.42, 0.6)
            ways = [(turns, wall.at(float(s))) for s in room.draw.permutation(sides)
                    if 0.1 < s < wall.length - 0.1]  # fmt: skip
            while room.has("ToiletPaperHanger") and ways:
                room.hang("ToiletPaperHanger", ways)
    return True


def _bathtub(room: Furnisher) -> None:
    """A bathtub in a corner, with faucet, and shower head and curtain if the room has them."""
    before = room.left.copy()
    unit = room.make("Bathtub")
    low, high = unit[0].box
    end = 1 if room.draw.random() < 0.5 else -1
    x = high[0] if end > 0 else low[0]
    rim = float(high[1])

    def at_end(name: str, y: float, size: tuple[float, float, float], z: float) -> None:
        wide, tall, deep = size
        a, b = sorted((x - end * 0.02, x - end * (0.02 + wide)))
        unit.append(room.block(name, (a, y, z - deep / 2), (b, y + tall, z + deep / 2)))

    middle = float((low[2] + high[2]) / 2)
    at_end("Faucet", rim + 0.02, (0.2, 0.25, 0.25), middle)
    if room.has("ShowerHead") and not room.has("ShowerDoor"):
        at_end("ShowerHead", 0.9, (0.22, 1.0, 0.14), middle)
    if room.has("ShowerCurtain"):
        at_end("ShowerCurtain", max(rim - 0.4, 0.05), (0.4, 1.9, 0.3), float(high[2]) - 0.16)
    free = np.array([(low[0] + 0.2, 0.0, high[2] + 0.02), (high[0] - 0.2, 0.3, high[2] + 0.6)])
    if room.floor.put(unit, room.places(unit, ("corner", "edge")), [free]) is None:
        room.left = before


def _shower(room: Furnisher) -> None:
    """A shower in a corner: a door in front, glass at its side, the head at the wall."""
    before = room.left.copy()
    width, depth = room.draw.uniform(0.95, 1.3), room.draw.uniform(0.85, 1.1)
    side = 1 if room.draw.random() < 0.5 else -1  # the open side, with the glass
    x, z = width / 2, depth / 2
    unit = []
    if room.left["ShowerDoor"] > 0:
        unit.append(room.block("ShowerDoor", (-x, 0.05, z - 0.06), (x, 2.0, z)))
    else:
        unit.append(room.block("ShowerGlass", (-x, 0.05, z - 0.06), (x, 1.95, z)))
    if room.left["ShowerGlass"] > 0:
        a, b = sorted((side * x, side * (x - 0.06)))
        unit.append(room.block("ShowerGlass", (a, 0.05, -z), (b, 1.95, z - 0.07)))
    if room.left["ShowerHead"] > 0:
        unit.append(room.block("ShowerHead", (-0.1, 0.9, -z + 0.01), (0.1, 1.95, -z + 0.25)))
    solid = np.array([(-x, 0.0, -z), (x, 2.2, z)])
    free = np.array([(-x, 0.0, z + 0.02), (x, 0.3, z + 0.65)])
    span = solid[:, LEVEL]
    places = (
        (wall.turns, room.floor.beside(wall, span, float(side < 0), WALL / 2))
        for wall, _ in room.floor.spots(width, room.draw, 40)
    )
    if room.floor.put(unit, places, [free], [solid]) is None:
        room.left = before
