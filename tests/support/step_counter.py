"""A custom sensor, as a user's module: it counts actions and frames that show the target."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax.sensors.sensor import Frame, Motion, Sensor, Start
from tdanet_jax.vocabulary import NUM_ACTIONS

#: Its name for `--sensors`.
NAME = "tests.support.step_counter"


class StepCounter(Sensor):
    """Actions so far, frames with the target in view, cells from the start, and how it began."""

    REQUIRES = ("odometry",)
    width = 4

    def init(self, start: Start) -> dict[str, jax.Array]:
        """Nothing is counted yet."""
        zero = jnp.zeros_like(start.rotation)
        return {"actions": zero, "frames": zero, "path": zero, "rotation": start.rotation}

    def update(self, state: Any, motion: Motion, others: Mapping[str, Any]) -> dict[str, jax.Array]:
        """Counts an action, and adds how far from the start odometry says that it has led."""
        return {
            **state,
            "actions": state["actions"] + (motion.action < NUM_ACTIONS),
            "path": state["path"] + jnp.abs(others["odometry"].cell).sum(),
        }

    def observe(self, state: Any, frame: Frame, others: Mapping[str, Any]) -> dict[str, jax.Array]:
        """Counts a frame that shows the target."""
        seen = jnp.any(frame.mask & (frame.classes == frame.target))
        return {**state, "frames": state["frames"] + seen}

    def clear(self, state: Any, changed: jax.Array) -> dict[str, jax.Array]:
        """No frame has shown another target."""
        return {**state, "frames": jnp.where(changed, 0, state["frames"])}

    def read(self, state: Any, others: Mapping[str, Any]) -> dict[str, jax.Array]:
        """The counts as they are."""
        return dict(state)

    def features(self, reading: Any) -> jax.Array:
        """Tenths of the counts, in alphabetical order."""
        counts = jnp.stack([reading[name] for name in sorted(reading)], axis=-1)
        return counts.astype(jnp.float32) / 10


def make() -> StepCounter:
    """The sensor."""
    return StepCounter()
