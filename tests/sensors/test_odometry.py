"""Dead reckoning and the map: a slow odometry of sets and degrees, and the rooms' truth."""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.env import dynamics
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.env.types import EnvParams, EnvState, Observation
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.tabulation import build
from tdanet_jax.sensors import odometry, suite
from tdanet_jax.sensors.odometry import Odometry, OdometryReading, OdometryState, measured_pose
from tdanet_jax.sensors.sensor import NO_SLIP, Motion, Start
from tests.support import toy
from tests.support.oracle import (
    DONE,
    HEADINGS,
    LOOK_DOWN,
    LOOK_UP,
    MOVE_AHEAD,
    ROOMS,
    ROTATE_LEFT,
    ROTATE_RIGHT,
    pose_of,
)

#: East and north of a step along each heading, in cells; oblique ones go along both axes.
STEPS = {0: (0, 1), 45: (1, 1), 90: (1, 0), 135: (1, -1), 180: (0, -1), 225: (-1, -1),
         270: (-1, 0), 315: (-1, 1)}  # fmt: skip
#: Before the first action.
NOTHING = 6
#: What stands in the front and in the middle of the window [row, column].
FRONT, MIDDLE, BEHIND = (3, 4), (4, 4), (5, 4)
BLOCKED = 256

AHEAD = [(MOVE_AHEAD, False)]
Walk = Sequence[tuple[int, bool]]  # actions, and whether the agent did not move
LONGEST = 120
SENSOR = Odometry()


def nearest(heading: int) -> int:
    """The multiple of 45 degrees that is nearest to a heading."""
    return min(range(0, 361, 45), key=lambda direction: abs(direction - heading)) % 360


class SlowOdometry:
    """The agent's pose and map in one episode, in degrees, tuples and sets."""

    def __init__(
        self, diagonal: bool, horizon: int, grid: PoseGrid = ITHOR, heading: int | None = None
    ) -> None:
        self.grid = grid
        self.x = self.z = 0
        self.heading = 45 * diagonal if heading is None else heading
        self.horizon = horizon
        self.action = NOTHING
        self.was_blocked = False
        self.stood = {(0, 0, nearest(self.heading))}
        self.in_the_way: set[tuple[int, int]] = set()

    def update(self, action: int, did_not_move: bool) -> None:
        """An action, and whether it failed to move the agent."""
        east, north = STEPS[nearest(self.heading)]
        self.action, self.was_blocked = action, action == MOVE_AHEAD and did_not_move
        if self.was_blocked:
            self.in_the_way.add(((self.x + east) % 64, (self.z + north) % 64))
        elif action == MOVE_AHEAD:
            self.x, self.z = self.x + east, self.z + north
        elif action == ROTATE_LEFT:
            self.heading = (self.heading - self.grid.turn) % 360
        elif action == ROTATE_RIGHT:
            self.heading = (self.heading + self.grid.turn) % 360
        elif action == LOOK_UP and self.horizon > 0:
            self.horizon -= 1
        elif action == LOOK_DOWN and self.horizon < len(self.grid.horizons) - 1:
            self.horizon += 1
        self.stood.add((self.x % 64, self.z % 64, nearest(self.heading)))

    def motion(self) -> list[float]:
        """The twelve numbers, from scalar products with the directions right and ahead."""
        sine, cosine = (f(math.radians(self.heading)) for f in (math.sin, math.cos))
        size = self.grid.grid_size
        right = (size * self.x * cosine - size * self.z * sine) / 4
        ahead = (size * self.x * sine + size * self.z * cosine) / 4
        down = self.grid.horizons[self.horizon] / 30
        last = [float(self.action == action) for action in range(6)]
        return [right, ahead, sine, cosine, down, self.was_blocked, *last]

    def cell(self, row: int, column: int) -> tuple[int, int]:
        """The cell of the map that the window shows there: the nearest one."""
        right, ahead = column - 4, 4 - row
        sine, cosine = (f(math.radians(self.heading)) for f in (math.sin, math.cos))
        x = self.x + round(right * cosine + ahead * sine)
        z = self.z + round(ahead * cosine - right * sine)
        return x % 64, z % 64

    def certain(self) -> np.ndarray:
        """The cells of the window to which no two cells of the map are as near: [9, 9] bool."""
        row, column = np.mgrid[:9, :9]
        at = (column - 4 + 1j * (4 - row)) * np.exp(-1j * np.radians(self.heading))
        return (np.abs(np.stack([at.real, at.imag]) % 1 - 0.5) > 1e-6).all(axis=0)

    def window(self) -> list[list[int]]:
        """The bits of the 9 x 9 cells."""
        rows = [[0] * 9 for _ in range(9)]
        for row in range(9):
            for column in range(9):
                x, z = self.cell(row, column)
                bits = BLOCKED if (x, z) in self.in_the_way else 0
                for bit in range(8):
                    if (x, z, (nearest(self.heading) + 45 * bit) % 360) in self.stood:
                        bits += 1 << bit
                rows[row][column] = bits
        return rows


