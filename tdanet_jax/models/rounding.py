"""Kernels that layers round before a product, so that a rollout can round them once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from flax import linen as nn

#: The Flax collection in which layers say it: for each of these kernels, by its name, a scalar of
#: the dtype that it is rounded to. Empty unless it is asked for.
ROUNDED_TO = "rounded_to"


def declare(module: nn.Module, name: str, dtype: Any) -> None:
    """Says that a module rounds its parameter `name` to a dtype wherever it uses it."""
    if module.is_mutable_collection(ROUNDED_TO) and not module.is_initializing():
        module.put_variable(ROUNDED_TO, name, jnp.zeros((), dtype))


def rounded(weights: Mapping[str, Any], dtypes: Mapping[str, Any], above: int) -> dict[str, Any]:
    """The parameters, rounded as the collection says, if they have more numbers than `above`."""

    def cast(x: Any, declared: Any) -> Any:
        if isinstance(x, Mapping):
            return rounded(x, declared or {}, above)
        return x if declared is None or x.size <= above else x.astype(declared.dtype)

    return {name: cast(x, dtypes.get(name)) for name, x in weights.items()}
