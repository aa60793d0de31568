"""The error that malformed scenes and scene files raise."""

from __future__ import annotations


class SceneError(ValueError):
    """A scene breaks a rule; the message is one line that names scene, object and rule."""

    def __init__(self, message: str) -> None:
        # Names come from files and may contain line breaks.
        super().__init__(" ".join(message.split()))
