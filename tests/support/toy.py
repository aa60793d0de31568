"""Rooms small enough to check by hand, and random ones."""

from __future__ import annotations

import numpy as np

from tdanet_jax.poses import GRID_SIZE
from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.vocabulary import ROOM_TYPES

AGENT = 0.9  # metres, y of an agent that stands on a floor at 0
CAMERA = 1.575  # metres, y of its camera
RANDOM_CLASSES = ("Apple", "Chair", "CounterTop", "DiningTable", "Drawer", "Fridge", "Mug", "Sofa")


def points(*spots: tuple[float, float]) -> np.ndarray:
    """Reachable points [P, 3] at some (x, z) metres."""
    return np.array([(x, AGENT, z) for x, z in spots], np.float64).reshape(-1, 3)


def line(count: int) -> np.ndarray:
    """Reachable points in a row from the origin along +z."""
    return points(*((0.0, GRID_SIZE * i) for i in range(count)))


def thing(
    name: str,
    middle: tuple[float, float, float],
    size: tuple[float, float, float] = (0.2, 0.2, 0.2),
    number: int = 0,
    is_open: bool = False,
) -> SceneObject:
    """An object of class `name` with its box around `middle`, metres."""
    center, half = np.array(middle), np.array(size) / 2
    return SceneObject(
        f"{name}|{number}", name, np.stack([center - half, center + half]), is_open=is_open
    )


def room(spots: np.ndarray, *objects: SceneObject, name: str = "Toy", room_type: int = 0) -> Scene:
    """A room of some reachable points and objects; objects are put in order."""
    ordered = sorted(objects, key=lambda item: (item.object_class, item.object_id))
    return Scene(name, ROOM_TYPES[room_type], spots, tuple(ordered))


def corridor() -> Scene:
    """Five points along +z, an apple straight ahead of them at eye level, 1.25 m past the last.

    From the points 0 to 4 the apple's near face is 2.15, 1.9, 1.65, 1.4 and 1.15 m away: it is
    seen from all of them looking along +z, and visible (within reach) from the last two.
    """
    return room(line(5), thing("Apple", (0.0, CAMERA, 2.25)), name="Corridor")


def random_room(draw: np.random.Generator, name: str = "Random") -> Scene:
    """A room with some of the points of a 6 x 6 grid and some boxes around and among them."""
    grid = np.stack(np.meshgrid(np.arange(6), np.arange(6), indexing="ij"), axis=-1).reshape(-1, 2)
    kept = grid[draw.random(len(grid)) < 0.6]
    if len(kept) == 0:
        kept = grid[:1]
    objects = []
    for number in range(draw.integers(2, 9)):
        size = draw.uniform(0.05, 0.9, 3)
        middle = np.array([*draw.uniform(-0.8, 2.1, 2), draw.uniform(0.1, 2.2)])[[0, 2, 1]]
        objects.append(
            thing(
                str(draw.choice(RANDOM_CLASSES)),
                (float(middle[0]), float(middle[1]), float(middle[2])),
                (float(size[0]), float(size[1]), float(size[2])),
                number,
                bool(draw.random() < 0.3),
            )
        )
    return room(points(*(kept * GRID_SIZE)), *objects, name=name, room_type=int(draw.integers(4)))


def random_rooms(seed: int, count: int = 3) -> list[Scene]:
    """Random rooms called Room0, Room1, ..."""
    draw = np.random.default_rng(seed)
    return [random_room(draw, name=f"Room{i}") for i in range(count)]
