"""The part of tdanet_jax that a robot needs: NumPy alone, Python 3.10 or newer.

`tdanet export` copies it, and the modules that it imports, next to the agent. There it is called
`tdanet_jax`, so that a robot's program is the same with JAX and without.
"""

from __future__ import annotations

from tdanet_jax.agent.base import Decision
from tdanet_jax.agent.camera import Camera
from tdanet_jax.agent.detection import Detection
from tdanet_jax.agent.navigator import Navigator, NavigatorConfig
from tdanet_jax.agent.numpy_agent import AgentState, load
from tdanet_jax.agent.numpy_agent import NumPyAgent as Agent
from tdanet_jax.decisions import Decisions

__all__ = [
    "Agent",
    "AgentState",
    "Camera",
    "Decision",
    "Decisions",
    "Detection",
    "Navigator",
    "NavigatorConfig",
    "load",
]
