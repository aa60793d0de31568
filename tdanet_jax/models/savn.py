"""SAVN: the baseline that adapts while it acts (Wortsman et al. 2019)."""

from __future__ import annotations

from typing import Any

from tdanet_jax.classes import Classes
from tdanet_jax.config import NetworkConfig
from tdanet_jax.models.adaptation import AdaptiveActorCritic
from tdanet_jax.models.baseline import BaselineEncoder


def make(config: NetworkConfig, classes: Classes, dtype: Any) -> AdaptiveActorCritic:
    """SAVN."""
    # The encoder's products are small, and batched by step where its gradient is taken: XLA's CPU
    # backend does not take all such products in bfloat16. The LSTM's are in `dtype`.
    encoder = BaselineEncoder(dropout=config.dropout, maps=config.image == "features")
    return AdaptiveActorCritic(
        encoder,
        hidden=config.hidden,
        dtype=dtype,
        rate=config.inner_rate,
        first_order=config.first_order,
    )
