"""Scene tables as the arrays that the environment reads."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax.env.types import EnvParams
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.sense_noise import SenseNoise
from tdanet_jax.sensors import detections, noise

if TYPE_CHECKING:
    from tdanet_jax.env.reward import Parents
    from tdanet_jax.scenes.tables import SceneTables

#: Steps after which a test episode ends, by room type (Du et al. 2020 and its successors).
TEST_STEP_LIMITS = (100, 200, 100, 100)
#: In room types of a user's own, as in living rooms: they can be as large, or larger.
OWN_TEST_STEP_LIMIT = 200


def limits_of_tests(tables: SceneTables) -> tuple[int, ...]:
    """Steps after which a test episode ends, by room type [T]."""
    own = len(tables.room_types) - len(TEST_STEP_LIMITS)
    return (*TEST_STEP_LIMITS, *[OWN_TEST_STEP_LIMIT] * own)


class FeatureMaps(NamedTuple):
    """ResNet-18's maps of some rooms, and where those of other tables' positions begin."""

    maps: jax.Array  # [S', 49, 512] float16
    first: np.ndarray  # [P] int, row in `maps` of each position's first pose


def make_params(
    tables: SceneTables,
    targets: Mapping[str, Sequence[str]],
    parents: Parents,
    step_limits: Sequence[int],
    spec: ObservationSpec,
    similarity: np.ndarray | None = None,
    features: FeatureMaps | None = None,
    scenes: Sequence[str] | None = None,
    size_noise: float = 0.0,
    extra: Mapping[str, Sequence[str]] | None = None,
) -> EnvParams:
    """The environment's parameters for some rooms and targets.

    Args:
      tables: the rooms.
      targets: room type -> target classes that an episode may ask for.
      parents: parents of every target and their rewards.
      step_limits: actions after which an episode is truncated, by room type.
      spec: what the agent is shown.
      similarity: [S, G], largest cosine between the target and a class in view; if given, it is
        rewarded in place of parents.
      features: ResNet-18's maps, if the spec shows them.
      scenes: the rooms in which `reset` begins an episode; by default all.
      size_noise: the sides of a target's boxes are scaled by a factor from e^-x to e^x per episode.
      extra: room type -> further target classes; in a room with `targets`, about half of the
        episodes ask for one of these.

    Raises:
      ValueError: no episode is possible.
    """
    start, classes, boxes, _ = _detections(tables, spec.rows == "class")
    longest = max(int(np.diff(start).max(initial=0)), 1)
    pad = (0, longest)  # rows after the last pose, so that a window of K never leaves the table
    begin = tables.scenes if scenes is None else scenes
    pool = _episode_pool(tables, (targets, extra or {}), begin)
    return EnvParams(
        next_position=jnp.asarray(tables.next_position, jnp.int32),
        position_room=jnp.asarray(tables.position_room_type, jnp.int8),
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
        raster=jnp.asarray(tables.raster, jnp.int8) if spec.image is not None else None,
        features=None if features is None else features.maps,
        first_feature=None if features is None else jnp.asarray(features.first, jnp.int32),
        spec=dataclasses.replace(spec, grid=tables.grid),
        size_noise=size_noise,
        houses=bool((tables.room_type < 0).any()),
        noise=None,
        **{name: jnp.asarray(v, jnp.int32) for name, v in pool.items()},
    )


def with_noise(
    params: EnvParams, tables: SceneTables, levels: SenseNoise, words: np.ndarray
) -> EnvParams:
    """The same environment with senses that err; unchanged if no level can be above 0.

    Args:
      params: what `make_params` made of the tables.
      tables: the rooms. Noise shows only classes that occur in them as detections.
      levels: of the noise.
      words: [C, D] word vectors, from which similar classes are found.
    """
    if not levels.any:
        return params
    merge = params.spec.rows == "class"
    _, classes, _, corners = _detections(tables, merge)
    names = tables.classes
    model = noise.make_params(
        levels, corners, classes, words, names, params.max_detections, one_per_class=merge
    )
    return params.replace(noise=model)


def _detections(
    tables: SceneTables, merge: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Detections of all poses: start [S + 1], class [N], (x, y, S) [N, 3] float32, extent [N, 4].

    With `merge`, a class's instances are one row (`detections.merge_classes`).
    """
    boxed = tables.row_box[:, 0] >= 0  # what is visible without a known box is no detection
    corners = tables.row_box[boxed].astype(np.float64) / (tables.image * tables.subpixel)
    start = np.concatenate([[0], np.cumsum(boxed)])[tables.row_start]
    classes = tables.row_class[boxed]
    if merge:
        key = tables.row_state[boxed].astype(np.int64) * len(tables.classes) + classes
        first, rows = detections.merge_classes(key, corners)
        start, classes = np.searchsorted(first, start), classes[first]
        if len(first):
            least = np.minimum.reduceat(corners[:, :2], first)
            corners = np.hstack([least, np.maximum.reduceat(corners[:, 2:], first)])
    else:
        rows = detections.centre_and_area(corners)
    return start, classes, rows.astype(np.float32), corners


def _episode_pool(
    tables: SceneTables, targets: Sequence[Mapping[str, Sequence[str]]], scenes: Sequence[str]
) -> dict[str, np.ndarray]:
    """Nested lists, as flat arrays: room type -> `scenes` -> targets -> start positions.

    An episode is valid if its target is visible from a state that its start can reach; rooms and
    pairs without a valid episode are left out. Each group of `targets` that a room has is asked for
    about equally often: the pairs of smaller ones are there several times.
    """
    reachable = tables.reachable
    chosen = np.isin(np.array(tables.scenes), scenes)
    room_scenes = np.zeros((len(tables.room_types), 2), np.int64)
    scene_pairs: list[tuple[int, int]] = []
    pair_target: list[int] = []
    pair_starts: list[tuple[int, int]] = []
    starts: list[np.ndarray] = []
    total = 0
    for room, room_name in enumerate(tables.room_types):
        first_scene = len(scene_pairs)
        for scene in np.flatnonzero(chosen).tolist():
            first_pair = len(pair_target)
            positions = tables.positions_in(scene, room)
            groups: list[list[tuple[int, tuple[int, int]]]] = []
            for group in targets:
                pairs = []
                for name in group.get(room_name, ()):
                    goal = tables.targets.index(name)
                    valid = positions[reachable[positions, goal]]
                    if valid.size:
                        pairs.append((goal, (total, valid.size)))
                        starts.append(valid)
                        total += valid.size
                groups.append(pairs)
            most = max(map(len, groups))
            for pairs in filter(None, groups):
                for goal, span in pairs * round(most / len(pairs)):
                    pair_target.append(goal)
                    pair_starts.append(span)
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
