"""The collector with a fake controller."""

from __future__ import annotations

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneError, collect, metadata
from tests.scenes.test_metadata import DOCUMENT


class FakeController:
    """Answers as AI2-THOR's controller does, with more fields than are needed."""

    def __init__(self, works: bool = True) -> None:
        self.works = works
        self.asked: list[Any] = []

    def reset(self, scene: str, gridSize: float) -> SimpleNamespace:
        self.asked.append((scene, gridSize))
        content = copy.deepcopy(DOCUMENT)
        records = [{**record, "mass": 1.0} for record in content["objects"]]
        return SimpleNamespace(metadata={"objects": records})

    def step(self, action: str) -> SimpleNamespace:
        self.asked.append(action)
        return SimpleNamespace(
            metadata={
                "lastActionSuccess": self.works,
                "errorMessage": "" if self.works else "broken",
                "actionReturn": DOCUMENT["reachable_positions"],
            }
        )


def test_what_is_collected_can_be_read(tmp_path: Path) -> None:
    controller = FakeController()
    documents = collect.collect(controller, [("FloorPlan1", "kitchen"), ("Mine", "bathroom")])
    assert controller.asked == [
        ("FloorPlan1", 0.25),
        "GetReachablePositions",
        ("Mine", 0.25),
        "GetReachablePositions",
    ]
    path = tmp_path / "scenes.json"
    path.write_text("an older file")
    collect.write_scenes(documents, path)
    first, second = metadata.read_scenes(path)
    assert (first.name, first.room_type) == ("FloorPlan1", "kitchen")
    assert (second.name, second.room_type) == ("Mine", "bathroom")
    assert len(first.objects) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["scenes.json"]


def test_another_grid_size_is_asked_for_and_noted(tmp_path: Path) -> None:
    controller = FakeController()
    documents = collect.collect(controller, [("Mine", "den")], grid_size=0.125)
    assert controller.asked[0] == ("Mine", 0.125)
    collect.write_scenes(documents, tmp_path / "scenes.json")
    [scene] = metadata.read_scenes(tmp_path / "scenes.json")
    assert scene.grid == PoseGrid(0.125)


def test_a_room_that_fails_costs_no_other() -> None:
    controller, rooms = FakeController(), [("A", "kitchen"), ("B", "kitchen"), ("C", "kitchen")]
    works = iter([True, False, True])
    step = controller.step

    def sometimes(action: str) -> SimpleNamespace:
        controller.works = next(works)
        return step(action)

    controller.step = sometimes  # type: ignore[method-assign]
    with pytest.warns(UserWarning, match="B: GetReachablePositions: broken; left out"):
        documents = collect.collect(controller, rooms)
    assert [document["name"] for document in documents] == ["A", "C"]


@pytest.mark.filterwarnings("ignore::UserWarning")
def test_a_failed_action() -> None:
    with pytest.raises(SceneError, match="FloorPlan1: GetReachablePositions: broken"):
        collect.collect(FakeController(works=False), [("FloorPlan1", "kitchen")])
