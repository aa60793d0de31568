"""The environment as one object, called as in gymnax 1.0."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax

from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams, EnvState, Observation
from tdanet_jax.vocabulary import NUM_ACTIONS


@dataclasses.dataclass(frozen=True, eq=False)
class Environment:
    """Object-goal navigation in a set of rooms; pure functions, for `jax.jit` and `jax.vmap`.

    Attributes:
      name: "ithor-18/4".
      default_params: its rooms, rewards and episodes.
      class_names: C names; `Observation.classes` and `.target` are indices of these.
      words: [C, D] word vectors of the classes; zero for those hidden from training.
    """

    name: str
    default_params: EnvParams
    class_names: tuple[str, ...]
    words: jax.Array

    @property
    def num_actions(self) -> int:
        """6: the actions of `tdanet_jax.vocabulary.Action`."""
        return NUM_ACTIONS

    def reset(
        self, key: jax.Array, params: EnvParams | None = None
    ) -> tuple[Observation, EnvState]:
        """Starts a random episode: (observation, state)."""
        return dynamics.reset(key, self.default_params if params is None else params)

    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: EnvParams | None = None
    ) -> tuple[Observation, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One action: (observation, state, reward, terminated, truncated, info).

        A finished episode is followed by the first state of a new one; see `dynamics.step`.
        """
        return dynamics.step(key, state, action, self.default_params if params is None else params)
