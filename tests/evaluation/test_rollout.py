"""Evaluation of known policies on real rooms, and of a network against a plain loop."""

from __future__ import annotations

import functools
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings

from tdanet_jax.env import dynamics
from tdanet_jax.env.params import TEST_STEP_LIMITS, make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.evaluation import episodes, metrics, policies, rollout
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.evaluation.policies import Policy
from tdanet_jax.evaluation.rollout import Records
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.tdanet import TDANetEncoder
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.scenes import SceneTables
from tdanet_jax.splits import make_split
from tdanet_jax.vocabulary import TARGETS, Action
from tests.support import oracle, samples
from tests.support.handmade import random_tables
from tests.support.oracle import ROOMS, Episode, World, pose_of

KEY = jax.random.key(0)


def params_of(
    tables: SceneTables, targets: Any = TARGETS, limits: Any = TEST_STEP_LIMITS
) -> EnvParams:
    return make_params(tables, targets, no_parents(tables), limits, ObservationSpec("class"))


@pytest.fixture(scope="module")
def rooms(ithor: SceneTables) -> SceneTables:
    """The 40 test rooms."""
    return ithor.subset(make_split("22/0").eval_scenes)


@pytest.fixture(scope="module")
def params(rooms: SceneTables) -> EnvParams:
    return params_of(rooms)


def drawn(tables: SceneTables, per_room_type: int, seed: int = 0) -> Episodes:
    return episodes.draw(tables, tables.scenes, TARGETS, per_room_type, seed)


def constant(action: Action) -> Policy:
    """Always the same action."""
    return Policy(
        lambda weights, batch: (),
        lambda weights, memory, key, state, params: (memory, jnp.full(state.pose.shape, action)),
    )


def rates(records: Records) -> tuple[float, float]:
    spl = metrics.spl(records.success, records.shortest, records.length)
    return 100 * records.success.mean(), 100 * spl.mean()


def test_the_shortest_path_succeeds_everywhere_at_full_efficiency(
    rooms: SceneTables, params: EnvParams
) -> None:
    chosen = drawn(rooms, 250)
    records = rollout.evaluate(policies.shortest_path(), None, params, chosen, KEY)
    assert rates(records) == (100, 100)
    np.testing.assert_array_equal(records.length, records.shortest)
    assert records.shortest.max() > 10


@settings(max_examples=6)
@given(random_tables())
def test_the_shortest_path_is_found_where_some_steps_lead_to_no_return(tables: SceneTables) -> None:
    targets = dict.fromkeys(ROOMS, tables.targets)
    chosen = episodes.draw(tables, tables.scenes, targets, 8, seed=0)
    params = params_of(tables, targets)
    records = rollout.evaluate(policies.shortest_path(), None, params, chosen, KEY)
    assert rates(records) == (100, 100)


def test_the_random_policy_finds_about_one_target_in_nine(
    rooms: SceneTables, params: EnvParams
) -> None:
    # 4,000 episodes: the standard deviation of the rate is half a per cent.
    chosen = drawn(rooms, 1000)
    records = rollout.evaluate(policies.random(), None, params, chosen, KEY)
    success, spl = rates(records)
    assert 9 <= success <= 14
    assert 3 <= spl <= 8


def test_records_are_what_the_slow_world_says_of_the_same_actions(
    rooms: SceneTables, params: EnvParams
) -> None:
    world = World(rooms, {}, TEST_STEP_LIMITS, oracle.walk_on_grid(rooms))
    room_type = rooms.room_type[rooms.position_scene]
    chosen = drawn(rooms, 40)
    for policy in (policies.random(), policies.shortest_path(), constant(Action.ROTATE_LEFT)):
        records = rollout.evaluate(policy, None, params, chosen, KEY)
        for i in range(0, len(chosen), 4):
            pose, target = pose_of(int(chosen.pose[i])), rooms.targets[chosen.target[i]]
            taken = records.actions[i][records.actions[i] >= 0]
            assert (records.actions[i][len(taken) :] == -1).all()
            assert len(taken) == records.length[i]
            episode = Episode(pose, target)
            for action in taken[:-1]:
                outcome = world.act(episode, int(action))
                assert not outcome.terminated
                assert not outcome.truncated
            outcome = world.act(episode, int(taken[-1]))
            assert outcome.terminated or outcome.truncated
            assert bool(records.success[i]) == outcome.success
            assert outcome.truncated == (len(taken) == TEST_STEP_LIMITS[room_type[pose.position]]
                                         and taken[-1] != Action.DONE)  # fmt: skip


def test_the_optimal_length_counts_done(rooms: SceneTables, params: EnvParams) -> None:
    world = World(rooms, {}, TEST_STEP_LIMITS, oracle.walk_on_grid(rooms))
    chosen = drawn(rooms, 3, seed=1)
    records = rollout.evaluate(constant(Action.DONE), None, params, chosen, KEY)
    for i in range(len(chosen)):
        target = rooms.targets[chosen.target[i]]
        away = world.distance(int(chosen.pose[i]), target)
        assert records.shortest[i] == away + 1
        assert bool(records.success[i]) == (away == 0)
    assert (records.length == 1).all()


