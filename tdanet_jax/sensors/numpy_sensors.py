"""Odometry and triangulation in NumPy: what agents without JAX sense.

The same as `odometry`, `triangulation` and `robust_triangulation`, which explain it, for one
episode; tests hold them side by side. NumPy alone, Python 3.10.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import PoseGrid
from tdanet_jax.sensors.shared import (
    BLOCKED,
    BORDER,
    DIRECTIONS,
    FOLLOWED,
    HALF_CERTAIN,
    MAP_SIZE,
    MAX_RADIUS,
    MOVED,
    POSITION_SCALE,
    PRIOR_WEIGHT,
    SAME_OBJECT_COSINE,
    WINDOW,
    MeasuredPose,
    first_heading,
    window_offsets,
)
from tdanet_jax.vocabulary import NUM_ACTIONS, VISIBILITY_DISTANCE, Action

#: States of the sensors by name; a step makes new ones.
States = Mapping[str, Any]
#: Sensors by name: length of their features.
WIDTHS = {
    "odometry": 6 + NUM_ACTIONS + WINDOW * WINDOW * (DIRECTIONS + 1),
    "triangulation": 9,
    "robust-triangulation": 9,
}


class OdometryState(NamedTuple):
    """The agent's pose and map, relative to the episode's start."""

    cell: np.ndarray  # [2] int, x and z in cells
    heading: int  # turns clockwise from z
    horizon: int  # its index
    action: int  # the last action; 6 before the first
    blocked: bool  # the last action was a MoveAhead that did not move the agent
    cells: np.ndarray  # [MAP_SIZE, MAP_SIZE] int, the bits of each cell
    place: np.ndarray  # [2], from the cell to where it stands; x and z in cells
    angle: float  # radians clockwise from its heading to that which was measured
    step: np.ndarray  # [2], x and z in cells that the last action moved it by
    measured: bool  # whether poses are measured; if not, `place` and `angle` are 0


class TargetEstimate(NamedTuple):
    """What is known of the target's position p: the normal equations `normal p = moment`."""

    normal: np.ndarray  # [3, 3], sum of the projections across the rays; 0 without any
    moment: np.ndarray  # [3]
    radius: float  # half the side of a square as large as the box; metres
    moved: bool  # the agent has moved since the last ray


NO_ESTIMATE = TargetEstimate(np.zeros((3, 3)), np.zeros(3), 0.0, False)


def init(spec: ObservationSpec, rotation: int, horizon: int, measured: bool) -> States:
    """The states at the start of an episode, from rotation and horizon as a pose has them."""
    heading = int(first_heading(spec.grid, rotation))
    cells = np.zeros((MAP_SIZE, MAP_SIZE), int)
    cells[0, 0] = 1 << int(spec.grid.neighbour(heading))
    odometry = OdometryState(
        np.zeros(2, int), heading, horizon, NUM_ACTIONS, False, cells,
        np.zeros(2), 0.0, np.zeros(2), measured,
    )  # fmt: skip
    return {name: odometry if name == "odometry" else NO_ESTIMATE for name in spec.sensors}


def after(
    spec: ObservationSpec,
    states: States,
    action: int,
    blocked: bool,
    pose: MeasuredPose | None,
    another_target: bool,
    boxes: np.ndarray,
) -> States:
    """The states after an action and the frame that follows.

    Args:
      action: the last action; 6 before the first, which changes nothing.
      blocked: whether it was a MoveAhead that did not move the agent.
      pose: where it led, if that is measured.
      another_target: whether the agent looks for something else than before.
      boxes: [N, F], x, y, S of the target's boxes in the frame.
    """
    out: dict[str, Any] = {}
    for name in spec.sensors:
        if name == "odometry":
            out[name] = _moved(spec.grid, states[name], action, blocked, pose)
            continue
        odometry, robust = out["odometry"], name == "robust-triangulation"
        estimate = _from_here(spec.grid, states[name], odometry)
        if another_target:
            estimate = NO_ESTIMATE
        out[name] = _seen(spec.grid, estimate, odometry, boxes, robust) if len(boxes) else estimate
    return out


