"""The environment: find an object of the target class in a room, as pure functions."""

from tdanet_jax.env.dynamics import (
    is_visible,
    move,
    observe,
    reset,
    reset_state,
    start,
    step,
    transition,
)
from tdanet_jax.env.environment import Environment
from tdanet_jax.env.params import TEST_STEP_LIMITS, FeatureMaps, make_params
from tdanet_jax.env.types import EnvParams, EnvState, Observation, Outcome

__all__ = [
    "TEST_STEP_LIMITS",
    "EnvParams",
    "EnvState",
    "Environment",
    "FeatureMaps",
    "Observation",
    "Outcome",
    "is_visible",
    "make_params",
    "move",
    "observe",
    "reset",
    "reset_state",
    "start",
    "step",
    "transition",
]
