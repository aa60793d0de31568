"""The jitted environment against the slow world, and its contract."""

from __future__ import annotations

import functools
from collections import Counter
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from tdanet_jax.env import dynamics
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import Parents, cosines, greatest_similarity, no_parents
from tdanet_jax.env.types import EnvParams, EnvState, Observation
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.tabulation import build
from tdanet_jax.vocabulary import TARGETS, Action
from tests.support import handmade, oracle, toy
from tests.support.handmade import (
    Room,
    Sighting,
    corridor,
    houses,
    lopsided,
    random_tables,
    tables_of,
)
from tests.support.oracle import DONE, ROOMS, Detection, Episode, World, pose_of, state_of

STEP_LIMITS = (7, 12, 5, 9)  # by room type; short, so that many episodes time out

reset = jax.jit(jax.vmap(dynamics.reset, (0, None)))
step = jax.jit(jax.vmap(dynamics.step, (0, 0, 0, None)))
observe = jax.jit(jax.vmap(dynamics.observe, (0, None)))


def random_parents(tables: SceneTables, seed: int) -> tuple[Parents, oracle.ParentRewards]:
    """Up to three parents per target with rewards of all sizes, in both worlds' terms."""
    rng = np.random.default_rng(seed)
    classes = np.full((len(tables.targets), 3), -1, np.int32)
    reward = np.zeros((len(tables.targets), 3), np.float32)
    named: dict[str, dict[str, float]] = {}
    common = np.bincount(tables.row_class[tables.row_visible], minlength=len(tables.classes))
    candidates = np.argsort(-common, kind="stable")[:12]
    for goal, target in enumerate(tables.targets):
        count = min(int(rng.integers(4)), len(candidates) - 1)
        chosen = [c for c in rng.permutation(candidates) if tables.classes[c] != target][:count]
        named[target] = {}
        for slot, cls in enumerate(chosen):
            # float32 throughout: both worlds pay the very same number.
            classes[goal, slot] = cls
            reward[goal, slot] = rng.choice([0.05, 0.2, 0.35, 0.5])
            named[target][tables.classes[cls]] = float(reward[goal, slot])
    return Parents(classes, reward), named


def in_use(tables: SceneTables) -> dict[str, tuple[str, ...]]:
    """Room type -> targets: the task's own, or all of them in hand-made rooms."""
    if set(tables.targets) == {name for names in TARGETS.values() for name in names}:
        return TARGETS
    return dict.fromkeys(ROOMS, tables.targets)


def detections_of(obs: Observation, row: int, tables: SceneTables) -> list[Detection]:
    """The valid rows of one observation of a batch; the padding checked to be blank."""
    mask = np.asarray(obs.mask[row])
    assert not np.asarray(obs.boxes[row])[~mask].any()
    assert not np.asarray(obs.classes[row])[~mask].any()
    assert bool(obs.empty[row]) == (not mask.any())
    classes, boxes = np.asarray(obs.classes[row])[mask], np.asarray(obs.boxes[row])[mask]
    return [
        Detection(tables.classes[cls], *(float(v) for v in box))
        for cls, box in zip(classes, boxes, strict=True)
    ]


def nth(tree: Any, row: int) -> Any:
    """One row of a batch."""
    return jax.tree.map(lambda x: x[row], tree)


def assert_same_detections(found: list[Detection], expected: list[Detection]) -> None:
    """The same rows in any order; boxes are float32 shares of the image, hence the tolerance."""

    def order(d: Detection) -> tuple[str, int, int, float]:
        return d.name, round(d.x * 9600), round(d.y * 9600), d.area  # half parts of a pixel

    found, expected = sorted(found, key=order), sorted(expected, key=order)
    assert [d.name for d in found] == [d.name for d in expected]
    np.testing.assert_allclose(
        np.array([d[1:] for d in found]).reshape(-1, 3),
        np.array([d[1:] for d in expected]).reshape(-1, 3),
        atol=1e-6,
    )


def assert_valid_start(world: World, state: EnvState, row: int) -> None:
    """The state is a first state of an episode that can succeed."""
    tables = world.tables
    pose = int(state.pose[row])
    target = tables.targets[int(state.target[row])]
    assert target in in_use(tables)[world.room(world.pose_of(pose).position)]
    assert world.pose_of(pose).horizon == 0
    assert int(state.steps[row]) == 0
    assert int(state.parents_seen[row]) == 0
    assert int(state.shortest[row]) == world.distance(pose, target) + 1