def read(spec: ObservationSpec, states: States) -> dict[str, np.ndarray]:
    """What the sensors say, by name, as the network's inputs: each [width] float32."""
    return {
        name: (
            _read_odometry(spec.grid, state)
            if name == "odometry"
            else _read_estimate(spec.grid, state, states["odometry"])
        ).astype(np.float32)
        for name, state in states.items()
    }


def features(spec: ObservationSpec, states: States) -> np.ndarray:
    """What all of them say, [width]."""
    return np.concatenate([*read(spec, states).values()])


def _moved(
    grid: PoseGrid,
    state: OdometryState,
    action: int,
    blocked: bool,
    pose: MeasuredPose | None,
) -> OdometryState:
    """Odometry after an action: marks one cell of the map."""
    ahead = grid.steps[state.heading]
    tried = action == Action.MOVE_AHEAD
    blocked = tried and blocked
    step = ahead if tried and not blocked else np.zeros(2, int)
    right = (action == Action.ROTATE_RIGHT) - (action == Action.ROTATE_LEFT)
    down = (action == Action.LOOK_DOWN) - (action == Action.LOOK_UP)
    new = state._replace(
        cell=state.cell + step,
        heading=(state.heading + right) % grid.rotations,
        horizon=min(max(state.horizon + down, 0), len(grid.horizons) - 1),
        action=action,
        blocked=blocked,
        step=step,
    )
    if pose is not None:
        new = new._replace(
            place=pose.place - new.cell,
            angle=float(pose.angle) - new.heading * (2 * np.pi / grid.rotations),
            step=pose.place - (state.cell + state.place),
        )
        ahead = grid.steps[_nearest(grid, new)[1]]
    cell, heading = _nearest(grid, new)
    if blocked:
        x, z = (cell + ahead) % MAP_SIZE
    else:
        x, z = cell % MAP_SIZE
    cells = state.cells.copy()
    cells[x, z] |= BLOCKED if blocked else 1 << int(grid.neighbour(heading))
    return new._replace(cells=cells)


def _nearest(grid: PoseGrid, state: OdometryState) -> tuple[np.ndarray, int]:
    """The cell [2] and the heading nearest to where the agent is."""
    cell = state.cell + np.rint(state.place).astype(int)
    turns = round(state.angle / (2 * np.pi / grid.rotations))
    return cell, (state.heading + turns) % grid.rotations


def _angle(grid: PoseGrid, state: OdometryState) -> float:
    """Radians clockwise from z in which the agent faces."""
    return state.heading * (2 * np.pi / grid.rotations) + state.angle


def _read_odometry(grid: PoseGrid, state: OdometryState) -> np.ndarray:
    """The pose relative to the start, and the map around the agent."""
    sine, cosine = np.sin(_angle(grid, state)), np.cos(_angle(grid, state))
    x, z = (state.cell + state.place) / (POSITION_SCALE / grid.grid_size)
    cell, heading = _nearest(grid, state)
    motion = [
        x * cosine - z * sine,
        x * sine + z * cosine,
        sine,
        cosine,
        grid.horizons[state.horizon] / 30,
        state.blocked,
        *(state.action == action for action in range(NUM_ACTIONS)),
    ]
    around = (cell + window_offsets(grid.rotations)[heading]) % MAP_SIZE
    bits = state.cells[around[..., 0], around[..., 1]]
    stood, own = bits & (BLOCKED - 1), int(grid.neighbour(heading))
    turned = ((stood >> own) | (stood << (DIRECTIONS - own))) & (BLOCKED - 1)
    window = (turned | bits & BLOCKED)[..., None] >> np.arange(DIRECTIONS + 1) & 1
    return np.concatenate([motion, window.ravel()])


def _from_here(grid: PoseGrid, estimate: TargetEstimate, odometry: OdometryState) -> TargetEstimate:
    """The estimate with its origin where the agent stands now."""
    x, z = odometry.step * grid.grid_size
    return estimate._replace(
        moment=estimate.moment - estimate.normal @ (x, 0.0, z),
        moved=estimate.moved or bool(np.hypot(*odometry.step) > MOVED),
    )


