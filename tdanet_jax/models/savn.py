"""SAVN: the baseline that adapts while it acts (Wortsman et al. 2019)."""

from __future__ import annotations

from typing import Any

from tdanet_jax.config import NetworkConfig
from tdanet_jax.models.baseline import BaselineEncoder
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic, make_adaptive


def make(config: NetworkConfig, classes: ClassVocabulary, dtype: Any) -> AdaptiveActorCritic:
    """SAVN, in float32 whatever `dtype` says."""
    encoder = BaselineEncoder(dropout=config.dropout, maps=config.image == "features")
    return make_adaptive(config, encoder)