def parents_seen(params: EnvParams, state: EnvState, tables: SceneTables) -> set[str]:
    """The names that a state's bit set stands for."""
    parents = np.asarray(params.parent_class[int(state.target)])
    return {tables.classes[c] for i, c in enumerate(parents) if int(state.parents_seen) >> i & 1}


def assert_worlds_agree(world: World, params: EnvParams, batch: int, steps: int, seed: int) -> int:
    """Plays `steps` actions of `batch` episodes in both worlds; returns the successes seen.

    Half of the actions lie on a shortest path, so that successes are as common as time-outs.
    """
    tables, rng = world.tables, np.random.default_rng(seed)
    keys = jax.random.split(jax.random.key(seed), steps + 1)
    obs, state = reset(jax.random.split(keys[0], batch), params)
    episodes = [
        Episode(world.pose_of(int(state.pose[b])), tables.targets[int(state.target[b])])
        for b in range(batch)
    ]
    for b in range(batch):
        assert_valid_start(world, state, b)
    successes = 0
    for t in range(steps):
        for b, episode in enumerate(episodes):
            expected = world.detections(world.state_of(episode.pose), merge=False)
            assert_same_detections(detections_of(obs, b, tables), expected)
            assert tables.classes[int(obs.target[b])] == episode.target
        actions = rng.choice(6, batch, p=[0.3, 0.15, 0.15, 0.15, 0.15, 0.1])
        for b, episode in enumerate(episodes):
            if rng.random() < 0.5 and world.distance(world.state_of(episode.pose), episode.target):
                actions[b] = world.best_action(episode.pose, episode.target)
            elif (
                rng.random() < 0.5
                and world.distance(world.state_of(episode.pose), episode.target) == 0
            ):
                actions[b] = DONE
        began = [int(v) for v in state.shortest]
        out = step(jax.random.split(keys[t + 1], batch), state, jnp.asarray(actions), params)
        obs, state, reward, terminated, truncated, info = jax.device_get(out)
        for b, episode in enumerate(episodes):
            expected = world.act(episode, int(actions[b]))
            assert float(reward[b]) == pytest.approx(expected.reward, abs=1e-6)  # float32
            assert bool(terminated[b]) == expected.terminated
            assert bool(truncated[b]) == expected.truncated
            assert bool(info["success"][b]) == expected.success
            assert int(info["length"][b]) == episode.steps
            assert int(info["shortest"][b]) == began[b]
            successes += expected.success
            final = info["final_state"]
            assert int(final.pose[b]) == world.state_of(episode.pose)
            assert int(final.steps[b]) == episode.steps
            assert parents_seen(params, nth(final, b), tables) == episode.parents_seen
            if expected.terminated or expected.truncated:
                assert_valid_start(world, state, b)
                target = tables.targets[int(state.target[b])]
                episodes[b] = Episode(world.pose_of(int(state.pose[b])), target)
            else:
                chex.assert_trees_all_equal(nth(state, b), nth(final, b))
                away = world.distance(int(state.pose[b]), episode.target)
                goal = tables.targets.index(episode.target)
                assert int(params.distance[int(state.pose[b]), goal]) == (
                    -1 if away is None else away
                )
    return successes


def test_agrees_with_the_slow_world_in_real_rooms(ithor: SceneTables) -> None:
    tables = ithor.subset(("FloorPlan29", "FloorPlan204", "FloorPlan303", "FloorPlan402"))
    parents, named = random_parents(tables, seed=1)
    world = World(tables, named, STEP_LIMITS, oracle.walk_on_grid(tables))
    params = make_params(tables, TARGETS, parents, STEP_LIMITS, ObservationSpec())
    successes = assert_worlds_agree(world, params, batch=20, steps=30, seed=2)
    assert successes > 10, "the walk should reach targets, or little has been compared"


@pytest.mark.slow
def test_agrees_with_the_slow_world_in_rooms_built_from_boxes() -> None:
    rng = np.random.default_rng(10)
    rooms = [toy.random_room(rng, name=f"Random{i}") for i in range(8)]
    tables = build([toy.corridor(), *rooms], targets=("Apple", "Mug", "Sofa"))
    parents, named = random_parents(tables, seed=1)
    world = World(tables, named, STEP_LIMITS, oracle.walk_on_grid(tables))
    params = make_params(tables, in_use(tables), parents, STEP_LIMITS, ObservationSpec())
    assert assert_worlds_agree(world, params, batch=20, steps=40, seed=3) > 20


