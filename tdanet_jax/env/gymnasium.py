"""The environment for Gymnasium (https://gymnasium.farama.org): one episode, or many side by side.

Importing this module registers `tdanet/iTHOR-22-0-v1`, `tdanet/iTHOR-18-4-v1` and
`tdanet/iTHOR-14-8-v1`, so `gymnasium.make("tdanet_jax.env.gymnasium:tdanet/iTHOR-18-4-v1")` needs
no other import; `gymnasium.make_vec` of the same name gives the vectorised one.
"""

from __future__ import annotations

import functools
from typing import Any, Literal

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from tdanet_jax.config import TrainConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.environment import FlatObservations
from tdanet_jax.env.spaces import Box, Dict, Discrete
from tdanet_jax.env.types import EnvParams, EnvState, Observation, Outcome
from tdanet_jax.splits import UNSEEN, file_name
from tdanet_jax.task import make
from tdanet_jax.vocabulary import NUM_ACTIONS

#: Version of the registered environments: it changes when their episodes do.
VERSION = 1


def to_gymnasium(space: Discrete | Box | Dict) -> spaces.Space:
    """The same space as Gymnasium writes it."""
    if isinstance(space, Discrete):
        return spaces.Discrete(space.n)
    if isinstance(space, Dict):
        return spaces.Dict({name: to_gymnasium(one) for name, one in space.spaces.items()})
    if space.dtype is bool:
        return spaces.MultiBinary(space.shape)
    return spaces.Box(space.low, space.high, space.shape, np.dtype(space.dtype).type)


class _Shown:
    """An environment as Gymnasium's users are shown it, and its compiled functions.

    Environments with the same arguments share one: tables are large, and compiling takes seconds.
    """

    def __init__(
        self,
        name: str | None,
        split: Literal["train", "test"],
        flat: bool,
        config: TrainConfig | None,
    ) -> None:
        self.env, self.params = make(name, split, config)
        self.flat = FlatObservations(self.env) if flat else None
        self.space = to_gymnasium((self.flat or self.env).observation_space(self.params))
        self.reset, self.step = jax.jit(self._reset), jax.jit(self._step)
        self.reset_many = jax.jit(jax.vmap(self._reset, (0, None)))
        self.step_many = jax.jit(jax.vmap(self._step_on, (0, 0, 0, None)))

    def _reset(self, key: jax.Array, params: EnvParams) -> tuple[Any, EnvState]:
        obs, state = dynamics.reset(key, params)
        return self._observed(obs, params), state

    def _step(self, state: EnvState, action: jax.Array, params: EnvParams) -> tuple[Any, Outcome]:
        out = dynamics.transition(state, action, params)
        return self._observed(dynamics.observe(out.state, params), params), out

    def _step_on(
        self, key: jax.Array, state: EnvState, action: jax.Array, params: EnvParams
    ) -> tuple[EnvState, Any]:
        """With an automatic reset: the state, and all that the host is told."""
        obs, state, *outcome, info = dynamics.step(key, state, action, params)
        final = self._observed(info["final_observation"], params)
        about = {name: info[name] for name in ("success", "length", "shortest")}
        return state, (self._observed(obs, params), outcome, final, about)

    def _observed(self, obs: Observation, params: EnvParams) -> Any:
        if self.flat is not None:
            return self.flat.flatten(obs, params)
        return {
            "classes": obs.classes,
            "boxes": jnp.minimum(obs.boxes, 1.0),
            "mask": obs.mask.astype(jnp.int8),
            "target": obs.target,
        }


_shared = functools.lru_cache(maxsize=4)(_Shown)