def begun(rotation: Any, horizon: Any) -> OdometryState:
    """The state at the start of an episode."""
    return SENSOR.init(Start(jnp.int32(rotation), jnp.int32(horizon)))


@functools.partial(jax.jit, static_argnames="map_too")
def walked(
    diagonal: Any, horizon: Any, actions: Any, blocked: Any, map_too: bool = False
) -> tuple[OdometryState, tuple[OdometryState, OdometryReading]]:
    """The last state of a walk [N], and states and readings, at its start and after each action."""

    def step(
        state: OdometryState, given: tuple
    ) -> tuple[OdometryState, tuple[OdometryState, OdometryReading]]:
        state = SENSOR.update(state, Motion(*given), {})
        kept = state if map_too else state.replace(cells=jnp.zeros(0))
        return state, (kept, SENSOR.read(state, {}))

    actions = jnp.concatenate([jnp.array([NOTHING]), actions])
    given = (actions, jnp.append(True, blocked))
    return jax.lax.scan(step, begun(diagonal, horizon), given)


def columns(walk: Walk) -> tuple[np.ndarray, np.ndarray]:
    """Actions and flags of a walk, filled up to `LONGEST` with turns: one shape is compiled."""
    filled = [*walk, *[(ROTATE_LEFT, False)] * LONGEST][:LONGEST]
    return np.array([a for a, _ in filled], np.int32), np.array([b for _, b in filled])


#: Actions are drawn in runs of one kind, so that a walk also leads far.
RUNS = st.lists(
    st.tuples(
        st.sampled_from((0, 0, 0, 1, 2, 3, 4, 5)), st.booleans(), st.sampled_from((1, 1, 2, 40))
    ),
    max_size=12,
)


@settings(max_examples=40)
@given(diagonal=st.booleans(), horizon=st.integers(0, 1), runs=RUNS)
def test_every_step_is_that_of_the_slow_odometry(diagonal: bool, horizon: int, runs: list) -> None:
    walk = [(action, blocked) for action, blocked, times in runs for _ in range(times)][:LONGEST]
    last, found = walked(diagonal, horizon, *columns(walk))
    state, seen = jax.device_get(found)
    slow = SlowOdometry(diagonal, horizon)
    for t in range(len(walk) + 1):
        if t:
            slow.update(*walk[t - 1])
        assert state.cell[t].tolist() == [slow.x, slow.z]
        assert (45 * state.heading[t], state.horizon[t]) == (slow.heading, slow.horizon)
        assert (state.action[t], state.blocked[t]) == (slow.action, slow.was_blocked)
        np.testing.assert_allclose(seen.motion[t], slow.motion(), atol=2e-6)
        np.testing.assert_array_equal(seen.window[t], slow.window())
    assert last.cells.shape == (64, 64)


