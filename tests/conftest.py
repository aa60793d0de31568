"""Fixtures that many tests share; the real rooms' tables are loaded once per session."""

from __future__ import annotations

import os
import tempfile

import jax
import pytest
from hypothesis import settings

from tdanet_jax import words
from tdanet_jax.scenes import SceneTables, load_tables
from tdanet_jax.words import WordVectors

# No deadline: tests do not time anything. Derandomised: the same examples on every run.
settings.register_profile("tests", deadline=None, derandomize=True, database=None)
settings.load_profile("tests")

# What one test or command has compiled, the next one need not: for this session alone.
_compiled = tempfile.TemporaryDirectory(prefix="tdanet-compiled-")
for _name, _value in {
    "jax_compilation_cache_dir": _compiled.name,
    "jax_persistent_cache_min_compile_time_secs": 0.5,
}.items():
    jax.config.update(_name, _value)
    os.environ[_name.upper()] = str(_value)  # for the commands that tests start

#: Two rooms of each type. Parts of FloorPlan29, 204 and 229 cannot be reached from the others.
SOME_ROOMS = (
    "FloorPlan7", "FloorPlan29", "FloorPlan204", "FloorPlan229", "FloorPlan303", "FloorPlan321",
    "FloorPlan402", "FloorPlan428",
)  # fmt: skip


@pytest.fixture(scope="session")
def ithor() -> SceneTables:
    """The tables of all 120 rooms."""
    return load_tables()


@pytest.fixture(scope="session")
def some_rooms(ithor: SceneTables) -> SceneTables:
    """The tables of eight rooms, two of each type."""
    return ithor.subset(SOME_ROOMS)


@pytest.fixture(scope="session")
def glove() -> WordVectors:
    """The bundled word vectors."""
    return words.load_bundled()
