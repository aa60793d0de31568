"""The class graph: which classes stand near each other in the training rooms.

Two classes are joined if at least `MIN_ROOMS` training rooms hold both, and if in at least
`MIN_SHARE` of those their nearest instances are within 1.5 m, centre to centre. Nodes are the
classes that training may know: the graph is built from rooms that went through the zero-shot
filter. A graph from elsewhere, such as the one of an imported data set, can take its place.
"""

from __future__ import annotations

import numpy as np

from tdanet_jax.env.reward import NEAR
from tdanet_jax.models.classes import Classes
from tdanet_jax.scenes.tables import SceneTables

#: Fewest rooms that say something about a pair of classes.
MIN_ROOMS = 2
#: Share of the rooms holding both classes in which they are near each other.
MIN_SHARE = 0.5


def co_occurrence(tables: SceneTables) -> np.ndarray:
    """The adjacency between the C classes of these rooms.

    Args:
      tables: training rooms only, and without the classes that training must not know.

    Returns:
      [C, C] float32, symmetric, 1 where two different classes are joined, else 0.
    """
    count = len(tables.classes)
    both, near = np.zeros((count, count), np.int32), np.zeros((count, count), np.int32)
    centres = (tables.object_box[:, :3] + tables.object_box[:, 3:]) / 2
    for scene in range(len(tables.scenes)):
        here = np.flatnonzero(tables.object_scene == scene)
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


def normalised(classes: Classes) -> np.ndarray:
    """The graph between the known classes, ready for graph convolutions.

    D^-1/2 (A + I) D^-1/2 with D the row sums of A + I (Kipf and Welling 2017), as in the published
    code of MJOLNIR.

    Returns:
      [n, n] float32, symmetric, in the order of `classes.known`.
    """
    node = {cls: i for i, cls in enumerate(classes.known)}
    weights = np.eye(len(node))
    for i, j, weight in classes.edges:
        weights[node[i], node[j]] = weights[node[j], node[i]] = weight
    scale = 1 / np.sqrt(weights.sum(axis=1))
    return (scale[:, None] * weights * scale).astype(np.float32)
