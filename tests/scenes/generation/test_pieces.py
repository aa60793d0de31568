"""Pieces: sizes from the catalogue, fronts, parts and levels from the known rooms."""

from __future__ import annotations

import numpy as np
import pytest

from tdanet_jax.scenes import placement
from tdanet_jax.scenes.generation import catalogue
from tdanet_jax.scenes.generation.catalogue import Catalogue
from tdanet_jax.scenes.generation.pieces import Library, box_of, yawed
from tests.scenes.test_placement import lying
from tests.support import toy


def library(turns: int = 0) -> Library:
    """Of a room with a dresser, which has a drawer at its front and a mug on it, turned."""
    dresser = toy.thing("Dresser", (0.0, 0.5, 0.0), (1.0, 1.0, 0.5))
    drawer = toy.thing("Drawer", (0.0, 0.7, 0.15), (0.8, 0.2, 0.2))
    mug = lying(toy.thing("Mug", (0.3, 1.05, 0.0), (0.1, 0.1, 0.1)), dresser, 0.0)
    items = [placement.turned(item, turns, np.zeros(3)) for item in (dresser, drawer, mug)]
    spots = [(0.0, 0.5), (0.25, 0.5), (0.0, 0.75), (1.0, 0.0)]
    for _ in range(turns):
        spots = [(z, -x) for x, z in spots]
    scene = toy.room(toy.points(*spots), *items)
    models = {"Dresser": np.array([(2.0, 0.8, 0.6)])}
    known = Catalogue(models, {"Dresser": (frozenset(),)}, {}, ())
    return Library([scene], known, placement.statistics([scene]))


@pytest.mark.parametrize("turns", range(4))
def test_a_model_has_the_parts_and_levels_of_what_it_is_like(turns: int) -> None:
    found = library(turns)
    piece = found.choose("Dresser", np.random.default_rng(0))
    assert piece.size.tolist() == [2.0, 0.8, 0.6]
    dresser, drawer = found.objects(piece, 1, np.random.default_rng(0))
    np.testing.assert_allclose(dresser.box, [(-1.0, 0.0, -0.3), (1.0, 0.8, 0.3)])
    np.testing.assert_allclose(drawer.box, [(-0.8, 0.48, 0.06), (0.8, 0.64, 0.3)], atol=1e-4)
    np.testing.assert_allclose(found.heights(piece), [0.8])
    assert (dresser.object_class, drawer.object_class) == ("Dresser", "Drawer")
    assert not dresser.pickupable


def test_a_class_without_models_has_the_sizes_of_the_known_rooms() -> None:
    piece = library().choose("Mug", np.random.default_rng(0))
    np.testing.assert_allclose(piece.size, 0.1)


def test_models_that_lie_in_the_catalogue_stand_as_in_rooms(known, generator) -> None:
    sizes = generator._library._sizes["TennisRacket"]
    assert (catalogue.load().sizes("TennisRacket", [s.name for s in known])[:, 1] < 0.1).all()
    assert (sizes[:, 1] > 0.5).all()


def test_what_is_turned_keeps_its_size_and_middle() -> None:
    item = toy.thing("Book", (1.0, 0.5, 2.0), (0.4, 0.1, 0.2))
    spun = yawed(item, 90.0)
    np.testing.assert_allclose(spun.box, [(0.9, 0.45, 1.8), (1.1, 0.55, 2.2)], atol=1e-4)
    spun = yawed(item, 30.0)
    assert spun.corners is not None
    edges = spun.corners[[1, 4, 3]] - spun.corners[0]
    np.testing.assert_allclose(np.sqrt((edges**2).sum(axis=1)), [0.4, 0.1, 0.2], atol=2e-4)
    np.testing.assert_allclose(spun.corners.mean(axis=0), (1.0, 0.5, 2.0), atol=1e-4)
    # Clockwise from above: +x turns towards -z.
    np.testing.assert_allclose(edges[0] / 0.4, (np.cos(np.pi / 6), 0, -0.5), atol=1e-3)
    assert spun.rotation == (0.0, 30.0, 0.0)
    assert yawed(item, 0.4) is item
    np.testing.assert_array_equal(box_of(np.array([2.0, 1.0, 4.0])), [(-1, 0, -2), (1, 1, 2)])
