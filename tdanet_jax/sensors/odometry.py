"""Odometry: dead reckoning from the agent's own motion, and a map of where it has been.

Nothing here knows the room. An agent knows which action it took and whether a MoveAhead was
blocked; from these follow its pose relative to the start, and a map of where it has been and what
was in the way. A reading holds the pose (like Habitat's GPS and compass) and the part of the map
around the agent, rotated so that ahead is up.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from tdanet_jax.poses import ITHOR, PoseGrid, modulo
from tdanet_jax.sensors.sensor import Motion, Sensor, Start
from tdanet_jax.sensors.shared import (
    BLOCKED,
    DIRECTIONS,
    MAP_SIZE,
    POSITION_SCALE,
    WINDOW,
    first_heading,
    window_offsets,
)
from tdanet_jax.sensors.shared import measured_pose as measured_pose
from tdanet_jax.vocabulary import NUM_ACTIONS, Action


class Deviation(struct.PyTreeNode):
    """How far the pose that an agent believes in is off the grid: motion slips or is measured."""

    place: jax.Array  # [2] float32, from the cell to where it believes to stand; x and z in cells
    angle: jax.Array  # float32, radians clockwise from its heading to that which it believes in
    error: jax.Array  # float32, radians by which the heading is wrong in this pose alone
    step: jax.Array  # [2] float32, x and z in cells that it believes the last action moved it by


class OdometryState(struct.PyTreeNode):
    """The agent's pose and map in one episode, in a frame whose origin is the start.

    The axes lie along the grid of reachable points: z is the start's heading, or for a start
    between two axes, the next one to its left (with turns of 60 degrees, the next that turns lead
    to).
    """

    cell: jax.Array  # [2] int32, x and z in cells
    heading: jax.Array  # int32, turns clockwise from z
    horizon: jax.Array  # int32, its index
    action: jax.Array  # int32, the last action; 6 before the first
    blocked: jax.Array  # bool, the last action was a MoveAhead that did not move the agent
    cells: jax.Array  # [MAP_SIZE, MAP_SIZE] uint16, the bits of each cell
    deviation: Deviation | None = None  # None if all motion is as the agent believes


class OdometryReading(struct.PyTreeNode):
    """What odometry says."""

    #: [12] float32: position to the right and ahead of the start as the agent faces now, in units
    #: of 4 m; sine and cosine of its heading; horizon, in units of 30 degrees; whether it was
    #: blocked; the last action.
    motion: jax.Array
    window: jax.Array  # [WINDOW, WINDOW] uint16, the map around it; headings relative to its own


class Odometry(Sensor):
    """Dead reckoning: exact, unless motion slips (`tdanet_jax.sensors.noise`)."""

    width = 6 + NUM_ACTIONS + WINDOW * WINDOW * (DIRECTIONS + 1)

    def init(self, start: Start) -> OdometryState:
        """At the origin; of the rotation, only how it lies to the axes of the grid matters."""
        heading = first_heading(self.grid, start.rotation)
        cells = jnp.zeros((MAP_SIZE, MAP_SIZE), jnp.uint16)
        return OdometryState(
            cell=jnp.zeros(2, jnp.int32),
            heading=heading,
            horizon=start.horizon,
            action=jnp.full_like(heading, NUM_ACTIONS),
            blocked=jnp.zeros_like(heading, bool),
            cells=cells.at[0, 0].set((1 << self.grid.neighbour(heading)).astype(jnp.uint16)),
            deviation=None
            if start.slip is None
            else Deviation(jnp.zeros(2), jnp.zeros(()), start.slip.error, jnp.zeros(2)),
        )

    def update(
        self, state: OdometryState, motion: Motion, others: Mapping[str, Any]
    ) -> OdometryState:
        """Moves on by an action, and marks one cell of the map."""
        ahead = state.cell + jnp.asarray(self.grid.steps)[state.heading]
        moves = motion.action == Action.MOVE_AHEAD
        blocked = moves & motion.blocked
        cell = jnp.where(moves & ~blocked, ahead, state.cell)
        heading, horizon = turn(self.grid, state.heading, state.horizon, motion.action)
        after = OdometryState(
            cell=cell,
            heading=heading,
            horizon=horizon,
            action=motion.action.astype(jnp.int32),
            blocked=blocked,
            cells=state.cells,
            deviation=None,
        )
        after = after.replace(deviation=_deviation(self.grid, state, motion, after))
        stands, faces = nearest(self.grid, after)
        # One cell changes: the one in the way, or the one where the agent stands.
        in_the_way = (
            ahead if after.deviation is None else stands + jnp.asarray(self.grid.steps)[faces]
        )
        changed = jnp.where(blocked, in_the_way, stands) & (MAP_SIZE - 1)
        bit = jnp.where(blocked, BLOCKED, 1 << self.grid.neighbour(faces)).astype(jnp.uint16)
        at = changed[0], changed[1]
        return after.replace(cells=state.cells.at[at].set(state.cells[at] | bit))

    def read(self, state: OdometryState, others: Mapping[str, Any]) -> OdometryReading:
        """The pose relative to the start, and the map around the agent."""
        angle = believed_angle(self.grid, state)
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        stands, heading = nearest(self.grid, state)
        place = state.cell if state.deviation is None else state.cell + state.deviation.place
        x, z = place / (POSITION_SCALE / self.grid.grid_size)
        right, ahead = x * cosine - z * sine, x * sine + z * cosine
        down = tilt(self.grid, state.horizon)
        motion = jnp.stack([right, ahead, sine, cosine, down, state.blocked])
        offsets = window_offsets(self.grid.rotations)
        around = (stands + jnp.asarray(offsets)[heading]) & (MAP_SIZE - 1)
        bits = state.cells[around[..., 0], around[..., 1]].astype(jnp.int32)
        stood = bits & (BLOCKED - 1)
        own = self.grid.neighbour(heading)
        turned = ((stood >> own) | (stood << (DIRECTIONS - own))) & (BLOCKED - 1)
        return OdometryReading(
            motion=jnp.concatenate([motion, jax.nn.one_hot(state.action, NUM_ACTIONS)]),
            window=(turned | bits & BLOCKED).astype(jnp.uint16),
        )

    def features(self, reading: OdometryReading) -> jax.Array:
        """The motion, then the bits of the window: [..., width]."""
        bits = reading.window[..., None] >> jnp.arange(DIRECTIONS + 1, dtype=jnp.uint16) & 1
        flat = bits.reshape(*bits.shape[:-3], -1)
        return jnp.concatenate([reading.motion, flat.astype(jnp.float32)], axis=-1)


def make() -> Odometry:
    """The sensor."""
    return Odometry()


def turn(
    grid: PoseGrid, heading: jax.Array, horizon: jax.Array, action: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Heading and horizon after an action, which moves each by at most one."""
    right = jnp.where(action == Action.ROTATE_RIGHT, 1, 0)
    right = jnp.where(action == Action.ROTATE_LEFT, -1, right)
    lowest = len(grid.horizons) - 1
    higher: jax.Array | int = 0
    lower: jax.Array | int = lowest
    if lowest > 1:  # with two horizons, as in iTHOR, there is nothing to compute
        higher, lower = jnp.maximum(horizon - 1, 0), jnp.minimum(horizon + 1, lowest)
    horizon = jnp.where(action == Action.LOOK_DOWN, lower, horizon)
    horizon = jnp.where(action == Action.LOOK_UP, higher, horizon)
    return modulo(heading + right, grid.rotations), horizon


