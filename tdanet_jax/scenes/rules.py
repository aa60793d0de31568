"""What hides what: the few named rules that stand in for AI2-THOR's meshes."""

from dataclasses import dataclass

CONTAINERS = frozenset({"Drawer", "Cabinet", "Fridge", "Microwave", "Safe", "Dresser", "Box"})
OPEN_FRAMES = frozenset(
    "ArmChair BathtubBasin Blinds Boots Chair CounterTop Curtains DeskLamp Faucet FloorLamp "
    "HandTowelHolder HousePlant Mirror Shelf ShelvingUnit ShowerCurtain ShowerDoor ShowerGlass "
    "ShowerHead SinkBasin Sink Stool StoveBurner StoveKnob TVStand ToiletPaperHanger "
    "TowelHolder Window".split()
)
PLATES = frozenset("CoffeeTable Desk DiningTable SideTable".split())


@dataclass(frozen=True)
class Rules:
    """Parameters of the occlusion model; lengths in metres."""

    reach: float = 1.5  # horizontal distance within which a seen object counts as visible
    patch: float = 0.15  # greatest edge of the patches that faces are sampled by
    patches: int = 6  # most patches along an edge
    plate: float = 0.05  # thickness of a table's top, the only part of it that hides things
    containers: frozenset[str] = CONTAINERS  # closed, they hide what lies in them
    open_frames: frozenset[str] = OPEN_FRAMES  # hide nothing
    plates: frozenset[str] = PLATES  # hide by their top alone


RULES = Rules()
