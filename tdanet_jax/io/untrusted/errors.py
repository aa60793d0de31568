"""The one error that broken or hostile files raise."""

from __future__ import annotations

LONGEST = 200  # characters of a reason; what a library says of a broken file may be endless


class FileError(ValueError):
    """A file is not what it should be; the message is one line: the file, then the reason."""

    def __init__(self, path: object, reason: object) -> None:
        plain = " ".join(str(reason).split())
        plain = plain if len(plain) <= LONGEST else plain[:LONGEST] + " ..."
        name = "".join(c if c.isprintable() else "?" for c in str(path))
        super().__init__(f"{name}: {''.join(c if c.isprintable() else '?' for c in plain)}")
