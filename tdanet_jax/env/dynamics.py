"""The environment: find an object of the target class in a room, as pure functions.

`reset` and `step` follow gymnax 1.0's calling convention and work on one episode; use `jax.vmap`
for thousands. Scene tables are an argument (`EnvParams`), never a baked-in constant.

Axis letters: P positions, S = 16 P poses, C classes, G targets, K detections, Q (scene, target)
pairs, R scenes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct

from tdanet_jax import poses
from tdanet_jax.env.reward import DONE_REWARD, SIMILARITY_SHARE, STEP_REWARD, Parents
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.sensors import detections, odometry
from tdanet_jax.sensors.odometry import Odometry, Trail
from tdanet_jax.vocabulary import ROOM_TYPES, Action

#: Rows and columns of the class raster, the size of a ResNet-18 feature map.
RASTER = (7, 7)
#: Cells and channels of a ResNet-18 feature map.
FEATURES = (49, 512)
#: Steps after which a test episode ends, by room type (Du et al. 2020 and its successors).
TEST_STEP_LIMITS = (100, 200, 100, 100)


class EnvParams(struct.PyTreeNode):
    """Everything that the environment reads: scene tables, rewards and the lists of episodes."""

    next_position: jax.Array  # [P, 8] int32, where MoveAhead leads, by heading
    position_room: jax.Array  # [P] int8, room type of the position
    row_start: jax.Array  # [S + 1] int32, detections of a pose are rows row_start[s]:row_start[s+1]
    row_class: jax.Array  # [N + K] int32, class of a detection
    row_box: jax.Array  # [N + K, 3] float32, box centre x, y and area S as shares of the image
    visible: jax.Array  # [S, ceil(C / 32)] uint32, bit set of the classes visible within 1.5 m
    distance: jax.Array  # [S, G] int16, actions to the target without Done; -1 out of reach
    target_class: jax.Array  # [G] int32, class of a target
    parent_class: jax.Array  # [G, 3] int32, -1 where a target has fewer parents
    parent_reward: jax.Array  # [G, 3] float32, R_p of the paper's Eq. 3
    step_limit: jax.Array  # [4] int32, actions after which an episode is truncated, by room type
    room_pool: jax.Array  # [rooms] int32, room types that have an episode
    room_scenes: jax.Array  # [4, 2] int32, first and number of the scenes of a room type
    scene_pairs: jax.Array  # [R', 2] int32, first and number of a scene's (scene, target) pairs
    pair_target: jax.Array  # [Q] int32, the target of a pair
    pair_starts: jax.Array  # [Q, 2] int32, first and number of a pair's start positions
    start_position: jax.Array  # [sum] int32, positions from which the pair's target can be reached
    similarity: jax.Array | None  # [S, G] float32, largest cosine in view, if it is paid for
    raster: jax.Array | None  # [S, 7, 7] int8, class of each image cell, -1 none; if anyone looks
    features: jax.Array | None  # [S', 49, 512] float16, ResNet-18's maps of imported rooms; or none
    first_feature: jax.Array | None  # [P] int32, row of a position's first pose in `features`
    max_detections: int = struct.field(pytree_node=False)  # K, most detections in any pose
    odometry: bool = struct.field(pytree_node=False, default=False)  # the agent senses its way
    triangulation: bool = struct.field(pytree_node=False, default=False)  # and the target's place
    size_noise: float = struct.field(pytree_node=False, default=0.0)  # see `_draw_area_factor`


class EnvState(struct.PyTreeNode):
    """One episode in progress."""

    pose: jax.Array  # int32, see scenes/poses.py
    target: jax.Array  # int32, index among the G targets
    steps: jax.Array  # int32, actions taken
    parents_seen: jax.Array  # int32, bit set over the target's three parents
    shortest: jax.Array  # int32, L: actions on the optimal path from the start, Done included
    similarity: jax.Array | None = None  # float32, largest cosine so far, if it is paid for
    area_factor: jax.Array | None = None  # float32, of the target's boxes, if there is size noise
    trail: Trail | None = None  # the way so far, if the agent senses it


class Observation(struct.PyTreeNode):
    """What the agent perceives. A frame without detections is one all-zero row."""

    classes: jax.Array  # [K] int32, class of each detection; 0 in padding
    boxes: jax.Array  # [K, 3] float32, x, y, S
    mask: jax.Array  # [K] bool, False in padding
    target: jax.Array  # int32, class of the target
    empty: jax.Array  # bool, no detection at all
    cells: jax.Array | None = None  # [7, 7] int32, class of each image cell, -1 none; if asked for
    features: jax.Array | None = None  # [49, 512] float16, ResNet-18's map of an imported image
    odometry: Odometry | None = None  # what the agent senses of its way; if asked for


class Outcome(NamedTuple):
    """What one action leads to, before any reset."""

    state: EnvState
    reward: jax.Array  # float32
    terminated: jax.Array  # bool, Done was taken
    truncated: jax.Array  # bool, the step limit was reached without Done
    success: jax.Array  # bool, Done with the target visible


def make_params(
    tables: SceneTables,
    targets: Mapping[str, Sequence[str]],
    parents: Parents,
    step_limits: Sequence[int],
    merge: bool,
    image: bool = False,
    similarity: np.ndarray | None = None,
    features: tuple[jax.Array, np.ndarray] | None = None,
    scenes: Sequence[str] | None = None,
    odometry: bool = False,
    triangulation: bool = False,
    size_noise: float = 0.0,
) -> EnvParams:
    """Puts scene tables into the arrays that the environment reads.

    Args:
      tables: the rooms.
      targets: room type -> target classes that an episode may ask for.
      parents: parents of every target and their rewards.
      step_limits: actions after which an episode is truncated, by room type.
      merge: one detection per class and pose (extent over its instances) instead of one per object.
      image: observations hold the class raster, too.
      similarity: [S, G], largest cosine between the target and a class in view; given, it is paid
        for in place of parents.
      features: ResNet-18's maps of all poses of some rooms, [S', 49, 512], and for each position of
        these tables the row of its first pose there; observations then hold the map, too.
      scenes: the rooms in which `reset` begins an episode; by default all.
      odometry: observations hold what the agent senses of its own way, too.
      triangulation: and where it senses its target.
      size_noise: x, where the sides of a target's boxes are multiplied by e^-x to e^x.

    Raises:
      ValueError: no episode is possible.
    """
    start, classes, boxes = _detections(tables, merge)
    longest = max(int(np.diff(start).max(initial=0)), 1)
    pad = (0, longest)  # rows behind the last pose, so that a window of K never leaves the table
    position_room = tables.room_type[tables.position_scene]
    pool = _episode_pool(tables, targets, tables.scenes if scenes is None else scenes)
    return EnvParams(
        next_position=jnp.asarray(tables.next_position, jnp.int32),
        position_room=jnp.asarray(position_room, jnp.int8),
        row_start=jnp.asarray(start, jnp.int32),
        row_class=jnp.asarray(np.pad(classes.astype(np.int32), pad)),
        row_box=jnp.asarray(np.pad(boxes, (pad, (0, 0)))),
        visible=jnp.asarray(tables.visible_bits(), jnp.uint32),
        distance=jnp.asarray(tables.distance, jnp.int16),
        target_class=jnp.asarray([tables.classes.index(t) for t in tables.targets], jnp.int32),
        parent_class=jnp.asarray(parents.classes, jnp.int32),
        parent_reward=jnp.asarray(parents.reward, jnp.float32),
        step_limit=jnp.asarray(step_limits, jnp.int32),
        max_detections=longest,
        similarity=None if similarity is None else jnp.asarray(similarity, jnp.float32),
        raster=jnp.asarray(tables.raster, jnp.int8) if image else None,
        features=None if features is None else features[0],
        first_feature=None if features is None else jnp.asarray(features[1], jnp.int32),
        odometry=odometry,
        triangulation=triangulation,
        size_noise=size_noise,
        **{name: jnp.asarray(v, jnp.int32) for name, v in pool.items()},
    )


def _detections(tables: SceneTables, merge: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Detections of all poses: start [S + 1], class [N] and (x, y, S) [N, 3] float32.

    Merged, a class's instances are one row (`detections.merge_classes`).
    """
    boxed = tables.row_box[:, 0] >= 0  # what is visible without a known box is no detection
    corners = tables.row_box[boxed].astype(np.float64) / (tables.image * tables.subpixel)
    start = np.concatenate([[0], np.cumsum(boxed)])[tables.row_start]
    classes = tables.row_class[boxed]
    if merge:
        key = tables.row_state[boxed].astype(np.int64) * len(tables.classes) + classes
        first, rows = detections.merge_classes(key, corners)
        start, classes = np.searchsorted(first, start), classes[first]
    else:
        rows = detections.centre_and_area(corners)
    return start, classes, rows.astype(np.float32)


