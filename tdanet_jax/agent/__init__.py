"""A trained agent on its own: detections in, actions out.

Names are imported when they are first used: detections and cameras need no JAX.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tdanet_jax.agent.agent import Agent, AgentState, load
    from tdanet_jax.agent.base import Decision
    from tdanet_jax.agent.camera import Camera
    from tdanet_jax.agent.detection import Detection
    from tdanet_jax.agent.navigator import Navigator, NavigatorConfig

#: Public names, and the module that each is in.
_MODULES = {
    "Agent": "agent",
    "AgentState": "agent",
    "Camera": "camera",
    "Decision": "base",
    "Detection": "detection",
    "Navigator": "navigator",
    "NavigatorConfig": "navigator",
    "load": "agent",
}

__all__ = [
    "Agent",
    "AgentState",
    "Camera",
    "Decision",
    "Detection",
    "Navigator",
    "NavigatorConfig",
    "load",
]


def __getattr__(name: str) -> Any:
    if name in _MODULES:
        return getattr(importlib.import_module(f"tdanet_jax.agent.{_MODULES[name]}"), name)
    raise AttributeError(f"tdanet_jax.agent has no {name}")
