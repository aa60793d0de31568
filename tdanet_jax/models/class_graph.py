"""The class graph: which classes stand near each other in the training rooms.

Two classes are joined if at least `MIN_ROOMS` training rooms hold both, and if in at least
`MIN_SHARE` of those rooms their nearest instances are within 1.5 m, centre to centre. Nodes are the
classes that training may know: the graph is built from rooms that passed the zero-shot filter.
Another graph, such as that of an imported data set, can replace it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tdanet_jax.env.reward import NEAR

if TYPE_CHECKING:
    from tdanet_jax.scenes.tables import SceneTables

#: Fewest rooms that hold both classes of an edge.
MIN_ROOMS = 2
#: Least share of the rooms holding both classes in which they are near each other.
MIN_SHARE = 0.5


def co_occurrence(tables: SceneTables) -> np.ndarray:
    """The adjacency between the C classes of these rooms.

    Args:
      tables: training rooms only, without the classes that training must not know.

    Returns:
      [C, C] float32, symmetric, 1 where two different classes are joined, else 0.
    """
    count = len(tables.classes)
    both, near = np.zeros((count, count), np.int32), np.zeros((count, count), np.int32)
    centres = (tables.object_box[:, :3] + tables.object_box[:, 3:]) / 2
    known = np.isfinite(centres).all(axis=1)
    for scene in range(len(tables.scenes)):
        here = np.flatnonzero((tables.object_scene == scene) & known)
        here = here[np.argsort(tables.object_class[here], kind="stable")]
        kinds, first = np.unique(tables.object_class[here], return_index=True)
        if not kinds.size:
            continue
        gaps = np.sqrt(((centres[here][:, None] - centres[here][None]) ** 2).sum(-1))
        nearest = np.minimum.reduceat(np.minimum.reduceat(gaps, first, axis=0), first, axis=1)
        pairs = np.ix_(kinds, kinds)
        both[pairs] += 1
        near[pairs] += nearest <= NEAR
    joined = (both >= MIN_ROOMS) & (near >= MIN_SHARE * both)
    np.fill_diagonal(joined, False)
    return joined.astype(np.float32)
