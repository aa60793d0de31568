"""What an agent can tell of its way from its own motion: dead reckoning, and a map of where it was.

Nothing here knows the room. An agent knows which action it took and whether a MoveAhead was
blocked; from these follow its pose relative to the start, and a map of where it has been and of
what was in the way. It senses the pose (as from the GPS and compass of Habitat) and the part of the
map around it, turned so that ahead is up. It may also keep in mind where it saw its target
(`triangulation.py`). The environment and an agent on its own run the same functions.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from tdanet_jax.poses import ROTATIONS
from tdanet_jax.scenes.visibility.geometry import STEPS
from tdanet_jax.sensors import triangulation
from tdanet_jax.sensors.triangulation import Sighting
from tdanet_jax.vocabulary import NUM_ACTIONS, Action

#: Cells of 0.25 m along each side of the map; beyond them it begins anew, like the surface of a
#: torus. The largest iTHOR room has 35.
MAP = 64
#: Cells along each side of the part of the map that is sensed, the agent in its middle.
WINDOW = 9
#: Bits of a cell: one for each heading in which the agent stood there, then "blocked".
BLOCKED = 1 << ROTATIONS
#: Length of `numbers`, without the target's.
NUMBERS = 6 + NUM_ACTIONS + WINDOW * WINDOW * (ROTATIONS + 1)
#: Metres are divided by this many cells (4 m).
REACH = 16.0


def _window_offsets() -> np.ndarray:
    """The cells of the window, [8, WINDOW, WINDOW, 2], by heading: first row far ahead.

    Along a diagonal, the nearest cells to a square that is turned by 45 degrees: some stand in two
    places of it, and some in none.
    """
    middle = WINDOW // 2
    row, column = np.mgrid[:WINDOW, :WINDOW]
    right, ahead = column - middle, middle - row
    angle = np.arange(ROTATIONS)[:, None, None] * (np.pi / 4)
    x = right * np.cos(angle) + ahead * np.sin(angle)
    z = ahead * np.cos(angle) - right * np.sin(angle)
    return np.rint(np.stack([x, z], axis=-1)).astype(np.int32)


OFFSETS = _window_offsets()


class Trail(struct.PyTreeNode):
    """The way of one episode, in a frame that begins at its start.

    The axes lie along the grid of reachable points: z is the start's heading, or for a start along
    a diagonal, the axis 45 degrees to its left.
    """

    cell: jax.Array  # [2] int32, x and z in cells
    heading: jax.Array  # int32, in steps of 45 degrees clockwise from z
    horizon: jax.Array  # int32, 1 while looking down
    action: jax.Array  # int32, the last action; 6 before the first
    blocked: jax.Array  # bool, the last action was a MoveAhead that did not move the agent
    cells: jax.Array  # [MAP, MAP] uint16, the bits of each cell
    sighting: Sighting | None = None  # where the target was seen, if the agent senses that


class Odometry(struct.PyTreeNode):
    """What the agent senses of its way."""

    #: [12] float32: where it is, to the right and ahead of its start as it faces now, in units of
    #: 4 m; sine and cosine of its heading; horizon; whether it was blocked; the last action.
    motion: jax.Array
    window: jax.Array  # [WINDOW, WINDOW] uint16, the map around it; headings relative to its own
    target: jax.Array | None = None  # [9] float32, `triangulation.sense`; if it senses that


def begin(diagonal: jax.Array, horizon: jax.Array, triangulates: bool = False) -> Trail:
    """The trail at the start of an episode.

    Args:
      diagonal: int32, 1 if the agent faces along a diagonal of the grid, 0 if along an axis.
      horizon: int32, 1 while looking down.
      triangulates: whether the agent senses its target's place, too.
    """
    cells = jnp.zeros((MAP, MAP), jnp.uint16).at[0, 0].set((1 << diagonal).astype(jnp.uint16))
    return Trail(
        cell=jnp.zeros(2, jnp.int32),
        heading=diagonal,
        horizon=horizon,
        action=jnp.full_like(diagonal, NUM_ACTIONS),
        blocked=jnp.zeros_like(diagonal, bool),
        cells=cells,
        sighting=triangulation.begin() if triangulates else None,
    )


def turn(heading: jax.Array, horizon: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Heading and horizon after an action."""
    right = jnp.where(action == Action.ROTATE_RIGHT, 1, 0)
    right = jnp.where(action == Action.ROTATE_LEFT, -1, right)
    horizon = jnp.where(action == Action.LOOK_DOWN, 1, horizon)
    horizon = jnp.where(action == Action.LOOK_UP, 0, horizon)
    return (heading + right) & (ROTATIONS - 1), horizon


