"""Parsers for untrusted files: they return plain data, or fail with one line that says why."""

from __future__ import annotations

from tdanet_jax.io.escaping import in_line

LONGEST = 260  # characters of a reason; a library may have much to say about a broken file


class FileError(ValueError):
    """A file is not valid; the message is one line: the file, then the reason."""

    def __init__(self, path: object, reason: object) -> None:
        super().__init__(f"{in_line(path)}: {in_line(reason, LONGEST)}")
