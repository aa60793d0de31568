"""Tables computed from rooms: by hand, by any number of threads, and what is refused."""

from __future__ import annotations

import dataclasses

import pytest

from tdanet_jax.scenes import SceneError, tabulation
from tdanet_jax.scenes.visibility.rules import RULES
from tests.support import toy


def test_tables_do_not_depend_on_the_number_of_threads(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    versions = set()
    for workers in (1, 3):
        monkeypatch.setattr(tabulation, "MOST_WORKERS", workers)
        monkeypatch.setattr(tabulation.os, "cpu_count", lambda: 4)
        versions.add(tabulation.build(toy.random_rooms(2)).data_version)
    assert len(versions) == 1


def test_no_more_classes_than_can_be_numbered() -> None:
    names = [f"Thing{i}" for i in range(128)]
    things = [toy.thing(name, (0.0, toy.CAMERA, 2.0)) for name in names]
    with pytest.raises(SceneError, match="128 classes, more than 127"):
        tabulation.build([toy.room(toy.line(1), *things)])


def test_class_outside_the_vocabulary() -> None:
    with pytest.raises(SceneError, match=r"Corridor: Apple\|0: class Apple"):
        tabulation.build([toy.corridor()], classes=("Mug",))


def test_corridor_by_hand() -> None:
    t = tabulation.build([toy.corridor()], rules=dataclasses.replace(RULES, void=100.0))
    apple = t.targets.index("Apple")
    ahead = t.distance[::16, apple]  # heading 0, horizon 0, from every point
    assert ahead.tolist() == [3, 2, 1, 0, 0]
    assert t.distance[4 * 2, apple] == 4 + 3  # from the first point, looking back
    assert t.raster[0, 3, 3] == t.classes.index("Apple")
    assert (t.raster[4 * 2] == -1).all()


def test_a_room_in_which_nothing_is_seen() -> None:
    t = tabulation.build([toy.room(toy.line(1), toy.thing("Apple", (0.0, 3.9, 0.0)))])
    assert len(t.row_object) == 0
    assert (t.distance == -1).all()
    assert not t.visible_bits().any()
