"""Variants of rooms: small objects elsewhere, some left out, furniture shifted, half mirrored.

A variant follows from its room, from statistics of training rooms, a seed and its number alone, to
the last bit. Its name begins with that of its room, so that it has the same type and part.
"""

from __future__ import annotations

import dataclasses
import re
import zlib

import numpy as np

from tdanet_jax.scenes import furniture
from tdanet_jax.scenes.placement import Statistics, rearrange
from tdanet_jax.scenes.room_names import UNKNOWN, kind_of
from tdanet_jax.scenes.scene import Scene, SceneObject

LEFT_OUT = 0.1  # share of the small objects that are not in a variant
SHIFTED = 0.5  # share of the furniture that is shifted, where there is room for it


def variant_name(name: str, copy: int) -> str:
    """FloorPlan1-v03 for FloorPlan1 and 3."""
    return f"{name}-v{copy:02d}"


def original_name(name: str) -> str:
    """FloorPlan1 for FloorPlan1-v03."""
    return re.sub(r"-v\d{2,}$", "", name)


def vary(scene: Scene, known: Statistics, seed: int, copy: int) -> Scene:
    """A variant of a room; those with an even number are mirrored.

    Args:
      known: of training rooms.
      copy: number of the variant, from 1.
    """
    draw = np.random.default_rng([seed, copy, zlib.crc32(scene.name.encode())])
    name = variant_name(scene.name, copy)
    arranged = furniture.shift(scene, draw, SHIFTED)
    varied = dataclasses.replace(
        arranged,
        name=name,
        part=scene.part or (kind_of(name) or UNKNOWN).part,
        objects=rearrange(arranged, known, draw, LEFT_OUT),
        default_position=None,
        default_rotation=None,
    )
    return mirrored(varied) if copy % 2 == 0 else varied


def mirrored(scene: Scene) -> Scene:
    """The room in a mirror: x is -x. Left and right, and turns, change places."""
    order = np.lexsort((scene.points[:, 2], -scene.points[:, 0]))
    types = scene.room_type
    where, turn = scene.default_position, scene.default_rotation
    return dataclasses.replace(
        scene,
        points=_flipped(scene.points[order]),
        room_type=types if isinstance(types, str) else tuple(types[i] for i in order),
        objects=tuple(map(_mirrored, scene.objects)),
        default_position=None if where is None else _flipped(where),
        default_rotation=None if turn is None else -turn % 360,
    )


def _flipped(places: np.ndarray) -> np.ndarray:
    return places * np.array([-1.0, 1.0, 1.0]) + 0.0  # without -0.0


def _mirrored(item: SceneObject) -> SceneObject:
    x, y, z = item.rotation
    return dataclasses.replace(
        item,
        box=np.sort(_flipped(item.box), axis=0),
        corners=None if item.corners is None else _flipped(item.corners),
        rotation=(x, -y % 360, -z % 360),
    )
