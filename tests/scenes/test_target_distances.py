"""Distances to targets that the tables do not have are those that tables with them have."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import dijkstra

from tdanet_jax.scenes import SceneTables, cache, tabulation, target_distances
from tdanet_jax.scenes.target_distances import distances, with_targets
from tdanet_jax.scenes.visibility.geometry import transitions
from tdanet_jax.scenes.visibility.rules import RULES
from tests.support import toy


def test_the_same_as_tables_that_are_built_with_these_targets() -> None:
    scenes = toy.random_rooms(3)
    classes = sorted({item.object_class for scene in scenes for item in scene.objects})
    built = tabulation.build(scenes, targets=("Mug", *classes[::-1]))
    found = with_targets(tabulation.build(scenes, targets=("Mug",)), ("Mug", *classes[::-1]))
    assert found.targets == ("Mug", *(name for name in classes[::-1] if name != "Mug"))
    order = [built.targets.index(name) for name in found.targets]
    np.testing.assert_array_equal(found.distance, built.distance[:, order])
    assert found.distance.dtype == built.distance.dtype


def test_the_papers_targets_come_out_as_they_are_bundled(
    some_rooms: SceneTables, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(target_distances, "TOGETHER", 5)
    np.testing.assert_array_equal(distances(some_rooms, some_rooms.targets), some_rooms.distance)
    assert with_targets(some_rooms, some_rooms.targets[::-1]) is some_rooms


def test_a_kettle_against_a_general_search(some_rooms: SceneTables) -> None:
    tables = some_rooms.subset(["FloorPlan7"])
    successor = transitions(tables.next_position)
    tail = np.repeat(np.arange(tables.num_states), successor.shape[1])
    backward = coo_array((np.ones(len(tail)), (successor.reshape(-1), tail)))
    for name in ("Kettle", "Floor" if "Floor" in tables.classes else "Window"):
        shown = tables.row_visible & (tables.row_class == tables.classes.index(name))
        goals = np.unique(tables.row_state[shown])
        expected = dijkstra(backward.tocsr(), unweighted=True, indices=goals, min_only=True)
        expected[np.isinf(expected)] = -1
        np.testing.assert_array_equal(distances(tables, [name])[:, 0], expected)
        assert goals.size


def test_many_distances_are_kept_by_their_content(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path))
    monkeypatch.setattr(target_distances, "KEPT", 0)
    seen = dataclasses.replace(RULES, void=100.0)
    tables = tabulation.build([toy.corridor()], targets=(), rules=seen)
    first = with_targets(tables, ["Apple"])
    [path] = tmp_path.glob("distances-*.npz")
    changed = dataclasses.replace(tables, next_position=tables.next_position.copy())
    changed.next_position[:] = np.arange(5)[:, None]  # nothing leads anywhere
    other = with_targets(changed, ["Apple"])
    assert (other.distance != first.distance).any()
    assert len([*tmp_path.glob("distances-*.npz")]) == 2
    monkeypatch.setattr(target_distances, "distances", lambda *_: pytest.fail("computed again"))
    np.testing.assert_array_equal(with_targets(tables, ["Apple"]).distance, first.distance)
    path.write_bytes(b"damaged")
    with pytest.warns(UserWarning, match="damaged"), pytest.raises(pytest.fail.Exception):
        with_targets(tables, ["Apple"])