def _seen(
    grid: PoseGrid,
    estimate: TargetEstimate,
    odometry: OdometryState,
    boxes: np.ndarray,
    robust: bool,
) -> TargetEstimate:
    """The estimate with the ray of the target's box; of several, see `Triangulation.observe`."""
    rays = _rays(grid, boxes, odometry)
    lengths = np.linalg.norm(rays, axis=-1)
    directions = rays / lengths[:, None]
    nearest = int(np.argmax(directions @ _direction_of(_solve(estimate)[0])))
    more = _with_ray(estimate, directions[nearest], estimate.moved, robust)
    agrees = directions[nearest] @ _direction_of(_solve(more)[0]) > SAME_OBJECT_COSINE
    if estimate.normal[0, 0] > 0 and agrees:
        chosen, seen = nearest, more
    else:
        chosen = int(np.argmax(boxes[:, 2]))
        prior = NO_ESTIMATE._replace(
            normal=PRIOR_WEIGHT * np.eye(3),
            moment=PRIOR_WEIGHT * VISIBILITY_DISTANCE * directions[chosen],
        )
        seen = _with_ray(prior, directions[chosen], True, robust)
    depth = np.linalg.norm(_solve(seen)[0]) / lengths[chosen]
    return seen._replace(radius=min(float(np.sqrt(boxes[chosen, 2]) * depth), MAX_RADIUS))


def _rays(grid: PoseGrid, boxes: np.ndarray, odometry: OdometryState) -> np.ndarray:
    """Rays to the centres of boxes, one metre deep along the optical axis: [N, 3]."""
    right, up = 2 * boxes[:, 0] - 1, 1 - 2 * boxes[:, 1]
    down, angle = np.radians(grid.horizons[odometry.horizon]), _angle(grid, odometry)
    ahead, up = np.cos(down) + up * np.sin(down), up * np.cos(down) - np.sin(down)
    sine, cosine = np.sin(angle), np.cos(angle)
    return np.stack([right * cosine + ahead * sine, up, ahead * cosine - right * sine], axis=-1)


def _with_ray(
    estimate: TargetEstimate, direction: np.ndarray, counts: bool, robust: bool
) -> TargetEstimate:
    """The estimate with one more ray from where the agent is, if it `counts`."""
    if not counts:
        return estimate._replace(moved=False)
    across = np.eye(3) - direction[:, None] * direction
    more = estimate._replace(normal=estimate.normal + across, moved=False)
    if not robust:
        return more
    position, _ = _solve(more)
    sine_squared = 1 - (direction @ _direction_of(position)) ** 2
    return more._replace(moment=more.moment + FOLLOWED * sine_squared * position)


def _direction_of(position: np.ndarray) -> np.ndarray:
    return position / max(float(np.linalg.norm(position)), 1e-6)


def _solve(estimate: TargetEstimate) -> tuple[np.ndarray, float]:
    """The position [3], and the weight of the evidence along the line of sight."""
    (a, b, c), (_, d, e), (_, _, f) = estimate.normal.tolist()  # symmetric
    first = d * f - e * e, c * e - b * f, b * e - c * d
    second, third = (
        (first[1], a * f - c * c, b * c - a * e),
        (first[2], b * c - a * e, a * d - b * b),
    )
    determinant = a * first[0] + b * first[1] + c * first[2]
    inverse = np.array([first, second, third]) / max(determinant, 1e-12)
    position = inverse @ estimate.moment
    direction = _direction_of(position)
    return position, 1 / max(float(direction @ inverse @ direction), 1e-6)


def _read_estimate(grid: PoseGrid, estimate: TargetEstimate, odometry: OdometryState) -> np.ndarray:
    """What is said of the target's position, as `Triangulation.read` explains: [9]."""
    if not estimate.normal[0, 0] > 0:
        return np.zeros(WIDTHS["triangulation"])
    (x, y, z), weight = _solve(estimate)
    sine, cosine = np.sin(_angle(grid, odometry)), np.cos(_angle(grid, odometry))
    position = np.array([x * cosine - z * sine, y, x * sine + z * cosine])
    left = VISIBILITY_DISTANCE - np.hypot(x, z)
    within = np.clip(np.array([left, left + estimate.radius]) / BORDER, -1, 1)
    certainty = weight / (weight + HALF_CERTAIN)
    return np.concatenate(
        [
            np.clip(position / POSITION_SCALE, -2, 2),
            [estimate.radius, certainty],
            within,
            within * certainty,
        ]
    )
