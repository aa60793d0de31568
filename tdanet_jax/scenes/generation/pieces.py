"""Pieces that rooms are furnished with: models of the catalogue and of the known rooms.

A piece stands on y = 0 around the origin, its back towards -z and its front towards +z. What is
part of it (drawers, shelves, basins) and how high things lie on it is that of the piece of its
class in the known rooms that is most like it, scaled.
"""

from __future__ import annotations

import dataclasses
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence

import numpy as np

from tdanet_jax.scenes.generation.catalogue import Catalogue
from tdanet_jax.scenes.placement import (
    LENGTH_DIGITS,
    LEVEL,
    SAME,
    TURNED,
    Statistics,
    holds,
    supports,
    turned,
)
from tdanet_jax.scenes.scene import Scene, SceneObject

#: What has no place of its own where a piece holds it.
PARTS = frozenset(["BathtubBasin", "Cabinet", "Drawer", "Shelf", "SinkBasin"])
OFF = 2.5  # a model whose height is so many times the usual one, or less, lies another way
AHEAD = 1.0  # metres in front of a piece in which points are counted, to find its front


@dataclasses.dataclass(frozen=True, eq=False)
class Piece:
    """A model: its size in metres, and as shares of it, its parts and where things lie on it."""

    object_class: str
    size: np.ndarray  # [3] width, height, depth
    parts: tuple[tuple[str, np.ndarray], ...] = ()  # class and box [2, 3], from the lower corner
    levels: tuple[float, ...] = ()  # of the height


class Library:
    """All pieces: those of the catalogue that no room but the known ones contains, and those of
    the known rooms themselves for classes of which the catalogue has none."""

    def __init__(self, scenes: Sequence[Scene], catalogue: Catalogue, usual: Statistics) -> None:
        """`scenes` are the known rooms, and `usual` what lies where in them."""
        names = [scene.name for scene in scenes]
        classes = sorted({item.object_class for scene in scenes for item in scene.objects})
        self._sizes = {name: catalogue.sizes(name, names) for name in classes}
        self._wide = {
            name: bool(np.mean(sizes[:, 0] >= sizes[:, 2]) >= 0.5) if len(sizes) else True
            for name, sizes in self._sizes.items()
        }
        self._usual = usual
        self._known: dict[str, list[Piece]] = defaultdict(list)
        self.flags: Mapping[str, tuple[bool, bool]] = {}  # class -> openable, pickupable
        self._is_open: dict[str, float] = {}
        flags: dict[str, list[tuple[bool, bool, bool]]] = defaultdict(list)
        for scene in scenes:
            support = supports(scene)
            for item in scene.objects:
                flags[item.object_class].append((item.openable, item.pickupable, item.is_open))
                if np.isfinite(item.box).all():
                    self._known[item.object_class].append(self._piece(scene, item, support))
        self.flags = {name: (any(r[0] for r in rows), rows[0][1]) for name, rows in flags.items()}
        self._is_open = {name: float(np.mean([r[2] for r in rows])) for name, rows in flags.items()}
        for name, sizes in self._sizes.items():
            self._sizes[name] = self._upright(name, sizes)

    def _piece(self, scene: Scene, item: SceneObject, support: Mapping[str, SceneObject]) -> Piece:
        """A piece of a known room, turned so that its front is +z."""
        if abs((item.rotation[1] + 45) % 90 - 45) > TURNED or item.pickupable:
            return Piece(item.object_class, _size(item, self._wide[item.object_class]))
        parts = [
            part
            for part in scene.objects
            if part.object_class in PARTS and part is not item and holds(item.box, part.box)
        ]
        lying = [
            other.box[0, 1]
            for other in scene.objects
            if other.pickupable and support.get(other.object_id) is item
        ]
        turns = _turns_to_front(scene, item, self._wide[item.object_class])
        base, *rest = (turned(other, turns, np.zeros(3)) for other in (item, *parts))
        low, size = base.box[0], np.maximum(base.box[1] - base.box[0], 1e-3)
        shares = sorted({round((y - low[1]) / size[1], 2) for y in lying})
        apart = [y for i, y in enumerate(shares) if i == 0 or (y - shares[i - 1]) * size[1] > SAME]
        return Piece(
            item.object_class,
            size,
            tuple((part.object_class, (part.box - low) / size) for part in rest),
            tuple(share for share in apart if share >= 0),
        )

    def _upright(self, name: str, sizes: np.ndarray) -> np.ndarray:
        """The models [n, 3] of a class; those that lie in the catalogue and stand in rooms are
        set upright, and the reverse."""
        if not self.flags[name][1]:
            return sizes
        usual = float(np.median([piece.size[1] for piece in self._known[name]]))
        result = sizes.copy()
        for size in result:
            off = np.abs(np.log(size / usual))
            if off[1] > np.log(OFF) and off.min() < np.log(OFF) / 2:
                axis = int(off.argmin())
                size[[1, axis]] = size[[axis, 1]]
        return result

    def __contains__(self, name: str) -> bool:
        return bool(len(self._sizes.get(name, ())) or self._known.get(name))

    def known(self, name: str) -> list[Piece]:
        """The pieces of a class in the known rooms."""
        return self._known.get(name, [])

    def choose(self, name: str, draw: np.random.Generator) -> Piece:
        """One of the pieces of a class."""
        known, sizes = self.known(name), self._sizes[name]
        if not len(sizes):
            return known[draw.integers(len(known))]
        size = sizes[draw.integers(len(sizes))]
        logs = np.log([piece.size for piece in known])
        order = np.abs(logs - np.log(size)).sum(axis=1).argsort(kind="stable")
        levels = (known[i].levels for i in order if known[i].levels)
        return Piece(name, size, known[order[0]].parts, next(levels, ()))

    def objects(
        self, piece: Piece, number: int, draw: np.random.Generator, degrees: float = 0.0
    ) -> list[SceneObject]:
        """A piece and its parts as objects around the origin, with ids that begin at `number`.

        Args:
          degrees: by which it is turned, clockwise from above. Parts are turned only by quarters.
        """
        root = self.object(piece.object_class, number, box_of(piece.size), draw)
        low = root.box[0]
        parts = [
            self.object(name, number + 1 + i, low + share * piece.size, draw)
            for i, (name, share) in enumerate(piece.parts)
        ]
        quarters, rest = divmod(degrees + 45, 90)
        whole = [turned(item, int(quarters) % 4, np.zeros(3)) for item in (root, *parts)]
        return whole if parts else [yawed(whole[0], rest - 45)]

    def object(
        self, name: str, number: int, box: np.ndarray, draw: np.random.Generator
    ) -> SceneObject:
        """An object of a class with a box [2, 3]."""
        openable, pickupable = self.flags.get(name, (False, False))
        return SceneObject(
            f"{name}|{number}",
            name,
            box.round(LENGTH_DIGITS),
            openable=openable,
            is_open=bool(openable and draw.random() < self._is_open[name]),
            pickupable=pickupable,
        )

    def heights(self, piece: Piece) -> tuple[float, ...]:
        """At which things lie on a piece that stands on the floor, in metres."""
        if piece.levels:
            return tuple(float(share * piece.size[1]) for share in piece.levels)
        rest = self._usual.rest.get(piece.object_class)
        if rest is None or rest.height is None:
            return ()
        return (float(rest.height + piece.size[1] * rest.from_top),)