def tilt(grid: PoseGrid, horizon: jax.Array) -> jax.Array:
    """How far the camera looks down, in units of 30 degrees."""
    if grid.horizons == ITHOR.horizons:
        return horizon
    return jnp.asarray(np.array(grid.horizons) / 30, jnp.float32)[horizon]


def _deviation(
    grid: PoseGrid, state: OdometryState, motion: Motion, after: OdometryState
) -> Deviation | None:
    """How far the believed pose is off the grid after an action."""
    before, slip, measured = state.deviation, motion.slip, motion.measured
    if before is not None and measured is not None:
        return Deviation(
            place=measured.place - after.cell,
            angle=measured.angle - after.heading * (2 * jnp.pi / grid.rotations),
            error=jnp.zeros_like(before.error),
            step=measured.place - (state.cell + before.place),
        )
    if before is None or slip is None:
        return None
    ahead = motion.action == Action.MOVE_AHEAD
    right = jnp.where(motion.action == Action.ROTATE_RIGHT, 1.0, 0.0)
    right = jnp.where(motion.action == Action.ROTATE_LEFT, -1.0, right)
    angle = before.angle + jnp.where(ahead, slip.drift, 0.0)
    angle = angle + right * (slip.turn - 1) * (2 * jnp.pi / grid.rotations)
    x, z = jnp.asarray(grid.steps, jnp.float32)[state.heading]
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    believed = slip.distance * jnp.stack([x * cosine + z * sine, z * cosine - x * sine])
    moved = ahead & ~motion.blocked
    return Deviation(
        place=before.place + jnp.where(moved, believed - jnp.stack([x, z]), 0.0),
        angle=angle,
        error=slip.error,
        step=jnp.where(moved, believed, 0.0),
    )


def nearest(grid: PoseGrid, state: OdometryState) -> tuple[jax.Array, jax.Array]:
    """The cell [2] and the heading, both int32, nearest to the pose that the agent believes in."""
    if state.deviation is None:
        return state.cell, state.heading
    cell = state.cell + jnp.rint(state.deviation.place).astype(jnp.int32)
    off = state.deviation.angle + state.deviation.error
    turns = jnp.rint(off / (2 * jnp.pi / grid.rotations)).astype(jnp.int32)
    return cell, (state.heading + turns) % grid.rotations


def believed_angle(grid: PoseGrid, state: OdometryState) -> jax.Array:
    """Radians clockwise from z in which the agent believes to face."""
    angle = state.heading * (2 * jnp.pi / grid.rotations)
    if state.deviation is None:
        return angle
    return angle + state.deviation.angle + state.deviation.error


def last_step(grid: PoseGrid, state: OdometryState) -> jax.Array:
    """The cells [2], along x and z, that the agent believes the last action moved it by."""
    if state.deviation is not None:
        return state.deviation.step
    moved = (state.action == Action.MOVE_AHEAD) & ~state.blocked
    return jnp.where(moved, jnp.asarray(grid.steps)[state.heading], 0)
