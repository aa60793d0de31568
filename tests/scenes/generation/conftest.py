"""The training rooms that generated rooms are like, and some generated rooms."""

from __future__ import annotations

import pytest

from tdanet_jax.scenes import ithor
from tdanet_jax.scenes.generation.rooms import Generator
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.splits import make_split


@pytest.fixture(scope="package")
def known() -> list[Scene]:
    """The training rooms."""
    train = make_split("22/0").train_scenes
    return [scene for scene in ithor.load_scenes() if scene.name in train]


@pytest.fixture(scope="package")
def generator(known: list[Scene]) -> Generator:
    return Generator(known)


@pytest.fixture(scope="package")
def rooms(generator: Generator) -> list[Scene]:
    """Three rooms of each type."""
    return [generator.room(number, 7) for number in range(1, 13)]
