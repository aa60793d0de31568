"""Where the target is, from the directions in which it was seen and from the agent's own way.

A box says in which direction an object lies, and not how far away: it may be near, or large.
Directions from two places cross where it is. So an agent that knows its way (`odometry.py`) can
tell the distance of what it was never trained to find, whatever its size. The target's place is the
point with the least sum of squared distances from all rays along which it was seen, and from a weak
guess: 1.5 m away on the first of them. The environment and an agent on its own run the same
functions.

Axes are those of `odometry.Trail`, x and z along the grid and y up, in metres from the camera.
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
#: A box is of the object that was seen before if it is less than 12 degrees away from its place.
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


def begin() -> Sighting:
    """Nothing was seen yet."""
    return Sighting(jnp.zeros((3, 3)), jnp.zeros(3), jnp.zeros(()))


def follow(sighting: Sighting, cells: jax.Array) -> Sighting:
    """The same, once the agent has gone `cells` [2] int32, along x and z."""
    x, z = cells * GRID
    moved = jnp.stack([x, jnp.zeros_like(x), z])
    return sighting.replace(moment=sighting.moment - sighting.normal @ moved)


def look(
    sighting: Sighting,
    heading: jax.Array,
    horizon: jax.Array,
    boxes: jax.Array,
    is_target: jax.Array,
) -> Sighting:
    """The same, once the agent has seen what is in view.

    Of several targets it goes on with the one that it saw before, or begins anew with the largest.

    Args:
      heading: int32, in steps of 45 degrees clockwise from z.
      horizon: int32, 1 while looking 30 degrees down.
      boxes: [K, 3] x, y, S of the detections.
      is_target: [K] bool, False in padding.
    """
    rays = _rays(boxes, heading, horizon)
    place, _ = _solve(sighting)
    likeness = jnp.where(is_target, rays @ _direction(place), -1.0)
    known = jnp.max(likeness) > SAME
    largest = jnp.argmax(jnp.where(is_target, boxes[:, 2], -1.0))
    chosen = jnp.where(known, jnp.argmax(likeness), largest)
    ray = rays[chosen]
    normal = jnp.where(known, sighting.normal, GUESS * jnp.eye(3))
    moment = jnp.where(known, sighting.moment, GUESS * REACH * ray)
    seen = Sighting(normal + jnp.eye(3) - jnp.outer(ray, ray), moment, sighting.radius)
    # The view is 90 degrees wide: an image's side is twice as long as what it shows is far away.
    radius = jnp.sqrt(boxes[chosen, 2]) * jnp.linalg.norm(_solve(seen)[0])
    seen = seen.replace(radius=jnp.minimum(radius, WIDEST))
    any_seen = jnp.any(is_target)
    return jax.tree.map(lambda new, old: jnp.where(any_seen, new, old), seen, sighting)


def sense(sighting: Sighting, heading: jax.Array) -> jax.Array:
    """What the agent senses of its target: [9] float32, zeros before it was seen.

    Its place, to the right, up and ahead of the agent as it faces now, in units of 4 m; its radius;
    how certain the place is, from 0 to 1; how far its middle and its side are within reach, in
    units of 0.25 m, from -1 to 1; and these two times the certainty.
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
    return jnp.where(sighting.normal[0, 0] > 0, sensed, 0.0)


def _direction(place: jax.Array) -> jax.Array:
    return place / jnp.maximum(jnp.linalg.norm(place), 1e-6)


def _rays(boxes: jax.Array, heading: jax.Array, horizon: jax.Array) -> jax.Array:
    """Unit vectors to the centres of boxes [K, 3]: [K, 3]."""
    right, up = 2 * boxes[:, 0] - 1, 1 - 2 * boxes[:, 1]
    down = horizon * (jnp.pi / 6)
    ahead, up = jnp.cos(down) + up * jnp.sin(down), up * jnp.cos(down) - jnp.sin(down)
    angle = heading * (jnp.pi / 4)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    rays = jnp.stack([right * cosine + ahead * sine, up, ahead * cosine - right * sine], axis=-1)
    return rays / jnp.linalg.norm(rays, axis=-1, keepdims=True)


def _solve(sighting: Sighting) -> tuple[jax.Array, jax.Array]:
    """The place [3], and the weight of what is known of it along the line of sight."""
    a, b, c = sighting.normal
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])  # symmetric
    inverse = adjugate / jnp.maximum(a @ adjugate[0], 1e-12)
    place = inverse @ sighting.moment
    ray = _direction(place)
    return place, 1 / jnp.maximum(ray @ inverse @ ray, 1e-6)
