"""Floor plans: every object's outline, oriented where that is known."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from tdanet_jax.scenes import SceneError, floor_plan, tabulation
from tests.support import toy


def test_outlines_of_the_boxes_in_a_custom_room():
    mug = toy.thing("Mug", (1.0, 1.0, 2.0), (0.2, 0.1, 0.4))
    sofa = toy.thing("Sofa", (-1.0, 0.5, 0.0), (1.0, 1.0, 2.0))
    built = tabulation.build([toy.room(toy.line(3), mug, sofa)])
    plan = floor_plan.of_room(built, "Toy")
    assert plan.classes == ("Sofa", "Mug")  # largest first
    np.testing.assert_allclose(plan.outlines[1].min(axis=0), (0.9, 1.8))
    np.testing.assert_allclose(plan.outlines[1].max(axis=0), (1.1, 2.2))
    assert floor_plan.area(plan.outlines[0]) == pytest.approx(2.0)
    np.testing.assert_allclose(plan.points, [(0, 0), (0, 0.25), (0, 0.5)])
    np.testing.assert_allclose(plan.extent, (-1.625, -1.125, 1.225, 2.325))


def test_objects_without_a_box_are_left_out():
    built = tabulation.build([toy.corridor()])
    boxes = np.full_like(built.object_box, np.nan)
    plan = floor_plan.of_room(dataclasses.replace(built, object_box=boxes), "Corridor")
    assert plan.classes == ()
    np.testing.assert_allclose(plan.extent, (-0.125, -0.125, 0.125, 1.125))


def test_bundled_rooms_have_oriented_outlines_where_their_boxes_are(ithor):
    plan = floor_plan.of_room(ithor, "FloorPlan228")
    own = ithor.object_scene == ithor.scenes.index("FloorPlan228")
    assert sorted(plan.classes) == sorted(ithor.classes[c] for c in ithor.object_class[own])
    slanted = 0
    boxes, kinds = ithor.object_box[own], ithor.object_class[own]
    for name, outline in zip(plan.classes, plan.outlines, strict=True):
        low, high = outline.min(axis=0), outline.max(axis=0)
        alike = boxes[kinds == ithor.classes.index(name)]
        away = (alike[:, [0, 2]] + alike[:, [3, 5]]) / 2 - outline.mean(axis=0)
        assert np.linalg.norm(away, axis=1).min() < 0.3, name
        slanted += floor_plan.area(outline) < 0.95 * np.prod(high - low)
    assert slanted > 3


def test_no_such_room(ithor):
    with pytest.raises(SceneError, match="Attic: no such room"):
        floor_plan.of_room(ithor, "Attic")
