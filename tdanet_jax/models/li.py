"""Our reading of Li et al. (2022): MJOLNIR-o that adapts while it acts.

Li, Guo, Zhang and Luo, "Context vector-based visual mapless navigation in indoor using hierarchical
semantic information and meta-learning", Complex & Intelligent Systems 2022. The ideas are those of
the title: a context vector describes what a frame shows of a hierarchy of objects, and the policy
keeps learning in tests. We know of no published code, and had no equation or layer size of the
article.

So the parts are those of the works that it builds on. Context vector and relations are MJOLNIR-o's
(`tdanet_jax.models.mjolnir`, Qiu et al. 2020), the adaptation is SAVN's (`shared.adaptation`,
Wortsman et al. 2019). All environments share the relations: neither the adjacency nor the graph
convolutions adapt. The linear layer after the graph adapts if it has at most 65,536 weights, and so
do the embedding of the previous action, the LSTM and the actor.
"""

from __future__ import annotations

from typing import Any

from tdanet_jax.config import NetworkConfig
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.mjolnir import MjolnirOEncoder
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic, make_adaptive


def make(config: NetworkConfig, classes: ClassVocabulary, dtype: Any) -> AdaptiveActorCritic:
    """The model, in float32 whatever `dtype` says."""
    return make_adaptive(config, MjolnirOEncoder(classes=classes, features=config.width))