def test_who_says_done_too_late_is_stopped_by_the_limit_of_the_room(
    rooms: SceneTables, params: EnvParams
) -> None:
    def act(weights: Any, memory: Any, key: Any, state: EnvState, params: EnvParams) -> Any:
        # Done comes one action too late: where the target is in view, it must not count any more.
        limit = params.step_limit[params.position_room[state.pose // 16].astype(jnp.int32)]
        late = state.steps >= limit
        return memory, jnp.where(late, Action.DONE, Action.LOOK_UP)

    chosen = drawn(rooms, 50)
    records = rollout.evaluate(Policy(lambda w, batch: (), act), None, params, chosen, KEY)
    assert (records.shortest == 1).any()
    room_type = rooms.room_type[rooms.position_scene[chosen.pose // 16]]
    np.testing.assert_array_equal(records.length, np.array([100, 200, 100, 100])[room_type])
    assert not records.success.any()


def test_equal_keys_give_equal_records_and_others_do_not(
    rooms: SceneTables, params: EnvParams
) -> None:
    chosen = drawn(rooms, 25)
    first, again, other = (
        rollout.evaluate(policies.random(), None, params, chosen, jax.random.key(k))
        for k in (1, 1, 2)
    )
    for field in ("shortest", "length", "success", "actions"):
        np.testing.assert_array_equal(getattr(first, field), getattr(again, field))
    assert not np.array_equal(first.actions, other.actions)


MODEL = ActorCritic(TDANetEncoder(width=16), hidden=16)


@functools.cache
def network_weights(classes: int) -> tuple[Any, jax.Array]:
    """Parameters with opinions, and word vectors of every class."""
    rng = np.random.default_rng(0)
    words = jnp.asarray(rng.normal(size=(classes, 6)), jnp.float32)
    params = jax.tree.map(
        lambda x: x if x.ndim > 1 else 0 * x,  # what is in view decides, and not the biases
        samples.parameters(MODEL, words),
    )
    # Rarely Done, so that episodes are long enough to remember something.
    params["actor"]["bias"] = jnp.zeros(6).at[Action.DONE].set(-1.0)
    return params, words


@functools.cache
def network_policy(classes: int, greedy: bool = False) -> Policy:
    """One object for all tests: what it is compiled for is compiled once."""
    return policies.network(MODEL, network_weights(classes)[1], greedy)


def test_a_network_acts_as_a_plain_loop_over_its_own_past_does(
    rooms: SceneTables, params: EnvParams
) -> None:
    weights, words = network_weights(len(rooms.classes))
    chosen = drawn(rooms, 5)
    policy = network_policy(len(rooms.classes), greedy=True)
    records = rollout.evaluate(policy, weights, params, chosen, KEY)
    assert len(np.unique(records.actions)) > 3

    @jax.jit
    def think(state: EnvState, carry: Any, probs: jax.Array, is_first: jax.Array) -> Any:
        table = actor_critic.prepare(MODEL, weights, words)
        obs = jax.tree.map(lambda x: x[None], dynamics.observe(state, params))
        return actor_critic.forward(MODEL, weights, table, carry, obs, probs, is_first)

    for i in range(0, len(chosen), 5):
        state = dynamics.start(jnp.int32(chosen.pose[i]), jnp.int32(chosen.target[i]), params)
        carry, probs = MODEL.initial_carry(1, weights), jnp.zeros((1, 6))
        for t in range(min(int(records.length[i]), 12)):
            carry, out = think(state, carry, probs, jnp.array([t == 0]))
            probs = jax.nn.softmax(out.logits)
            action = int(np.argmax(out.logits))
            assert action == records.actions[i, t]
            state = dynamics.transition(state, jnp.int32(action), params).state


def test_a_greedy_network_ignores_the_key_and_a_sampling_one_does_not(
    rooms: SceneTables, params: EnvParams
) -> None:
    weights, _ = network_weights(len(rooms.classes))
    chosen = drawn(rooms, 5)  # as many as in other tests, for which it is compiled
    for greedy in (True, False):
        policy = network_policy(len(rooms.classes), greedy)
        one, two = (
            rollout.evaluate(policy, weights, params, chosen, jax.random.key(k)).actions
            for k in (3, 4)
        )
        assert np.array_equal(one, two) == greedy


def test_sampled_actions_follow_the_probabilities_of_the_network(
    rooms: SceneTables, params: EnvParams
) -> None:
    weights, words = network_weights(len(rooms.classes))
    start = drawn(rooms, 1)
    many = Episodes(np.repeat(start.pose[:1], 4000), np.repeat(start.target[:1], 4000))
    brief = params.replace(step_limit=jnp.ones(4, jnp.int32))  # the first action is enough
    policy = network_policy(len(rooms.classes))
    records = rollout.evaluate(policy, weights, brief, many, KEY)
    table = actor_critic.prepare(MODEL, weights, words)
    state = jax.vmap(dynamics.start, (0, 0, None))(start.pose[:1], start.target[:1], params)
    obs = jax.vmap(dynamics.observe, (0, None))(state, params)
    blank = (MODEL.initial_carry(1, weights), obs, jnp.zeros((1, 6)), jnp.ones(1, bool))
    _, out = jax.jit(actor_critic.forward, static_argnums=0)(MODEL, weights, table, *blank)
    share = np.bincount(records.actions[:, 0], minlength=6) / 4000
    # A share of 4,000 draws has a standard deviation of at most 0.008.
    np.testing.assert_allclose(share, jax.nn.softmax(out.logits)[0], atol=0.04)
    chex.assert_shape(records.actions, (4000, 1))


def test_episodes_play_in_parts_as_they_do_at_once(
    rooms: SceneTables, params: EnvParams, monkeypatch: pytest.MonkeyPatch
) -> None:
    weights, words = network_weights(len(rooms.classes))
    chosen = drawn(rooms, 5)
    alone = rollout.evaluate(network_policy(len(rooms.classes)), weights, params, chosen, KEY)
    assert len(chosen) % 7  # the last part is not full
    assert len({*alone.length.tolist()}) > 7  # and parts become fewer
    monkeypatch.setattr(rollout, "PART", 7)
    policy = policies.network(MODEL, words)  # not yet compiled
    parts = rollout.evaluate(policy, weights, params, chosen, KEY)
    jax.tree.map(np.testing.assert_array_equal, vars(parts), vars(alone))


@pytest.mark.parametrize("greedy", [True, False])
def test_forbidden_actions_are_never_taken(
    rooms: SceneTables, params: EnvParams, greedy: bool
) -> None:
    weights, words = network_weights(len(rooms.classes))
    chosen = drawn(rooms, 20)
    state = jax.vmap(dynamics.start, (0, 0, None))(chosen.pose, chosen.target, params)
    forbidden = [action for action in Action if action != Action.LOOK_UP]
    policy = policies.network(MODEL, words, greedy, forbidden)
    memory = policy.start(weights, len(chosen))
    _, taken = jax.jit(policy.act)(weights, memory, KEY, state, params)
    assert {*taken.tolist()} == {Action.LOOK_UP}


@pytest.mark.parametrize("batched", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_stacked_networks_play_as_each_of_them_alone(
    rooms: SceneTables, params: EnvParams, batched: bool
) -> None:
    weights, _ = network_weights(len(rooms.classes))
    several = [
        weights,
        jax.tree.map(lambda x: 0.5 * x, weights),
        jax.tree.map(jnp.negative, weights),
    ]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *several)
    policy = network_policy(len(rooms.classes))
    lists = {"seen": drawn(rooms, 5), "unseen": drawn(rooms, 5, seed=1)}
    seeds = (3, 3, 2**32 - 1)
    together = rollout.evaluate_stacked(policy, stacked, params, lists, seeds, batched)
    assert len(together) == 3
    for one, seed, played in zip(several, seeds, together, strict=True):
        alone = rollout.evaluate_lists(policy, one, params, lists, seed)
        for group, (chosen, records) in alone.items():
            assert played[group][0] is chosen
            for field in ("shortest", "length", "success", "actions"):
                np.testing.assert_array_equal(
                    getattr(played[group][1], field), getattr(records, field)
                )
    lengths = [played["seen"][1].length.tolist() for played in together]
    assert lengths[0] != lengths[1] != lengths[2]


def test_a_history_of_any_length_is_traced_once_a_list(
    rooms: SceneTables, params: EnvParams
) -> None:
    weights, words = network_weights(len(rooms.classes))
    stacked = jax.tree.map(lambda x: jnp.stack([x] * 20), weights)
    policy = policies.network(MODEL, words)
    traced = chex.assert_max_traces(policy.act, n=1)
    counted = Policy(policy.start, traced)
    lists = {"seen": drawn(rooms, 1), "unseen": drawn(rooms, 1)}  # of one shape: one compilation
    assert len(rollout.evaluate_stacked(counted, stacked, params, lists, 0)) == 20


def test_who_walks_into_something_has_collided(rooms: SceneTables, params: EnvParams) -> None:
    chosen = drawn(rooms, 5)
    records = rollout.evaluate(policies.random(), None, params, chosen, KEY)
    for i, actions in enumerate(records.actions):
        pose, bumped = jnp.int32(chosen.pose[i]), False
        for action in actions[: records.length[i]]:
            after = int(rooms.next_position[int(pose) // 16, int(pose) // 2 % 8])
            bumped |= bool(action == 0 and after == int(pose) // 16)
            pose = dynamics.move(pose, jnp.int32(action), params)
        assert records.collided[i] == bumped
    assert 0 < records.collided.sum() < len(chosen.pose)
