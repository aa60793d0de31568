"""The network as printed: Eqs. 1 and 2 of the paper, frame by frame, without class table or cache.

Every function takes the array module first: NumPy for golden values in float64, `jax.numpy` for
gradients of the plain form.
"""

from __future__ import annotations

from typing import Any

import numpy as np

TARGET_BOX = (0.5, 0.5, 0.25)

Params = Any
Array = Any


def relu(xp: Any, x: Array) -> Array:
    return xp.maximum(x, 0.0)


def sigmoid(xp: Any, x: Array) -> Array:
    return 1 / (1 + xp.exp(-x))


def linear(layer: Params, x: Array) -> Array:
    return x @ layer["kernel"] + layer["bias"]


def softmax(xp: Any, logits: Array) -> Array:
    weights = xp.exp(logits - logits.max())
    return weights / weights.sum()


def attention(xp: Any, params: Params, rows: Array, target: Array) -> Array:
    """Weights of the K detections [K, 3 + D] of a frame for a target row [3 + D]."""
    query = linear(params["attention"], target)
    return softmax(xp, linear(params["attention"], rows) @ query)


def encode(
    xp: Any,
    params: Params,
    rows: Array,
    word: Array,
    *,
    target_attention: bool = True,
    siamese: bool = True,
    dropped: Array | None = None,
    dropout: float = 0.25,
) -> Array:
    """Features of one frame.

    Args:
      rows: [K, 3 + D] detections (x, y, S, word vector), or [K, 4 + D] with the score after S; K at
        least 1: a frame without any has one all-zero row.
      word: [D], the target's word vector.
      dropped: [H] bool, units that dropout zeroes.
    """
    box = (*TARGET_BOX, 1.0)[: rows.shape[1] - len(word)]
    target = xp.concatenate([xp.array(box), word])
    projected = linear(params["linear1"], rows)  # M_L1
    if target_attention:
        pooled = attention(xp, params, rows, target) @ projected  # V_L1 = V_att M_L1
    else:
        pooled = projected.mean(axis=0)
    features = relu(xp, linear(params["linear2"], relu(xp, pooled)))
    if siamese:
        first = relu(xp, linear(params["linear1"], target))
        features = xp.abs(features - relu(xp, linear(params["linear2"], first)))
    if dropped is not None:
        features = xp.where(dropped, 0.0, features / (1 - dropout))
    if not siamese and not target_attention:
        features = xp.concatenate([features, word])
    hidden = relu(xp, linear(params["linear3"], features))
    return relu(xp, linear(params["linear4"], hidden))


def image(
    xp: Any,
    params: Params,
    cells: Array,
    words: Array,
    target: int,
    action: Array,
    kept: Array | None = None,
    dropout: float = 0.25,
    maps: Array | None = None,
) -> Array:
    """Features [3136] of the image trunk for one frame, cell by cell.

    Args:
      cells: [7, 7], class of each cell, -1 none.
      words: [C, D].
      target: class of the target.
      action: [10], embedding of the previous action probabilities.
      kept: [2, 49, 64] bool, units that dropout keeps after each convolution.
      maps: [49, 512], ResNet-18's feature map, instead of the raster.
    """

    def drop(x: Array, layer: int, cell: int) -> Array:
        return x if kept is None else xp.where(kept[layer, cell], x / (1 - dropout), 0.0)

    embedded = relu(xp, linear(params["target"], words[target]))
    second = xp.concatenate([params["pointwise"]["kernel"], params["context"]["kernel"]])
    out = []
    for i, cls in enumerate(np.asarray(cells).reshape(-1)):
        cell = words[cls] if cls >= 0 else 0 * words[0]
        cell = cell if maps is None else maps[i]
        first = drop(relu(xp, linear(params["convolution"], cell)), 0, i)
        joined = xp.concatenate([first, embedded, action])  # 138 channels
        out.append(drop(relu(xp, joined @ second + params["context"]["bias"]), 1, i))
    return xp.concatenate(out)