def random_likeness(
    tables: SceneTables, seed: int
) -> tuple[np.ndarray, dict[str, dict[str, float]]]:
    """Cosines of all sizes between targets and classes, in both worlds' terms."""
    words = np.random.default_rng(seed).normal(size=(len(tables.classes), 3))
    cosine = cosines(words.astype(np.float32))
    named = {
        target: dict(
            zip(tables.classes, map(float, cosine[tables.classes.index(target)]), strict=True)
        )
        for target in tables.targets
    }
    return greatest_similarity(tables, cosine), named


@pytest.mark.slow
def test_rewards_for_likeness_agree_with_the_slow_world(some_rooms: SceneTables) -> None:
    similarity, named = random_likeness(some_rooms, seed=5)
    world = World(some_rooms, {}, STEP_LIMITS, similarity=named)
    nobody = no_parents(some_rooms)
    params = make_params(
        some_rooms, TARGETS, nobody, STEP_LIMITS, ObservationSpec(), similarity=similarity
    )
    assert assert_worlds_agree(world, params, batch=25, steps=30, seed=6) > 20


@settings(max_examples=2)
@given(random_tables(), st.integers(0, 1000))
def test_rewards_for_likeness_agree_on_random_tables(tables: SceneTables, seed: int) -> None:
    similarity, named = random_likeness(tables, seed)
    world = World(tables, {}, STEP_LIMITS, similarity=named)
    nobody = no_parents(tables)
    params = make_params(
        tables, in_use(tables), nobody, STEP_LIMITS, ObservationSpec(), similarity=similarity
    )
    assert_worlds_agree(world, params, batch=8, steps=20, seed=seed)


def check_random_tables(tables: SceneTables, seed: int) -> None:
    parents, named = random_parents(tables, seed)
    world = World(tables, named, STEP_LIMITS)
    params = make_params(tables, in_use(tables), parents, STEP_LIMITS, ObservationSpec())
    assert_worlds_agree(world, params, batch=8, steps=20, seed=seed)


@settings(max_examples=4)  # each compiles; many more in the slow test below
@given(random_tables(), st.integers(0, 1000))
def test_agrees_with_the_slow_world_on_random_tables(tables: SceneTables, seed: int) -> None:
    check_random_tables(tables, seed)


@pytest.mark.slow
@settings(max_examples=500)
@given(random_tables(), st.integers(0, 1000))
def test_agrees_with_the_slow_world_on_many_random_tables(tables: SceneTables, seed: int) -> None:
    check_random_tables(tables, seed)
    jax.clear_caches()  # hundreds of compiled programs would exhaust a process's memory maps


def check_observations(tables: SceneTables, rows: Any, states: np.ndarray) -> None:
    world = World(tables, {}, STEP_LIMITS)
    params = params_of(tables, rows)
    zeros = jnp.zeros(len(states), jnp.int32)
    seen = EnvState(jnp.asarray(states), zeros, zeros, zeros, zeros)
    obs = jax.device_get(observe(seen, params))
    for row, pose in enumerate(states):
        expected = world.detections(int(pose), merge=rows == "class")
        assert_same_detections(detections_of(obs, row, tables), expected)


@pytest.mark.parametrize("rows", ["object", "class"])
def test_observations_of_real_rooms_are_the_slow_worlds(some_rooms: SceneTables, rows: str) -> None:
    states = np.random.default_rng(3).choice(some_rooms.num_states, 400, replace=False)
    check_observations(some_rooms, rows, states.astype(np.int32))


@settings(max_examples=5)
@given(random_tables(), st.sampled_from(["object", "class"]))
def test_observations_of_random_tables_are_the_slow_worlds(tables: SceneTables, rows: str) -> None:
    check_observations(tables, rows, np.arange(tables.num_states, dtype=np.int32))


def test_the_last_rows_of_the_table_are_observed_whole(some_rooms: SceneTables) -> None:
    # A window of K rows that starts at the last pose must not be moved back by clamping.
    states = np.arange(some_rooms.num_states - 32, some_rooms.num_states, dtype=np.int32)
    check_observations(some_rooms, "object", states)


