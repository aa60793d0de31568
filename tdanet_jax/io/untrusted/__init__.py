"""Parsers for untrusted files: they return plain data, or fail with one line that says why."""

from __future__ import annotations

LONGEST = 200  # characters of a reason; a library may have much to say about a broken file


class FileError(ValueError):
    """A file is not valid; the message is one line: the file, then the reason."""

    def __init__(self, path: object, reason: object) -> None:
        plain = " ".join(str(reason).split())
        plain = plain if len(plain) <= LONGEST else plain[:LONGEST] + " ..."
        name = "".join(c if c.isprintable() else "?" for c in str(path))
        super().__init__(f"{name}: {''.join(c if c.isprintable() else '?' for c in plain)}")
