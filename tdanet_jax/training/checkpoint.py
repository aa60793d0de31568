"""Checkpoints of a run: everything that is needed to continue bit for bit.

`DIR/checkpoints/<updates>/` holds `state.npz` (parameters, optimiser, episodes in progress,
recurrent state, random key, counters: plain arrays, whichever devices held them, by their paths in
the state, such as `params/actor/kernel`), `meta.json` (format version, training time, data version)
and `SHA256SUMS`, the checksums of both (`sha256sum -c SHA256SUMS` checks them, too).
"""

from __future__ import annotations

import json
import os
import shutil
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import jax
import numpy as np

from tdanet_jax.io import assets, files
from tdanet_jax.io.untrusted import FileError, jsons, npz, orbax, regular
from tdanet_jax.training import history
from tdanet_jax.training.history import Snapshot
from tdanet_jax.training.renames import renamed

if TYPE_CHECKING:
    from tdanet_jax.training.learner import TrainState

T = TypeVar("T")

#: Version of the files' layout; a newer one is refused, an older one renamed (`renames`).
FORMAT = 3
#: The last version that Orbax wrote: folders `state` and `meta`.
LAST_OF_ORBAX = 2
FOLDER = "checkpoints"
ARRAYS = "state.npz"
META = "meta.json"
CHECKSUMS = "SHA256SUMS"
KEPT = 2
#: Rows of a frame.
MOST_DETECTIONS = 2**15


class NewerFormat(ValueError):
    """A checkpoint that only a newer version can read."""


def newest(run: Path | str) -> Snapshot:
    """The network of a run's newest checkpoint, or of a shared agent's folder.

    Raises:
      ValueError: the folder holds none, or none can be read.
    """
    run = Path(run)
    if is_shared(run):
        return history.read(run / history.NETWORK)
    checkpoints = Checkpoints(run)
    if checkpoints.latest() is None:
        raise ValueError(f"{run / FOLDER}: no checkpoint")
    return checkpoints.snapshot()


def is_shared(run: Path | str) -> bool:
    """Whether a folder holds a shared agent: a network, and nothing to continue training from."""
    return os.path.lexists(Path(run) / history.NETWORK)


class Checkpoints:
    """The checkpoints of one run's folder."""

    def __init__(self, run: Path | str) -> None:
        self.folder = (Path(run) / FOLDER).absolute()

    def save(self, state: TrainState, meta: Mapping[str, Any]) -> None:
        """Writes a checkpoint; it appears complete or not at all. The newest two are kept.

        Raises:
          ValueError: it cannot be written; those before it are as they were.
        """
        updates = int(state.updates)
        path = self.folder / str(updates)
        arrays = _named(jax.device_get(_plain(state)))
        for name, array in arrays.items():
            if array.dtype.isbuiltin != 1:
                raise ValueError(f"{path}: {name} is {array.dtype}, which npz cannot hold")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with files.private_folder(self.folder) as partial:
                fresh = partial / path.name
                fresh.mkdir()
                np.savez(fresh / ARRAYS, **arrays)
                (fresh / META).write_text(json.dumps({**meta, "format": FORMAT}))
                sums = "".join(f"{sha}  {name}\n" for name, sha in _checksums(fresh).items())
                (fresh / CHECKSUMS).write_text(sums)
                shutil.rmtree(path, ignore_errors=True)  # only a damaged one can be there
                fresh.rename(path)
        except OSError as error:
            kept = f"the one before it is {self.latest()}" if self._steps() else "there is no other"
            reason = f"checkpoint not written ({error.strerror or error}); {kept}"
            raise ValueError(f"{path}: {reason}") from error
        # A later one is damaged: the run has continued from an earlier one instead.
        keep = [step for step in self._steps() if step <= updates][:KEPT]
        for step in set(self._steps()) - set(keep):
            shutil.rmtree(self.folder / str(step))

    def latest(self) -> int | None:
        """The number of updates of the newest complete checkpoint."""
        return next(iter(self._steps()), None)

    def restore(
        self, make_state: Callable[[int | None], TrainState]
    ) -> tuple[TrainState, dict[str, Any]]:
        """The newest checkpoint that can be read; a damaged one is skipped with a warning.

        Args:
          make_state: makes a state of the right shapes, given the `max_detections` of its meta, if
            there are any; only traced, never run.

        Returns:
          The state, all of it NumPy arrays, which alone can be laid out over several processes: its
          key is `jax.random.key_data`. And its meta.

        Raises:
          ValueError: there is no checkpoint, or none that fits this configuration.
        """

        def read(path: Path, written: int, meta: dict[str, Any]) -> tuple[TrainState, Any]:
            rows = meta.get("max_detections")
            if rows is not None:
                rows = int(jsons.number(path, rows, "max_detections", MOST_DETECTIONS))
            blank = jax.eval_shape(_plain, jax.eval_shape(lambda: make_state(rows)))
            return _state(path, written, blank), meta

        return self._read(read)

    def snapshot(self) -> Snapshot:
        """The network of the newest checkpoint, without knowing anything else of the run.

        Raises:
          ValueError: there is no checkpoint, or none can be read.
        """
        return self._read(_snapshot)

    def _steps(self) -> list[int]:
        """The complete checkpoints, newest first."""
        regular.check_folder(self.folder)
        names = (path.name for path in self.folder.glob("*") if path.is_dir())
        found = (int(name) for name in names if name.isdecimal() and str(int(name)) == name)
        return sorted(found, reverse=True)

    def _read(self, read: Callable[[Path, int, dict[str, Any]], T]) -> T:
        """What `read` makes of the newest checkpoint that it can read."""
        faults: list[Exception] = []
        for step in self._steps():
            try:
                found = _read_one(self.folder / str(step), read)
            except NewerFormat:
                raise  # it is sound: no older one may replace it
            except (ValueError, OSError) as error:
                faults.append(error)
                continue
            for fault in faults:
                warnings.warn(f"{fault}; taking checkpoint {step} in its place", stacklevel=4)
            return found
        raise faults[0] if faults else ValueError(f"{self.folder}: no checkpoint")


