"""Boxes, their faces, and the graph of reachable points.

World axes are AI2-THOR's: x right, y up, z forward, left-handed; metres. Headings count from
+z clockwise seen from above (90 degrees looks along +x), in steps of 45 degrees.
"""

import numpy as np

from tdanet_jax.scenes.scene import GRID

HEADINGS = 8
HORIZONS = 2
VIEWS = HEADINGS * HORIZONS
# Grid steps of MoveAhead along each heading; a diagonal one moves a step on both axes.
STEPS = np.array([(0, 1), (1, 1), (1, 0), (1, -1), (0, -1), (-1, -1), (-1, 0), (-1, 1)])


def next_positions(points: np.ndarray) -> np.ndarray:
    """Where MoveAhead leads from each of `points` [P, 3] along each heading: [P, 8] int32.

    A step to a place that is not reachable leaves the agent where it is.
    """
    cells = np.rint(points[:, [0, 2]] / (GRID / 4)).astype(np.int64)
    index = {(int(x), int(z)): i for i, (x, z) in enumerate(cells)}
    result = np.empty((len(points), HEADINGS), np.int32)
    for i, (x, z) in enumerate(cells):
        for heading, (dx, dz) in enumerate(STEPS * 4):
            result[i, heading] = index.get((int(x + dx), int(z + dz)), i)
    return result


def transitions(next_position: np.ndarray) -> np.ndarray:
    """State after each of the five moving actions: [S, 5] int32, S = P * 16.

    Columns are MoveAhead, RotateLeft, RotateRight, LookUp, LookDown; a state's index is
    (position * 8 + heading) * 2 + horizon.
    """
    count = len(next_position)
    position, heading, horizon = np.meshgrid(
        np.arange(count), np.arange(HEADINGS), np.arange(HORIZONS), indexing="ij"
    )

    def state(p: np.ndarray, r: np.ndarray, h: np.ndarray) -> np.ndarray:
        return ((p * HEADINGS + r % HEADINGS) * HORIZONS + h).reshape(-1)

    columns = [
        state(next_position[position, heading], heading, horizon),
        state(position, heading - 1, horizon),
        state(position, heading + 1, horizon),
        state(position, heading, np.zeros_like(horizon)),
        state(position, heading, np.ones_like(horizon)),
    ]
    return np.stack(columns, axis=1).astype(np.int32)


def action_distances(successor: np.ndarray, goals: np.ndarray) -> np.ndarray:
    """Fewest actions from each state to a goal state, -1 where there is no way.

    Args:
        successor: [S, A] int, state after each action.
        goals: [S, G] bool, goal states of each of G <= 64 targets.

    Returns:
        [S, G] int16. All targets advance together: one bit of a word each.
    """
    count = goals.shape[1]
    bits = np.uint64(1) << np.arange(count, dtype=np.uint64)
    seen = np.where(goals, bits, np.uint64(0)).sum(axis=1, dtype=np.uint64)
    result = np.where(goals, 0, -1).astype(np.int16)
    frontier, step = seen, 0
    while frontier.any():
        step += 1
        arriving = np.bitwise_or.reduce(frontier[successor], axis=1) & ~seen
        state = np.flatnonzero(arriving)
        hit = (arriving[state, None] & bits) != 0
        result[state] = np.where(hit, np.int16(step), result[state])
        seen = seen | arriving
        frontier = arriving
    return result


def box_points(boxes: np.ndarray, steps: int = 4) -> np.ndarray:
    """A lattice of (steps + 1)^3 points in each of `boxes` [O, 2, 3]: [O, K, 3]."""
    share = np.arange(steps + 1) / steps
    lattice = np.stack(np.meshgrid(share, share, share, indexing="ij"), axis=-1).reshape(-1, 3)
    return boxes[:, None, 0] + lattice * (boxes[:, None, 1] - boxes[:, None, 0])


def frustum_rotation(boxes: np.ndarray, visible: np.ndarray, camera: np.ndarray) -> int:
    """The rotation, of 0, 90, 180, 270, in which most `visible` boxes lie in a 90-degree view.

    Only the view's four planes count, not occlusion, so that the choice does not depend on the
    rules that are judged against these flags. Among equals, fewest unflagged objects within
    1.5 m that lie wholly in view; then the least rotation.

    Args:
        boxes: [O, 2, 3] metres. visible: [O] bool. camera: [3] metres.
    """
    points = box_points(boxes) - camera
    near = np.hypot(points[..., 0], points[..., 2]).min(axis=1) <= 1.5
    scores = []
    for heading in range(0, HEADINGS, 2):
        x, z = STEPS[heading]
        depth = points[..., 0] * x + points[..., 2] * z
        side = points[..., 0] * z - points[..., 2] * x
        inside = (depth > 0) & (np.abs(side) < depth) & (np.abs(points[..., 1]) < depth)
        seen = inside.any(axis=1)
        scores.append(((seen & visible).sum(), -(inside.all(axis=1) & near & ~visible).sum()))
    return max(range(4), key=lambda quarter: (*scores[quarter], -quarter)) * 90
