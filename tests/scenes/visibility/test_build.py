"""What the camera sees: by hand, against dense ray casting, and under symmetries."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.poses import TURNS, PoseGrid
from tdanet_jax.scenes import ithor
from tdanet_jax.scenes.checks import agreement, dense_rays
from tdanet_jax.scenes.scene import Scene, SceneObject
from tdanet_jax.scenes.visibility import build
from tdanet_jax.scenes.visibility.build import cosine_and_sine, detect, tilted, turned
from tdanet_jax.scenes.visibility.rules import RULES, Rules
from tdanet_jax.scenes.visibility.solids import fronts_of, patches_of, solids_of, void_boxes
from tests.support import toy

BARE = dataclasses.replace(RULES, void=100.0)  # toy rooms have no walls
MIDDLE = 2400  # of the image, in sixteenths of a pixel


def seen(
    scene: Scene, position: int, heading: int, horizon: int = 0, rules: Rules = BARE
) -> dict[str, tuple[np.ndarray, bool]]:
    """Box and visibility of each object seen from a state, by class."""
    found = detect(scene, rules)
    rows = np.flatnonzero(found.state == (position * 8 + heading) * 2 + horizon)
    return {
        scene.objects[found.owner[r]].object_class: (found.box[r], bool(found.visible[r]))
        for r in rows
    }


def test_corridor_by_hand() -> None:
    scene = toy.corridor()
    for position, depth in enumerate((2.15, 1.9, 1.65, 1.4, 1.15)):
        box, visible = seen(scene, position, 0)["Apple"]
        half = MIDDLE * 0.1 / depth  # the near face is 0.2 m wide
        expected = [MIDDLE - half, MIDDLE - half, MIDDLE + half, MIDDLE + half]
        assert np.allclose(box, expected, atol=4), position
        assert visible == (depth < RULES.reach)


@pytest.mark.parametrize("heading", range(8))
def test_headings_turn_clockwise_from_z(heading: int) -> None:
    angle = np.radians(45 * heading)
    apple = toy.thing("Apple", (np.sin(angle), toy.CAMERA, np.cos(angle)))
    scene = toy.room(toy.line(1), apple)
    for other in range(8):
        found = seen(scene, 0, other)
        if other == heading:
            box, visible = found["Apple"]
            assert visible
            assert abs((box[0] + box[2]) / 2 - MIDDLE) < 8
        elif (other - heading) % 8 in (2, 3, 4, 5, 6):
            assert not found
    right = seen(toy.room(toy.line(1), apple), 0, (heading - 1) % 8)
    if right:  # half a quarter turn to the left puts it at the right edge
        assert (right["Apple"][0][0] + right["Apple"][0][2]) / 2 > 2 * MIDDLE * 0.9


def test_cosines_are_the_nearest_numbers_whatever_the_last_bits_of_the_machines() -> None:
    for degrees in range(-90, 361):
        for value, exact in zip(
            cosine_and_sine(degrees),
            (math.cos(math.radians(degrees)), math.sin(math.radians(degrees))),
            strict=True,
        ):
            assert value == np.float32(exact + 1e-12) or abs(exact) < 1e-9
            assert value == np.float32(exact - 1e-12) or abs(exact) < 1e-9
    half = np.sqrt(np.float32(0.5))
    assert cosine_and_sine(45) == (half, half)
    assert cosine_and_sine(30) == (np.sqrt(np.float32(0.75)), np.float32(0.5))
    assert cosine_and_sine(90) == (0, 1)
    assert all(type(value) is np.float32 for value in cosine_and_sine(60))


@pytest.mark.parametrize("turn", TURNS)
def test_cameras_turn_and_tilt_by_whole_degrees(turn: int) -> None:
    x, up, z = np.random.default_rng(turn).normal(size=(3, 50)).astype(np.float32)
    found = turned(x, z, turn)
    assert len(found) == 360 // turn
    for i, (right, ahead) in enumerate(found):
        rotated = (x + 1j * z) * np.exp(1j * np.radians(turn * i))
        np.testing.assert_allclose(right + 1j * ahead, rotated, atol=1e-6)
        assert right.dtype == np.float32
    above, ahead = tilted(up, z, turn - 60)
    lifted = (z + 1j * up) * np.exp(1j * np.radians(turn - 60))
    np.testing.assert_allclose(ahead + 1j * above, lifted, atol=1e-6)


@pytest.mark.parametrize(
    "other", [PoseGrid(rotations=12, horizons=(-30, 0, 30)), PoseGrid(0.25, 4, (0,))]
)
def test_common_views_of_two_grids_are_the_same(other: PoseGrid) -> None:
    rng = np.random.default_rng(4)
    for room in (toy.corridor(), toy.random_room(rng)):
        mine = detect(room, BARE)
        theirs = detect(dataclasses.replace(room, grid=other), BARE)
        compared = 0
        for position in range(len(room.points)):
            for rotation in (0, 90, 180, 270):
                for horizon in set(room.grid.horizons) & set(other.horizons):
                    rows = [
                        found.state == grid.from_degrees(position, rotation, horizon)
                        for found, grid in ((mine, room.grid), (theirs, other))
                    ]
                    for a, b in zip(mine[1:], theirs[1:], strict=True):
                        np.testing.assert_array_equal(a[rows[0]], b[rows[1]])
                    compared += rows[0].sum()
        assert compared >= 5


def test_looking_down_moves_the_picture_up() -> None:
    # At a depression of 30 degrees, straight ahead: in the middle of the lowered view.
    depth = 1.0
    apple = toy.thing("Apple", (0.0, toy.CAMERA - depth * np.tan(np.pi / 6), depth), (0.1,) * 3)
    scene = toy.room(toy.line(1), apple)
    low, high = seen(scene, 0, 0, 1)["Apple"][0], seen(scene, 0, 0, 0)["Apple"][0]
    assert abs((low[1] + low[3]) / 2 - MIDDLE) < 0.05 * MIDDLE
    assert abs((high[1] + high[3]) / 2 - MIDDLE * (1 + np.tan(np.pi / 6))) < 0.06 * MIDDLE


def test_boxes_are_cut_at_the_image() -> None:
    sofa = toy.thing("Sofa", (1.0, toy.CAMERA, 1.5), (2.0, 0.4, 0.4))
    box, _ = seen(toy.room(toy.line(1), sofa), 0, 0)["Sofa"]
    # A patch whose middle is outside does not count: the box may end half a patch before the edge.
    assert 2 * MIDDLE * (1 - RULES.patch / 2) < box[2] <= 2 * MIDDLE
    assert box[0] == pytest.approx(MIDDLE, abs=4)


def wall(kind: str, z: float, **shape: float) -> SceneObject:
    return toy.thing(kind, (0.0, toy.CAMERA, z), (2.0, shape.get("height", 2.0), 0.2))


def test_what_hides_and_what_does_not() -> None:
    apple = toy.thing("Apple", (0.0, toy.CAMERA, 1.2))
    for kind, hides in (
        ("Sofa", True),
        ("Wall", True),
        ("Fridge", True),
        ("Curtains", False),
        ("Chair", False),
    ):
        found = seen(toy.room(toy.line(1), apple, wall(kind, 0.6)), 0, 0)
        assert ("Apple" in found) != hides, kind
        assert (kind in found) == (kind not in RULES.structure)


def house_with(*structure: SceneObject, spots: np.ndarray | None = None) -> Scene:
    """Four points along +z, and a mug ahead of them beyond a wall across the third."""
    mug = toy.thing("Mug", (0.0, toy.CAMERA, 1.5))
    return toy.room(toy.line(4) if spots is None else spots, mug, *structure)


def seen_from(scene: Scene) -> list[int]:
    """The positions that look along +z and see the mug."""
    return [p for p in range(len(scene.points)) if "Mug" in seen(scene, p, 0)]


WALL = toy.thing("Wall", (0.0, 1.25, 0.6), (4.0, 2.5, 0.1))
BACK = toy.thing("Wall", (0.0, 1.25, 0.5), (4.0, 2.5, 0.1), number=1)
DOORWAY = toy.thing("Doorway", (0.1, 1.0, 0.6), (1.0, 2.0, 0.2))
FRAME = toy.thing("Doorframe", (0.48, 1.0, 0.6), (1.0, 2.0, 0.2))
DOOR = toy.thing("Door", (0.48, 1.0, 0.6), (1.0, 2.0, 0.04))
OPEN_DOOR = dataclasses.replace(DOOR, is_open=True)


def test_what_is_behind_a_wall_is_seen_through_its_doors_alone() -> None:
    shut = dataclasses.replace(DOORWAY, openable=True)
    for structure, expected in (
        ((), [0, 1, 2, 3]),
        ((WALL,), [3]),
        ((WALL, DOORWAY), [0, 1, 2, 3]),
        ((WALL, shut), [3]),
        ((WALL, dataclasses.replace(shut, is_open=True)), [0, 1, 2, 3]),
        ((WALL, dataclasses.replace(DOORWAY, object_class="Doorframe")), [0, 1, 2, 3]),
        ((WALL, dataclasses.replace(DOORWAY, object_class="Door")), [3]),
        # Beside the line of sight; and in another wall, although in front of this one.
        ((WALL, toy.thing("Doorway", (1.0, 1.0, 0.6), (1.0, 2.0, 0.2))), [3]),
        ((WALL, toy.thing("Doorway", (0.0, 1.0, 0.45), (1.0, 2.0, 0.25))), [3]),
        # On another storey.
        ((WALL, toy.thing("Doorway", (0.1, 4.0, 0.6), (1.0, 2.0, 0.2))), [3]),
        # A frame with its door, at whose jamb one would see the mug.
        ((WALL, FRAME, DOOR), [3]),
        ((FRAME, DOOR), [3]),
        ((WALL, FRAME, OPEN_DOOR), [0, 1, 2, 3]),
        # A doorway between the walls of two rooms, back to back, is thinner than both.
        ((BACK, WALL, toy.thing("Doorway", (0.1, 1.0, 0.55), (1.0, 2.0, 0.06))), [0, 1, 2, 3]),
        # Open doors without a frame: in the wall, beside it, and at right angles to it.
        ((WALL, OPEN_DOOR), [0, 1, 2, 3]),
        ((WALL, toy.thing("Door", (0.1, 1.0, 0.68), (0.9, 1.9, 0.04), is_open=True)), [3]),
        ((WALL, toy.thing("Door", (0.0, 1.0, 1.05), (0.04, 1.9, 0.9), is_open=True)), [3]),
        ((WALL, toy.thing("Door", (0.0, 1.0, 1.0), (0.04, 1.9, 0.9), is_open=True)), [3]),
    ):
        scene = house_with(*structure)
        assert seen_from(scene) == expected, structure
        found = detect(scene, BARE)
        assert {scene.objects[i].object_class for i in found.owner} == {"Mug"}


def test_a_wall_is_whole_but_for_its_doors_and_where_an_agent_stands() -> None:
    def spans(
        *others: SceneObject, spots: np.ndarray | None = None, size: float = 0.25
    ) -> list[list[list[float]]]:
        scene = house_with(WALL, *others, spots=spots)
        solids = solids_of(dataclasses.replace(scene, grid=PoseGrid(size)), BARE)
        boxes = np.stack([solids.lo, solids.hi], axis=1)
        thick = np.ptp(boxes[:, :, 2], axis=1) == 90  # 0.1 m but for 5 % on both sides
        return sorted(boxes[thick][:, :, :2].tolist())

    whole = [[[-2000, 0], [2000, 2500]]]
    assert spans() == whole
    door = [[[-2000, 0], [-400, 2500]], [[-400, 2000], [600, 2500]], [[600, 0], [2000, 2500]]]
    assert spans(DOORWAY) == door
    hatch = toy.thing("Doorway", (0.1, 1.5, 0.6), (1.0, 1.0, 0.2))
    below = [[-400, 0], [600, 1000]]
    assert spans(hatch) == [door[0], below, *door[1:]]
    assert spans(toy.thing("Doorway", (0.1, 4.0, 0.6), (1.0, 2.0, 0.2))) == whole
    inside = toy.points((0.0, 0.0), (0.5, 0.6))
    assert spans(spots=inside) == [[[-2000, 0], [300, 2500]], [[700, 0], [2000, 2500]]]
    coarse = toy.points((0.0, 0.6), (0.5, 0.6))
    assert spans(spots=coarse, size=0.5) == [[[-2000, 0], [-250, 2500]], [[750, 0], [2000, 2500]]]
    turned_wall = dataclasses.replace(WALL, box=WALL.box[:, [2, 1, 0]])
    lo, hi = (getattr(solids_of(house_with(turned_wall), BARE), side) for side in ("lo", "hi"))
    assert [555, 0, -2000] in lo.tolist()
    assert [645, 2500, 2000] in hi.tolist()


def test_oblique_walls_are_inset_in_their_thickness_alone() -> None:
    flat = np.array([(-1, 0), (1, 0), (1, 0.1), (-1, 0.1)])
    along = np.array([(1, 1), (-1, 1)]) / np.sqrt(2)
    corners = np.array([(x, y, z) for y in (0.0, 2.0) for x, z in flat @ along])
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    oblique = dataclasses.replace(WALL, box=box, corners=corners)
    solids = solids_of(house_with(oblique), BARE)
    assert (solids.hi - solids.lo)[-1].tolist() == [2000, 2000, 90]


def test_a_room_without_anything_to_see() -> None:
    around = toy.thing("Cabinet", (0.0, 1.0, 0.0), (2.0, 2.0, 2.0))  # no point before any front
    carved = toy.thing("CounterTop", (0.0, 0.9, 0.0), (0.1, 0.1, 0.1))
    for item in (around, carved, WALL):
        assert len(detect(toy.room(toy.line(1), item), RULES).state) == 0


def test_a_table_hides_by_its_top_alone() -> None:
    low = toy.thing("Apple", (0.0, 0.3, 1.45))
    table = toy.thing("DiningTable", (0.0, 0.4, 1.1), (2.0, 0.8, 0.3))
    sofa = toy.thing("Sofa", (0.0, 0.4, 1.1), (2.0, 0.8, 0.3))
    assert "Apple" in seen(toy.room(toy.line(1), low, table), 0, 0, 1)
    assert "Apple" not in seen(toy.room(toy.line(1), low, sofa), 0, 0, 1)


@pytest.mark.parametrize(("is_open", "found"), [(True, True), (False, False)])
def test_only_closed_things_hide_what_they_hold(is_open: bool, found: bool) -> None:
    fridge = toy.thing("Fridge", (0.0, toy.CAMERA, 1.2), (0.8,) * 3, is_open=is_open)
    apple = toy.thing("Apple", (0.0, toy.CAMERA, 1.2))
    assert ("Apple" in seen(toy.room(toy.line(1), fridge, apple), 0, 0)) == found


def test_reach_is_horizontal() -> None:
    for distance, within in ((RULES.reach - 0.01, True), (RULES.reach + 0.01, False)):
        lamp = toy.thing("Painting", (0.0, toy.CAMERA + 0.8, distance + 0.1))
        assert seen(toy.room(toy.line(1), lamp), 0, 0)["Painting"][1] == within


def test_fronts_look_at_the_room() -> None:
    drawer = toy.thing("Drawer", (0.0, 0.5, 1.5), (0.4, 0.2, 0.4))
    assert fronts_of(drawer, toy.line(3), RULES.nearly) == [(2, 0)]
    aside = toy.points((1.5, 1.5), (1.75, 1.5))
    assert fronts_of(drawer, aside, RULES.nearly) == [(0, 1)]
    # From behind, nothing of the drawer is seen; of a sofa in its place much is.
    spots = toy.points((0.0, 0.0), (0.0, 0.25), (0.0, 3.5))
    assert "Drawer" in seen(toy.room(spots, drawer), 0, 0)
    assert "Drawer" not in seen(toy.room(spots, drawer), 2, 4)
    sofa = dataclasses.replace(drawer, object_class="Sofa", object_id="Sofa|0")
    assert "Sofa" in seen(toy.room(spots, sofa), 2, 4)


def test_counters_end_where_an_agent_can_stand() -> None:
    counter = toy.thing("CounterTop", (0.0, 0.9, 1.0), (3.0, 0.04, 3.0))
    scene = toy.room(toy.line(3), counter)
    patches = patches_of(scene, RULES)
    gaps = np.abs(patches.center[:, None] / 1000 - scene.points)[:, :, [0, 2]]
    assert np.hypot(*np.moveaxis(gaps, -1, 0)).min() >= RULES.standing
    assert len(patches.owner) > 100


def test_nothing_is_seen_through_a_void() -> None:
    # Two arms of an L: from the end of one the far thing in the other is behind the corner.
    spots = [(0.0, 0.25 * i) for i in range(17)] + [(0.25 * i, 4.0) for i in range(1, 17)]
    apple = toy.thing("Apple", (4.0, toy.CAMERA, 4.5))
    scene = toy.room(toy.points(*spots), apple)
    assert void_boxes(scene, RULES)
    assert "Apple" not in seen(scene, 0, 1, rules=RULES)  # from (0, 0) across the corner
    assert "Apple" in seen(scene, 16, 2, rules=RULES)  # from (0, 4) along the arm
    assert "Apple" in seen(scene, 0, 1)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_voids_keep_clear_of_points_and_objects(seed: int) -> None:
    scene = toy.random_room(np.random.default_rng(seed))
    rules = dataclasses.replace(RULES, void=0.3)
    for box in void_boxes(scene, rules):
        low, high = box[0, [0, 2]] - 0.1, box[1, [0, 2]] + 0.1
        ground = scene.points[:, [0, 2]]
        assert not ((ground > low) & (ground < high)).all(axis=1).any()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_turning_the_room_turns_the_views(seed: int) -> None:
    scene = toy.random_room(np.random.default_rng(seed))
    turned = quarter_turn(scene)
    a, b = detect(scene, BARE), detect(turned, BARE)
    position, view = np.divmod(a.state, 16)
    moved = position * 16 + (view + 4) % 16  # two headings of 45 degrees, two horizons each
    order = np.lexsort((a.owner, moved))
    assert (moved[order] == b.state).all()
    assert (a.owner[order] == b.owner).all()
    assert (a.box[order] == b.box).all()
    assert (a.visible[order] == b.visible).all()


def quarter_turn(scene: Scene) -> Scene:
    """The scene turned clockwise: what was along +z is along +x."""

    def turn(places: np.ndarray) -> np.ndarray:
        return np.stack([places[..., 2], places[..., 1], -places[..., 0]], axis=-1)

    objects = []
    for item in scene.objects:
        box = turn(item.box)
        objects.append(dataclasses.replace(item, box=np.stack([box.min(0), box.max(0)])))
    return dataclasses.replace(scene, points=turn(scene.points), objects=tuple(objects))


def test_oriented_boxes_are_used() -> None:
    # A thin sheet at 45 degrees: its axis-aligned box is 1 m wide, itself it hides a strip only.
    half, thin = np.sqrt(0.125), 0.005
    along, across = np.array([half, 0, half]), np.array([thin, 0, -thin])
    flat = [-along - across, along - across, along + across, -along + across]
    corners = np.array([np.add((0, toy.CAMERA + y, 1.0), v) for y in (-0.5, 0.5) for v in flat])
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    sheet = SceneObject("Painting|0", "Painting", box, corners)
    apple = toy.thing("Apple", (-0.28, toy.CAMERA, 1.05), (0.05,) * 3)
    scene = toy.room(toy.line(1), sheet, apple)
    assert solids_of(scene, RULES).aligned == 1
    assert "Apple" not in seen(scene, 0, 0)
    square = dataclasses.replace(sheet, corners=None)
    assert "Apple" in seen(toy.room(toy.line(1), square, apple), 0, 0)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=6)
def test_boxes_agree_with_dense_rays_in_random_rooms(seed: int) -> None:
    draw = np.random.default_rng(seed)
    scene = toy.random_room(draw)
    states = draw.choice(len(scene.points) * 16, 3, replace=False)
    overlaps, classes = dense_rays.compare_boxes(scene, RULES, states)
    assert not overlaps or np.mean(overlaps) > 0.8
    assert classes.errors <= 1


def test_boxes_agree_with_dense_rays_in_real_rooms() -> None:
    scenes = ithor.load_scenes()
    draw = np.random.default_rng(0)
    overlaps: list[float] = []
    total = agreement.Confusion()
    for number in (5, 48, 70, 101):
        states = draw.choice(len(scenes[number].points) * 16, 2, replace=False)
        more, classes = dense_rays.compare_boxes(scenes[number], RULES, states)
        overlaps += more
        total += classes
    assert len(overlaps) > 50
    assert np.mean(overlaps) > 0.9
    assert min(total.precision, total.recall) > 0.95


@pytest.mark.parametrize("every", [pytest.param(1, marks=pytest.mark.slow), 4])
def test_agreement_with_the_published_flags(every: int) -> None:
    scenes = ithor.load_scenes()
    train = [scene for i, scene in enumerate(scenes) if i % 30 < 20][::every]
    test = [scene for i, scene in enumerate(scenes) if i % 30 >= 20][::every]
    for rooms, least in ((train, 0.95), (test, 0.93)):
        total = sum(agreement.by_class(rooms, RULES).values(), agreement.Confusion())
        assert total.f1 > least


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize(
    "flat", [(0,), (1,), (2,), (0, 1), (1, 2), (0, 2), (0, 1, 2)], ids=lambda axes: f"flat{axes}"
)
def test_flat_things_are_seen_like_thin_ones(flat: tuple[int, ...], turned: bool) -> None:
    def seen_with(thickness: float) -> dict[str, tuple[np.ndarray, bool]]:
        size = np.array([0.5, 0.4, 0.3])
        size[list(flat)] = thickness
        middle, half = np.array([0.2, toy.CAMERA - 0.1, 1.2]), size / 2
        picture = toy.thing(
            "Painting", (middle[0], middle[1], middle[2]), (size[0], size[1], size[2])
        )
        if turned:  # by 30 degrees about its upright axis
            signs = [(x, y, z) for y in (-1, 1) for x, z in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            x, y, z = (half * np.array(signs)).T
            cosine, sine = np.sqrt(0.75), 0.5
            corners = middle + np.stack([cosine * x + sine * z, y, cosine * z - sine * x], axis=1)
            box = np.stack([corners.min(axis=0), corners.max(axis=0)])
            picture = dataclasses.replace(picture, box=box, corners=corners)
        return seen(toy.room(toy.line(1), picture), 0, 0)

    found, thin = seen_with(0.0), seen_with(0.001)
    assert found["Painting"][1]
    assert thin["Painting"][1]
    assert np.abs(found["Painting"][0].astype(int) - thin["Painting"][0]).max() <= 4


def test_a_flat_thing_hides_what_is_behind_it() -> None:
    apple = toy.thing("Apple", (0.0, toy.CAMERA, 1.2))
    picture = toy.thing("Painting", (0.0, toy.CAMERA, 0.8), (1.0, 1.0, 0.0))
    assert "Apple" not in seen(toy.room(toy.line(1), apple, picture), 0, 0)


def test_a_knob_is_flagged_by_its_front_and_boxed_by_all_that_stands_out() -> None:
    rules = dataclasses.replace(BARE, nearly=0.0)
    knob = toy.thing("StoveKnob", (0.0, toy.CAMERA, 1.0), (0.04, 0.04, 0.04))
    # Its front looks along -z to the first point, 0.98 m away; the second is 1 m to its right.
    spots = toy.points((0.0, 0.0), (1.01, 1.0))
    assert fronts_of(knob, spots, rules.nearly) == [(2, 0)]
    box, visible = seen(toy.room(spots, knob), 0, 0, rules=rules)["StoveKnob"]
    half = MIDDLE * 0.02 / 0.98
    assert visible
    assert np.allclose(box, [MIDDLE - half] * 2 + [MIDDLE + half] * 2, atol=4)
    # From its right it has a box, its right face's, but is not visible.
    box, visible = seen(toy.room(spots, knob), 1, 6, rules=rules)["StoveKnob"]
    half = MIDDLE * 0.02 / 0.99
    assert not visible
    assert np.allclose(box, [MIDDLE - half] * 2 + [MIDDLE + half] * 2, atol=4)
    # From behind it has none, and from its right a drawer has none.
    behind = toy.points((0.0, 0.0), (0.0, 2.1))
    assert seen(toy.room(behind, knob), 0, 0, rules=rules)
    assert not seen(toy.room(behind, knob), 1, 4, rules=rules)
    drawer = dataclasses.replace(knob, object_class="Drawer")
    assert not seen(toy.room(spots, drawer), 1, 6, rules=rules)


@pytest.mark.parametrize("length", [20.0, 70.0])
def test_rooms_of_any_size(length: float) -> None:
    # Two walls with a gap between them half-way, and an apple behind the gap, or behind a wall.
    def hall(x: float) -> Scene:
        apple = toy.thing("Apple", (x, toy.CAMERA, length), (0.4, 0.4, 0.4))
        walls = [
            toy.thing("Sofa", (side * (0.3 + length / 2), toy.CAMERA, length / 2),
                      (length, 4.0, 0.2), number)
            for number, side in enumerate((-1, 1))
        ]  # fmt: skip
        return toy.room(toy.line(1), apple, *walls)

    solid = dataclasses.replace(BARE, inset=0.0)
    box, visible = seen(hall(0.0), 0, 0, rules=solid)["Apple"]
    assert not visible
    half = MIDDLE * 0.2 / (length - 0.2)
    assert np.allclose(box, [MIDDLE - half] * 2 + [MIDDLE + half] * 2, atol=4)
    assert "Apple" not in seen(hall(3.0), 0, 0, rules=solid)


def test_rooms_with_any_number_of_solids() -> None:
    # 300 books in a row, each of which hides an apple from a point of its own.
    places = [0.1 * i for i in range(300)]
    books = [toy.thing("Book", (x, toy.CAMERA, 0.8), (0.09, 0.3, 0.05), i)
             for i, x in enumerate(places)]  # fmt: skip
    for x in (places[0], places[-1]):
        apple = toy.thing("Apple", (x, toy.CAMERA, 1.2), (0.05, 0.05, 0.05))
        spots = toy.points((x, 0.0))
        assert "Apple" in seen(toy.room(spots, apple, *books[1:-1]), 0, 0)
        assert "Apple" not in seen(toy.room(spots, apple, *books), 0, 0)


def test_batches_of_positions_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = next(scene for scene in ithor.load_scenes() if scene.name == "FloorPlan402")
    scene = dataclasses.replace(scene, points=scene.points[:20])
    whole = detect(scene, RULES)
    monkeypatch.setattr(build, "PAIRS", 7 * len(patches_of(scene, RULES).owner))
    for field, other in zip(whole, detect(scene, RULES), strict=True):
        assert field.dtype == other.dtype
        assert np.array_equal(field, other)


def test_the_middle_of_a_run_of_patches_adds_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """In FloorPlan412 a shower's glass reaches behind the camera, where this does not hold."""
    scene = next(room for room in ithor.load_scenes() if room.name == "FloorPlan412")
    expected = detect(scene, RULES)

    def each_alone(place: np.ndarray, alone: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.arange(len(place)), np.arange(len(place))

    monkeypatch.setattr(build, "_runs", each_alone)
    for found, right in zip(detect(scene, RULES), expected, strict=True):
        np.testing.assert_array_equal(found, right)