def _read_one(path: Path, read: Callable[[Path, int, dict[str, Any]], T]) -> T:
    """What `read` makes of a checkpoint, given its arrays, its format and its meta."""
    regular.check_tree(path)
    _verify(path)
    try:
        file = path / "meta" / "metadata" if (path / "meta").is_dir() else path / META
        meta = jsons.load(file, links=False)
        if not isinstance(meta, dict):
            raise FileError(file, "not a JSON object")
        written = int(jsons.number(file, meta.get("format"), "format", 1e9))
        if written <= FORMAT:
            where = {name: meta.get(name) for name in ("seconds", "data_version")}
            history.check_progress(file, where)
            if written > LAST_OF_ORBAX:
                return read(path / ARRAYS, written, meta)
            with orbax.as_npz(path / "state") as arrays:
                return read(arrays, written, meta)
    except (ValueError, OSError) as error:
        reason = str(error).removeprefix(f"{path}/").removeprefix(f"{path}: ")
        raise ValueError(f"{path}: unreadable checkpoint ({reason})") from error
    raise NewerFormat(
        f"{path}: checkpoint of format {written}, this version reads up to {FORMAT}: "
        "a newer tdanet_jax wrote it"
    )


def _state(arrays: Path, written: int, blank: TrainState) -> TrainState:
    """The tree of `blank` with the arrays that have the same names.

    By name, because a later version of the state may have further parts that are None here, which
    the files of an earlier one do not mention.

    Raises:
      FileError: names, shapes or types differ; no array has been read then.
    """
    wanted = _named(blank)

    def check(found: Mapping[str, npz.Header]) -> None:
        found = renamed(found, written)
        for name in sorted(found.keys() ^ wanted.keys()):
            reason = f"{name} is {'missing' if name in wanted else 'of no use here'}"
            raise FileError(arrays, reason)
        for name, leaf in wanted.items():
            one, other = (f"{x.dtype}{x.shape}" for x in (found[name], leaf))
            if one != other:
                raise FileError(arrays, f"{name} is {one}, not {other}")

    found = renamed(npz.read(arrays, links=False, check=check), written)
    return jax.tree.unflatten(jax.tree.structure(blank), [found[name] for name in wanted])


def _snapshot(arrays: Path, written: int, meta: Mapping[str, Any]) -> Snapshot:
    """The network and the progress in a checkpoint.

    Raises:
      FileError: one of them is not there, or not what it must be.
    """
    prefix, counters = "params/", ("updates", "episodes")

    def is_needed(name: str) -> bool:
        return name.startswith(prefix) or name in counters

    found = npz.read(arrays, links=False, only=is_needed)
    counts = {name: found.pop(name, None) for name in counters}
    if not found:
        raise FileError(arrays, "has no params")
    weights = {name.removeprefix(prefix): x for name, x in renamed(found, written).items()}
    return history.snapshot(
        arrays,
        history.weights(arrays, weights),
        point=0,
        **{name: x.item() if x is not None and x.shape == () else x for name, x in counts.items()},
        **{name: meta[name] for name in ("seconds", "data_version")},
    )


def _named(state: TrainState) -> dict[str, Any]:
    """The arrays of a state by name, params/actor/kernel: of fields, keys and places."""
    leaves = jax.tree_util.tree_leaves_with_path(state)
    return {jax.tree_util.keystr(path, simple=True, separator="/"): leaf for path, leaf in leaves}


def _plain(state: TrainState) -> TrainState:
    """The state with its random key as integers, which is what a file can hold."""
    return state.replace(key=jax.random.key_data(state.key))


def _checksums(folder: Path) -> dict[str, str]:
    """sha256 by relative path of all files in a checkpoint."""
    found = sorted(path for path in folder.rglob("*") if path.is_file() and path.name != CHECKSUMS)
    return {path.relative_to(folder).as_posix(): assets.sha256(path) for path in found}


def _verify(path: Path) -> None:
    """Raises ValueError if a file is not the one that was written. Old ones have no checksums."""
    listed = path / CHECKSUMS
    if not listed.exists():
        return
    lines = listed.read_bytes().decode(errors="replace").splitlines()
    expected = {name: sha for sha, _, name in (line.partition("  ") for line in lines)}
    found = _checksums(path)
    wrong = [n for n in expected.keys() | found.keys() if expected.get(n) != found.get(n)]
    if wrong:
        raise ValueError(f"{path}: damaged checkpoint ({len(wrong)} files differ from {CHECKSUMS})")
