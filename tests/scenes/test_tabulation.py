"""Tables computed from rooms: by hand, by any number of threads, and what is refused."""

from __future__ import annotations

import dataclasses
import tracemalloc

import numpy as np
import pytest

from tdanet_jax.scenes import SceneError, tabulation
from tdanet_jax.scenes.visibility.rules import RULES
from tdanet_jax.scenes.visibility.solids import near_any
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


def test_painting_in_batches_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    low = rng.integers(0, 4000, (300, 2))
    box = np.concatenate([low, low + rng.integers(0, 800, (300, 2))], axis=1).astype(np.int16)
    state, label = np.sort(rng.integers(0, 40, 300)), rng.integers(0, 100, 300)
    whole = tabulation.paint(state, box, label, 41, 4800)
    assert len(np.unique(whole)) > 50
    for size in (1, 7, 64, 299):
        monkeypatch.setattr(tabulation, "BOXES", size)
        np.testing.assert_array_equal(tabulation.paint(state, box, label, 41, 4800), whole)
    none = np.zeros(0, np.int64)
    assert (tabulation.paint(none, np.zeros((0, 4)), none, 2, 4800) == -1).all()


@pytest.mark.parametrize(
    ("budget", "reason"), [("patches=10", r"\d+ patches up to object Apple\|0, more than 10"),
                           ("tests=10", r"\d+ pairs of a line of sight and a box, more than 10")],
)  # fmt: skip
def test_rooms_beyond_a_budget_are_refused_before_they_are_computed(
    monkeypatch: pytest.MonkeyPatch, budget: str, reason: str
) -> None:
    monkeypatch.setenv("TDANET_BUDGETS", budget)
    with pytest.raises(SceneError, match=f"Corridor: {reason}; .* TDANET_BUDGETS"):
        tabulation.build([toy.corridor()])


def test_progress_ends_with_all_rooms() -> None:
    shown: list[tuple[float, int]] = []
    tabulation.build(toy.random_rooms(2)[:3], progress=lambda *pair: shown.append(pair))
    assert shown == sorted(shown)
    assert shown[-1] == (3, 3)


def test_a_huge_object_takes_little_memory() -> None:
    room = toy.room(toy.line(4), toy.thing("Sofa", (0.0, 1.0, 2.0), (900.0, 1.0, 1.0)))
    tracemalloc.start()
    tabulation.build([room])
    assert tracemalloc.get_traced_memory()[1] < 200 << 20
    tracemalloc.stop()


def test_a_carved_object_among_many_points_takes_little_memory() -> None:
    places = np.zeros((20_000, 3))
    tracemalloc.start()
    assert near_any(np.zeros((4096, 3)), places, 0.1).all()
    assert tracemalloc.get_traced_memory()[1] < 400 << 20
    tracemalloc.stop()