def scene_priors(
    xp: Any, params: Params, cells: Array, words: Array, known: tuple[int, ...], adjacency: Array
) -> Array:
    """The graph's features of one frame, as in the code of SAVN: relu(A X W) three times.

    Args:
      cells: [7, 7], class of each cell, -1 none.
      words: [C, D].
      known: the n classes that are nodes.
      adjacency: [n, n], normalised.
    """
    seen = xp.array([float((np.asarray(cells) == cls).any()) for cls in known])
    frame = linear(params["seen"], seen)
    nodes = xp.stack([xp.concatenate([frame, linear(params["words"], words[c])]) for c in known])
    parts = [params["convolution_seen"]["kernel"], params["convolution_words"]["kernel"]]
    for kernel in (xp.concatenate(parts), params["kernel1"], params["kernel2"]):
        nodes = relu(xp, adjacency @ nodes @ kernel)
    return linear(params["mapping"], nodes[:, 0])


def lstm(
    xp: Any, params: Params, hidden: Array, cell: Array, x: Array, skip_inputs: Array
) -> tuple[Array, Array]:
    """One step on [x, skip_inputs], with the gates in the order i, f, g, o and two biases."""
    first, last = params["kernel"][: x.shape[-1]], params["kernel"][x.shape[-1] :]
    kernel = xp.concatenate([first, params.get("kernel_skip", last[:0]), last])
    z = xp.concatenate([x, skip_inputs, hidden], axis=-1) @ kernel
    z = z + params["bias_ih"] + params["bias_hh"]
    i, f, g, o = xp.split(z, 4, axis=-1)
    cell = sigmoid(xp, f) * cell + sigmoid(xp, i) * xp.tanh(g)
    return sigmoid(xp, o) * xp.tanh(cell), cell


def lstm_rollout(
    xp: Any,
    params: Params,
    hidden: Array,
    cell: Array,
    x: Array,
    skip_inputs: Array,
    is_first: Array,
) -> tuple[Array, tuple[Array, Array]]:
    """Hidden states [T, B, H] of T steps and the last carry; the carry is zero where `is_first`."""
    out = []
    for x_t, skip_t, is_first_t in zip(x, skip_inputs, is_first, strict=True):
        hidden = xp.where(is_first_t[:, None], 0.0, hidden)
        cell = xp.where(is_first_t[:, None], 0.0, cell)
        hidden, cell = lstm(xp, params, hidden, cell, x_t, skip_t)
        out.append(hidden)
    return xp.stack(out), (hidden, cell)


def frames(obs: Any, words: Array) -> list[tuple[Array, Array]]:
    """Detection rows and target word of each frame of a flat batch of observations."""
    found = []
    for classes, boxes, mask, target in zip(
        obs.classes, obs.boxes, obs.mask, obs.target, strict=True
    ):
        rows = [
            np.concatenate([box, words[cls]])
            for cls, box, valid in zip(
                np.asarray(classes), np.asarray(boxes), np.asarray(mask), strict=True
            )
            if valid
        ]
        blank = np.zeros(obs.boxes.shape[-1] + words.shape[1])
        found.append((np.array(rows or [blank]), words[int(target)]))
    return found


def actor_critic(
    xp: Any,
    params: Params,
    frames: list[list[tuple[Array, Array]]],
    prev_action_probs: Array,
    carry: tuple[Array, Array],
    is_first: Array,
    dropped: Array | None = None,
    **encoder: Any,
) -> tuple[Array, Array]:
    """Logits [T, B, 6] and values [T, B] of a rollout of frames[t][b]."""
    inputs, actions = [], []
    for t, row in enumerate(frames):
        features = [
            encode(
                xp, params["encoder"], *frame,
                dropped=None if dropped is None else dropped[t, b], **encoder,
            )
            for b, frame in enumerate(row)
        ]  # fmt: skip
        inputs.append(xp.stack(features))
        actions.append(relu(xp, linear(params["action_embedding"], prev_action_probs[t])))
    hidden, _ = lstm_rollout(
        xp, params["lstm"], *carry, xp.stack(inputs), xp.stack(actions), is_first
    )
    return linear(params["actor"], hidden), linear(params["critic"], hidden)[..., 0]


def in_float64(params: Params) -> Params:
    """The parameters as NumPy arrays of double precision."""
    if hasattr(params, "items"):
        return {name: in_float64(value) for name, value in params.items()}
    return np.asarray(params, np.float64)
