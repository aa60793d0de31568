"""The parameters of a run at fixed shares of its budget, for learning curves and later analysis.

`DIR/history/<updates>.npz` holds the parameters alone, by their path in the network
(`encoder/linear2/kernel`), and where the run was, under names that begin with @.
Checkpoints, which resume a run, are three times as large, and only the newest are kept. A shared
agent's folder has neither, but one such file next to its configuration, `NETWORK`.
"""

from __future__ import annotations

import dataclasses
import math
import zipfile
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import traverse_util

from tdanet_jax.io import files
from tdanet_jax.training.renames import renamed

FOLDER = "history"
SUFFIX = ".npz"
#: The network of a shared agent's folder (`saved_networks.share`).
NETWORK = "network.npz"
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
      ValueError: the file is missing, damaged or of a newer format; the message names it.
    """
    path = Path(path)
    try:
        with np.load(path, allow_pickle=False) as data:
            content = {name: data[name] for name in data.files}
            where = {name[1:]: content.pop(name).item() for name in data.files if name[0] == "@"}
        content = {name: array.astype(np.float32) for name, array in content.items()}
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file") from None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: unreadable ({str(error).splitlines()[0]})") from error
    written = where.pop("format", None)
    if written is not None and written > FORMAT:
        raise ValueError(
            f"{path}: format {written}, this version reads {FORMAT}: a newer tdanet_jax wrote it"
        )
    if written is None or where.keys() != _WHERE:
        raise ValueError(f"{path}: not a point of a run's history")
    weights = traverse_util.unflatten_dict(renamed(content, written), sep="/")
    return Snapshot(weights=weights, **where)


def checksums(path: Path | str) -> list[tuple[str, int]]:
    """Name and checksum (CRC-32) of every array of a point, from the file's directory alone.

    Raises:
      ValueError: the file is missing or damaged; the message names it.
    """
    path = Path(path)
    try:
        with zipfile.ZipFile(path) as archive:
            return [(entry.filename, entry.CRC) for entry in archive.infolist()]
    except (OSError, zipfile.BadZipFile) as error:
        raise ValueError(f"{path}: unreadable ({error})") from error


def points(run: Path | str) -> list[Path]:
    """The files of a run's history, oldest first."""
    run = Path(run)
    return sorted(path for path in (run / FOLDER).glob(f"*{SUFFIX}") if path.stem.isdecimal())


def drop_after(run: Path | str, updates: int) -> None:
    """Deletes the points after a checkpoint: their updates will be done again."""
    run = Path(run)
    files.remove_partial(run / FOLDER)
    for path in points(run):
        if int(path.stem) > updates:
            path.unlink()
