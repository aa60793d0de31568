"""Generates rooms: each follows from its number, a seed and the known rooms alone."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from tdanet_jax.scenes.generation import catalogue
from tdanet_jax.scenes.generation.furnish import ON_FURNITURE, Furnisher
from tdanet_jax.scenes.generation.pieces import Library
from tdanet_jax.scenes.generation.plan import Plan, Plans
from tdanet_jax.scenes.generation.room_types import BUILDERS, IN_KITCHENS
from tdanet_jax.scenes.placement import statistics
from tdanet_jax.scenes.scene import Scene, SceneError

ATTEMPTS = 200  # for a room
LEAST, MOST = 0.75, 1.2  # share of the reachable points of a plan that a room has
MISSING = 0.1  # share of a plan's objects for which a room may have no place
GROWTH = 1.04  # what has no place gets longer walls
SLOWLY = 0.25  # power of a share by which sides change: points grow faster than the floor
SCALED = 6  # attempts with a plan


class Generator:
    """Makes rooms like the known ones."""

    def __init__(self, scenes: Sequence[Scene]) -> None:
        """`scenes` are the known rooms: training rooms alone, for rooms to train in.

        Raises:
          SceneError: they are not rooms of all of iTHOR's types, or there is no piece of a kind
            that is built into kitchens.
        """
        self._usual = statistics(scenes, ON_FURNITURE)
        self._catalogue = catalogue.load()
        self._library = Library(scenes, self._catalogue, self._usual)
        self._plans = Plans(scenes)
        if lacking := [room for room in BUILDERS if room not in self._plans.room_types]:
            raise SceneError(
                f"rooms are generated after training rooms, and there is no {lacking[0]}"
            )
        if lacking := [name for name in IN_KITCHENS if name not in self._library]:
            raise SceneError(
                f"rooms are generated after training rooms, and none has a {', '.join(lacking)}"
            )

    def room(self, number: int, seed: int) -> Scene:
        """A room, with its number from 1; types take turns.

        Raises:
          SceneError: no room could be made.
        """
        types = [*BUILDERS]
        room_type = types[(number - 1) % len(types)]
        name = f"{room_type}-{(number - 1) // len(types) + 1:04d}"
        plan: Plan | None = None
        obstacle = ""
        for attempt in range(ATTEMPTS):
            draw = np.random.default_rng([seed, number, attempt])
            if plan is None or attempt % SCALED == 0:
                plan = self._plans.choose(room_type, draw)
            room = Furnisher(plan, self._plans, self._library, self._usual, self._catalogue, draw)
            room.openings()
            if not BUILDERS[room_type](room):
                obstacle = "no place for what is built in"
                plan = plan.scaled(GROWTH)
                continue
            room.furnish()
            # The same again, larger or smaller, until an agent has as much room as it should.
            share = len(room.floor.points) / plan.points
            if not LEAST <= share <= MOST:
                obstacle = f"{share:.0%} of the reachable points of the room that it is like"
                plan = plan.scaled(share**-SLOWLY)
                continue
            scene = room.scatter(name)
            if room.missing <= MISSING:
                return scene
            obstacle = f"no place for {room.missing:.0%} of its objects"
            plan = plan.scaled(GROWTH)
        raise SceneError(f"{name}: no such room in {ATTEMPTS} attempts; the last: {obstacle}")
