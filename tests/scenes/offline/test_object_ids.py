"""Ids of objects: told from classes, and read for class and place."""

from __future__ import annotations

import numpy as np
import pytest

from tdanet_jax.scenes.offline import object_ids


@pytest.mark.parametrize(
    ("name", "kind"),
    [("Mug|+00.10|+00.93|-01.20", "Mug"), ("Sink|+00.10|+00.93|-01.20|SinkBasin", "SinkBasin"),
     ("Apple|+00.10|+00.93|-01.20|AppleSliced_3", "AppleSliced"), ("Cabinet|1|2", "Cabinet"),
     ("Cup|surface|2|+01.00|7", "Cup")],
)  # fmt: skip
def test_classes_in_ids(name: str, kind: str) -> None:
    assert object_ids.is_id(name)
    assert object_ids.class_of(name) == kind


@pytest.mark.parametrize("name", ["Mug", "coffee machine", "Mug_1a2b", "Mug|", "|1|2", "a||b", ""])
def test_what_is_no_id(name: str) -> None:
    assert not object_ids.is_id(name)


def test_places_in_ids() -> None:
    place = object_ids.place_in("Sink|+00.10|+00.93|-01.20|SinkBasin")
    assert place.tolist() == [[0.10, 0.93, -1.20]] * 2
    for name in ("Cabinet|1|2", "Apple|a|b|c", "Mug|1|2|1e9", "Mug|nan|0|0",
                 "Sofa|3|0|1", "Mug|00.10|00.93|01.20", "Mug|+0.1|+0.9|-9999.0"):  # fmt: skip
        assert np.isnan(object_ids.place_in(name)).all()