@pytest.mark.parametrize(
    "grid",
    [
        PoseGrid(0.5, 4, (0,)),
        pytest.param(PoseGrid(0.25, 6, (0, 30)), marks=pytest.mark.slow),
        PoseGrid(0.1, 12, (-30, 0, 30)),
        PoseGrid(0.25, 24, (-15, 0, 60)),
    ],
    ids=str,
)
def test_on_other_grids_too_and_the_networks_input_stays_as_long(grid: PoseGrid) -> None:
    spec = ObservationSpec(sensors=("odometry",), grid=grid)
    sensor = suite.make(spec)["odometry"]
    assert suite.width(spec) == SENSOR.width
    update, read = jax.jit(lambda s, a, b: sensor.update(s, Motion(a, b), {})), jax.jit(sensor.read)
    actions, blocked = wandering(grid.rotations, 60)
    for rotation in range(grid.rotations):
        state = sensor.init(Start(jnp.int32(rotation), jnp.int32(grid.level)))
        # In its own frame it starts along an axis, or as far from one as it does in the room.
        own = grid.turn * int(state.heading)
        assert (own - grid.turn * rotation) % 90 == 0
        assert own < (180 if grid.turn == 60 else 90)
        if rotation > 3:
            continue
        slow = SlowOdometry(False, grid.level, grid, own)
        for action, flag in zip(actions, blocked, strict=True):
            state = update(state, jnp.int32(action), jnp.bool_(flag))
            slow.update(int(action), bool(flag))
            seen = read(state, {})
            assert state.cell.tolist() == [slow.x, slow.z]
            np.testing.assert_allclose(seen.motion, slow.motion(), atol=2e-6)
            certain = slow.certain()
            assert certain.mean() > 0.6
            np.testing.assert_array_equal(
                np.where(certain, seen.window, 0), np.where(certain, slow.window(), 0)
            )


def wandering(seed: int, length: int) -> tuple[np.ndarray, np.ndarray]:
    """A random walk."""
    rng = np.random.default_rng(seed)
    actions = rng.choice(6, length, p=[0.5, 0.15, 0.15, 0.05, 0.05, 0.1])
    return actions.astype(np.int32), rng.random(length) < 0.3


def test_the_map_holds_the_whole_path_and_nothing_else() -> None:
    actions, blocked = wandering(0, LONGEST)
    last, _ = walked(1, 0, actions, blocked)
    slow = SlowOdometry(diagonal=True, horizon=0)
    for action, flag in zip(actions, blocked, strict=True):
        slow.update(int(action), bool(flag))
    cells = np.zeros((64, 64), int)
    for x, z, heading in slow.stood:
        cells[x, z] += 1 << heading // 45
    for x, z in slow.in_the_way:
        cells[x, z] += BLOCKED
    np.testing.assert_array_equal(last.cells, cells)
    assert len(slow.in_the_way) > 5


@pytest.mark.parametrize("diagonal", [False, True])
def test_beyond_64_cells_the_map_begins_anew_and_the_position_does_not(diagonal: bool) -> None:
    _, (state, seen) = walked(diagonal, 0, *columns([(MOVE_AHEAD, True), *66 * AHEAD]))
    # After 62 steps the start is two cells ahead, and beyond it lies the path that it took; what
    # was in the way there is three cells ahead. Diagonal cells are as far as 1.4 rows.
    assert state.cell[63].tolist() == [62 * diagonal, 62]
    assert [row for row in range(4) if seen.window[63, row, 4] & 1] == (
        [0, 1] if diagonal else [0, 1, 2]
    )
    assert [row for row in range(4) if seen.window[63, row, 4] & BLOCKED] == [0 if diagonal else 1]
    away = 62 / 16 * (math.sqrt(2) if diagonal else 1)
    np.testing.assert_allclose(seen.motion[63, :2], [0, away], atol=1e-5)
    # After 64 it stands on the start, as far as the map goes.
    assert state.cell[65].tolist() == [64 * diagonal, 64]
    assert seen.window[65][FRONT] & BLOCKED


@pytest.mark.slow
def test_compiled_is_eager_and_many_are_one_by_one() -> None:
    starts = [(0, 0), (1, 1), (1, 0)]
    walks = [wandering(seed, 8) for seed in range(len(starts))]
    alone = [walked(*start, *walk, map_too=True) for start, walk in zip(starts, walks, strict=True)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *alone)
    given = (*np.array(starts).T, *(np.stack(x) for x in zip(*walks, strict=True)))
    together = jax.vmap(functools.partial(walked, map_too=True))(*given)
    close = {"rtol": 1e-6, "atol": 1e-6}  # sines and cosines may be computed by another formula
    chex.assert_trees_all_close(together, stacked, **close)
    state = begun(1, 1)
    for t, (action, flag) in enumerate(zip(*walks[1], strict=True), start=1):
        state = SENSOR.update(state, Motion(jnp.int32(action), jnp.asarray(flag)), {})
        eager = state, SENSOR.read(state, {})
        compiled = jax.tree.map(lambda x, t=t: x[t], alone[1][1])
        chex.assert_trees_all_close(eager, compiled, **close)
        chex.assert_trees_all_equal_dtypes(eager, compiled)