def _episode_pool(
    tables: SceneTables, targets: Mapping[str, Sequence[str]], scenes: Sequence[str]
) -> dict[str, np.ndarray]:
    """Nested lists, as flat arrays: room type -> `scenes` -> targets -> start positions.

    An episode is valid if its target is visible from a state that its start can reach; rooms and
    pairs without a valid episode are left out.
    """
    reachable = tables.reachable
    chosen = np.isin(np.array(tables.scenes), scenes)
    room_scenes = np.zeros((len(ROOM_TYPES), 2), np.int64)
    scene_pairs: list[tuple[int, int]] = []
    pair_target: list[int] = []
    pair_starts: list[tuple[int, int]] = []
    starts: list[np.ndarray] = []
    total = 0
    for room, room_name in enumerate(ROOM_TYPES):
        first_scene = len(scene_pairs)
        for scene in np.flatnonzero((tables.room_type == room) & chosen):
            first_pair = len(pair_target)
            positions = np.flatnonzero(tables.position_scene == scene)
            for name in targets.get(room_name, ()):
                goal = tables.targets.index(name)
                valid = positions[reachable[positions, goal]]
                if valid.size:
                    pair_target.append(goal)
                    pair_starts.append((total, valid.size))
                    starts.append(valid)
                    total += valid.size
            if len(pair_target) > first_pair:
                scene_pairs.append((first_pair, len(pair_target) - first_pair))
        room_scenes[room] = first_scene, len(scene_pairs) - first_scene
    if not starts:
        raise ValueError("no room holds a target class that can be reached")
    return {
        "room_pool": np.flatnonzero(room_scenes[:, 1]),
        "room_scenes": room_scenes,
        "scene_pairs": np.array(scene_pairs),
        "pair_target": np.array(pair_target),
        "pair_starts": np.array(pair_starts),
        "start_position": np.concatenate(starts),
    }


