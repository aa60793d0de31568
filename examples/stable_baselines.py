"""Stable-Baselines3 in the rooms of split 18/4: PPO, or with a memory, sb3-contrib's RecurrentPPO.

`pip install stable-baselines3 sb3-contrib`, then `python examples/stable_baselines.py`.
"""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from sb3_contrib import RecurrentPPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.env_util import make_vec_env

import tdanet_jax
from tdanet_jax.config import TrainConfig
from tdanet_jax.env.environment import FlatObservations
from tdanet_jax.env.gymnasium import NavigationEnv
from tdanet_jax.evaluation import policies


def score(model: BaseAlgorithm, config: TrainConfig | None = None) -> dict[str, Any]:
    """The results of a trained model on the fixed test episodes; its actions are sampled."""
    memory: dict[str, Any] = {}

    def start(batch: int) -> None:
        memory.update(state=None, begun=np.ones(batch, bool))

    def predict(vectors: np.ndarray) -> np.ndarray:
        actions, memory["state"] = model.predict(vectors, memory["state"], memory["begun"])
        memory["begun"] = np.zeros(len(vectors), bool)
        return actions

    test = FlatObservations(tdanet_jax.make("ithor-18/4", "test", config)[0])
    policy = policies.on_host(test, predict, start)
    return tdanet_jax.evaluate(policy=policy, config=config)


def main(steps: int = 1_000_000) -> None:
    """Trains, and plays the test episodes."""
    many = make_vec_env(NavigationEnv, n_envs=16, env_kwargs={"name": "ithor-18/4"})
    model = RecurrentPPO("MlpLstmPolicy", many, n_steps=64, batch_size=256, verbose=1)
    model.learn(steps)
    results = score(model)
    for group in ("seen", "unseen"):
        row = results[group]["L>=1"]
        print(f"{group}: SR {row['SR']:.1f}  SPL {row['SPL']:.1f}")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
