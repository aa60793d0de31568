"""TDANet in JAX: zero-shot object-goal navigation in the iTHOR rooms, without Unity.

`make` an environment, `train` a run, `evaluate` it, `load` its agent. Importing the package is
quick: everything heavy is imported when it is first used.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from tdanet_jax import _moved

if TYPE_CHECKING:
    from tdanet_jax.agent import (
        Agent,
        Camera,
        Decision,
        Detection,
        Navigator,
        NavigatorConfig,
        load,
    )
    from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
    from tdanet_jax.decisions import Decisions
    from tdanet_jax.eval_config import EvalConfig
    from tdanet_jax.task import make
    from tdanet_jax.training.callbacks import Callbacks
    from tdanet_jax.workflows.evaluate import evaluate
    from tdanet_jax.workflows.export import export
    from tdanet_jax.workflows.train import train

__version__ = "0.2.0"

#: Public names, and the module that each is in.
_PUBLIC = {
    "Agent": "agent",
    "Callbacks": "training.callbacks",
    "Camera": "agent",
    "Decision": "agent",
    "Decisions": "decisions",
    "Detection": "agent",
    "EvalConfig": "eval_config",
    "LearnerConfig": "config",
    "Navigator": "agent",
    "NavigatorConfig": "agent",
    "NetworkConfig": "config",
    "TrainConfig": "config",
    "evaluate": "workflows.evaluate",
    "export": "workflows.export",
    "load": "agent",
    "make": "task",
    "train": "workflows.train",
}

__all__ = [
    "Agent",
    "Callbacks",
    "Camera",
    "Decision",
    "Decisions",
    "Detection",
    "EvalConfig",
    "LearnerConfig",
    "Navigator",
    "NavigatorConfig",
    "NetworkConfig",
    "TrainConfig",
    "__version__",
    "evaluate",
    "export",
    "load",
    "make",
    "train",
]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"tdanet_jax.{_PUBLIC[name]}"), name)
    return _moved.attribute(name)


def __dir__() -> list[str]:
    return sorted({*globals(), *_PUBLIC})
