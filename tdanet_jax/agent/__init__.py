"""A trained agent on its own: detections in, actions out."""

from tdanet_jax.agent.agent import Agent, AgentState, Decision, Detection, load

__all__ = ["Agent", "AgentState", "Decision", "Detection", "load"]
