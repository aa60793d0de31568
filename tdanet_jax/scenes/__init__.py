"""Rooms: objects and reachable points, and the scene tables that are computed from them."""

from __future__ import annotations

from tdanet_jax.scenes.cache import load_tables
from tdanet_jax.scenes.scene import SceneError
from tdanet_jax.scenes.tables import SceneTables

__all__ = ["SceneError", "SceneTables", "load_tables"]
