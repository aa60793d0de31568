"""The parameters of a run at fixed shares of its budget, for learning curves and later analysis.

`DIR/history/<updates>.npz` holds the parameters alone, by their path in the network
(`encoder/linear2/kernel`), and where the run was, under names that begin with @.
Checkpoints, which resume a run, are three times as large, and only the newest are kept. A shared
agent's folder has neither, but one such file next to its configuration, `NETWORK`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import traverse_util

from tdanet_jax.io import files
from tdanet_jax.io.bundled_agents import SUFFIX
from tdanet_jax.io.untrusted import FileError, jsons, npz, regular
from tdanet_jax.training.renames import renamed

FOLDER = "history"
#: The network of a shared agent's folder (`saved_networks.share`).
NETWORK = "network.npz"
#: Parts of a parameter's name, at most: encoder/linear2/kernel has three.
DEEPEST = 20
#: Version of the files' layout; `read` refuses a newer one, and renames in an older one.
FORMAT = 2


@dataclasses.dataclass(frozen=True)
class Snapshot:
    """A network at one moment of its training."""

    weights: Any  # its parameters
    updates: int  # updates done
    episodes: int  # training episodes done
    seconds: float  # training time
    point: int  # which point of the history it is, from 1; 0 outside the history
    data_version: str  # of the scene tables that it trained on


_WHERE = {field.name for field in dataclasses.fields(Snapshot)} - {"weights"}


def due(before: float, after: float, points: int) -> int:
    """The newest point that lies between two shares of the budget, or 0 if there is none.

    Point k of n is reached at the share k / n; the last is the end of the budget.
    """
    reached, passed = (min(math.floor(share * points), points) for share in (after, before))
    return reached if reached > passed else 0


def write(run: Path | str, snapshot: Snapshot) -> Path:
    """Adds a point; the file appears complete or not at all."""
    run = Path(run)
    path = run / FOLDER / f"{snapshot.updates:08d}{SUFFIX}"
    path.parent.mkdir(exist_ok=True)
    save(path, snapshot)
    return path


def save(path: Path | str, snapshot: Snapshot, half: bool = False) -> None:
    """Writes a snapshot; the file appears complete or not at all.

    Args:
      half: keep 16 bits of each parameter (float16).

    Raises:
      ValueError: a parameter is too large for that.
    """
    path = Path(path)
    arrays = traverse_util.flatten_dict(jax.device_get(snapshot.weights), sep="/")
    if half:
        if any(abs(array).max(initial=0) > np.finfo(np.float16).max for array in arrays.values()):
            raise ValueError(f"{path}: a parameter does not fit into float16")
        arrays = {name: array.astype(np.float16) for name, array in arrays.items()}
    where = {name: getattr(snapshot, name) for name in _WHERE} | {"format": FORMAT}
    content: dict[str, Any] = arrays | {f"@{name}": np.array(v) for name, v in where.items()}
    with files.replacing(path) as fresh, fresh.open("wb") as file:
        np.savez(file, **content)


def read(path: Path | str) -> Snapshot:
    """One point.

    Raises:
      ValueError: the file is missing, damaged, too large or of a newer format; the message names
        it.
    """
    path = Path(path)
    content = npz.read(path, links=False)
    progress: dict[str, Any] = {}
    for name in (*_WHERE, "format"):
        value = content.pop(f"@{name}", None)
        if value is None or value.shape != ():
            raise FileError(path, "not a point of a run's history")
        progress[name] = value.item()
    written = int(jsons.number(path, progress.pop("format"), "format", 1e9))
    if written > FORMAT:
        raise FileError(
            path, f"format {written}, this version reads {FORMAT}: a newer tdanet_jax wrote it"
        )
    return snapshot(path, weights(path, renamed(content, written)), **progress)


def weights(path: Path | str, arrays: Mapping[str, np.ndarray]) -> Any:
    """A network: nested dictionaries of the parameters (float32) whose names are paths.

    Raises:
      FileError: one is no parameter, or its name has too many parts or begins with another's.
    """
    for name, array in arrays.items():
        parts = name.split("/")
        begins = any("/".join(parts[:n]) in arrays for n in range(1, len(parts)))
        if array.dtype.kind != "f" or len(parts) > DEEPEST or begins:
            raise FileError(path, f"{name} is not a parameter")
    single = {name: array.astype(np.float32, copy=False) for name, array in arrays.items()}
    return traverse_util.unflatten_dict(single, sep="/")


def snapshot(path: Path | str, weights: Any, **progress: Any) -> Snapshot:
    """A network that was read from a file, with the progress of its run.

    Raises:
      FileError: the progress is not what it must be; the message names the field.
    """
    check_progress(path, progress)
    return Snapshot(weights=weights, **progress)


def check_progress(path: Path | str, progress: Mapping[str, Any]) -> None:
    """Raises FileError if a field of a run's progress is not what it must be, and names it."""
    for name, value in progress.items():
        if name == "data_version":
            if not isinstance(value, str) or not value.isprintable() or len(value) > 100:
                raise FileError(path, f"{name} is not a version")
            continue
        least = jsons.number(path, value, name, 1e15)
        if least < 0 or (type(value) is not int and name != "seconds"):
            raise FileError(path, f"{name} is {value}: not a count")


def check_fit(path: Path | str, weights: Any, expected: Any, width: int | None = None) -> None:
    """Checks that a network has the parameters of the model that its configuration describes.

    Args:
      expected: the model's parameters, or their shapes alone.
      width: numbers in a word vector, if the vectors are not the bundled ones.

    Raises:
      FileError: a name or a shape differs, for which `width` is then blamed.
    """
    ours, theirs = (
        {name: x.shape for name, x in traverse_util.flatten_dict(tree, sep="/").items()}
        for tree in (weights, expected)
    )
    for name in sorted(ours.keys() | theirs.keys()):
        if ours.get(name) != theirs.get(name):
            if width is not None:
                raise FileError(
                    path,
                    f"was trained with word vectors of another width than {width}, which "
                    "--word-vectors gives",
                )
            raise FileError(
                path,
                f"does not fit the run's configuration: {name} is "
                f"{ours.get(name, 'missing')}, not {theirs.get(name, 'a parameter')}",
            )


def points(run: Path | str) -> list[Path]:
    """The files of a run's history, oldest first.

    Raises:
      FileError: the folder of the history is a link.
    """
    run = Path(run)
    regular.check_folder(run / FOLDER)
    found = (run / FOLDER).glob(f"*{SUFFIX}")
    return sorted(path for path in found if path.stem.isdecimal() and path.stem.isascii())


def drop_after(run: Path | str, updates: int) -> None:
    """Deletes the points after a checkpoint: their updates will be done again."""
    run = Path(run)
    found = points(run)  # an error if the folder is a link
    files.remove_partial(run / FOLDER)
    for path in found:
        if int(path.stem) > updates:
            path.unlink()
