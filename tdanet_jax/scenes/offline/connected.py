"""The part of each room that an agent can walk, as the original recordings have it.

Those were made by following every action from one start, so every state leads to every other. The
reference code relies on it: its shortest path to an object goes to all states in which the object
is visible, and one that no action reaches makes the path infinite and the episode's SPL 0.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from tdanet_jax.poses import VIEWS
from tdanet_jax.scenes.tables import SceneTables, row_offsets
from tdanet_jax.scenes.visibility.geometry import action_distances, transitions


class Connected(NamedTuple):
    """Rooms that are connected, and what was left out of them."""

    tables: SceneTables
    kept: np.ndarray  # [S] bool, the states of the original tables that are left
    left_out: Mapping[str, int]  # room -> number of states, of rooms that lost some


def largest_parts(tables: SceneTables) -> Connected:
    """The largest part of each room in which every state leads to every other.

    Turning and looking up and down are always possible, so the states of a position stay together,
    and positions are connected if MoveAhead leads from each to the other. Of parts of equal size,
    the one with the room's first position is kept.
    """
    count, headings = tables.next_position.shape
    tail = np.repeat(np.arange(count), headings)
    moves = coo_array(
        (np.ones(len(tail), bool), (tail, tables.next_position.reshape(-1))), (count, count)
    )
    _, label = connected_components(moves, directed=True, connection="strong")
    _, first, part, size = np.unique(
        label, return_index=True, return_inverse=True, return_counts=True
    )
    positions = np.zeros(count, bool)
    left_out = {}
    for scene, name in enumerate(tables.scenes):
        here = np.flatnonzero(tables.position_scene == scene)
        best = min(set(part[here].tolist()), key=lambda p: (-size[p], first[p]))
        positions[here] = part[here] == best
        if lost := int((~positions[here]).sum()):
            left_out[name] = lost * VIEWS
    return Connected(_restrict(tables, positions), np.repeat(positions, VIEWS), left_out)


def _restrict(tables: SceneTables, positions: np.ndarray) -> SceneTables:
    """The tables without some positions; moves to these are blocked.

    Args:
      positions: [P] bool, those to keep.
    """
    if positions.all():
        return tables
    states = np.repeat(positions, VIEWS)
    rows = states[tables.row_state]
    number = np.cumsum(positions, dtype=np.int32) - 1
    stay = np.arange(len(positions), dtype=np.int32)[:, None]
    ahead = np.where(positions[tables.next_position], tables.next_position, stay)
    next_position = number[ahead[positions]]
    return dataclasses.replace(
        tables,
        position=tables.position[positions],
        position_scene=tables.position_scene[positions],
        position_room_type=tables.position_room_type[positions],
        next_position=next_position,
        row_start=row_offsets(np.diff(tables.row_start)[states]),
        row_object=tables.row_object[rows],
        row_box=tables.row_box[rows],
        row_visible=tables.row_visible[rows],
        distance=action_distances(transitions(next_position), tables.distance[states] == 0),
        raster=tables.raster[states],
    )
