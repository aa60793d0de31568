"""TDANet in JAX: zero-shot object-goal navigation in the iTHOR rooms, without Unity."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from tdanet_jax.agent.agent import Agent

__version__ = "0.1.0"


def load(run: Path | str) -> Agent:
    """The trained agent of a run's folder; see `tdanet_jax.agent.agent.load`."""
    from tdanet_jax.agent import agent  # here, so that importing the package stays quick

    return agent.load(run)
