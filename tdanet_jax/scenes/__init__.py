"""Rooms: their objects and reachable points, and the tables that an agent's world is made of."""

from __future__ import annotations

from tdanet_jax.scenes.cache import load_tables
from tdanet_jax.scenes.errors import SceneError
from tdanet_jax.scenes.tables import SceneTables

__all__ = ["SceneError", "SceneTables", "load_tables"]
