"""Rules of visibility and occlusion, in place of meshes.

AI2-THOR casts rays at points that its authors placed on each object's mesh. The metadata contains
only boxes, so these rules say how to interpret the box of each kind of object. They were chosen on
the default frames of the 80 training rooms; `experiments.scenes verify` shows the agreement.
"""

from __future__ import annotations

from dataclasses import dataclass

from tdanet_jax.vocabulary import DOORS, WALLS


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


@dataclass(frozen=True)
class Rules:
    """The rules and their parameters; lengths in metres.

    In addition, an object's oriented box is used if the metadata has one, and an object hides what
    is inside its box only if it is closed.
    """

    # Reach: an object is visible only if its box is this close, horizontally, to the agent.
    # AI2-THOR's limit is 1.5 m to the colliders, which stay a little inside the boxes.
    reach: float = 1.48

    # Slivers: an object is visible only if at least this share of the surface that faces the
    # camera is seen: AI2-THOR tests a handful of points, which slivers miss.
    sliver: float = 0.04

    # Sampling: the edge of a patch; three times as much for what a face measures beyond a metre.
    patch: float = 0.1

    # Fronts: parts of furniture, of which only upright faces towards the room are seen: the one
    # with the nearest reachable point in front of it, and any whose nearest is at most a step of
    # the grid farther.
    fronts: frozenset[str] = _names("Cabinet Drawer Shelf StoveKnob")
    nearly: float = 0.25

    # Knobs: fronts that stand out. Whether they are visible is decided on the front, but their
    # image box is that of all faces but the bottom and the back.
    knobs: frozenset[str] = _names("StoveKnob")

    # Carved: L- and U-shaped objects, without the places this close to where an agent can stand.
    carved: frozenset[str] = _names("CounterTop")
    standing: float = 0.2

    # Inset: meshes do not fill their boxes; solids are smaller by this share on every side.
    inset: float = 0.05

    # Structure: parts of the building, which hide things and are never detections. They are inset
    # in their thickness alone. The box of a door that is not shut is a hole in the wall around it,
    # unless it has swung out of the wall.
    walls: frozenset[str] = WALLS
    doors: frozenset[str] = DOORS

    # Closed: hide their contents. Toilets, sinks and bathtubs do not.
    closed: frozenset[str] = _names("Box Cabinet Drawer Fridge Microwave Safe")

    # Plates: stand on legs; only a top of this thickness occludes.
    plates: frozenset[str] = _names("CoffeeTable Desk DiningTable SideTable")
    thickness: float = 0.05

    # See-through: glass, cloth on rails, lattices, thin stands, hollow or rounded objects and
    # sheets with holes; they occlude nothing.
    see_through: frozenset[str] = _names(
        "ArmChair Bathtub BathtubBasin Blinds Boots Chair CounterTop Curtains DeskLamp Faucet "
        "FloorLamp HandTowelHolder HousePlant Laptop Mirror Shelf ShelvingUnit ShowerCurtain "
        "ShowerDoor ShowerGlass ShowerHead Sink SinkBasin Stool StoveBurner StoveKnob TVStand "
        "Toilet ToiletPaperHanger TowelHolder Window"
    )

    # Walls: nothing is seen across a void, an area of the floor plan this far from every reachable
    # point and every object.
    void: float = 0.5

    @property
    def structure(self) -> frozenset[str]:
        """Classes that are parts of the building."""
        return self.walls | self.doors


RULES = Rules()
