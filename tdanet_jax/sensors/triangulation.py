"""Where the target is, from the directions in which it was seen and from the agent's own way.

A box says in which direction an object lies, and not how far away: it may be near, or large.
Directions from two places cross where it is. So an agent that knows its way (`odometry.py`) can
tell the distance of what it was never trained to find, whatever its size. The target's place is the
point with the least sum of squared distances from all rays along which it was seen, and from a weak
guess: 1.5 m away on the first of them. The environment and an agent on its own run the same
functions.

Axes are those of `odometry.Trail`, x and z along the grid and y up, in metres from the camera,
whose view is 90 degrees wide and high.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from tdanet_jax.scenes.scene import GRID, REACH

#: Length of `sense`.
NUMBERS = 9
#: Weight of the guess, where a ray weighs 1.
GUESS = 1e-3
#: A box is of the object that was seen before if it is less than 12 degrees away from the place
#: that follows if it is.
SAME = float(np.cos(np.radians(12)))
#: Weight along the line of sight at which the place is half certain.
HALF = 0.03
#: Most of a radius, in metres.
WIDEST = 1.0
#: Metres of the place are divided by this, and clipped at twice as many.
FAR = 4.0
#: Metres to the border of reach are divided by this, and clipped there.
BORDER = 0.25


class Sighting(struct.PyTreeNode):
    """What is known of the target's place p: the normal equations normal p = moment."""

    normal: jax.Array  # [3, 3] float32, sum of the projections across the rays; 0 without any
    moment: jax.Array  # [3] float32
    radius: jax.Array  # float32, half the side of a square as large as the box; metres
    moved: jax.Array  # bool, the agent has moved since the last ray


def begin() -> Sighting:
    """Nothing was seen yet."""
    return Sighting(jnp.zeros((3, 3)), jnp.zeros(3), jnp.zeros(()), jnp.zeros((), bool))


def forget(sighting: Sighting, lost: jax.Array) -> Sighting:
    """Nothing, if it is `lost`, a bool."""
    return _choose(lost, begin(), sighting)


def follow(sighting: Sighting, cells: jax.Array) -> Sighting:
    """The same, once the agent has gone `cells` [2] int32, along x and z."""
    x, z = cells * GRID
    moved = jnp.stack([x, jnp.zeros_like(x), z])
    return sighting.replace(
        moment=sighting.moment - _dot(sighting.normal, moved),
        moved=sighting.moved | jnp.any(cells != 0),
    )


def look(
    sighting: Sighting,
    heading: jax.Array,
    horizon: jax.Array,
    boxes: jax.Array,
    is_target: jax.Array,
) -> Sighting:
    """The same, once the agent has seen what is in view.

    Of several targets it goes on with the one nearest to the place known before. If that cannot be
    the one seen before, it begins anew with the largest. From one point, only the first ray counts.

    Args:
      heading: int32, in steps of 45 degrees clockwise from z.
      horizon: int32, 1 while looking 30 degrees down.
      boxes: [K, 3] x, y, S of the detections.
      is_target: [K] bool, False in padding.
    """
    rays = _rays(boxes, heading, horizon)  # as long as what they show is one metre deep
    lengths = jnp.linalg.norm(rays, axis=-1)
    directions = rays / lengths[:, None]
    likeness = _dot(directions, _direction(_solve(sighting)[0]))
    nearest = jnp.argmax(jnp.where(is_target, likeness, -2.0))
    largest = jnp.argmax(jnp.where(is_target, boxes[:, 2], -1.0))
    more = _add(sighting, directions[nearest], sighting.moved)
    likely = _dot(directions[nearest], _direction(_solve(more)[0])) > SAME
    same = _any_ray(sighting) & likely
    guess = begin().replace(normal=GUESS * jnp.eye(3), moment=GUESS * REACH * directions[largest])
    seen = _choose(same, more, _add(guess, directions[largest], True))
    chosen = jnp.where(same, nearest, largest)
    # What is one metre deep is two metres of an image's side.
    depth = jnp.linalg.norm(_solve(seen)[0]) / lengths[chosen]
    radius = jnp.minimum(jnp.sqrt(boxes[chosen, 2]) * depth, WIDEST)
    return _choose(jnp.any(is_target), seen.replace(radius=radius), sighting)


def sense(sighting: Sighting, heading: jax.Array) -> jax.Array:
    """What the agent senses of its target: [9] float32, zeros before it was seen.

    Its place, to the right, up and ahead of the agent as it faces now, in units of 4 m; its radius;
    how certain the place is, from 0 to 1, along the line to it; how far its middle and its side are
    within 1.5 m on the level, in units of 0.25 m, from -1 to 1; and these two times the certainty.
    """
    place, weight = _solve(sighting)
    angle = heading * (jnp.pi / 4)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    x, y, z = place
    turned = jnp.stack([x * cosine - z * sine, y, x * sine + z * cosine])
    left = REACH - jnp.hypot(x, z)
    within = jnp.clip(jnp.stack([left, left + sighting.radius]) / BORDER, -1.0, 1.0)
    certain = weight / (weight + HALF)
    sensed = jnp.concatenate(
        [
            jnp.clip(turned / FAR, -2.0, 2.0),
            jnp.stack([sighting.radius, certain]),
            within,
            within * certain,
        ]
    )
    return jnp.where(_any_ray(sighting), sensed, 0.0)


def _any_ray(sighting: Sighting) -> jax.Array:
    return sighting.normal[0, 0] > 0


def _add(sighting: Sighting, direction: jax.Array, counts: jax.Array | bool) -> Sighting:
    """The same with one more ray from where the agent is, if it counts."""
    across = jnp.eye(3) - direction[:, None] * direction
    normal = sighting.normal + jnp.where(counts, across, 0.0)
    return sighting.replace(normal=normal, moved=jnp.zeros((), bool))


def _choose(chosen: jax.Array, one: Sighting, other: Sighting) -> Sighting:
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), one, other)


def _dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Scalar products along the last axis, in full precision: a GPU rounds `@`."""
    return jnp.sum(a * b, axis=-1)


def _direction(place: jax.Array) -> jax.Array:
    return place / jnp.maximum(jnp.linalg.norm(place), 1e-6)


def _rays(boxes: jax.Array, heading: jax.Array, horizon: jax.Array) -> jax.Array:
    """To the centres of boxes [K, 3], one metre deep in the image: [K, 3]."""
    right, up = 2 * boxes[:, 0] - 1, 1 - 2 * boxes[:, 1]
    down = horizon * (jnp.pi / 6)
    ahead, up = jnp.cos(down) + up * jnp.sin(down), up * jnp.cos(down) - jnp.sin(down)
    angle = heading * (jnp.pi / 4)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    return jnp.stack([right * cosine + ahead * sine, up, ahead * cosine - right * sine], axis=-1)


def _solve(sighting: Sighting) -> tuple[jax.Array, jax.Array]:
    """The place [3], and the weight of what is known of it along the line to it."""
    a, b, c = sighting.normal
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])  # symmetric
    inverse = adjugate / jnp.maximum(_dot(a, adjugate[0]), 1e-12)
    place = _dot(inverse, sighting.moment)
    direction = _direction(place)
    return place, 1 / jnp.maximum(_dot(direction, _dot(inverse, direction)), 1e-6)