def _pick(bits: jax.Array, count: jax.Array | int) -> jax.Array:
    """A uniform integer below `count`, from 24 of 32 random bits."""
    share = (bits >> 8).astype(jnp.float32) * jnp.float32(2.0**-24)
    return jnp.minimum((share * count).astype(jnp.int32), jnp.asarray(count, jnp.int32) - 1)


def _pick_from(bits: jax.Array, span: jax.Array) -> jax.Array:
    """A uniform index in [first, first + number) for span = (first, number)."""
    return span[0] + _pick(bits, span[1])


def start(
    params: EnvParams, pose: jax.Array, target: jax.Array, area_factor: jax.Array | None = None
) -> EnvState:
    """The state at the start of the given episode."""
    zero = jnp.zeros_like(pose)
    _, rotation, horizon = poses.split(pose)
    shortest = params.distance[pose, target].astype(jnp.int32) + 1
    state = EnvState(
        pose=pose,
        target=target,
        steps=zero,
        parents_seen=zero,
        shortest=shortest,
        similarity=None if params.similarity is None else jnp.zeros_like(pose, jnp.float32),
        area_factor=area_factor,
    )
    if params.odometry:
        trail = odometry.begin(rotation & 1, horizon, params.triangulation)
        state = state.replace(trail=_look(trail, state, params))
    return state


def _look(trail: Trail, state: EnvState, params: EnvParams) -> Trail:
    """The trail, once the agent has seen what is in view."""
    classes, boxes, mask = _in_view(state, params)
    return odometry.look(trail, boxes, mask & (classes == params.target_class[state.target]))


def reset_state(key: jax.Array, params: EnvParams) -> EnvState:
    """A random episode: room type, scene, target and start, each uniform given the one before.

    Starts are uniform over the positions from which the target can be reached and over the eight
    rotations; the horizon is 0.
    """
    bits = jax.random.bits(key, (4,))
    room = params.room_pool[_pick(bits[0], params.room_pool.shape[0])]
    scene = _pick_from(bits[1], params.room_scenes[room])
    pair = _pick_from(bits[2], params.scene_pairs[scene])
    position = params.start_position[_pick_from(bits[3], params.pair_starts[pair])]
    rotation = (bits[0] & 7).astype(jnp.int32)  # bits that the choice of the room does not use
    factor = _draw_area_factor(key, params.size_noise) if params.size_noise else None
    return start(params, poses.join(position, rotation), params.pair_target[pair], factor)


def _draw_area_factor(key: jax.Array, noise: float) -> jax.Array:
    """The square of a factor of the sides of boxes, log-uniform from e^-noise to e^noise."""
    own = jax.random.fold_in(key, 0)  # not `key`: with or without noise, episodes are the same
    return jnp.exp(2 * jax.random.uniform(own, minval=-noise, maxval=noise))


def reset(key: jax.Array, params: EnvParams) -> tuple[Observation, EnvState]:
    """Starts a random episode: (observation, state)."""
    state = reset_state(key, params)
    return observe(state, params), state