@pytest.mark.parametrize("diagonal", [0, 1])
@pytest.mark.parametrize("blocked", [False, True])
def test_no_action_yet_changes_nothing(diagonal: int, blocked: bool) -> None:
    before = begun(diagonal, 1)
    after = SENSOR.update(before, Motion(jnp.int32(NOTHING), jnp.asarray(blocked)), {})
    chex.assert_trees_all_equal(after, before)
    chex.assert_trees_all_equal_dtypes(after, before)


@pytest.mark.parametrize("rotation", range(8))
def test_of_the_rotation_at_the_start_only_whether_it_is_along_a_diagonal_matters(
    rotation: int,
) -> None:
    chex.assert_trees_all_equal(begun(rotation, 1), begun(rotation % 2, 1))
    assert int(begun(rotation, 1).heading) == rotation % 2


def test_another_target_does_not_clear_the_map() -> None:
    state, _ = walked(0, 0, *columns(AHEAD))
    for changed in (False, True):
        chex.assert_trees_all_equal(SENSOR.clear(state, jnp.asarray(changed)), state)


def test_a_start_along_a_diagonal_reads_the_same_as_one_along_an_axis() -> None:
    seen = [walked(d, 0, *columns([]))[1][1] for d in (0, 1)]
    seen = [jax.tree.map(lambda x: x[0], found) for found in seen]
    for start, turned in zip(seen, (0, math.sqrt(0.5)), strict=True):
        expected = np.zeros((9, 9))
        expected[MIDDLE] = 1
        np.testing.assert_array_equal(start.window, expected)
        motion = [0, 0, turned, math.sqrt(1 - turned**2), *[0] * 8]
        np.testing.assert_allclose(start.motion, motion, atol=1e-6)
    batch = suite.blank(ObservationSpec(sensors=("odometry",)), 3)["odometry"]
    for row in range(3):
        chex.assert_trees_all_close(jax.tree.map(lambda x, r=row: x[r], batch), seen[0])


@pytest.mark.parametrize("turns", range(8))
def test_move_ahead_leads_to_the_cell_in_front_of_the_middle(turns: int) -> None:
    walk = [*[(ROTATE_RIGHT, False)] * turns, (MOVE_AHEAD, True), *AHEAD]
    _, (state, seen) = walked(0, 0, *columns(walk))
    turned, stopped, moved = (np.asarray(seen.window[turns + i]) for i in range(3))
    assert not (turned & BLOCKED).any()
    assert stopped[FRONT] == BLOCKED
    # Only the nearest rows ahead may show the same cell once more, along a diagonal.
    assert set(zip(*np.nonzero(stopped & BLOCKED), strict=True)) <= {FRONT, (2, 4)}
    assert stopped[MIDDLE] == turned[MIDDLE]
    assert stopped[MIDDLE] & 1
    # And there it leads: the cell that was in front is the middle, and the old middle is behind it.
    assert moved[MIDDLE] == BLOCKED | 1
    assert moved[BEHIND] == stopped[MIDDLE]
    assert moved[FRONT] == 0 or turns % 2
    east, north = STEPS[HEADINGS[turns]]
    assert state.cell[turns + 2].tolist() == [east, north]


def test_headings_in_the_window_are_relative_to_ones_own() -> None:
    walk = [(ROTATE_RIGHT, False), (ROTATE_RIGHT, False), (ROTATE_RIGHT, False)]
    _, (_, seen) = walked(0, 0, *columns(walk))
    # It looked 45, 90 and 135 degrees to the left of where it looks now.
    assert seen.window[:4, *MIDDLE].tolist() == [1, 1 | 1 << 7, 1 | 3 << 6, 1 | 7 << 5]


