"""The one error that malformed scenes and broken scene files raise."""


class SceneError(ValueError):
    """A scene breaks a rule; the message is one line naming scene, object and rule."""
