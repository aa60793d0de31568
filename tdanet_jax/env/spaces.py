"""Spaces of actions and observations, for code that is written against gymnax.

`tdanet_jax.env.gymnasium` has those of Gymnasium.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jax.typing import DTypeLike


@dataclasses.dataclass(frozen=True)
class Discrete:
    """The integers from 0 to `n` - 1."""

    n: int
    dtype: DTypeLike = jnp.int32

    @property
    def shape(self) -> tuple[int, ...]:
        """Of one value: ()."""
        return ()

    def sample(self, key: jax.Array) -> jax.Array:
        """A uniform value."""
        return jax.random.randint(key, (), 0, self.n, self.dtype)

    def contains(self, x: jax.Array) -> jax.Array:
        """Whether `x` is one of its values: bool."""
        return (jnp.asarray(x) >= 0) & (jnp.asarray(x) < self.n)


@dataclasses.dataclass(frozen=True)
class Box:
    """Arrays of a shape with all values from `low` to `high`."""

    low: float
    high: float
    shape: tuple[int, ...]
    dtype: DTypeLike = jnp.float32

    def sample(self, key: jax.Array) -> jax.Array:
        """A uniform value; where there are no bounds, a normal one."""
        if jnp.isinf(self.low) or jnp.isinf(self.high):
            return jax.random.normal(key, self.shape).astype(self.dtype)
        if jnp.issubdtype(self.dtype, jnp.integer):
            return jax.random.randint(key, self.shape, self.low, self.high + 1, self.dtype)
        if jnp.issubdtype(self.dtype, jnp.bool_):
            return jax.random.bernoulli(key, shape=self.shape)
        drawn = jax.random.uniform(key, self.shape, minval=self.low, maxval=self.high)
        return drawn.astype(self.dtype)

    def contains(self, x: jax.Array) -> jax.Array:
        """Whether all of `x` lies within the bounds: bool."""
        return jnp.all((jnp.asarray(x) >= self.low) & (jnp.asarray(x) <= self.high))


@dataclasses.dataclass(frozen=True)
class Dict:
    """Spaces by name: of a structure's fields, or of a mapping's values."""

    spaces: Mapping[str, Discrete | Box | Dict]

    def sample(self, key: jax.Array) -> dict[str, object]:
        """A value of each space."""
        keys = jax.random.split(key, len(self.spaces))
        pairs = zip(self.spaces.items(), keys, strict=True)
        return {name: space.sample(key) for (name, space), key in pairs}

    def contains(self, x: object) -> jax.Array:
        """Whether each part of `x` lies in its space: bool."""
        parts = x if isinstance(x, Mapping) else vars(x)
        return jnp.all(
            jnp.stack([space.contains(parts[name]) for name, space in self.spaces.items()])
        )