@pytest.mark.parametrize("rows", ["object", "class"])
def test_no_detection_is_dropped_for_lack_of_room(some_rooms: SceneTables, rows: str) -> None:
    params = params_of(some_rooms, rows)
    fullest = np.diff(params.row_start).argmax().astype(np.int32)
    zero = jnp.int32(0)
    obs = dynamics.observe(EnvState(jnp.int32(fullest), zero, zero, zero, zero), params)
    assert obs.mask.all()
    world = World(some_rooms, {}, STEP_LIMITS)
    assert len(obs.mask) == len(world.detections(int(fullest), merge=rows == "class"))


def two_mugs(kind: str = "kitchen") -> SceneTables:
    """A corridor of three points with two mugs and a bread at its end."""
    objects = [("Mug", (0.0, 1.0, 1.0)), ("Mug", (0.0, 1.0, 1.5)), ("Bread", (0.0, 1.0, 2.0))]
    sightings = {
        handmade.state(2, 0): [
            Sighting(0, (0, 0, 480, 480)),
            Sighting(1, (2400, 2400, 4800, 4800), visible=False),
            Sighting(2, (960, 960, 1920, 1440)),
        ],
        handmade.state(2, 45): [Sighting(2, visible=False)],
    }
    room = Room(kind, corridor(3), objects, sightings)
    return tables_of([room], ["Bread", "Mug"], ["Mug", "Bread"])


def params_of(tables: SceneTables, rows: Any = "object") -> EnvParams:
    spec = ObservationSpec(rows)
    return make_params(tables, in_use(tables), no_parents(tables), STEP_LIMITS, spec)


def at(pose: int, target: int = 0) -> EnvState:
    zero = jnp.int32(0)
    return EnvState(jnp.int32(pose), jnp.int32(target), zero, zero, jnp.int32(1))


def test_a_detection_is_the_centre_and_area_of_its_box() -> None:
    tables = two_mugs()
    obs = dynamics.observe(at(handmade.state(2, 0)), params_of(tables))
    bread = np.asarray(obs.boxes[0])
    assert tables.classes[int(obs.classes[0])] == "Bread"
    np.testing.assert_allclose(bread, [0.3, 0.25, 0.2 * 0.1], atol=1e-7)


def test_a_merged_detection_has_the_mean_corner_and_the_common_extent() -> None:
    tables = two_mugs()
    obs = dynamics.observe(at(handmade.state(2, 0)), params_of(tables, "class"))
    mug = np.asarray(obs.boxes[1])
    assert tables.classes[int(obs.classes[1])] == "Mug"
    assert int(obs.mask.sum()) == 2
    np.testing.assert_allclose(mug, [0.4, 0.4, 1.0], atol=1e-7)


def test_an_empty_frame_is_marked_and_blank() -> None:
    obs = dynamics.observe(at(handmade.state(0, 0)), params_of(two_mugs()))
    assert bool(obs.empty)
    assert not obs.mask.any()
    assert not obs.boxes.any()


def test_a_class_in_view_beyond_reach_is_not_visible() -> None:
    tables = two_mugs()
    params = params_of(tables)
    bread = jnp.int32(tables.classes.index("Bread"))
    assert bool(dynamics.is_visible(jnp.int32(handmade.state(2, 0)), bread, params))
    assert not bool(dynamics.is_visible(jnp.int32(handmade.state(2, 45)), bread, params))
    assert not bool(dynamics.is_visible(jnp.int32(handmade.state(2, 0)), jnp.int32(-1), params))


@pytest.mark.parametrize(
    ("pose", "action", "expected"),
    [
        (oracle.Pose(0, 0, 0), 0, oracle.Pose(1, 0, 0)),
        (oracle.Pose(1, 180, 30), 0, oracle.Pose(0, 180, 30)),
        (oracle.Pose(2, 0, 0), 0, oracle.Pose(2, 0, 0)),  # the corridor's end
        (oracle.Pose(1, 90, 0), 0, oracle.Pose(1, 90, 0)),  # a wall
        (oracle.Pose(1, 0, 30), 1, oracle.Pose(1, 315, 30)),
        (oracle.Pose(1, 90, 0), 1, oracle.Pose(1, 45, 0)),
        (oracle.Pose(1, 315, 0), 2, oracle.Pose(1, 0, 0)),
        (oracle.Pose(1, 90, 30), 2, oracle.Pose(1, 135, 30)),
        (oracle.Pose(1, 90, 30), 3, oracle.Pose(1, 90, 0)),
        (oracle.Pose(1, 90, 0), 3, oracle.Pose(1, 90, 0)),  # already level
        (oracle.Pose(1, 90, 0), 4, oracle.Pose(1, 90, 30)),
        (oracle.Pose(1, 90, 30), 4, oracle.Pose(1, 90, 30)),  # already down
        (oracle.Pose(1, 90, 30), 5, oracle.Pose(1, 90, 30)),
    ],
)
def test_actions_move_as_described_and_impossible_ones_do_not(
    pose: oracle.Pose, action: int, expected: oracle.Pose
) -> None:
    moved = dynamics.move(jnp.int32(state_of(pose)), jnp.int32(action), params_of(two_mugs()))
    assert pose_of(int(moved)) == expected


