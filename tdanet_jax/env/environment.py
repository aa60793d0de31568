"""The environment as one object, called as in gymnax 1.0."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax.env import dynamics
from tdanet_jax.env.spaces import Box, Dict, Discrete
from tdanet_jax.env.types import EnvParams, EnvState, Observation
from tdanet_jax.sensors import suite
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

    def action_space(self, params: EnvParams | None = None) -> Discrete:
        """The actions. Under `jit`, where none is refused, any other number is a step in place."""
        return Discrete(NUM_ACTIONS)

    def observation_space(self, params: EnvParams | None = None) -> Dict:
        """The fields of `Observation` that every environment has."""
        params = params or self.default_params
        rows = params.max_detections
        return Dict(
            {
                "classes": Box(0, len(self.class_names) - 1, (rows,), jnp.int32),
                "boxes": Box(0.0, 1.0, (rows, params.spec.columns)),
                "mask": Box(0, 1, (rows,), bool),
                "target": Discrete(len(self.class_names)),
            }
        )

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


@dataclasses.dataclass(frozen=True, eq=False)
class FlatObservations:
    """An environment whose observations are vectors [size] float32, with word vectors filled in.

    For networks of others, which know nothing of classes. In this order: for each of the K rows, 1
    (0 in padding), x, y, S, its score if scores are shown, and the word vector of its class; the
    word vector of the target; and the features of the sensors, if there are any.

    Attributes:
      env: what `tdanet_jax.make` gives.
    """

    env: Environment

    @property
    def name(self) -> str:
        """The environment's name."""
        return self.env.name

    @property
    def default_params(self) -> EnvParams:
        """The environment's parameters."""
        return self.env.default_params

    @property
    def num_actions(self) -> int:
        """6: the actions of `tdanet_jax.vocabulary.Action`."""
        return self.env.num_actions

    def action_space(self, params: EnvParams | None = None) -> Discrete:
        """The actions."""
        return self.env.action_space(params)

    def observation_space(self, params: EnvParams | None = None) -> Box:
        """Vectors of the size that `params` give; the same in training and in tests."""
        params = params or self.default_params
        width = self.env.words.shape[1]
        size = params.max_detections * (1 + params.spec.columns + width) + width
        if params.spec.sensors:
            size += suite.width(params.spec)
        return Box(-jnp.inf, jnp.inf, (size,))

    def flatten(self, obs: Observation, params: EnvParams | None = None) -> jax.Array:
        """One observation as a vector [size] float32."""
        spec = (params or self.default_params).spec
        shown = obs.mask[:, None]
        words = jnp.where(shown, self.env.words[obs.classes], 0.0)
        rows = jnp.concatenate([shown.astype(jnp.float32), obs.boxes, words], axis=1)
        parts = [rows.ravel(), self.env.words[obs.target]]
        if spec.sensors:
            parts.append(suite.features(spec, obs.sensors))
        return jnp.concatenate(parts)

    def reset(self, key: jax.Array, params: EnvParams | None = None) -> tuple[jax.Array, EnvState]:
        """Starts a random episode: (vector, state)."""
        obs, state = self.env.reset(key, params)
        return self.flatten(obs, params), state

    def step(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: EnvParams | None = None
    ) -> tuple[jax.Array, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
        """One action, as `Environment.step`; `final_observation` is a vector too."""
        obs, state, reward, terminated, truncated, info = self.env.step(key, state, action, params)
        info = {**info, "final_observation": self.flatten(info["final_observation"], params)}
        return self.flatten(obs, params), state, reward, terminated, truncated, info
