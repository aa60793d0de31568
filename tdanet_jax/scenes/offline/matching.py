"""Matching boxes, which the original layout lists by class, to objects, which it lists by id.

Some recordings list boxes by id as well.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from tdanet_jax.io.untrusted import FileError
from tdanet_jax.scenes.offline.layout import OBJECT_FILE
from tdanet_jax.scenes.offline.object_ids import UNKNOWN, class_of, is_id, place_in
from tdanet_jax.scenes.scene import MOST_OBJECTS, Scene, SceneObject
from tdanet_jax.scenes.visibility.build import Detections

#: The box in the image of an object that is visible, but has none in the data.
NO_BOX = (-1, -1, -1, -1)


@dataclass
class Objects:
    """The objects of a scene, by id."""

    classes: dict[str, str] = field(default_factory=dict)
    boxes: dict[str, np.ndarray] = field(default_factory=dict)  # [2, 3] metres, or NaN
    #: States in which an object is visible.
    states: dict[str, set[int]] = field(default_factory=lambda: defaultdict(set))

    def add(self, path: Path, name: str, object_class: str, box: np.ndarray) -> None:
        """Adds an object, or replaces it.

        Raises:
          FileError: it has no name or class, or there are too many objects.
        """
        if not name or not object_class or len(self.classes) >= MOST_OBJECTS:
            raise FileError(path, "an object without a name, or too many objects")
        if not name.isprintable() or not object_class.isprintable():
            raise FileError(path, f"object {name[:40]}: has a control character")
        self.classes[name] = object_class
        self.boxes[name] = box


class BoxMatcher:
    """Matches boxes to objects, state by state.

    If the files do not say whose a box is, the largest boxes of a class go to its visible objects,
    which are near, and the others to its other objects, then to unnamed ones if there are more
    boxes than objects. A visible object without a box gets a row with `NO_BOX`.

    Args:
      path: the file of boxes, for messages.
      owners: state -> ids of the objects to which its boxes belong, in order; None if unknown.
      keys: of all states, for messages.

    Attributes:
      names: the classes or ids by which boxes were listed.
    """

    def __init__(
        self,
        path: Path,
        objects: Objects,
        owners: dict[int, list[str]] | None,
        keys: Sequence[str],
    ) -> None:
        self.names: set[str] = set()
        self._path = path
        self._objects = objects
        self._owners = owners
        self._keys = keys
        self._by_class: dict[str, list[str]] = defaultdict(list)
        for name in sorted(objects.classes):
            self._by_class[objects.classes[name]].append(name)
        self._visible: dict[int, set[str]] = defaultdict(set)
        for name, states in objects.states.items():
            for state in states:
                self._visible[state].add(name)
        self._rows: list[tuple[int, str, tuple[int, ...], bool]] = []

    def add(self, boxes: Iterable[tuple[int, dict[str, np.ndarray]]]) -> None:
        """Adds the rows of all states: those with boxes, then visible objects without one.

        Raises:
          FileError: the boxes do not fit their owners, or an object has two in one state.
        """
        done = set()
        for state, groups in boxes:
            if state in done:  # listed as "0.00" and as "-0.00"
                continue
            done.add(state)
            visible = self._visible.get(state, set())
            self.names.update(groups)
            if any(map(is_id, groups)):
                pairs = [p for item in groups.items() for p in self._by_id(state, *item)]
            elif self._owners is None:
                pairs = [
                    p for kind, group in groups.items() for p in self._guess(kind, group, visible)
                ]
            else:
                pairs = self._look_up(state, self._owners.get(state, []), groups)
            self._rows += [(state, name, box, name in visible) for name, box in pairs]
            lacking = visible - {name for name, _ in pairs}
            self._rows += [(state, name, NO_BOX, True) for name in lacking]
        for state in self._visible.keys() - done:
            self._rows += [(state, name, NO_BOX, True) for name in self._visible[state]]

    def _by_id(self, state: int, name: str, boxes: np.ndarray) -> list:
        if len(boxes) > 1:
            where = f"{self._keys[state]}: {name}"
            raise FileError(self._path, f"{where}: {len(boxes)} boxes of one object in a state")
        if name not in self._objects.classes:  # visible from nowhere
            self._objects.add(self._path, name, class_of(name), place_in(name))
        return [(name, tuple(box)) for box in boxes.tolist()]

    def _look_up(self, state: int, owners: list[str], groups: dict[str, np.ndarray]) -> list:
        classes = [kind for kind, boxes in groups.items() for _ in boxes]
        flat = [tuple(box) for boxes in groups.values() for box in boxes.tolist()]
        known = [self._objects.classes[name] for name in owners]
        if known != classes or len(set(owners)) != len(owners):
            raise FileError(self._path, f"{self._keys[state]}: the boxes do not fit {OBJECT_FILE}")
        return list(zip(owners, flat, strict=True))

    def _guess(self, object_class: str, boxes: np.ndarray, visible: set[str]) -> list:
        names = self._by_class[object_class]
        number = 0
        while len(names) < len(boxes):
            unnamed = f"{object_class}|unnamed|{number}"
            number += 1
            if unnamed not in self._objects.classes:
                self._objects.add(self._path, unnamed, object_class, UNKNOWN)
                names.append(unnamed)
        area = (boxes[:, 2] - boxes[:, 0]).astype(np.int64) * (boxes[:, 3] - boxes[:, 1])
        order = np.argsort(-area, kind="stable")
        near_first = sorted(names, key=lambda name: name not in visible)
        return list(zip(near_first, map(tuple, boxes[order].tolist()), strict=False))

    def finish(self, name: str, room_type: str, points: np.ndarray) -> tuple[Scene, Detections]:
        """The scene, with its objects by class and id, and all rows by state and object."""
        classes = self._objects.classes
        order = sorted(classes, key=lambda name: (classes[name], name))
        objects = tuple(SceneObject(n, classes[n], self._objects.boxes[n]) for n in order)
        index = {name: i for i, name in enumerate(order)}
        rows = sorted((state, index[n], box, visible) for state, n, box, visible in self._rows)
        detections = Detections(
            state=np.array([row[0] for row in rows], np.int32),
            owner=np.array([row[1] for row in rows], np.int32),
            box=np.array([row[2] for row in rows], np.int16).reshape(-1, 4),
            visible=np.array([row[3] for row in rows], bool),
        )
        return Scene(name, room_type, points, objects), detections
