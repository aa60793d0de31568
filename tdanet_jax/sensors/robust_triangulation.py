"""Triangulation for bearings with errors, of a detector's boxes or of odometry.

If bearings are wrong by some degrees, the point with the least sum of squared distances to the rays
lies too near on average: a ray that is off by an angle a has a weight of sin^2 a along the true
line of sight, and draws the estimate to where the agent stands. Here the same weight draws it back
to the position that was estimated. Without errors, the two kinds of triangulation nearly agree.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from tdanet_jax.sensors.shared import FOLLOWED
from tdanet_jax.sensors.triangulation import TargetEstimate, Triangulation, direction_of, dot, solve


class RobustTriangulation(Triangulation):
    """Tracks the target's position over an episode."""

    def add(
        self, estimate: TargetEstimate, direction: jax.Array, counts: jax.Array | bool
    ) -> TargetEstimate:
        """The estimate with one more ray from where the agent is, if `counts`.

        The ray's error is the angle between it and the position that is re-estimated with it.
        """
        more = super().add(estimate, direction, counts)
        position, _ = solve(more)
        sine = jnp.cross(direction, direction_of(position))
        pull = FOLLOWED * dot(sine, sine) * position
        return more.replace(moment=more.moment + jnp.where(counts, pull, 0.0))


def make() -> RobustTriangulation:
    """The sensor."""
    return RobustTriangulation()
