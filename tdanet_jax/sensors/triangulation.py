"""Triangulation: the target's position from the bearings of its past detections.

A box tells in which direction an object lies, and not how far away: it may be near, or large.
Bearings from two places intersect where it is. So an agent with odometry can tell the distance of
a class that it was never trained to find, whatever its size. The estimate is the point with the
least sum of squared distances to all rays along which the target was seen, and to a weak prior:
1.5 m away along the first of them.

Axes are those of `odometry.OdometryState`, x and z along the grid and y up, in metres from the
camera, whose field of view is 90 degrees in both directions.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from tdanet_jax.poses import PoseGrid
from tdanet_jax.sensors import odometry
from tdanet_jax.sensors.sensor import Frame, Motion, Sensor, Start
from tdanet_jax.sensors.shared import (
    BORDER,
    HALF_CERTAIN,
    MAX_RADIUS,
    MOVED,
    POSITION_SCALE,
    PRIOR_WEIGHT,
    SAME_OBJECT_COSINE,
)
from tdanet_jax.vocabulary import VISIBILITY_DISTANCE


class TargetEstimate(struct.PyTreeNode):
    """What is known of the target's position p: the normal equations `normal p = moment`."""

    normal: jax.Array  # [3, 3] float32, sum of the projections across the rays; 0 without any
    moment: jax.Array  # [3] float32
    radius: jax.Array  # float32, half the side of a square as large as the box; metres
    moved: jax.Array  # bool, the agent has moved since the last ray


def no_estimate() -> TargetEstimate:
    """The target has not been seen yet."""
    return TargetEstimate(jnp.zeros((3, 3)), jnp.zeros(3), jnp.zeros(()), jnp.zeros((), bool))


class Triangulation(Sensor):
    """Tracks the target's position over an episode."""

    REQUIRES = ("odometry",)
    width = 9

    def init(self, start: Start) -> TargetEstimate:
        """No estimate."""
        return no_estimate()

    def update(
        self, state: TargetEstimate, motion: Motion, others: Mapping[str, Any]
    ) -> TargetEstimate:
        """Shifts the origin to where the agent stands now."""
        cells = odometry.last_step(self.grid, others["odometry"])
        x, z = cells * self.grid.grid_size
        moved = jnp.stack([x, jnp.zeros_like(x), z])
        return state.replace(
            moment=state.moment - dot(state.normal, moved),
            moved=state.moved | (cells[0] ** 2 + cells[1] ** 2 > MOVED**2),
        )

    def observe(
        self, state: TargetEstimate, frame: Frame, others: Mapping[str, Any]
    ) -> TargetEstimate:
        """Adds the ray of the target's box, if it is in view.

        Of several boxes it takes the one nearest to the estimated direction. If that cannot be the
        object tracked so far, it starts anew with the largest. Only the first ray from one point
        counts.
        """
        angle = odometry.believed_angle(self.grid, others["odometry"])
        boxes, is_target = frame.boxes, frame.mask & (frame.classes == frame.target)
        # As long as what they show is one metre deep.
        rays = _rays(self.grid, boxes, angle, others["odometry"].horizon)
        lengths = jnp.linalg.norm(rays, axis=-1)
        directions = rays / lengths[:, None]
        cosine = dot(directions, direction_of(solve(state)[0]))
        nearest = jnp.argmax(jnp.where(is_target, cosine, -2.0))
        largest = jnp.argmax(jnp.where(is_target, boxes[:, 2], -1.0))
        more = self.add(state, directions[nearest], state.moved)
        agrees = dot(directions[nearest], direction_of(solve(more)[0])) > SAME_OBJECT_COSINE
        same = _any_ray(state) & agrees
        prior = no_estimate().replace(
            normal=PRIOR_WEIGHT * jnp.eye(3),
            moment=PRIOR_WEIGHT * VISIBILITY_DISTANCE * directions[largest],
        )
        seen = _choose(same, more, self.add(prior, directions[largest], True))
        chosen = jnp.where(same, nearest, largest)
        # At a depth of one metre, the image is two metres wide.
        depth = jnp.linalg.norm(solve(seen)[0]) / lengths[chosen]
        radius = jnp.minimum(jnp.sqrt(boxes[chosen, 2]) * depth, MAX_RADIUS)
        return _choose(jnp.any(is_target), seen.replace(radius=radius), state)

    def add(
        self, estimate: TargetEstimate, direction: jax.Array, counts: jax.Array | bool
    ) -> TargetEstimate:
        """The estimate with one more ray from where the agent is, if `counts`."""
        across = jnp.eye(3) - direction[:, None] * direction
        normal = estimate.normal + jnp.where(counts, across, 0.0)
        return estimate.replace(normal=normal, moved=jnp.zeros((), bool))

    def clear(self, state: TargetEstimate, changed: jax.Array) -> TargetEstimate:
        """No estimate of another target."""
        return _choose(changed, no_estimate(), state)

    def read(self, state: TargetEstimate, others: Mapping[str, Any]) -> jax.Array:
        """[9] float32, zeros until the target has been seen.

        Its position to the right of, above and ahead of the agent as it faces now, in units of 4 m;
        its radius; the certainty of the position along the line of sight, from 0 to 1; how far its
        centre and its near side are within 1.5 m horizontally, in units of 0.25 m, from -1 to 1;
        and these two times the certainty.
        """
        position, weight = solve(state)
        angle = odometry.believed_angle(self.grid, others["odometry"])
        sine, cosine = jnp.sin(angle), jnp.cos(angle)
        x, y, z = position
        turned = jnp.stack([x * cosine - z * sine, y, x * sine + z * cosine])
        left = VISIBILITY_DISTANCE - jnp.hypot(x, z)
        within = jnp.clip(jnp.stack([left, left + state.radius]) / BORDER, -1.0, 1.0)
        certainty = weight / (weight + HALF_CERTAIN)
        reading = jnp.concatenate(
            [
                jnp.clip(turned / POSITION_SCALE, -2.0, 2.0),
                jnp.stack([state.radius, certainty]),
                within,
                within * certainty,
            ]
        )
        return jnp.where(_any_ray(state), reading, 0.0)