def test_an_action_that_moves_nothing_still_counts_as_taken() -> None:
    out = dynamics.transition(at(handmade.state(2, 0)), jnp.int32(0), params_of(two_mugs()))
    assert int(out.state.steps) == 1
    assert int(out.state.pose) == handmade.state(2, 0)


@pytest.mark.parametrize(("room", "limit"), list(zip(ROOMS, STEP_LIMITS, strict=True)))
def test_the_step_limit_of_the_room_type_truncates_and_does_not_terminate(
    room: str, limit: int
) -> None:
    params = params_of(two_mugs(room))
    state = at(handmade.state(0, 0))
    for taken in range(1, limit + 1):
        out = dynamics.transition(state, jnp.int32(1), params)
        assert bool(out.truncated) == (taken == limit)
        assert not bool(out.terminated)
        last, state = state, out.state
    # Done in the very last step is an end, not a time-out.
    out = dynamics.transition(last, jnp.int32(DONE), params)
    assert bool(out.terminated)
    assert not bool(out.truncated)


@pytest.mark.parametrize(("start", "limit"), [(1, STEP_LIMITS[0]), (2, STEP_LIMITS[2])])
def test_the_step_limit_of_a_house_is_that_of_the_room_of_the_start(start: int, limit: int) -> None:
    params = params_of(houses())
    state = dynamics.start(jnp.int32(handmade.state(start, 0)), jnp.int32(0), params)
    state = state.replace(pose=jnp.int32(handmade.state(3 - start, 0)))  # in the other room
    for taken in range(1, limit + 1):
        out = dynamics.transition(state, jnp.int32(1), params)
        assert bool(out.truncated) == (taken == limit)
        state = out.state


@pytest.fixture(scope="module")
def contract(some_rooms: SceneTables) -> tuple[EnvParams, EnvState, jax.Array, jax.Array]:
    """Parameters, a batch of states in mid-episode, actions and keys."""
    parents, _ = random_parents(some_rooms, seed=4)
    params = make_params(some_rooms, TARGETS, parents, STEP_LIMITS, ObservationSpec("class"))
    keys = jax.random.split(jax.random.key(5), 24)
    _, state = reset(keys, params)
    state = state.replace(steps=jnp.arange(24, dtype=jnp.int32) % 5)
    return params, state, jnp.arange(24) % 6, keys


def test_jit_equals_eager_and_vmap_equals_a_loop(contract: tuple) -> None:
    params, state, actions, keys = contract
    batched = step(keys, state, actions, params)
    single = jax.jit(dynamics.step)
    for b in range(24):
        own = nth((keys, state, actions), b)
        row = nth(batched, b)
        chex.assert_trees_all_equal(single(*own, params), row)
        if b < 4:
            chex.assert_trees_all_equal(dynamics.step(*own, params), row)
            chex.assert_trees_all_equal(dynamics.reset(own[0], params), nth(reset(keys, params), b))


@pytest.mark.parametrize("action", [1, Action.ROTATE_LEFT, DONE, Action.DONE])
def test_a_plain_number_is_an_action_too(action: int) -> None:
    params, state = params_of(two_mugs()), at(handmade.state(0, 0))
    for take in (dynamics.transition, jax.jit(dynamics.transition)):
        out = take(state, action, params)
        expected = dynamics.transition(state, jnp.int32(action), params)
        chex.assert_trees_all_equal_dtypes(out, expected)
        chex.assert_trees_all_equal(out, expected)
    _, _, _, terminated, truncated, _ = dynamics.step(jax.random.key(0), state, action, params)
    assert terminated.dtype == truncated.dtype == bool
    assert bool(terminated) == (action == DONE)
    assert not bool(truncated)


