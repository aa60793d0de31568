"""Reading files that nobody vouches for: plain data or one line that says what is wrong."""

from __future__ import annotations

from tdanet_jax.io.untrusted.errors import FileError

__all__ = ["FileError"]
