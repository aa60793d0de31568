"""A layer with ReLU of each detection, and its maximum and sum over the detections of a frame.

Observations are padded to the fullest frame of all rooms, so most of their rows are empty: of 77,
about 12 are in view. On a CPU, where a row costs what it takes to compute, only those are computed,
a block of rows at a time; so is the gradient, which computes them again.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from flax import struct

from tdanet_jax.env.types import Observation
from tdanet_jax.models.layers import look_up

#: Rows that are computed together.
BLOCK = 512


class RowTable(struct.PyTreeNode):
    """What a layer makes of the parts of a row (`layers.by_part`); the ReLU is of their sum."""

    names: jax.Array  # [C, U], of the word vector of each class, bias included
    boxes: jax.Array  # [F, U], of a unit of x, y, S and the score


def maximum_and_sum(table: RowTable, obs: Observation) -> tuple[jax.Array, jax.Array]:
    """The layer's maximum and sum over each frame, [..., U] each; 0 in a frame without detections.

    The boxes are data: they get no gradient. On a GPU all rows are computed: scattered sums would
    have no fixed order there, so that runs would not repeat to the last bit.
    """
    if jax.default_backend() != "cpu":
        rows = jax.nn.relu(look_up(table.names, obs.classes) + obs.boxes @ table.boxes)
        rows = jnp.where(obs.mask[..., None], rows, 0.0)
        return rows.max(-2), rows.sum(-2)
    *batch, longest = obs.mask.shape
    flat = obs.classes.reshape(-1), obs.boxes.reshape(-1, obs.boxes.shape[-1])
    most, total = _pool(table, *flat, obs.mask.reshape(-1, longest))
    shape = (*batch, most.shape[-1])
    return most.reshape(shape), total.reshape(shape)


class _Rows(NamedTuple):
    """The N * K rows of N frames, and which of them are in view."""

    classes: jax.Array  # [N * K]
    boxes: jax.Array  # [N * K, F]
    order: jax.Array  # [N * K + R], the indices of rows in view, then only N * K; R of a block
    in_view: jax.Array  # how many are
    longest: int  # K


class _Block(NamedTuple):
    """Some of the rows."""

    frame: jax.Array  # [R], N where there is no row: scattering drops it
    classes: jax.Array  # [R]
    boxes: jax.Array  # [R, F]
    units: jax.Array  # [R, U], after the ReLU; anything where there is no row


def _block(index: jax.Array, table: RowTable, rows: _Rows, size: int) -> _Block:
    at = jax.lax.dynamic_slice(rows.order, (index * size,), (size,))
    classes, boxes = (x.at[at].get(mode="clip") for x in (rows.classes, rows.boxes))
    units = jax.nn.relu(table.names[classes] + boxes @ table.boxes)
    return _Block(at // rows.longest, classes, boxes, units)


def _for_each_block(rows: _Rows, body: Any, start: Any) -> Any:
    """`body(index, R, value)` of each block of R rows, one after the other."""
    size = len(rows.order) - len(rows.classes)
    blocks = -(-rows.in_view // size)
    return jax.lax.fori_loop(0, blocks, lambda index, value: body(index, size, value), start)


@jax.custom_vjp
def _pool(
    table: RowTable, classes: jax.Array, boxes: jax.Array, mask: jax.Array
) -> tuple[jax.Array, jax.Array]:
    return _forward(table, classes, boxes, mask)[0]


def _forward(
    table: RowTable, classes: jax.Array, boxes: jax.Array, mask: jax.Array
) -> tuple[tuple[jax.Array, jax.Array], Any]:
    places, (frames, longest) = mask.size, mask.shape
    size = min(BLOCK, places)
    (order,) = jnp.nonzero(mask.reshape(-1), size=places + size, fill_value=places)
    rows = _Rows(classes, boxes, order, mask.sum(), longest)

    def body(
        index: jax.Array, size: int, value: tuple[jax.Array, jax.Array]
    ) -> tuple[jax.Array, jax.Array]:
        most, total = value
        block = _block(index, table, rows, size)
        return (
            most.at[block.frame].max(block.units, mode="drop", indices_are_sorted=True),
            total.at[block.frame].add(block.units, mode="drop", indices_are_sorted=True),
        )

    nothing = jnp.zeros((frames, table.names.shape[1]))
    pooled = _for_each_block(rows, body, (nothing, nothing))
    return pooled, (table, rows, pooled[0])


def _backward(saved: Any, gradient: tuple[jax.Array, jax.Array]) -> tuple[Any, ...]:
    """The gradient of the table. Rows that share a maximum get all of its gradient, each."""
    table, rows, most = saved

    def body(index: jax.Array, size: int, value: RowTable) -> RowTable:
        block = _block(index, table, rows, size)
        of_most, of_total, highest = (
            x.at[block.frame].get(mode="fill", fill_value=0.0) for x in (*gradient, most)
        )
        is_most = block.units == highest
        of_units = jnp.where(block.units > 0, of_total + jnp.where(is_most, of_most, 0.0), 0.0)
        return RowTable(
            names=value.names.at[block.classes].add(of_units),
            boxes=value.boxes + block.boxes.T @ of_units,
        )

    return _for_each_block(rows, body, jax.tree.map(jnp.zeros_like, table)), None, None, None


_pool.defvjp(_forward, _backward)
