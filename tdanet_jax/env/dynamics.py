"""The environment's dynamics: find an object of the target class in a room, as pure functions.

`reset` and `step` follow gymnax 1.0's calling convention and work on one episode; use `jax.vmap`
for thousands. Scene tables are an argument (`EnvParams`), never a baked-in constant.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax.env.reward import DONE_REWARD, SIMILARITY_SHARE, STEP_REWARD
from tdanet_jax.env.types import EnvParams, EnvState, Observation, Outcome
from tdanet_jax.sensors import noise, odometry, suite
from tdanet_jax.sensors.noise import Detections
from tdanet_jax.sensors.sensor import Frame, Motion, Start
from tdanet_jax.vocabulary import NUM_ACTIONS, Action


def _pick(bits: jax.Array, count: jax.Array | int) -> jax.Array:
    """A uniform integer below `count`, from 24 of 32 random bits."""
    share = (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)
    return jnp.minimum((share * count).astype(jnp.int32), jnp.asarray(count, jnp.int32) - 1)


def _pick_from(bits: jax.Array, span: jax.Array) -> jax.Array:
    """A uniform index in [first, first + number) for span = (first, number)."""
    return span[0] + _pick(bits, span[1])


def start(
    pose: jax.Array,
    target: jax.Array,
    params: EnvParams,
    area_factor: jax.Array | None = None,
    noise_key: jax.Array | None = None,
) -> EnvState:
    """The state at the start of the given episode.

    Args:
      pose: where it starts.
      target: index of what to look for.
      params: the environment.
      area_factor: of the target's boxes, if there is size noise.
      noise_key: for what an episode's senses get wrong, if they err; None is one fixed key.
    """
    zero = jnp.zeros_like(pose)
    position, rotation, horizon = params.grid.split(pose)
    shortest = params.distance[pose, target].astype(jnp.int32) + 1
    state = EnvState(
        pose=pose,
        target=target,
        steps=zero,
        parents_seen=zero,
        shortest=shortest,
        similarity=None if params.similarity is None else jnp.zeros_like(pose, jnp.float32),
        area_factor=area_factor,
        room=params.position_room[position] if params.houses else None,
        noise=None
        if params.noise is None
        else noise.begin(jax.random.key(0) if noise_key is None else noise_key, params.noise),
    )
    bits = _noise_bits(state, params)
    slip = None if bits is None or state.noise is None else noise.slip(bits, state.noise)
    begun = suite.init(params.spec, Start(rotation, horizon, slip))
    return _look(state.replace(sensors=begun), params, bits)


def reset_state(key: jax.Array, params: EnvParams) -> EnvState:
    """A random episode: room type, scene, target and start, each uniform given the one before. With
    extra targets, those and the others each come about half of the time.

    Starts are uniform over the positions from which the target can be reached and over the
    rotations; the horizon is 0.
    """
    bits = jax.random.bits(key, (4,))
    room = params.room_pool[_pick(bits[0], params.room_pool.shape[0])]
    scene = _pick_from(bits[1], params.room_scenes[room])
    pair = _pick_from(bits[2], params.scene_pairs[scene])
    position = params.start_position[_pick_from(bits[3], params.pair_starts[pair])]
    rotation = _draw_rotation(bits, params.grid.rotations)
    factor = _draw_area_factor(key, params.size_noise) if params.size_noise else None
    pose = params.grid.look_level(position, rotation)
    own = None if params.noise is None else jax.random.fold_in(key, 1)
    return start(pose, params.pair_target[pair], params, factor, own)


def _draw_rotation(bits: jax.Array, rotations: int) -> jax.Array:
    """A uniform rotation, from those bits of words [4] that other choices do not use."""
    if rotations == 8:
        return (bits[0] & 7).astype(jnp.int32)
    return _pick(bits[0] << 24 | (bits[1] & 255) << 16 | (bits[2] & 255) << 8, rotations)


def _draw_area_factor(key: jax.Array, noise: float) -> jax.Array:
    """The square of a factor of the sides of boxes, log-uniform from e^-noise to e^noise."""
    # Not `key` itself: with or without noise, episodes are the same.
    own = jax.random.fold_in(key, 0)
    return jnp.exp(2 * jax.random.uniform(own, minval=-noise, maxval=noise))


def reset(key: jax.Array, params: EnvParams) -> tuple[Observation, EnvState]:
    """Starts a random episode: (observation, state)."""
    state = reset_state(key, params)
    return observe(state, params), state


def observe(state: EnvState, params: EnvParams) -> Observation:
    """What the agent is shown: the detections in view, padded to K rows, the target, and what its
    sensors read.
    """
    frame = _frame(state, params) if state.frame is None else state.frame
    features = None
    if params.features is not None and params.first_feature is not None:
        position, *view = params.grid.split(state.pose)
        features = params.features[params.first_feature[position] + params.grid.join(0, *view)]
    return Observation(
        classes=frame.classes,
        boxes=frame.boxes,
        mask=frame.mask,
        target=frame.target,
        empty=~frame.mask[0] if params.noise is None else ~jnp.any(frame.mask),
        cells=None if params.raster is None else params.raster[state.pose].astype(jnp.int32),
        features=features,
        sensors=suite.read(params.spec, state.sensors),
    )


def _noise_bits(state: EnvState, params: EnvParams) -> jax.Array | None:
    """The random bits of a step, if senses err."""
    if state.noise is None:
        return None
    return noise.draw(state.noise, state.steps, params.max_detections)


def _look(state: EnvState, params: EnvParams, bits: jax.Array | None) -> EnvState:
    """The state once the sensors have observed the frame; it keeps a frame that senses got wrong.

    Args:
      bits: of the step, if senses err.
    """
    frame = _frame(state, params)
    if bits is not None:
        frame = _noisy(frame, state, params, bits)
        state = state.replace(frame=frame)
    return state.replace(sensors=suite.observe(params.spec, state.sensors, frame))


def _frame(state: EnvState, params: EnvParams) -> Frame:
    """The detections in view, padded with zeros."""
    target = params.target_class[state.target]
    first, last = params.row_start[state.pose], params.row_start[state.pose + 1]
    longest = params.max_detections
    mask = jnp.arange(longest, dtype=jnp.int32) < last - first
    # Slices of flat arrays: gathering row by row takes twice the time.
    classes = jax.lax.dynamic_slice(params.row_class, (first,), (longest,))
    boxes = jax.lax.dynamic_slice(params.row_box.reshape(-1), (3 * first,), (3 * longest,))
    inside = jnp.arange(3 * longest, dtype=jnp.int32) < 3 * (last - first)
    boxes = jnp.where(inside, boxes, 0.0).reshape(longest, 3)
    if state.area_factor is not None:
        is_target = classes == target
        area = jnp.minimum(boxes[:, 2] * jnp.where(is_target, state.area_factor, 1.0), 1.0)
        boxes = boxes.at[:, 2].set(area)
    if params.spec.scores:
        boxes = jnp.concatenate([boxes, mask[:, None].astype(jnp.float32)], axis=1)
    return Frame(jnp.where(mask, classes, 0), boxes, mask, target)


def _noisy(frame: Frame, state: EnvState, params: EnvParams, bits: jax.Array) -> Frame:
    """What senses that err make of a frame."""
    assert params.noise is not None
    assert state.noise is not None
    longest, first = params.max_detections, params.row_start[state.pose]
    flat = params.noise.corners.reshape(-1)
    corners = jax.lax.dynamic_slice(flat, (4 * first,), (4 * longest,)).reshape(longest, 4)
    seen = Detections(frame.classes, frame.boxes, frame.mask)
    found = noise.detect(seen, corners, bits, state.noise, params.noise, params.row_class)
    return Frame(*found, frame.target)


def is_visible(pose: jax.Array, cls: jax.Array, params: EnvParams) -> jax.Array:
    """Whether an instance of class `cls` is visible within 1.5 m; False for class -1."""
    word = params.visible[pose, jnp.maximum(cls, 0) >> 5]
    return (cls >= 0) & ((word >> (cls & 31).astype(jnp.uint32)) & 1).astype(bool)


def would_succeed(state: EnvState, params: EnvParams) -> jax.Array:
    """Whether a `Done` would succeed now: the target is visible within 1.5 m."""
    return is_visible(state.pose, params.target_class[state.target], params)


def move(pose: jax.Array, action: jax.Array, params: EnvParams) -> jax.Array:
    """The pose after an action; an impossible action leaves it as it is."""
    position, rotation, horizon = params.grid.split(pose)
    ahead = params.next_position[position, rotation]
    position = jnp.where(action == Action.MOVE_AHEAD, ahead, position)
    return params.grid.join(position, *odometry.turn(params.grid, rotation, horizon, action))


def best_actions(state: EnvState, params: EnvParams) -> jax.Array:
    """The actions [6] bool that begin a shortest path to the target.

    `Done` alone where the target is visible; none where it cannot be reached.
    """
    actions = jnp.arange(NUM_ACTIONS)
    here = params.distance[state.pose, state.target]
    there = params.distance[move(state.pose, actions, params), state.target]
    return jnp.where(actions == Action.DONE, here == 0, (there == here - 1) & (here > 0))


def transition(state: EnvState, action: jax.Array, params: EnvParams) -> Outcome:
    """One action, without any reset. The reward is one of four values, as in the paper's Eq. 3.

    -0.01 by default; a partial reward instead where `_partial_reward` gives one; R_t, or R_t and
    the partial reward for what is in view, for a `Done` with the target visible.
    """
    action = jnp.asarray(action)  # of a Python int, `done` would be a Python bool
    steps = state.steps + 1
    bits = _noise_bits(state.replace(steps=steps), params)
    slip, moves = None, action
    if bits is not None and state.noise is not None:
        slip = noise.slip(bits, state.noise)
        turns = (action == Action.ROTATE_LEFT) | (action == Action.ROTATE_RIGHT)
        moves = jnp.where(turns & noise.turn_fails(bits, state.noise), NUM_ACTIONS, action)
    pose = move(state.pose, moves, params)
    done = action == Action.DONE
    success = done & would_succeed(state, params)
    earns, partial, at_done, seen = _partial_reward(state, pose, params)
    reward = jnp.where(~done & earns, partial, STEP_REWARD)
    reward = jnp.where(success, DONE_REWARD + at_done, reward)
    room = state.room
    if room is None:  # a scene has one type
        room = params.position_room[params.grid.split(pose).position]
    limit = params.step_limit[room.astype(jnp.int32)]
    after = seen.replace(pose=pose, steps=steps)
    moved = suite.update(params.spec, after.sensors, Motion(action, pose == state.pose, slip))
    return Outcome(
        state=_look(after.replace(sensors=moved), params, bits),
        reward=reward.astype(jnp.float32),
        terminated=done,
        truncated=~done & (steps >= limit),
        success=success,
    )


def _partial_reward(
    state: EnvState, pose: jax.Array, params: EnvParams
) -> tuple[jax.Array, jax.Array, jax.Array, EnvState]:
    """What the view from `pose` is worth.

    With parents: R_p when a parent of the target is visible for the first time (the largest such;
    once per parent class). With similarities: 0.1 times the largest cosine between the target and a
    class in view when it is the largest of the episode so far (Zhao et al. 2023).

    Returns:
      Whether it earns anything, how much, what the same view adds to a success whatever was seen
      before, and the state that remembers it.
    """
    if params.similarity is not None and state.similarity is not None:
        now = params.similarity[pose, state.target]
        worth = SIMILARITY_SHARE * now
        best = jnp.maximum(now, state.similarity)
        rises = now > state.similarity
        return rises, worth, jnp.maximum(worth, 0.0), state.replace(similarity=best)
    rewards = params.parent_reward[state.target]
    in_view = is_visible(pose, params.parent_class[state.target], params)
    bits = jnp.left_shift(1, jnp.arange(rewards.shape[0], dtype=jnp.int32))
    new = in_view & ((state.parents_seen & bits) == 0)

    def largest(among: jax.Array) -> jax.Array:
        return jnp.max(jnp.where(among, rewards, 0.0), axis=-1)

    seen = state.parents_seen | jnp.sum(jnp.where(in_view, bits, 0), axis=-1, dtype=jnp.int32)
    return jnp.any(new), largest(new), largest(in_view), state.replace(parents_seen=seen)


def choose(chosen: jax.Array, new: EnvState, old: EnvState) -> EnvState:
    """`new` where `chosen` [B], else `old`, in a batch of B episodes."""

    def one(chosen: jax.Array, new: EnvState, old: EnvState) -> EnvState:
        return jax.tree.map(lambda a, b: jnp.where(chosen, a, b), new, old)

    return jax.vmap(one)(chosen, new, old)


def step(
    key: jax.Array, state: EnvState, action: jax.Array, params: EnvParams
) -> tuple[Observation, EnvState, jax.Array, jax.Array, jax.Array, dict[str, Any]]:
    """One action; a finished episode is followed by the first state of a new one.

    Returns:
      observation, state, reward, terminated, truncated, info. `info` holds `success`, the episode's
      `length` (e, Done included) and `shortest` (L), and, as in gymnax, `terminated`, `truncated`
      and `final_observation`, from which a truncated episode is bootstrapped. It is that of
      `final_state`, the state before the reset.
    """
    out = transition(state, action, params)
    done = out.terminated | out.truncated
    begun = reset_state(key, params)
    following = jax.tree.map(lambda new, old: jnp.where(done, new, old), begun, out.state)
    info = {
        "success": out.success,
        "length": out.state.steps,
        "shortest": state.shortest,
        "terminated": out.terminated,
        "truncated": out.truncated,
        "final_state": out.state,
        "final_observation": observe(out.state, params),
    }
    observation = observe(following, params)
    return observation, following, out.reward, out.terminated, out.truncated, info
