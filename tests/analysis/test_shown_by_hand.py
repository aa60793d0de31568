"""Slivers, reach and dashes, computed by hand: what pictures, traces and pages say of them.

An apple at the end of a corridor is in view from all of its points, and within reach from the
fourth on. A painting of 64 patches is hidden but for two of them, or for three: it is in view in
both cases, and visible where more than 4 % of it are.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure

from tdanet_jax.analysis import drawing, pictures, replay, trace
from tdanet_jax.analysis.trace import Player, Trace
from tdanet_jax.env.params import TEST_STEP_LIMITS, make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables, camera_view, tabulation
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.vocabulary import Action
from tests.support import toy

CAMERA = toy.CAMERA
#: Nine points in a row, and an apple straight ahead of them, 0.25 m past the last.
CORRIDOR = toy.room(toy.line(9), toy.thing("Apple", (0.0, CAMERA, 2.25)))
#: Metres, the edge of a patch of the painting.
PATCH = 0.0975
#: Metres from the corridor's points to the apple's near face, 0.2 m wide, and whether within reach.
DEPTHS = {0: 2.15, 1: 1.9, 2: 1.65, 3: 1.4, 4: 1.15, 8: 0.15}
NEAR = {0: False, 1: False, 2: False, 3: True, 4: True, 8: True}


def painting(patches: int) -> Scene:
    """A painting 0.9 m ahead, of which some of the upper patches of the right column show.

    It is 0.78 m wide and high, in eight rows and columns of patches. Two fridges 0.5 m ahead hide
    the rest. Solids are smaller than their boxes, by 5 % of half their size at each
    side.
    """

    def fridge(left: float, right: float, low: float, high: float, number: int) -> Any:
        """A fridge that hides lines of sight that meet the painting between these places."""
        share = 0.5 / 0.9  # of the way to the painting
        middle, half = (left + right) / 2, (right - left) / 2 / 0.95
        center, tall = (low + high) / 2, (high - low) / 2 / 0.95
        return toy.thing(
            "Fridge", (share * middle, CAMERA + share * center, 0.5),
            (share * 2 * half, share * 2 * tall, 0.01), number,
        )  # fmt: skip

    hidden = 0.39 - PATCH * patches
    return toy.room(
        toy.line(1),
        toy.thing("Painting", (0.0, CAMERA, 1.0), (0.78, 0.78, 0.2)),
        fridge(-0.6, 0.39 - PATCH, -0.6, 0.6, 0),
        fridge(0.2, 0.6, -0.6, hidden, 1),
    )


@pytest.fixture(scope="module")
def corridor() -> SceneTables:
    return tabulation.build([CORRIDOR]).with_known_targets()


def seen(tables: SceneTables, state: int, name: str) -> tuple[np.ndarray, bool]:
    """Box in pixels, and whether it is visible, of an object in view."""
    view = camera_view.of_pose(tables, state)
    item = view.classes.index(name)
    return 300 * view.boxes[item], bool(view.visible[item])


def test_boxes_and_reach_along_the_corridor(corridor: SceneTables) -> None:
    for point, depth in DEPTHS.items():
        box, near = seen(corridor, 16 * point, "Apple")
        half = 150 * 0.1 / depth
        np.testing.assert_allclose(box, [150 - half] * 2 + [150 + half] * 2, atol=0.05)
        assert near == NEAR[point]


@pytest.mark.parametrize(("patches", "visible"), [(2, False), (3, True)])
def test_a_sliver_is_in_view_and_not_visible(patches: int, visible: bool) -> None:
    tables = tabulation.build([painting(patches)])
    box, near = seen(tables, 0, "Painting")
    right = np.array([0.39 - PATCH, -0.39, 0.39, -0.39 + PATCH * patches])  # y down
    np.testing.assert_allclose(box, 150 + 150 * right / 0.9, atol=0.05)
    assert near == visible
    found = tables.distance[0, tables.targets.index("Painting")]
    assert (found == 0) == visible


def test_a_target_that_is_half_hidden_is_outlined_where_it_shows() -> None:
    tables = tabulation.build([painting(4)])
    axes = Figure().subplots()
    drawing.draw_view(axes, camera_view.of_pose(tables, 0), None, "Painting")
    [outline] = [patch for patch in axes.patches if patch.get_linewidth() > 2]
    x, y, width, height = *outline.get_xy(), outline.get_width(), outline.get_height()
    half = 0.5 / 0.9
    expected = [0.5 + (0.39 - PATCH) * half, 0.5 - 0.39 * half, PATCH * half, 4 * PATCH * half]
    np.testing.assert_allclose([x, y, width, height], expected, atol=2e-4)


def test_dashes_say_that_the_target_is_out_of_reach(corridor: SceneTables) -> None:
    for point, near in NEAR.items():
        axes = Figure().subplots()
        drawing.draw_view(axes, camera_view.of_pose(corridor, 16 * point), None, "Apple")
        [outline] = [patch for patch in axes.patches if patch.get_linewidth() > 2]
        offset, dashes = outline.get_linestyle() if not near else (0, None)
        assert (outline.get_linestyle() == "-") == near
        assert near or (offset, tuple(dashes)) == drawing.DASHED


def walked(tables: SceneTables, point: int) -> Trace:
    """Done at a point of the corridor, after walking there from its beginning."""
    params = make_params(
        tables, {"kitchen": ("Apple",)}, no_parents(tables), TEST_STEP_LIMITS, ObservationSpec()
    )
    task: Any = SimpleNamespace(eval_params=params)
    goal = tables.targets.index("Apple")
    episode = Episodes(np.array([0], np.int32), np.array([goal], np.int32))
    actions = np.array([Action.MOVE_AHEAD] * point + [Action.DONE])
    return trace.retrace(Player("someone", task), tables, episode, actions)


def test_traces_and_pages_know_how_far_the_target_is(corridor: SceneTables) -> None:
    for point, near in NEAR.items():
        made = walked(corridor, point)
        np.testing.assert_array_equal(made.pose, [*range(0, 16 * point + 1, 16), 16 * point])
        assert made.success == near
        assert made.shortest == 4  # three steps, and Done
        for step in (step for step in DEPTHS if step <= point):
            [[name, *box, reached]] = replay._step(made, corridor, step)["boxes"]
            half = 150 * 0.1 / DEPTHS[step]
            assert name == "Apple"
            np.testing.assert_allclose(box, [150 - half] * 2 + [150 + half] * 2, atol=0.11)
            assert reached == NEAR[step]


@pytest.mark.parametrize("point", NEAR)
def test_colours_of_a_room_say_what_is_within_reach(
    corridor: SceneTables, point: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    drawn: list[Figure] = []
    monkeypatch.setattr(drawing, "save", lambda figure, path: drawn.append(figure))
    pictures.room(CORRIDOR, corridor, 16 * point, Path("room.png"))
    plan, view = drawn[0].axes
    expected, other = (drawing.GREEN, drawing.BLUE)[:: 1 if NEAR[point] else -1]
    for axes in (plan, view):
        edges = {patch.get_edgecolor() for patch in axes.patches}
        assert to_rgba(expected) in edges
        assert to_rgba(other) not in edges
    assert view.get_title().startswith("1 objects in view from x 0.00, z ")
    [field] = [patch for patch in plan.patches if hasattr(patch, "theta1")]
    assert field.r == 1.5
    np.testing.assert_allclose(field.center, (0.0, 0.25 * point))
