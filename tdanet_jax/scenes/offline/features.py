"""Feature maps: imported from every scene's HDF5 file into one memory-mapped array."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from tdanet_jax import poses
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import FileError, hdf5
from tdanet_jax.poses import VIEWS
from tdanet_jax.scenes import dataset
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.scenes.offline import layout
from tdanet_jax.scenes.offline.layout import Grid, Report, find_root, find_scenes
from tdanet_jax.scenes.room_names import Kinds
from tdanet_jax.scenes.tables import SceneTables


def find_features(folder: Path, kinds: Kinds | None = None) -> dict[str, Path]:
    """The feature file of each scene of a folder that is imported with these kinds of rooms.

    Raises:
      FileError: a scene has none, or h5py is not installed.
    """
    scenes, _ = find_scenes(find_root(folder), kinds)
    found = {scene.name: scene.path / layout.FEATURE_FILE for scene in scenes}
    for path in found.values():
        hdf5.need_h5py(path)
        if not path.is_file():
            raise FileError(path, "no such file")
    return found


def save_with_maps(rooms: Rooms, out: Path, sources: Mapping[str, Path], report: Report) -> None:
    """Writes a file of rooms and, next to it, their feature maps: both, or neither.

    Args:
      sources: the feature file of each scene, from `find_features`.
      report: called for every scene's maps.

    Raises:
      FileError: a feature file is broken.
    """
    with files.replacing(features_path(out)) as temporary:
        write_features(sources, rooms.tables, temporary, report)
        dataset.save_rooms(rooms, out)


def write_features(
    sources: Mapping[str, Path], tables: SceneTables, out: Path, report: Report
) -> None:
    """Writes every scene's feature maps into one memory-mapped file.

    Args:
      sources: the feature file of each scene.
      out: a .npy file, [S, 512, 7, 7] float16 for the S states of the tables; zero for states of
        which there is no map.

    Raises:
      FileError: a feature file is broken.
    """
    features = np.lib.format.open_memmap(
        out, "w+", np.float16, (tables.num_states, *layout.FEATURE_SHAPE)
    )
    for i, name in enumerate(tables.scenes):
        here = np.flatnonzero(tables.position_scene == i)
        count = _copy_features(
            sources[name], Grid(tables.position[here]), features, poses.join(here[0])
        )
        rest = len(here) * VIEWS - count
        note = f"; {rest} states without one are zero" if rest else ""
        report((i + 1) / len(tables.scenes), f"{name}: {count} feature maps{note}")
    features.flush()


def _copy_features(path: Path, grid: Grid, features: np.ndarray, first: int) -> int:
    copied = set()
    with hdf5.opened(path) as reader:
        for key in reader.names():
            state = grid.state(path, key)
            with np.errstate(over="ignore"):  # an overflow is infinite, and refused below
                values = reader.read(key, layout.FEATURE_SHAPE).astype(np.float16)
            if not np.isfinite(values).all():
                raise FileError(path, f"{key} has numbers beyond half precision")
            features[first + state] = values
            copied.add(state)
    return len(copied)


def features_path(data: Path) -> Path:
    """Path of the feature maps of a file of rooms, next to it."""
    return data.with_suffix(".features.npy")


def load_features(data: Path, tables: SceneTables) -> np.ndarray:
    """The feature maps of a file of rooms, memory-mapped: [S, 512, 7, 7] float16.

    Raises:
      FileError: there are none, or they belong to other rooms.
    """
    path = features_path(data)
    if not path.is_file():
        raise FileError(path, "no such file; import with --features")
    try:
        features = np.lib.format.open_memmap(path, mode="r")
    except (ValueError, OSError) as error:
        raise FileError(path, f"not an array ({error})") from None
    if features.shape != (tables.num_states, *layout.FEATURE_SHAPE) or features.dtype != np.float16:
        raise FileError(path, f"{features.shape} {features.dtype}: not the maps of these rooms")
    return features
