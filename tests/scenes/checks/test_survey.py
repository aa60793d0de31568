"""The survey of rooms: unreachable targets with their reasons, disconnected points."""

from __future__ import annotations

import dataclasses

from tdanet_jax.scenes import SceneTables, tabulation
from tdanet_jax.scenes.checks import survey
from tdanet_jax.scenes.visibility.rules import RULES as PUBLISHED
from tests.support import toy

RULES = dataclasses.replace(PUBLISHED, void=100.0)  # toy rooms have no walls


def test_targets_out_of_reach() -> None:
    far = toy.room(toy.line(2), toy.thing("Apple", (0.0, 1.5, 2.75)), name="Far")
    fridge = toy.thing("Fridge", (0.0, 1.0, 1.0), (0.6, 2.0, 0.6))
    closed = toy.room(toy.line(1), fridge, toy.thing("Mug", (0.0, 1.0, 1.0)), name="Closed")
    near = toy.room(toy.line(1), toy.thing("Apple", (0.0, 1.5, 1.0)), name="Near")
    found = survey.invisible_targets(tabulation.build([far, closed, near], rules=RULES))
    assert [(case.scene, case.target) for case in found] == [("Far", "Apple"), ("Closed", "Mug")]
    assert found[0].reason.startswith("2.40 m from")
    assert "closed" in found[1].reason


def test_disconnected_rooms() -> None:
    apple = toy.thing("Apple", (0.0, 1.5, 1.0))
    whole = toy.room(toy.line(3), apple, name="Whole")
    split = toy.room(toy.points((0, 0), (0, 0.25), (0, 0.75), (1, 1)), apple, name="Split")
    assert survey.disconnected_rooms(tabulation.build([whole, split], rules=RULES)) == {"Split": 3}


def test_bundled_rooms(ithor: SceneTables) -> None:
    assert survey.disconnected_rooms(ithor) == {"FloorPlan204": 3}
    lost = survey.invisible_targets(ithor)
    assert len(lost) == 26
    far = {(case.scene, case.target) for case in lost if "nearest" in case.reason}
    assert far == {("FloorPlan329", "AlarmClock"), ("FloorPlan402", "SoapBar")}
    assert all("closed" in case.reason for case in lost if "nearest" not in case.reason)
