"""The data types of the environment.

Axis letters: P positions, S poses, C classes, T room types, G targets, K detections, Q (scene,
target) pairs, R scenes.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import PoseGrid
from tdanet_jax.sensors.noise import EpisodeNoise, NoiseParams
from tdanet_jax.sensors.sensor import Frame

#: Rows and columns of the class raster, the size of a ResNet-18 feature map.
RASTER = (7, 7)
#: Cells and channels of a ResNet-18 feature map.
FEATURES = (49, 512)


class EnvParams(struct.PyTreeNode):
    """Everything that the environment reads: scene tables, rewards and the lists of episodes."""

    next_position: jax.Array  # [P, rotations] int32, where MoveAhead leads, by heading
    position_room: jax.Array  # [P] int8, room type of the position
    row_start: jax.Array  # [S + 1] int32, detections of a pose are rows row_start[s]:row_start[s+1]
    row_class: jax.Array  # [N + K] int32, class of a detection
    row_box: jax.Array  # [N + K, 3] float32, box centre x, y and area S as shares of the image
    visible: jax.Array  # [S, ceil(C / 32)] uint32, bit set of the classes visible within 1.5 m
    distance: jax.Array  # [S, G] int16, actions to the target without Done; -1 out of reach
    target_class: jax.Array  # [G] int32, class of a target
    parent_class: jax.Array  # [G, 3] int32, -1 where a target has fewer parents
    parent_reward: jax.Array  # [G, 3] float32, R_p of the paper's Eq. 3
    step_limit: jax.Array  # [T] int32, actions after which an episode is truncated, by room type
    room_pool: jax.Array  # [rooms] int32, room types that have an episode
    room_scenes: jax.Array  # [T, 2] int32, first and number of the scenes of a room type
    scene_pairs: jax.Array  # [R', 2] int32, first and number of a scene's (scene, target) pairs
    pair_target: jax.Array  # [Q] int32, the target of a pair
    pair_starts: jax.Array  # [Q, 2] int32, first and number of a pair's start positions
    start_position: jax.Array  # [sum] int32, positions from which the pair's target can be reached
    similarity: jax.Array | None  # [S, G] float32, largest cosine in view, if it is rewarded
    raster: jax.Array | None  # [S, 7, 7] int8, class of each image cell, -1 none; if it is shown
    features: jax.Array | None  # [S', 49, 512] float16, ResNet-18's maps of imported rooms; or none
    first_feature: jax.Array | None  # [P] int32, row of a position's first pose in `features`
    max_detections: int = struct.field(pytree_node=False)  # K, most detections in any pose
    spec: ObservationSpec = struct.field(pytree_node=False, default=ObservationSpec())
    size_noise: float = struct.field(pytree_node=False, default=0.0)  # LearnerConfig.size_noise
    houses: bool = struct.field(pytree_node=False, default=False)  # scenes of several room types
    noise: NoiseParams | None = None  # of senses that err (`params.with_noise`)

    @property
    def grid(self) -> PoseGrid:
        """The poses at a position."""
        return self.spec.grid

    def with_rows(self, rows: int) -> EnvParams:
        """The same with so many rows in an observation, at least as many as now."""
        more = rows - self.max_detections  # rows of padding, also after the last pose
        noise = self.noise
        if noise is not None:
            noise = noise.replace(corners=jnp.pad(noise.corners, ((0, more), (0, 0))))
        return self.replace(
            row_class=jnp.pad(self.row_class, (0, more)),
            row_box=jnp.pad(self.row_box, ((0, more), (0, 0))),
            noise=noise,
            max_detections=rows,
        )

    def padded(self, other: EnvParams, spare: float = 0.0) -> EnvParams:
        """The same rooms in tables at least as long as those of `other`, so that one program serves
        both. Nothing reads the padding, but what noise draws depends on `max_detections`.

        Args:
          spare: share by which all of these tables are lengthened, so that those of others fit too.
        """
        rows = max(self.max_detections, other.max_detections)
        params = self if rows == self.max_detections else self.with_rows(rows)

        def longer(ours: jax.Array | None, theirs: jax.Array | None) -> jax.Array | None:
            if ours is None or theirs is None:
                return ours
            length = max(int(len(ours) * (1 + spare)), len(theirs))
            return jnp.pad(ours, ((0, length - len(ours)), *[(0, 0)] * (ours.ndim - 1)))

        noise = params.noise
        if noise is not None and other.noise is not None:
            noise = noise.replace(corners=longer(noise.corners, other.noise.corners))
        tables = {name: longer(getattr(params, name), getattr(other, name)) for name in _TABLES}
        return params.replace(noise=noise, **tables)


#: Tables whose length depends on the rooms.
_TABLES = (
    "next_position", "position_room", "row_start", "row_class", "row_box", "visible", "distance",
    "scene_pairs", "pair_target", "pair_starts", "start_position", "similarity", "raster",
)  # fmt: skip


class EnvState(struct.PyTreeNode):
    """One episode in progress."""

    pose: jax.Array  # int32, see poses.py
    target: jax.Array  # int32, index among the G targets
    steps: jax.Array  # int32, actions taken
    parents_seen: jax.Array  # int32, bit set over the target's three parents
    shortest: jax.Array  # int32, L: actions on the optimal path from the start, Done included
    similarity: jax.Array | None = None  # float32, largest cosine so far, if it is rewarded
    area_factor: jax.Array | None = None  # float32, of the target's boxes, if there is size noise
    room: jax.Array | None = None  # int8, room type of the start, if there are houses
    sensors: Mapping[str, Any] = struct.field(default_factory=dict)  # states of the sensors by name
    noise: EpisodeNoise | None = None  # of senses that err
    frame: Frame | None = None  # what they show


class Observation(struct.PyTreeNode):
    """What the agent perceives. A frame without detections is one all-zero row.

    With noise, padding lies anywhere.
    """

    classes: jax.Array  # [K] int32, class of each detection; 0 in padding
    boxes: jax.Array  # [K, 3] float32, x, y, S; [K, 4] with the score, if it is shown
    mask: jax.Array  # [K] bool, False in padding
    target: jax.Array  # int32, class of the target
    empty: jax.Array  # bool, no detection at all
    cells: jax.Array | None = None  # [7, 7] int32, class of each image cell, -1 none; if shown
    features: jax.Array | None = None  # [49, 512] float16, ResNet-18's map of an imported image
    sensors: Mapping[str, Any] = struct.field(default_factory=dict)  # readings by name

    @property
    def target_in_view(self) -> jax.Array:
        """Whether a detection is of the target's class; with the leading axes of `target`."""
        return jnp.any(self.mask & (self.classes == self.target[..., None]), axis=-1)


class Outcome(NamedTuple):
    """What one action leads to, before any reset."""

    state: EnvState
    reward: jax.Array  # float32
    terminated: jax.Array  # bool, Done was taken
    truncated: jax.Array  # bool, the step limit was reached without Done
    success: jax.Array  # bool, Done with the target visible