def observe(state: EnvState, params: EnvParams) -> Observation:
    """The detections in view, padded to K rows."""
    classes, boxes, mask = _in_view(state, params)
    features = None
    if params.features is not None and params.first_feature is not None:
        position, *view = poses.split(state.pose)
        features = params.features[params.first_feature[position] + poses.join(0, *view)]
    return Observation(
        classes=classes,
        boxes=boxes,
        mask=mask,
        target=params.target_class[state.target],
        empty=~mask[0],
        cells=None if params.raster is None else params.raster[state.pose].astype(jnp.int32),
        features=features,
        odometry=None if state.trail is None else odometry.sense(state.trail),
    )


def _in_view(state: EnvState, params: EnvParams) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The detections in view: classes [K], boxes [K, 3], zeros in padding, and mask [K]."""
    first, last = params.row_start[state.pose], params.row_start[state.pose + 1]
    longest = params.max_detections
    mask = jnp.arange(longest, dtype=jnp.int32) < last - first
    # Windows of flat arrays: looking up row by row takes twice the time.
    classes = jax.lax.dynamic_slice(params.row_class, (first,), (longest,))
    boxes = jax.lax.dynamic_slice(params.row_box.reshape(-1), (3 * first,), (3 * longest,))
    inside = jnp.arange(3 * longest, dtype=jnp.int32) < 3 * (last - first)
    boxes = jnp.where(inside, boxes, 0.0).reshape(longest, 3)
    if state.area_factor is not None:
        is_target = classes == params.target_class[state.target]
        area = jnp.minimum(boxes[:, 2] * jnp.where(is_target, state.area_factor, 1.0), 1.0)
        boxes = boxes.at[:, 2].set(area)
    return jnp.where(mask, classes, 0), boxes, mask


def is_visible(params: EnvParams, pose: jax.Array, cls: jax.Array) -> jax.Array:
    """Whether an instance of class `cls` is visible within 1.5 m; False for class -1."""
    word = params.visible[pose, jnp.maximum(cls, 0) >> 5]
    return (cls >= 0) & ((word >> (cls & 31).astype(jnp.uint32)) & 1).astype(bool)


def move(params: EnvParams, pose: jax.Array, action: jax.Array) -> jax.Array:
    """The pose after an action; an impossible action leaves it as it is."""
    position, rotation, horizon = poses.split(pose)
    ahead = params.next_position[position, rotation]
    position = jnp.where(action == Action.MOVE_AHEAD, ahead, position)
    return poses.join(position, *odometry.turn(rotation, horizon, action))


def transition(state: EnvState, action: jax.Array, params: EnvParams) -> Outcome:
    """One action, without any reset. The reward is one of four values, as in the paper's Eq. 3.

    -0.01 by default; a partial reward instead where `_partial_reward` gives one; R_t, or R_t and
    the partial reward for what is in view, for a `Done` with the target visible.
    """
    action = jnp.asarray(action)  # of a Python int, `done` would be a Python bool
    pose = move(params, state.pose, action)
    done = action == Action.DONE
    success = done & is_visible(params, pose, params.target_class[state.target])
    earns, partial, at_done, seen = _partial_reward(state, pose, params)
    reward = jnp.where(~done & earns, partial, STEP_REWARD)
    reward = jnp.where(success, DONE_REWARD + at_done, reward)
    steps = state.steps + 1
    limit = params.step_limit[params.position_room[poses.split(pose).position].astype(jnp.int32)]
    after = seen.replace(pose=pose, steps=steps)
    if state.trail is not None:
        trail = odometry.follow(state.trail, action, pose == state.pose)
        after = after.replace(trail=_look(trail, after, params))
    return Outcome(
        state=after,
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
    in_view = is_visible(params, pose, params.parent_class[state.target])
    bits = jnp.left_shift(1, jnp.arange(rewards.shape[0], dtype=jnp.int32))
    fresh = in_view & ((state.parents_seen & bits) == 0)

    def largest(among: jax.Array) -> jax.Array:
        return jnp.max(jnp.where(among, rewards, 0.0), axis=-1)

    seen = state.parents_seen | jnp.sum(jnp.where(in_view, bits, 0), axis=-1, dtype=jnp.int32)
    return jnp.any(fresh), largest(fresh), largest(in_view), state.replace(parents_seen=seen)


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
      `length` (e, Done included) and `shortest` (L), and `final_state`, the state before the reset:
      a truncated episode is bootstrapped from `observe(info["final_state"], params)`.
    """
    out = transition(state, action, params)
    over = out.terminated | out.truncated
    fresh = reset_state(key, params)
    following = jax.tree.map(lambda new, old: jnp.where(over, new, old), fresh, out.state)
    info = {
        "success": out.success,
        "length": out.state.steps,
        "shortest": state.shortest,
        "final_state": out.state,
    }
    observation = observe(following, params)
    return observation, following, out.reward, out.terminated, out.truncated, info