def test_the_features_are_the_motion_and_the_windows_bits_cell_by_cell() -> None:
    rng = np.random.default_rng(0)
    motion = rng.normal(size=(2, 3, 12)).astype(np.float32)
    window = rng.integers(0, 512, (2, 3, 9, 9)).astype(np.uint16)
    found = SENSOR.features(OdometryReading(jnp.asarray(motion), jnp.asarray(window)))
    assert found.shape == (2, 3, 12 + 9 * 9 * 9)
    assert SENSOR.width == found.shape[-1]
    assert found.dtype == jnp.float32
    np.testing.assert_array_equal(found[..., :12], motion)
    expected = [window[..., r, c] >> b & 1 for r in range(9) for c in range(9) for b in range(9)]
    np.testing.assert_array_equal(found[..., 12:], np.stack(expected, axis=-1))


# In the environment


def params_of(tables: SceneTables, sensors: bool, limits: Sequence[int] = (1000,) * 4) -> EnvParams:
    """Episodes for every target in every room."""
    targets = dict.fromkeys(ROOMS, tables.targets)
    spec = ObservationSpec(sensors=("odometry",) if sensors else ())
    return make_params(tables, targets, no_parents(tables), limits, spec)


@jax.jit
def played(params: EnvParams, pose: jax.Array, actions: jax.Array) -> tuple[EnvState, Observation]:
    """States and observations [N + 1, B] at the start of episodes and after each action [N, B]."""

    def shown(state: EnvState) -> tuple[EnvState, Observation]:
        obs = jax.vmap(dynamics.observe, (0, None))(state, params)
        kept = {name: one.replace(cells=jnp.zeros(0)) for name, one in state.sensors.items()}
        return state.replace(sensors=kept), obs

    def step(state: EnvState, action: jax.Array) -> tuple[EnvState, Any]:
        state = jax.vmap(dynamics.transition, (0, 0, None))(state, action, params).state
        return state, shown(state)

    start = jax.vmap(dynamics.start, (0, None, None))(pose, jnp.int32(0), params)
    _, after = jax.lax.scan(step, start, actions)
    return jax.tree.map(lambda one, rest: jnp.concatenate([one[None], rest]), shown(start), after)


@functools.cache
def toy_rooms() -> SceneTables:
    """Rooms with many holes in their grids."""
    rng = np.random.default_rng(10)
    rooms = [toy.random_room(rng, name=f"Random{i}") for i in range(8)]
    return build([toy.corridor(), *rooms], targets=("Apple", "Mug", "Sofa"))


@pytest.fixture(params=["real", pytest.param("toy", marks=pytest.mark.slow)])
def tables(request: pytest.FixtureRequest) -> SceneTables:
    if request.param == "toy":
        return toy_rooms()
    found: SceneTables = request.getfixturevalue("some_rooms")
    return found


def random_episodes(
    tables: SceneTables, batch: int = 64, steps: int = 100
) -> tuple[np.ndarray, np.ndarray]:
    """Poses [B] of all headings and horizons, and actions [N, B], half of them MoveAhead."""
    rng = np.random.default_rng(3)
    pose = rng.integers(len(tables.position), size=batch) * 16 + np.arange(batch) % 16
    actions = rng.choice(5, (steps, batch), p=[0.6, 0.15, 0.15, 0.05, 0.05])
    return pose.astype(np.int32), actions.astype(np.int32)