def make() -> Triangulation:
    """The sensor."""
    return Triangulation()


def _any_ray(estimate: TargetEstimate) -> jax.Array:
    return estimate.normal[0, 0] > 0


def _choose(chosen: jax.Array, one: TargetEstimate, other: TargetEstimate) -> TargetEstimate:
    return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), one, other)


def dot(a: jax.Array, b: jax.Array) -> jax.Array:
    """Scalar products along the last axis, in full precision: a GPU rounds `@`."""
    return jnp.sum(a * b, axis=-1)


def direction_of(position: jax.Array) -> jax.Array:
    """The unit vector towards a position [3]."""
    return position / jnp.maximum(jnp.linalg.norm(position), 1e-6)


def _rays(grid: PoseGrid, boxes: jax.Array, angle: jax.Array, horizon: jax.Array) -> jax.Array:
    """Rays to the centres of boxes [K, 3], one metre deep along the optical axis: [K, 3].

    The agent faces `angle` radians clockwise from z.
    """
    right, up = 2 * boxes[:, 0] - 1, 1 - 2 * boxes[:, 1]
    down = odometry.tilt(grid, horizon) * (jnp.pi / 6)
    ahead, up = jnp.cos(down) + up * jnp.sin(down), up * jnp.cos(down) - jnp.sin(down)
    sine, cosine = jnp.sin(angle), jnp.cos(angle)
    return jnp.stack([right * cosine + ahead * sine, up, ahead * cosine - right * sine], axis=-1)


def solve(estimate: TargetEstimate) -> tuple[jax.Array, jax.Array]:
    """The position [3], and the weight of the evidence along the line of sight."""
    a, b, c = estimate.normal
    adjugate = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])  # symmetric
    inverse = adjugate / jnp.maximum(dot(a, adjugate[0]), 1e-12)
    position = dot(inverse, estimate.moment)
    direction = direction_of(position)
    return position, 1 / jnp.maximum(dot(direction, dot(inverse, direction)), 1e-6)
