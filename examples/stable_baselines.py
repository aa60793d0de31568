"""Stable-Baselines3 in the rooms of split 18/4: PPO, or with a memory, sb3-contrib's RecurrentPPO.

`pip install stable-baselines3 sb3-contrib -e '.[gymnasium]'`, then
`python examples/stable_baselines.py`: trains, and plays the test episodes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
import tyro
from gymnasium import spaces
from sb3_contrib import RecurrentPPO
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv, VecMonitor

import tdanet_jax
from tdanet_jax import TrainConfig
from tdanet_jax.env.gymnasium import NavigationVectorEnv
from tdanet_jax.evaluation import policies


@dataclass
class Args:
    """Trains in the rooms of a split, and plays its test episodes."""

    algorithm: Literal["PPO", "RecurrentPPO"] = "RecurrentPPO"
    """without a memory, or with one"""
    total_timesteps: int = 2_000_000
    """environment steps in all"""
    split: str = "18/4"
    """seen and unseen target classes"""
    validation: bool = False
    """train without the validation rooms and classes, and play the validation episodes"""
    seed: int = 0
    """of parameters, episodes and actions"""


class ManyEpisodes(VecEnv):
    """`NavigationVectorEnv` for Stable-Baselines3, which steps all episodes in one compiled call.

    `make_vec_env(NavigationEnv, n_envs=16)` works as well, but calls one environment after another.
    """

    def __init__(self, envs: NavigationVectorEnv) -> None:
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        """The first observations of new episodes."""
        obs, _ = self.envs.reset(seed=self._seeds[0])
        self._reset_seeds()
        return obs

    def step_async(self, actions: np.ndarray) -> None:
        """Keeps the actions for `step_wait`."""
        self._actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        """Takes them, and says about episodes that ended what Stable-Baselines3 asks for."""
        obs, reward, terminated, truncated, info = self.envs.step(self._actions)
        about: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for i in np.flatnonzero(terminated | truncated):
            about[i] = {
                "terminal_observation": info["final_obs"][i],
                "TimeLimit.truncated": bool(truncated[i]),
                "is_success": bool(info["success"][i]),
            }
        return obs, reward, terminated | truncated, about

    def close(self) -> None:
        """Closes the environment."""
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        """An attribute, the same for each episode."""
        return [getattr(self.envs, attr_name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        """Sets an attribute of all."""
        setattr(self.envs, attr_name, value)

    def env_method(self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any) -> Any:
        """There is no environment of a single episode to call."""
        raise NotImplementedError(method_name)

    def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> Sequence[bool]:
        """No episode is wrapped on its own."""
        return [False for _ in self._get_indices(indices)]


class Dense(BaseFeaturesExtractor):
    """A layer that makes the long vectors short, so that the LSTM after it is quick."""

    def __init__(self, observation_space: spaces.Box, features_dim: int = 256) -> None:
        super().__init__(observation_space, features_dim)
        self.layer = torch.nn.Linear(observation_space.shape[0], features_dim)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Features [B, features_dim] of vectors [B, size]."""
        return torch.relu(self.layer(obs))


def score(model: BaseAlgorithm, config: TrainConfig | None = None) -> dict[str, Any]:
    """The results of a trained model on the fixed test episodes; its actions are sampled."""
    memory: dict[str, Any] = {}

    def start(batch: int) -> None:
        memory.update(state=None, begun=np.ones(batch, bool))

    def predict(vectors: np.ndarray) -> np.ndarray:
        actions, memory["state"] = model.predict(vectors, memory["state"], memory["begun"])
        memory["begun"] = np.zeros(len(vectors), bool)
        return actions

    return tdanet_jax.evaluate(policy=policies.on_host(predict, start), config=config)


def main(args: Args) -> None:
    """Trains, and plays the test episodes."""
    config = TrainConfig(split=args.split, validation=args.validation)
    many = VecMonitor(ManyEpisodes(NavigationVectorEnv(64, f"ithor-{args.split}", config=config)))
    kind, policy, network = PPO, "MlpPolicy", {"features_extractor_class": Dense}
    if args.algorithm == "RecurrentPPO":  # actor and critic share an LSTM, as in the other examples
        kind, policy = RecurrentPPO, "MlpLstmPolicy"
        network |= {"shared_lstm": True, "enable_critic_lstm": False}
    model = kind(
        policy,
        many,
        learning_rate=5e-4,
        n_steps=32,
        batch_size=512,
        n_epochs=2,
        ent_coef=0.01,
        policy_kwargs=network,
        seed=args.seed,
        verbose=1,
    )
    model.learn(args.total_timesteps, log_interval=10)
    results = score(model, config)
    for group in ("seen", "unseen"):
        if results[group] is None:  # nothing is unseen in 22/0
            continue
        row = results[group]["L>=1"]
        print(f"{group}: SR {row['SR']:.1f}  SPL {row['SPL']:.1f}")


if __name__ == "__main__":
    main(tyro.cli(Args))
