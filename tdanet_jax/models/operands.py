"""Which kernels a network rounds before it multiplies; whoever acts for long rounds them once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
from flax import linen as nn

#: The Flax collection in which layers say it: for each of these kernels, by its name, a scalar of
#: the dtype that it is rounded to. Empty unless it is asked for.
OPERANDS = "operands"


def declare(module: nn.Module, name: str, dtype: Any) -> None:
    """Says that a module rounds its parameter `name` to a dtype wherever it uses it."""
    if module.is_mutable_collection(OPERANDS) and not module.is_initializing():
        module.put_variable(OPERANDS, name, jnp.zeros((), dtype))


def rounded(weights: Mapping[str, Any], operands: Mapping[str, Any], least: int) -> dict[str, Any]:
    """The parameters with the kernels in `operands` of more than `least` numbers in its dtypes."""

    def cast(x: Any, operand: Any) -> Any:
        if isinstance(x, Mapping):
            return rounded(x, operand or {}, least)
        return x if operand is None or x.size <= least else x.astype(operand.dtype)

    return {name: cast(x, operands.get(name)) for name, x in weights.items()}