def test_one_trace_per_shape_whatever_the_tables_hold(some_rooms: SceneTables) -> None:
    parents, _ = random_parents(some_rooms, seed=4)
    params = make_params(some_rooms, TARGETS, parents, STEP_LIMITS, ObservationSpec("class"))
    others = jax.tree.map(lambda x: x + 0, params).replace(
        step_limit=jnp.asarray((3, 3, 3, 3), jnp.int32)
    )
    chex.clear_trace_counter()

    @jax.jit
    @chex.assert_max_traces(n=1)
    def traced(keys: jax.Array, state: EnvState, actions: jax.Array, params: EnvParams) -> Any:
        return jax.vmap(dynamics.step, (0, 0, 0, None))(keys, state, actions, params)

    keys = jax.random.split(jax.random.key(6), 8)
    _, state = reset(keys, params)
    for chosen in (params, others, params):
        _, state, *_ = traced(keys, state, jnp.zeros(8, jnp.int32), chosen)


def test_dtypes_are_stable_from_reset_through_steps(contract: tuple) -> None:
    params, state, actions, keys = contract
    obs, begun = jax.eval_shape(jax.vmap(dynamics.reset, (0, None)), keys, params)
    after = jax.eval_shape(jax.vmap(dynamics.step, (0, 0, 0, None)), keys, state, actions, params)
    chex.assert_trees_all_equal_shapes_and_dtypes(after[0], obs)
    chex.assert_trees_all_equal_shapes_and_dtypes(after[1], begun)
    chex.assert_trees_all_equal_shapes_and_dtypes(after[5]["final_state"], begun)
    assert after[2].dtype == jnp.float32
    assert [after[i].dtype for i in (3, 4)] == [jnp.bool_] * 2
    chex.assert_trees_all_equal_shapes_and_dtypes(
        jax.lax.scan(lambda s, k: (step(k, s, actions, params)[1], None), state, keys[None])[0],
        state,
    )


def test_a_finished_episode_is_followed_by_a_new_one_and_its_last_state_is_kept() -> None:
    params = params_of(two_mugs())
    begun = at(handmade.state(2, 0)).replace(steps=jnp.int32(3), parents_seen=jnp.int32(1))
    key = jax.random.key(7)
    obs, state, _, terminated, _, info = dynamics.step(key, begun, jnp.int32(DONE), params)
    assert bool(terminated)
    assert bool(info["success"])
    assert int(info["final_state"].pose) == handmade.state(2, 0)
    assert int(info["final_state"].steps) == int(info["length"]) == 4
    assert int(state.steps) == int(state.parents_seen) == 0
    chex.assert_trees_all_equal(obs, dynamics.observe(state, params))
    chex.assert_trees_all_equal(state, dynamics.reset(key, params)[1])


def test_an_unfinished_episode_goes_on_whatever_the_key() -> None:
    params = params_of(two_mugs())
    state = at(handmade.state(0, 0))
    states = [dynamics.step(jax.random.key(k), state, jnp.int32(2), params)[1] for k in range(3)]
    chex.assert_trees_all_equal(*states)


def assert_uniform(values: np.ndarray, expected: set[int]) -> None:
    """Chi-square test at one in a million: a fixed key passes or fails once and for all."""
    counts = Counter(values.tolist())
    assert set(counts) == expected
    if len(expected) > 1:
        assert stats.chisquare([counts[v] for v in sorted(expected)]).pvalue > 1e-6


