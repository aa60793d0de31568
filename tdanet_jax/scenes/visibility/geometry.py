"""Boxes, their faces, and the graph of reachable points.

World axes are AI2-THOR's: x right, y up, z forward, left-handed; metres. Headings count from
+z clockwise seen from above (90 degrees looks along +x).
"""

from __future__ import annotations

import numpy as np

from tdanet_jax.poses import ITHOR, STEPS, PoseGrid
from tdanet_jax.scenes.scene import SceneError, SceneObject

THIN = 1e-3  # metres; a box that is thinner than this is taken to be this thick


def box_frame(box: np.ndarray, corners: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """The oriented box of an object, or its axis-aligned one: a corner [3] and edges [3, 3] (rows).

    Pictures and rugs may be flat: an edge without a length gets one of a millimetre, perpendicular
    to the others.

    Args:
      box: [2, 3] axis-aligned box.
      corners: [8, 3] of the oriented box, if known: around the bottom face, then around the top.
    """
    origin = box[0] if corners is None else corners[0]
    edges = np.diag(box[1] - box[0]) if corners is None else corners[[1, 4, 3]] - origin
    lengths = np.sqrt((edges * edges).sum(axis=1))
    known = [edge / length for edge, length in zip(edges, lengths, strict=True) if length >= THIN]
    for axis in np.flatnonzero(lengths < THIN):
        # The part of each world axis that is perpendicular to the edges with a direction.
        rest = np.eye(3) - sum((np.outer(edge, edge) for edge in known), np.zeros((3, 3)))
        direction = rest[np.argmax(np.abs(rest).sum(axis=1))]
        known.append(direction / np.sqrt((direction * direction).sum()))
        origin, edges[axis] = origin - known[-1] * THIN / 2, known[-1] * THIN
    return origin, edges


def gap_to_box(item: SceneObject, points: np.ndarray) -> np.ndarray:
    """Squared horizontal distance of `points` [P, 3] from an object's box: [P], 0 inside it."""
    origin, edges = box_frame(item.box, item.corners)
    level = np.argsort(np.abs(edges[:, 1]), kind="stable")[:2]
    if np.abs(edges[level, 1]).max() >= THIN:
        origin, edges = box_frame(item.box, None)
        level = np.array([0, 2])
    gap = np.zeros(len(points))
    for edge in edges[level][:, [0, 2]]:
        length = np.sqrt((edge * edge).sum())
        along = (points[:, 0] - origin[0]) * edge[0] + (points[:, 2] - origin[2]) * edge[1]
        beyond = np.maximum(np.maximum(-along / length, along / length - length), 0)
        gap += beyond * beyond
    return gap


def next_positions(points: np.ndarray, grid: PoseGrid = ITHOR) -> np.ndarray:
    """The position after MoveAhead from each of `points` [P, 3]: [P, rotations] int32.

    A step towards a point that is not reachable leaves the agent where it is.
    """
    cells = np.rint((points - points[0])[:, [0, 2]] / grid.grid_size).astype(np.int64)
    index = {(int(x), int(z)): i for i, (x, z) in enumerate(cells)}
    result = np.empty((len(points), grid.rotations), np.int32)
    for i, (x, z) in enumerate(cells):
        for heading, (dx, dz) in enumerate(grid.steps):
            result[i, heading] = index.get((int(x + dx), int(z + dz)), i)
    return result


def transitions(next_position: np.ndarray, grid: PoseGrid = ITHOR) -> np.ndarray:
    """State after each of the five moving actions: [S, 5] int32.

    Columns are MoveAhead, RotateLeft, RotateRight, LookUp, LookDown.
    """
    position, rotation, horizon = grid.split(np.arange(len(next_position) * grid.views))
    columns = [
        grid.join(next_position[position, rotation], rotation, horizon),
        grid.join(position, (rotation - 1) % grid.rotations, horizon),
        grid.join(position, (rotation + 1) % grid.rotations, horizon),
        grid.join(position, rotation, np.maximum(horizon - 1, 0)),
        grid.join(position, rotation, np.minimum(horizon + 1, len(grid.horizons) - 1)),
    ]
    return np.stack(columns, axis=1).astype(np.int32)


def action_distances(successor: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Fewest actions from each state to a goal state, -1 where none leads to one.

    Args:
      successor: [S, A] int, state after each action.
      goals: [S, G] bool, goal states of each of G <= 64 targets.

    Returns:
      [S, G] int16. The searches of all targets run together, one bit of a word each.
    """
    count = goals.shape[1]
    bits = np.uint64(1) << np.arange(count, dtype=np.uint64)
    seen = np.where(goals, bits, np.uint64(0)).sum(axis=1, dtype=np.uint64)
    result = np.where(goals, 0, -1).astype(np.int16)
    frontier, step = seen, 0
    while frontier.any():
        step += 1
        if step > np.iinfo(np.int16).max:
            raise SceneError(f"a way of more than {step - 1} actions")
        arriving = np.bitwise_or.reduce(frontier[successor], axis=1) & ~seen
        state = np.flatnonzero(arriving)
        hit = (arriving[state, None] & bits) != 0
        result[state] = np.where(hit, np.int16(step), result[state])
        seen = seen | arriving
        frontier = arriving
    return result


def lattice(origins: np.ndarray, edges: np.ndarray, steps: int = 8) -> np.ndarray:
    """Centres of the steps^3 cells of each of O boxes: [O, K, 3].

    Args:
      origins: [O, 3] a corner of each box.
      edges: [O, 3, 3] its edge vectors.
    """
    share = (np.arange(steps) + 0.5) / steps
    cells = np.stack(np.meshgrid(share, share, share, indexing="ij"), axis=-1).reshape(-1, 3)
    return origins[:, None] + (cells[None, :, :, None] * edges[:, None]).sum(axis=2)


def frustum_rotation(points: np.ndarray, visible: np.ndarray, camera: np.ndarray) -> int:
    """The likeliest rotation, of 0, 90, 180, 270 degrees, of a level camera with a 90-degree view.

    Only the frustum counts: the probability that an object is visible is taken to be the share of
    it that lies inside. Occlusion plays no part, so that the choice does not depend on the rules
    that these flags are used to judge. Ties go to the smallest rotation.

    Args:
      points: [O, K, 3] points spread over each object within reach, metres.
      visible: [O] bool, AI2-THOR's flags.
      camera: [3] metres.
    """
    offset = points - camera
    scores = []
    for heading in range(0, len(STEPS), 2):
        x, z = STEPS[heading]
        depth = offset[..., 0] * x + offset[..., 2] * z
        side = offset[..., 0] * z - offset[..., 2] * x
        inside = (np.abs(side) < depth) & (np.abs(offset[..., 1]) < depth)
        share = np.clip(inside.mean(axis=1), 0.002, 0.9)
        scores.append(np.log(np.where(visible, share, 1 - share)).sum())
    return int(np.argmax(np.round(scores, 6))) * 90