def test_dead_reckoning_is_the_true_displacement(tables: SceneTables) -> None:
    pose, actions = random_episodes(tables)
    state, obs = jax.device_get(played(params_of(tables, sensors=True), pose, actions))
    known, seen = state.sensors["odometry"], obs.sensors["odometry"]
    farthest, stopped = 0.0, 0
    for b in range(len(pose)):
        start = pose_of(int(pose[b]))
        frame = start.heading // 90 * 90  # of a start along a diagonal, the axis to its left
        sine, cosine = (round(f(math.radians(frame))) for f in (math.sin, math.cos))
        slow = SlowOdometry(start.heading != frame, start.horizon // 30)
        for t in range(len(actions) + 1):
            now = pose_of(int(state.pose[t, b]))
            if t:
                stays = state.pose[t, b] == state.pose[t - 1, b]
                slow.update(int(actions[t - 1, b]), bool(stays))
                ahead = actions[t - 1, b] == MOVE_AHEAD
                stopped += ahead and stays
                assert known.blocked[t, b] == (ahead and stays)
                if ahead:
                    assert bool(seen.window[t, b][FRONT] & BLOCKED) >= stays
            x, _, z = (tables.position[now.position] - tables.position[start.position]) / 0.25
            truth = x * cosine - z * sine, x * sine + z * cosine
            np.testing.assert_allclose(known.cell[t, b], truth, atol=1e-3)
            assert (45 * known.heading[t, b] + frame) % 360 == now.heading
            assert 30 * known.horizon[t, b] == now.horizon
            farthest = max(farthest, *map(abs, truth))
            if b % 8 == 5 and t % 5 == 0:  # the slow window takes its time
                np.testing.assert_array_equal(seen.window[t, b], slow.window())
        np.testing.assert_allclose(seen.motion[-1, b], slow.motion(), atol=2e-6)
    # A point is reachable or it is not: nobody ever stood where something was in the way.
    window = seen.window
    assert not ((window & BLOCKED > 0) & (window & (BLOCKED - 1) > 0)).any()
    assert farthest > (8 if len(tables.position) > 500 else 4)
    assert stopped > 500


def test_without_odometry_everything_else_is_the_same(some_rooms: SceneTables) -> None:
    pose, actions = random_episodes(some_rooms, batch=8, steps=20)
    state, obs = played(params_of(some_rooms, sensors=False), pose, actions)
    assert state.sensors == obs.sensors == {}
    sensing, more = played(params_of(some_rooms, sensors=True), pose, actions)
    assert list(sensing.sensors) == list(more.sensors) == ["odometry"]
    chex.assert_trees_all_equal(sensing.replace(sensors={}), state)
    chex.assert_trees_all_equal(more.replace(sensors={}), obs)


@pytest.mark.slow
def test_an_automatic_reset_begins_a_new_map() -> None:
    params = params_of(toy_rooms(), sensors=True, limits=(7,) * 4)
    reset, step = (jax.jit(jax.vmap(f, axes)) for f, axes in (
        (dynamics.reset, (0, None)), (dynamics.step, (0, 0, 0, None)),
    ))  # fmt: skip
    batch, rng = 32, np.random.default_rng(4)
    obs, state = reset(jax.random.split(jax.random.key(0), batch), params)
    slow = [slow_start(state, b) for b in range(batch)]
    ends = {"done": 0, "time-out": 0, "diagonal": 0}
    for t in range(25):
        actions = rng.choice(6, batch, p=[0.5, 0.1, 0.2, 0.05, 0.05, 0.1])
        keys = jax.random.split(jax.random.fold_in(jax.random.key(1), t), batch)
        before = state
        obs, state, _, terminated, truncated, info = step(keys, state, actions, params)
        final = jax.device_get(info["final_state"])
        last, seen = final.sensors["odometry"], obs.sensors["odometry"]
        for b in range(batch):
            slow[b].update(int(actions[b]), bool(final.pose[b] == before.pose[b]))
            assert last.cell[b].tolist() == [slow[b].x, slow[b].z]
            assert last.action[b] == actions[b]
            if terminated[b] or truncated[b]:
                assert terminated[b] == (actions[b] == DONE)
                ends["done" if terminated[b] else "time-out"] += 1
                slow[b] = slow_start(state, b)
                ends["diagonal"] += slow[b].heading
                now = jax.tree.map(lambda x, b=b: x[b], state.sensors["odometry"])
                chex.assert_trees_all_equal(now, begun(slow[b].heading // 45, 0))
            np.testing.assert_array_equal(seen.window[b], slow[b].window())
            np.testing.assert_allclose(seen.motion[b], slow[b].motion(), atol=2e-6)
    assert min(ends.values()) > 10


def slow_start(state: EnvState, b: int) -> SlowOdometry:
    """The slow odometry at the start of the state's episode b."""
    pose = pose_of(int(state.pose[b]))
    return SlowOdometry(pose.heading % 90 != 0, pose.horizon // 30)


def test_choosing_episodes_chooses_their_maps() -> None:
    params = params_of(toy_rooms(), sensors=True)
    states = [
        jax.vmap(dynamics.start, (0, None, None))(poses, jnp.int32(0), params)
        for poses in (jnp.arange(0, 8), jnp.arange(16, 24))
    ]
    chosen = jnp.arange(8) % 3 == 0
    found = dynamics.choose(chosen, *states)
    for b in range(8):
        one, new, old = (jax.tree.map(lambda x, b=b: x[b], s) for s in (found, *states))
        chex.assert_trees_all_equal(one, new if chosen[b] else old)


# Measured poses.


measured_walk = st.lists(st.tuples(st.integers(0, 4), st.booleans()), min_size=1, max_size=12)


def relative(place: tuple[float, float], heading: float, rotation: float) -> tuple[float, ...]:
    """A pose in metres and degrees as it is measured from the start."""
    angle = math.radians(rotation)
    (x, z) = place
    right, ahead = (
        x * math.cos(angle) - z * math.sin(angle),
        x * math.sin(angle) + z * math.cos(angle),
    )
    return ahead, right, heading - rotation


update, read, last_step = (
    jax.jit(SENSOR.update),
    jax.jit(SENSOR.read),
    jax.jit(functools.partial(odometry.last_step, ITHOR)),
)


@settings(max_examples=30)
@given(st.integers(0, 7), measured_walk)
def test_where_motion_goes_as_believed_measuring_it_changes_nothing(
    rotation: int, walk: list[tuple[int, bool]]
) -> None:
    plain = SENSOR.init(Start(jnp.int32(rotation), jnp.int32(0)))
    state = SENSOR.init(Start(jnp.int32(rotation), jnp.int32(0), NO_SLIP))
    first = int(plain.heading) * 45
    for action, blocked in walk:
        motion = Motion(jnp.int32(action), jnp.array(blocked))
        plain = update(plain, motion, {})
        place = tuple(0.25 * np.asarray(plain.cell, float))
        told = relative(place, 45 * int(plain.heading), first)
        pose = measured_pose(ITHOR, rotation, *told)
        state = update(state, motion._replace(measured=pose), {})
        known, expected = read(state, {}), read(plain, {})
        np.testing.assert_array_equal(known.window, expected.window)
        np.testing.assert_allclose(known.motion, expected.motion, atol=1e-5)
        np.testing.assert_allclose(last_step(state), last_step(plain), atol=1e-5)


@settings(max_examples=30)
@given(
    st.integers(0, 7),
    st.lists(st.tuples(*[st.floats(-1, 1)] * 2, st.floats(-180, 180)), min_size=1, max_size=5),
)
def test_a_measured_pose_is_believed_whatever_the_action(
    rotation: int, poses: list[tuple[float, float, float]]
) -> None:
    state = SENSOR.init(Start(jnp.int32(rotation), jnp.int32(0), NO_SLIP))
    angle = np.radians(45 * (rotation % 2))
    before = np.zeros(2)
    for ahead, right, turned in poses:
        pose = measured_pose(ITHOR, rotation, ahead, right, turned)
        state = update(state, Motion(jnp.int32(MOVE_AHEAD), jnp.array(False), measured=pose), {})
        place = np.array([ahead * np.sin(angle) + right * np.cos(angle),
                          ahead * np.cos(angle) - right * np.sin(angle)])  # fmt: skip
        faces = angle + np.radians(turned)
        motion = np.asarray(read(state, {}).motion)
        np.testing.assert_allclose(motion[2:4], [np.sin(faces), np.cos(faces)], atol=1e-5)
        beside = place[0] * np.cos(faces) - place[1] * np.sin(faces)
        assert motion[0] == pytest.approx(beside / 4, abs=1e-5)
        np.testing.assert_allclose(last_step(state), (place - before) / 0.25, atol=1e-4)
        cell = np.rint(place / 0.25).astype(int) % 64
        direction = round(float(np.degrees(faces)) / 45) % 8
        assert int(state.cells[*cell]) >> direction & 1
        before = place
