"""The environment: find an object of the target class in a room, as pure functions."""