def test_resets_are_uniform_over_room_types_then_scenes_then_targets_then_starts() -> None:
    tables = lopsided()
    params = make_params(
        tables, {"kitchen": ("Mug", "Bread"), "bedroom": ("Bread",)}, no_parents(tables),
        STEP_LIMITS, ObservationSpec(),
    )  # fmt: skip
    keys = jax.random.split(jax.random.key(8), 20_000)
    state = jax.device_get(jax.jit(jax.vmap(dynamics.reset_state, (0, None)))(keys, params))
    position, rotation, horizon = state.pose // 16, state.pose // 2 % 8, state.pose % 2
    scene = tables.position_scene[position]
    kitchen = scene != 4
    assert not horizon.any()
    assert_uniform(tables.room_type[scene], {ROOMS.index("kitchen"), ROOMS.index("bedroom")})
    assert_uniform(scene[kitchen], {0, 1, 2})
    assert_uniform(state.target[scene == 0], {0, 1})  # once per class, not per instance
    assert set(state.target[scene == 1]) == {0}
    assert set(state.target[scene == 4]) == {1}, "a bedroom may only ask for its own targets"
    assert_uniform(position[scene == 0], {0, 1})
    assert_uniform(position[scene == 1], {2, 3, 4})
    assert_uniform(position[scene == 2], {5, 6})  # the other three cannot reach the mug
    assert_uniform(rotation, set(range(8)))
    for s in range(3):
        assert_uniform(rotation[scene == s], set(range(8)))
        for p in np.unique(position[scene == s]):
            assert_uniform(rotation[position == p], set(range(8)))


@pytest.mark.parametrize("rotations", [4, 6, 8, 12, 24])
def test_rotations_of_other_grids_are_uniform_and_independent_of_the_target(rotations: int) -> None:
    grid = PoseGrid(rotations=rotations, horizons=(-30, 0))
    here = {0: [Sighting(0), Sighting(1)]}
    ahead = [[0] * rotations, [1] * rotations]
    ahead[1][0] = 0
    objects = [("Mug", (0.0, 0.0, 0.0)), ("Bread", (0.0, 0.0, 0.0))]
    rooms = [Room("kitchen", ahead, objects, here)] * 3
    tables = tables_of(rooms, ["Bread", "Mug"], ["Mug", "Bread"], grid=grid)
    keys = jax.random.split(jax.random.key(8), 20_000)
    drawn = jax.jit(jax.vmap(dynamics.reset_state, (0, None)))(keys, params_of(tables))
    state = jax.device_get(drawn)
    position, rotation, horizon = grid.split(state.pose)
    assert (horizon == grid.level).all()
    for goal in range(2):
        for place in range(6):
            assert_uniform(
                rotation[(state.target == goal) & (position == place)], set(range(rotations))
            )


@pytest.mark.parametrize(
    "real", [pytest.param(True, marks=pytest.mark.slow), False], ids=["real rooms", "houses"]
)
def test_every_valid_episode_is_offered_and_no_other(ithor: SceneTables, real: bool) -> None:
    tables = ithor.subset(("FloorPlan29", "FloorPlan402"))  # unconnected; connected
    targets, ahead = TARGETS, oracle.walk_on_grid(tables)
    if not real:
        tables, targets = houses(), {"kitchen": ("Mug",), "bedroom": ("Pillow", "Mug")}
        ahead = None
    world = World(tables, {}, STEP_LIMITS, ahead)
    nobody = no_parents(tables)
    params = jax.device_get(make_params(tables, targets, nobody, STEP_LIMITS, ObservationSpec()))
    found: dict[tuple[int, int, str], set[int]] = {}
    for room in params.room_pool:
        first, count = params.room_scenes[room]
        for pairs, number in params.scene_pairs[first : first + count]:
            for pair in range(pairs, pairs + number):
                start, length = params.pair_starts[pair]
                positions = params.start_position[start : start + length].tolist()
                assert len(set(positions)) == len(positions)
                scene = int(tables.position_scene[positions[0]])
                target = tables.targets[params.pair_target[pair]]
                assert (room, scene, target) not in found
                found[room, scene, target] = set(positions)
    expected = {}
    for scene in range(len(tables.scenes)):
        for room, names in targets.items():
            for target in names:
                if starts := world.valid_starts(scene, target, room):
                    expected[ROOMS.index(room), scene, target] = starts
    assert found == expected


def test_tables_without_a_possible_episode_are_refused() -> None:
    room = Room("kitchen", corridor(2), [("Mug", (0.0, 0.0, 0.0))], {})
    tables = tables_of([room], ["Mug"], ["Mug"])
    with pytest.raises(ValueError, match="target class"):
        params_of(tables)


def test_rewards_of_a_batch_do_not_depend_on_their_neighbours(contract: tuple) -> None:
    params, state, actions, keys = contract
    order = np.random.default_rng(9).permutation(24)
    shuffle = functools.partial(jax.tree.map, lambda x: x[order])
    chex.assert_trees_all_equal(
        step(*shuffle((keys, state, actions)), params), shuffle(step(keys, state, actions, params))
    )
