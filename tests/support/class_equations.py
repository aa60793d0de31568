"""The published networks with a row per class, one frame at a time, without class table or cache.

As in `equations`, every function takes the array module first: NumPy for golden values in float64,
`jax.numpy` for gradients of the plain form. n known classes, D wide word vectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from tests.support.equations import Array, Params, linear, relu, softmax


def context(
    seen: dict[int, tuple[float, float, float]], target: Array, words: Array, known: tuple[int, ...]
) -> np.ndarray:
    """[n, 5]: present, x, y, S and the cosine to the target, for every known class.

    Args:
      seen: class -> (x, y, S) of the classes in view, whichever they are.
      target: [D], the target's word vector.
      words: [C, D].
    """
    rows = []
    for cls in known:
        here = (1.0, *seen[cls]) if cls in seen else (0.0, 0.0, 0.0, 0.0)
        length = np.linalg.norm(words[cls]) * np.linalg.norm(target)
        rows.append((*here, float(words[cls] @ target) / length if length else 0.0))
    return np.array(rows)


def ssnet(xp: Any, params: Params, rows: Array) -> Array:
    """[5 n]: softmax(Q K^T) V of the rows [n, 5] (Zhao et al. 2023, Eq. 3)."""
    query, key, value = (rows @ params[name] for name in ("query", "key", "value"))
    return (xp.stack([softmax(xp, row) for row in query @ key.T]) @ value).reshape(-1)


def mjolnir_graph(
    xp: Any, params: Params, rows: Array, words: Array, known: tuple[int, ...]
) -> Array:
    """[H]: the graph's features of the rows [n, 5] (Qiu et al. 2020, as published in code)."""
    a, n = params["adjacency"], len(known)
    present = xp.broadcast_to(rows[:, 0], (n, n))  # every node sees the presence of all
    x = xp.concatenate([present, xp.asarray(words[np.array(known)])], axis=1)  # [n, n + D]
    for layer in ("kernels_0", "kernels_1", "kernels_2"):
        x = relu(xp, (a @ x) @ params[layer]["kernel"])
    x = xp.concatenate([x, rows], axis=1)  # [n, 10]
    x = relu(xp, (a @ x) @ params["last"])[:, 0]
    return linear(params["mapping"], x)


def mjolnir_o(xp: Any, params: Params, rows: Array, words: Array, known: tuple[int, ...]) -> Array:
    """[H + 5 n]: the graph's features and the context."""
    features = mjolnir_graph(xp, params["graph"], rows, words, known)
    return xp.concatenate([features, rows.reshape(-1)])


def mjolnir_r(
    xp: Any,
    params: Params,
    rows: Array,
    words: Array,
    known: tuple[int, ...],
    image: Array,
) -> Array:
    """[3136 + H]: the features of the image, from `equations.image`, and of the graph."""
    return xp.concatenate([image, mjolnir_graph(xp, params["graph"], rows, words, known)])


def frames(obs: Any, words: Array) -> list[tuple[dict[int, Any], Array]]:
    """What is seen and the target's word vector, of each frame of a flat batch."""
    return [
        (
            {
                int(cls): tuple(float(v) for v in box)
                for cls, box, valid in zip(classes, boxes, mask, strict=True)
                if valid
            },
            np.asarray(words[int(target)], np.float64),
        )
        for classes, boxes, mask, target in zip(
            *(np.asarray(x) for x in (obs.classes, obs.boxes, obs.mask, obs.target)), strict=True
        )
    ]
