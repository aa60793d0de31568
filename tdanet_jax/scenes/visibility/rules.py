"""What can be seen of which object, and what hides what: the rules that stand in for meshes.

AI2-THOR casts rays at points that its authors placed on each object's mesh. The metadata holds
boxes only, so a few rules say how the box of each kind of object is to be read. They were chosen
on the default frames of the 80 training rooms; `experiments.scenes verify` shows the agreement.
"""

from __future__ import annotations

from dataclasses import dataclass


def _names(text: str) -> frozenset[str]:
    return frozenset(text.split())


@dataclass(frozen=True)
class Rules:
    """The rules and their parameters; lengths in metres.

    Beyond these, an object's oriented box is used wherever the metadata has one, and an object
    never hides what lies inside its own box unless it is closed.
    """

    # Reach: an object is visible only if its box is this near, horizontally, to the agent.
    # AI2-THOR's limit is 1.5 m to the colliders, which stay a little inside the boxes.
    reach: float = 1.48

    # Slivers: at least this share of the surface that faces the camera must be in view and
    # free for an object to be visible: AI2-THOR tests a handful of points, which slivers miss.
    sliver: float = 0.04

    # Sampling: faces are divided into patches of about this edge, beyond a metre three times it.
    patch: float = 0.1

    # Fronts: parts of furniture, seen only by the upright faces that look at the room: the one
    # nearest to a reachable point before it, and any other that is nearly as near.
    fronts: frozenset[str] = _names("Cabinet Drawer Shelf StoveKnob")
    nearly: float = 0.1

    # Carved: L- and U-shaped; where an agent can stand, and this far around, they are not.
    carved: frozenset[str] = _names("CounterTop")
    standing: float = 0.2

    # Inset: meshes do not fill their boxes; solids are narrower by this share at every side.
    inset: float = 0.05

    # Closed: hide what lies in them. Toilets, sinks and bathtubs do not.
    closed: frozenset[str] = _names("Box Cabinet Drawer Fridge Microwave Safe")

    # Plates: on legs; only the top hides things, this thick.
    plates: frozenset[str] = _names("CoffeeTable Desk DiningTable SideTable")
    thickness: float = 0.05

    # Frames: glass, cloth on rails, lattices, thin stands, hollow or rounded things and sheets
    # with holes; they hide nothing.
    frames: frozenset[str] = _names(
        "ArmChair Bathtub BathtubBasin Blinds Boots Chair CounterTop Curtains DeskLamp Faucet "
        "FloorLamp HandTowelHolder HousePlant Laptop Mirror Shelf ShelvingUnit ShowerCurtain "
        "ShowerDoor ShowerGlass ShowerHead Sink SinkBasin Stool StoveBurner StoveKnob TVStand "
        "Toilet ToiletPaperHanger TowelHolder Window"
    )

    # Walls: nothing is seen across a void, a stretch of the plan this far from every reachable
    # point and every object.
    void: float = 0.5


RULES = Rules()