def follow(trail: Trail, action: jax.Array, blocked: jax.Array) -> Trail:
    """The trail after an action.

    Args:
      action: int32; 6, before the first action, changes nothing.
      blocked: bool, whether the agent did not move; it counts if the action is MoveAhead.
    """
    ahead = trail.cell + jnp.asarray(STEPS)[trail.heading]
    moves = action == Action.MOVE_AHEAD
    blocked = moves & blocked
    cell = jnp.where(moves & ~blocked, ahead, trail.cell)
    heading, horizon = turn(trail.heading, trail.horizon, action)
    # One cell changes: the one in the way, or the one where the agent stands.
    changed = jnp.where(blocked, ahead, cell) & (MAP - 1)
    bit = jnp.where(blocked, BLOCKED, 1 << heading).astype(jnp.uint16)
    at = changed[0], changed[1]
    sighting = trail.sighting
    if sighting is not None:
        sighting = triangulation.follow(sighting, cell - trail.cell)
    return Trail(
        cell=cell,
        heading=heading,
        horizon=horizon,
        action=action.astype(jnp.int32),
        blocked=blocked,
        cells=trail.cells.at[at].set(trail.cells[at] | bit),
        sighting=sighting,
    )


def forget(trail: Trail, lost: jax.Array) -> Trail:
    """The trail, without what it knows of a target's place if that is `lost`, a bool."""
    if trail.sighting is None:
        return trail
    return trail.replace(sighting=triangulation.forget(trail.sighting, lost))


def look(trail: Trail, boxes: jax.Array, is_target: jax.Array) -> Trail:
    """The trail, once the agent has seen where its target is in view, if it senses that.

    Args:
      trail: behind the last action.
      boxes: [K, 3] x, y, S of the detections.
      is_target: [K] bool, False in padding.
    """
    if trail.sighting is None:
        return trail
    seen = triangulation.look(trail.sighting, trail.heading, trail.horizon, boxes, is_target)
    return trail.replace(sighting=seen)


def sense(trail: Trail) -> Odometry:
    """What the agent senses behind its last action."""
    heading = trail.heading
    angle = heading * (jnp.pi / 4)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    x, z = trail.cell / REACH
    right, ahead = x * cosine - z * sine, x * sine + z * cosine
    motion = jnp.stack([right, ahead, sine, cosine, trail.horizon, trail.blocked])
    around = (trail.cell + jnp.asarray(OFFSETS)[heading]) & (MAP - 1)
    bits = trail.cells[around[..., 0], around[..., 1]].astype(jnp.int32)
    stood = bits & (BLOCKED - 1)
    turned = ((stood >> heading) | (stood << (ROTATIONS - heading))) & (BLOCKED - 1)
    return Odometry(
        motion=jnp.concatenate([motion, jax.nn.one_hot(trail.action, NUM_ACTIONS)]),
        window=(turned | bits & BLOCKED).astype(jnp.uint16),
        target=None if trail.sighting is None else triangulation.sense(trail.sighting, heading),
    )


def numbers(sensed: Odometry) -> jax.Array:
    """All of it as float32, [..., NUMBERS] from leading axes [...], and behind it the target's."""
    bits = sensed.window[..., None] >> jnp.arange(ROTATIONS + 1, dtype=jnp.uint16) & 1
    flat = bits.reshape(*bits.shape[:-3], -1)
    target = [] if sensed.target is None else [sensed.target]
    return jnp.concatenate([sensed.motion, flat.astype(jnp.float32), *target], axis=-1)


def sensed_at_start(batch: int, triangulates: bool) -> Odometry:
    """What is sensed at the start of `batch` episodes, along an axis."""
    zero = jnp.zeros(batch, jnp.int32)
    begun = jax.vmap(lambda diagonal, horizon: begin(diagonal, horizon, triangulates))
    return jax.vmap(sense)(begun(zero, zero))