class NavigationEnv(gymnasium.Env):
    """One episode at a time.

    Args:
      name: of an environment, as `tdanet_jax.make` takes it: "ithor-14/8"; by default, that of the
        configuration's split.
      split: "train" or "test" rooms.
      flat: observations are vectors with word vectors filled in (`FlatObservations`), or else
        dictionaries: class indices, boxes, mask and target, without further sensors.
      config: what else can be set, as `tdanet_jax.make` takes it.

    Raises:
      ValueError: no environment has this name; by `step`: no action has this number, or there is
        not one for each episode.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 (Gymnasium's own form)

    def __init__(
        self,
        name: str | None = None,
        split: Literal["train", "test"] = "train",
        flat: bool = True,
        config: TrainConfig | None = None,
    ) -> None:
        self._shown = _shared(name, split, flat, config)
        self.observation_space = self._shown.space
        self.action_space = spaces.Discrete(NUM_ACTIONS)
        self._state: EnvState | None = None

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes that observations without word vectors hold by index."""
        return self._shown.env.class_names

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts a random episode: (observation, info with the target's name)."""
        super().reset(seed=seed, options=options)
        key = jax.random.key(int(self.np_random.integers(2**31)))
        obs, self._state = self._shown.reset(key, self._shown.params)
        return self._shown_to_user(obs), self._about(self._state)

    def step(self, action: int) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """One action; `info` holds the target's name, `success`, `length` and `shortest`."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        taken = _checked(action, ())
        obs, out = self._shown.step(self._state, taken, self._shown.params)
        out = jax.device_get(out)
        self._state = out.state
        info = self._about(out.state) | {"success": bool(out.success)}
        return (
            self._shown_to_user(obs),
            float(out.reward),
            bool(out.terminated),
            bool(out.truncated),
            info,
        )

    def _shown_to_user(self, obs: Any) -> Any:
        if isinstance(obs, dict):  # Gymnasium wants a number, not an array
            return _on_host(obs) | {"target": int(obs["target"])}
        return _on_host(obs)

    def _about(self, state: EnvState) -> dict[str, Any]:
        params = self._shown.params
        target = self.class_names[int(params.target_class[int(state.target)])]
        return {
            "target": target,
            "length": int(state.steps),
            "shortest": int(state.shortest),
        }


class NavigationVectorEnv(VectorEnv):
    """Many episodes side by side, in one compiled call; arguments as of `NavigationEnv`.

    An episode that ends is followed by the first observation of another in the same step.
    `info["final_obs"]` and `info["final_info"]` hold the last ones, where `info["_final_obs"]`.
    """

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        name: str | None = None,
        split: Literal["train", "test"] = "train",
        flat: bool = True,
        config: TrainConfig | None = None,
    ) -> None:
        shown = self._shown = _shared(name, split, flat, config)
        self.num_envs = num_envs
        self.single_observation_space = shown.space
        self.single_action_space = spaces.Discrete(NUM_ACTIONS)
        self.observation_space = batch_space(shown.space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._state: EnvState | None = None

    @property
    def class_names(self) -> tuple[str, ...]:
        """Names of the classes that observations without word vectors hold by index."""
        return self._shown.env.class_names

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Starts `num_envs` random episodes: (observations, info)."""
        super().reset(seed=seed, options=options)
        obs, self._state = self._shown.reset_many(self._keys(), self._shown.params)
        return _on_host(obs), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[Any, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One action [num_envs] in each episode."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() before step()")
        taken = _checked(actions, (self.num_envs,))
        step = self._shown.step_many
        self._state, told = step(self._keys(), self._state, taken, self._shown.params)
        obs, (reward, terminated, truncated), final, about = _on_host(told)
        done = terminated | truncated
        info = {
            **about,
            "final_obs": final,
            "_final_obs": done,
            "final_info": about,
            "_final_info": done,
        }
        return obs, reward, terminated, truncated, info

    def _keys(self) -> jax.Array:
        key = jax.random.key(int(self.np_random.integers(2**31)))
        return jax.random.split(key, self.num_envs)


def _on_host(arrays: Any) -> Any:
    """The same in NumPy arrays that may be written to, as PyTorch and many wrappers expect."""
    return jax.tree.map(np.array, arrays)


def _checked(actions: Any, shape: tuple[int, ...]) -> jax.Array:
    """The actions in JAX, if there are as many as there should be and each of them exists."""
    given = np.asarray(actions)
    if given.shape != shape:
        raise ValueError(f"actions of shape {given.shape}: must have shape {shape}")
    for action in given.ravel().tolist():
        if action not in range(NUM_ACTIONS):  # a fraction is not
            raise ValueError(f"action {action}: must be a whole number from 0 to {NUM_ACTIONS - 1}")
    return jnp.asarray(given, jnp.int32)


for _split in UNSEEN:
    gymnasium.register(
        f"tdanet/iTHOR-{file_name(_split)}-v{VERSION}",
        entry_point=f"{__name__}:NavigationEnv",
        vector_entry_point=f"{__name__}:NavigationVectorEnv",
        kwargs={"name": f"ithor-{_split}"},
    )
