"""Parsers for untrusted files: they return plain data, or fail with one line that says why."""

from __future__ import annotations

from tdanet_jax.io.untrusted.errors import FileError

__all__ = ["FileError"]