def box_of(size: np.ndarray) -> np.ndarray:
    """The box [2, 3] of a size [3] around the origin, standing on y = 0."""
    half = size * np.array([0.5, 0.0, 0.5])
    return np.stack([-half, size - half])


def yawed(item: SceneObject, degrees: float) -> SceneObject:
    """An object turned clockwise about the vertical through its middle, with its oriented box."""
    if abs(degrees) < 1.0:
        return item
    angle = np.radians(degrees)
    (x1, y1, z1), (x2, y2, z2) = item.box
    middle = item.box.mean(axis=0)
    offset = np.array([(x, z) for x, z in ((x1, z1), (x2, z1), (x2, z2), (x1, z2))]) - middle[LEVEL]
    cosine, sine = np.cos(angle), np.sin(angle)
    spun = offset @ np.array([[cosine, -sine], [sine, cosine]]) + middle[LEVEL]
    corners = np.array([(x, y, z) for y in (y1, y2) for x, z in spun]).round(LENGTH_DIGITS)
    return dataclasses.replace(
        item,
        box=np.stack([corners.min(axis=0), corners.max(axis=0)]),
        corners=corners,
        rotation=(0.0, (item.rotation[1] + degrees) % 360, 0.0),
    )


def _size(item: SceneObject, wide: bool) -> np.ndarray:
    """Width, height and depth of an object that may be turned."""
    sides = np.ptp(item.box, axis=0)
    if item.corners is not None:
        edges = item.corners[[1, 4, 3]] - item.corners[0]
        lengths = np.sqrt((edges * edges).sum(axis=1))
        up = int(np.abs(edges[:, 1]).argmax())
        sides = np.insert(np.delete(lengths, up), 1, lengths[up])
    low, high = sorted(sides[LEVEL])
    return np.maximum(np.array([high, sides[1], low] if wide else [low, sides[1], high]), 1e-3)


def _turns_to_front(scene: Scene, item: SceneObject, wide: bool) -> int:
    """Quarters by which a piece is to be turned so that its front is +z.

    The front is the side before which an agent can stand at most places, among those as wide as is
    usual for the class.
    """
    spans = np.ptp(item.box, axis=0)[LEVEL]
    at = scene.points[:, LEVEL]
    counts: Counter[int] = Counter()
    for turns, (axis, upper) in enumerate(((1, 1), (0, 0), (1, 0), (0, 1))):
        edge = item.box[upper, LEVEL[axis]]
        ahead = (at[:, axis] - edge) * (2 * upper - 1)
        across = at[:, 1 - axis]
        low, high = item.box[:, LEVEL[1 - axis]]
        inside = (ahead > 0) & (ahead <= AHEAD) & (low - SAME <= across) & (across <= high + SAME)
        counts[turns] = int(inside.sum()) + 1
        if abs(spans[0] - spans[1]) > 0.1 * spans.max():
            is_wide = spans[1 - axis] > spans[axis]
            counts[turns] *= int(is_wide == wide)
    return max(counts, key=lambda turns: (counts[turns], -turns))
