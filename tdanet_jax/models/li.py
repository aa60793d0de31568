"""The model of Li et al. (2022) in our reading: MJOLNIR-o that adapts while it acts.

Li, Guo, Zhang and Luo, "Context vector-based visual mapless navigation in indoor using hierarchical
semantic information and meta-learning", Complex & Intelligent Systems 2022. The published ideas are
those of the title: a context vector holds what a frame shows of a hierarchy of objects, and the
policy goes on learning in tests. We know of no published code, and had no equation or layer of the
article at hand.

So the parts are those of the works that it builds on. Context vector and relations are MJOLNIR-o's
(`tdanet_jax.models.mjolnir`, Qiu et al. 2020), the adaptation is SAVN's (`adaptation`, Wortsman et
al. 2019). The relations are shared by all environments: neither the adjacency nor the graph
convolutions adapt. What adapts is the linear layer behind the graph, if it has at most 65,536
weights, the embedding of the previous action, the LSTM and the actor.
"""

from __future__ import annotations

from typing import Any

from tdanet_jax.config import NetworkConfig
from tdanet_jax.models.classes import Classes
from tdanet_jax.models.mjolnir import MjolnirOEncoder
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic


def make(config: NetworkConfig, classes: Classes, dtype: Any) -> AdaptiveActorCritic:
    """The model. It multiplies in float32, whatever `dtype` says, as SAVN does."""
    return AdaptiveActorCritic(
        MjolnirOEncoder(classes=classes, features=config.width),
        hidden=config.hidden,
        rate=config.inner_rate,
        first_order=config.first_order,
    )
