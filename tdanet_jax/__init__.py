"""TDANet in JAX: zero-shot object-goal navigation in the iTHOR rooms, without Unity."""

__version__ = "0.1.0"
