"""The zero-shot filter: nothing of a hidden class reaches the learner.

Every model trains on tables that went through `hide_classes`, so there is one place where unseen
classes are kept out: as detection, target, parent, raster cell or graph node.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tdanet_jax.scenes.tables import SceneTables


def hide_classes(tables: SceneTables, hidden: Collection[str]) -> SceneTables:
    """The same rooms without any trace of the classes in `hidden`.

    The indices of classes and targets stay as they are. Solids of hidden classes still block the
    view of what is behind them, as an object that no detector knows would.

    Raises:
      ValueError: a hidden class is not in the tables' vocabulary.
    """
    unknown = sorted(set(hidden) - set(tables.classes))
    if unknown:
        raise ValueError(f"cannot hide {', '.join(unknown)}: not in the tables' vocabulary")
    gone = np.isin(np.array(tables.classes), sorted(hidden))  # [C]
    keep_object = ~gone[tables.object_class]
    new_index = np.cumsum(keep_object) - 1
    keep_row = keep_object[tables.row_object]
    kept_before = np.concatenate([[0], np.cumsum(keep_row)])
    distance = tables.distance.copy()
    distance[:, [target in hidden for target in tables.targets]] = -1
    raster = tables.raster.copy()
    raster[(raster >= 0) & gone[raster]] = -1
    return dataclasses.replace(
        tables,
        row_start=kept_before[tables.row_start].astype(tables.row_start.dtype),
        row_object=new_index[tables.row_object[keep_row]].astype(tables.row_object.dtype),
        row_box=tables.row_box[keep_row],
        row_visible=tables.row_visible[keep_row],
        object_id=tuple(
            name for name, keep in zip(tables.object_id, keep_object, strict=True) if keep
        ),
        object_class=tables.object_class[keep_object],
        object_scene=tables.object_scene[keep_object],
        object_box=tables.object_box[keep_object],
        distance=distance,
        raster=raster,
    )


def hide_words(words: np.ndarray, classes: tuple[str, ...], hidden: Collection[str]) -> np.ndarray:
    """The table of word vectors [C, D] with the rows of hidden classes set to zero."""
    gone = np.isin(np.array(classes), sorted(hidden))
    return np.where(gone[:, None], 0.0, words).astype(words.dtype)
