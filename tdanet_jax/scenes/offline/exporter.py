"""Export of tables as a folder in the original layout."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import files
from tdanet_jax.io.untrusted import hdf5
from tdanet_jax.poses import GRID_SIZE, ITHOR
from tdanet_jax.scenes.offline import layout
from tdanet_jax.scenes.offline.connected import Connected, largest_parts
from tdanet_jax.scenes.offline.layout import Report, state_keys
from tdanet_jax.scenes.room_names import check_name
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.visibility.geometry import transitions
from tdanet_jax.vocabulary import ROOM_TYPES

Parents = Mapping[str, Mapping[str, Mapping[str, float]]]


def write_folder(
    tables: SceneTables,
    out: Path,
    report: Report,
    parents: Parents | None = None,
    vectors: np.ndarray | None = None,
    features: bool = False,
) -> Connected:
    """Writes a folder with one folder per scene, atomically: of each, its largest connected part.

    Args:
      out: must not exist.
      report: called for every scene.
      parents: room type -> target -> parent -> R_p, for `c2p_prob.json`.
      vectors: [C, D] one vector per class, for `thor_glove/glove_map<D>d.hdf5`.
      features: also write `resnet18_featuremap.hdf5`: channel c of a map is 1 in the cells of the
        7 x 7 raster with class c of `tables.classes`, and 0 elsewhere.

    Returns:
      What was written, and what was left out because it is not connected.

    Raises:
      SceneError: a scene's name is not a plain one.
    """
    for name in tables.scenes:
        check_name(name)
    if vectors is not None or features:
        hdf5.need_h5py(out)
    connected = largest_parts(tables)
    out.parent.mkdir(parents=True, exist_ok=True)
    with files.replacing(out) as temporary:
        temporary.mkdir()
        for i, name in enumerate(tables.scenes):
            room = connected.tables.subset([name])
            folder = temporary / name
            folder.mkdir()
            write_scene(room, folder)
            if features:
                write_features(room, folder / layout.FEATURE_FILE)
            report((i + 1) / len(tables.scenes), name)
        if parents:
            titled = {
                layout.ROOM_NAMES[ROOM_TYPES.index(r)]: targets for r, targets in parents.items()
            }
            _write(temporary / layout.PARENT_FILE, titled)
        if vectors is not None:
            write_vectors(tables.classes, vectors, temporary / "thor_glove")
    return connected


def check_layout(tables: SceneTables) -> None:
    """Raises ValueError if the original layout cannot hold these rooms.

    Its keys are coordinates to the centimetre, which tell the rooms' points apart and a step long;
    a class with a bar would be read as an object's id, and one with a slash is no name in HDF5.
    """
    if odd := [name for name in tables.classes if {*name} & {"/", "|"}]:
        raise ValueError(f"class {odd[0]}: the original layout cannot hold names with / or |")
    last = tables.room_types[tables.position_room_type.max()]
    if last not in ROOM_TYPES:
        what = f"rooms of type {last}"
    elif (tables.room_type < 0).any():
        what = "houses with rooms of several types"
    elif tables.grid != ITHOR:
        what = "rooms on another grid than iTHOR's"
    elif room := _off_centimetres(tables):
        what = f"{room}, whose points in whole centimetres are not {GRID_SIZE} m apart"
    else:
        return
    raise ValueError(f"{what}: the original layout has rooms of iTHOR's types and grid alone")


def _off_centimetres(tables: SceneTables) -> str | None:
    """A room in which a step between neighbours is not one of 0.25 m in the keys of states."""
    for scene, name in enumerate(tables.scenes):
        ground = tables.position[tables.position_scene == scene][:, [0, 2]]
        cells = np.rint((ground - ground[0]) / GRID_SIZE)
        rounded = np.array([[round(value, 2) for value in point] for point in ground.tolist()])
        if np.abs(rounded - rounded[0] - cells * GRID_SIZE).max() > 1e-6:
            return name
    return None


def write_scene(room: SceneTables, folder: Path) -> None:
    """Writes grid, graph, visibility map (under both names), boxes and objects of a room."""
    keys = state_keys(room.position)
    _write(folder / layout.GRID_FILE, [dict(zip("xyz", point, strict=True)) for point in
                                room.position.tolist()])  # fmt: skip
    _write(folder / layout.GRAPH_FILE, graph(room, keys))
    for name in layout.VISIBILITY_FILES[:2]:
        _write(folder / name, visible_from(room, keys))
    _write(folder / layout.BOX_FILE, boxes(room, keys))
    _write(folder / layout.OBJECT_FILE, objects(room, keys))


def graph(room: SceneTables, keys: Sequence[str]) -> dict[str, Any]:
    """The moves in networkx's node-link form: a link per state and action that changes it.

    The list of links is there twice: networkx before 3.6 reads `links`, later versions `edges`.
    """
    successor = transitions(room.next_position)
    links = [
        {"source": keys[state], "target": keys[to]}
        for state in range(len(keys))
        for to in dict.fromkeys(successor[state].tolist())
        if to != state
    ]
    return {
        "directed": True,
        "multigraph": False,
        "graph": {},
        "nodes": [{"id": key} for key in keys],
        "links": links,
        "edges": links,
    }


def visible_from(room: SceneTables, keys: Sequence[str]) -> dict[str, list[str]]:
    """Object id -> keys of the states in which it is visible.

    Objects that are never visible are not listed: the reference draws targets from all that are.
    """
    rows = np.flatnonzero(room.row_visible)
    rows = rows[np.argsort(room.row_object[rows], kind="stable")]
    result: dict[str, list[str]] = {}
    for item, state in zip(room.row_object[rows].tolist(), room.row_state[rows].tolist(),
                           strict=True):  # fmt: skip
        result.setdefault(room.object_id[item], []).append(keys[state])
    return result


def boxes(room: SceneTables, keys: Sequence[str]) -> dict[str, dict[str, list[float]]]:
    """State -> class -> x1, y1, x2, y2 in pixels of each instance, concatenated."""
    result: dict[str, dict[str, list[float]]] = {key: {} for key in keys}
    rows = np.flatnonzero(room.row_box[:, 0] >= 0)
    pixels = (room.row_box[rows] / room.subpixel).tolist()
    states, classes = room.row_state[rows].tolist(), room.row_class[rows].tolist()
    for state, c, box in zip(states, classes, pixels, strict=True):
        result[keys[state]].setdefault(room.classes[c], []).extend(box)
    return result


def objects(room: SceneTables, keys: Sequence[str]) -> dict[str, Any]:
    """What the original layout lacks: the class and box (metres) of every object, and for each box
    of `objects_bb.json` the index of its object in that list."""
    rows = np.flatnonzero(room.row_box[:, 0] >= 0)
    instances: dict[str, list[int]] = {key: [] for key in keys}
    for state, item in zip(room.row_state[rows].tolist(), room.row_object[rows].tolist(),
                           strict=True):  # fmt: skip
        instances[keys[state]].append(item)
    records = {
        name: {
            "objectType": room.classes[room.object_class[i]],
            "box": None if np.isnan(room.object_box[i]).any() else room.object_box[i].tolist(),
        }
        for i, name in enumerate(room.object_id)
    }
    return {"objects": records, "instances": instances}


def write_features(room: SceneTables, path: Path) -> None:
    """Writes one-hot class rasters as feature maps [512, 7, 7], a dataset per state."""
    import h5py

    with h5py.File(path, "w") as file:
        for key, raster in zip(state_keys(room.position), room.raster, strict=True):
            channel = np.arange(layout.FEATURE_SHAPE[0])[:, None, None]
            values = (raster[None] == channel).astype(np.float32)
            file.create_dataset(key, data=values, compression="gzip", compression_opts=1)


def write_vectors(classes: Sequence[str], vectors: np.ndarray, folder: Path) -> None:
    """Writes a dataset per class name, as in `thor_glove`."""
    import h5py

    folder.mkdir()
    with h5py.File(folder / f"glove_map{vectors.shape[1]}d.hdf5", "w") as file:
        for name, vector in zip(classes, vectors, strict=True):
            file.create_dataset(name, data=vector.astype(np.float32))


def _write(path: Path, content: Any) -> None:
    path.write_text(json.dumps(content, separators=(",", ":")), encoding="utf-8")
