"""SAVN: the baseline that adapts while it acts (Wortsman et al. 2019)."""

from __future__ import annotations

from typing import Any

from tdanet_jax.config import NetworkConfig
from tdanet_jax.models.baseline import BaselineEncoder
from tdanet_jax.models.classes import Classes
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic


def make(config: NetworkConfig, classes: Classes, dtype: Any) -> AdaptiveActorCritic:
    """SAVN. It multiplies in float32, whatever `dtype` says.

    At some sizes XLA's CPU backend compiles its bfloat16 products and then refuses to run them.
    """
    return AdaptiveActorCritic(
        BaselineEncoder(dropout=config.dropout, maps=config.image == "features"),
        hidden=config.hidden,
        rate=config.inner_rate,
        first_order=config.first_order,
    )
