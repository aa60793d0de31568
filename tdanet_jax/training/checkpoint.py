"""Checkpoints of a run (Orbax): everything that is needed to continue bit for bit.

`DIR/checkpoints/<updates>/` holds `state` (parameters, optimiser, episodes in progress, recurrent
state, random key, counters; plain arrays, whichever devices held them), `meta` (JSON: format
version, training time, data version) and `SHA256SUMS`, the checksums of all its files
(`sha256sum -c SHA256SUMS` checks them, too).
"""

from __future__ import annotations

import contextlib
import ctypes
import logging
import os
import shutil
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from tdanet_jax.io import assets, files
from tdanet_jax.io.untrusted import FileError, jsons, orbax, regular
from tdanet_jax.io.untrusted.budgets import unpacking_excess
from tdanet_jax.training import history
from tdanet_jax.training.history import Snapshot
from tdanet_jax.training.renames import renamed

if TYPE_CHECKING:
    from tdanet_jax.training.learner import TrainState

#: Version of the files' layout; a newer one is refused, an older one renamed (`renames`).
FORMAT = 2
FOLDER = "checkpoints"
CHECKSUMS = "SHA256SUMS"
KEPT = 2

# Orbax logs every file it touches, and every error that it also raises.
logging.getLogger("absl").setLevel(logging.CRITICAL)


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
        run = Path(run)
        self.folder = (run / FOLDER).absolute()
        # Every process reads for itself, and one alone writes: none waits for the others.
        here = jax.process_index()
        alone = ocp.options.MultiprocessingOptions(primary_host=here, active_processes={here})
        self._orbax = ocp.Checkpointer(
            ocp.CompositeCheckpointHandler(
                composite_options=ocp.CompositeOptions(multiprocessing_options=alone),
                state=ocp.StandardCheckpointHandler(multiprocessing_options=alone),
                meta=ocp.JsonCheckpointHandler(multiprocessing_options=alone),
            ),
            multiprocessing_options=alone,
        )

    def save(self, state: TrainState, meta: dict[str, Any]) -> None:
        """Writes a checkpoint; it appears complete or not at all. The newest two are kept.

        Raises:
          ValueError: it cannot be written; those before it are as they were.
        """
        updates = int(state.updates)
        path = self.folder / str(updates)
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            content = jax.device_get(_plain(state))
            _check_space(self.folder, content)
            with files.private_folder(self.folder) as partial, _quiet_threads():
                fresh = partial / path.name
                self._orbax.save(
                    fresh,
                    args=ocp.args.Composite(
                        state=ocp.args.StandardSave(content),
                        meta=ocp.args.JsonSave({**meta, "format": FORMAT}),
                    ),
                )
                sums = "".join(f"{sha}  {name}\n" for name, sha in _checksums(fresh).items())
                (fresh / CHECKSUMS).write_text(sums)
                shutil.rmtree(path, ignore_errors=True)  # only a damaged one can be there
                fresh.rename(path)
        except Exception as error:  # Orbax and TensorStore raise many kinds, for a full disk too
            with contextlib.suppress(OSError):  # its threads may still write into it
                files.remove_partial(self.folder)
            kept = f"the one before it is {self.latest()}" if self._steps() else "there is no other"
            reason = f"checkpoint not written ({_reason(error)}); {kept}"
            raise ValueError(f"{path}: {reason}") from error
        # A later one is damaged: the run has continued from an earlier one instead.
        keep = [step for step in self._steps() if step <= updates][:KEPT]
        for step in set(self._steps()) - set(keep):
            shutil.rmtree(self.folder / str(step))
        _give_memory_back()

    def latest(self) -> int | None:
        """The number of updates of the newest complete checkpoint."""
        return next(iter(self._steps()), None)

    def restore(self, make_state: Callable[[], TrainState]) -> tuple[TrainState, dict[str, Any]]:
        """The newest checkpoint that can be read; a damaged one is skipped with a warning.

        Args:
          make_state: makes a state of the right shapes; only traced, never run.

        Raises:
          ValueError: there is no checkpoint, or none that fits this configuration.
        """
        shapes = jax.eval_shape(_plain, jax.eval_shape(make_state))
        blank = jax.tree.map(lambda x: np.empty(x.shape, x.dtype), shapes)
        state, meta = self._read(blank)
        return state.replace(key=jax.random.wrap_key_data(state.key)), meta

    def snapshot(self) -> Snapshot:
        """The network of the newest checkpoint, without knowing anything else of the run.

        Raises:
          ValueError: there is no checkpoint, or none can be read.
        """
        return self._read(None)

    def _steps(self) -> list[int]:
        """The complete checkpoints, newest first."""
        regular.check_folder(self.folder)
        names = (path.name for path in self.folder.glob("*") if path.is_dir())
        found = (int(name) for name in names if name.isdecimal() and str(int(name)) == name)
        return sorted(found, reverse=True)

    def _read(self, blank: Any) -> Any:
        faults: list[Exception] = []
        for step in self._steps():
            path = self.folder / str(step)
            try:
                read = self._read_one(path, blank)
                found = _snapshot(path, *read) if blank is None else read
            except NewerFormat:
                raise  # it is sound: no older one may replace it
            except (ValueError, OSError) as error:
                faults.append(error)
                continue
            for fault in faults:
                warnings.warn(f"{fault}; taking checkpoint {step} in its place", stacklevel=4)
            return found
        raise faults[0] if faults else ValueError(f"{self.folder}: no checkpoint")

    def _read_one(self, path: Path, blank: Any) -> tuple[Any, dict[str, Any]]:
        size = regular.check_tree(path)
        _verify(path)
        try:
            meta = jsons.load(path / "meta" / "metadata", links=False)
            written = meta["format"]
            if written <= FORMAT:
                described = renamed(orbax.describe(path / "state"), written)
                if blank is None:
                    described = {n: one for n, one in described.items() if _is_of_network(n)}
                    _check_budgets(described, size)
                else:
                    _fitted(described, blank)  # its shapes, before anything is read
                found = {name: one.read() for name, one in described.items()}
                state = history.nested(path, found) if blank is None else _fitted(found, blank)
        except Exception as error:  # a damaged folder has many kinds of faults
            raise ValueError(f"{path}: unreadable checkpoint ({_reason(error)})") from error
        if written > FORMAT:
            raise NewerFormat(
                f"{path}: checkpoint of format {written}, this version reads up to {FORMAT}: "
                "a newer tdanet_jax wrote it"
            )
        return state, meta


def _is_of_network(name: str) -> bool:
    """Whether an array of a state is needed for the network alone."""
    return name.startswith("params/") or name in ("updates", "episodes")


def _snapshot(path: Path, state: Any, meta: Mapping[str, Any]) -> Snapshot:
    """The network and the progress in a checkpoint."""
    counts = {name: state.get(name) for name in ("updates", "episodes")}
    if any(getattr(count, "shape", None) != () for count in counts.values()):
        raise FileError(path, "has no updates or episodes")
    weights = state.get("params")
    if not isinstance(weights, dict):
        raise FileError(path, "has no params")
    return history.snapshot(
        path,
        weights,
        point=0,
        **{name: count.item() for name, count in counts.items()},
        **{name: meta.get(name) for name in ("seconds", "data_version")},
    )


def _check_budgets(described: Mapping[str, orbax.Stored], size: int) -> None:
    """Raises ValueError if arrays are too many or too large to be read.

    Args:
      size: bytes of the checkpoint's files.
    """
    unpacked = sum(one.size for one in described.values())
    if reason := unpacking_excess(len(described), unpacked, size):
        raise ValueError(reason)


def _fitted(found: Mapping[str, Any], blank: Any) -> Any:
    """The tree of `blank` with the leaves that have the same names.

    By name, because a later version of the state may have further parts that are None here, which
    the files of an earlier one do not mention.

    Raises:
      ValueError: names, shapes or types differ.
    """
    wanted = {_name(path): leaf for path, leaf in jax.tree_util.tree_leaves_with_path(blank)}
    for name in sorted(found.keys() ^ wanted.keys()):
        raise ValueError(f"{name} is {'missing' if name in wanted else 'of no use here'}")
    for name, leaf in wanted.items():
        one, other = (f"{x.dtype}{x.shape}" for x in (found[name], leaf))
        if one != other:
            raise ValueError(f"{name} is {one}, not {other}")
    return jax.tree.unflatten(jax.tree.structure(blank), [found[name] for name in wanted])


def _name(path: tuple[Any, ...]) -> str:
    """params/actor/kernel, whether the parts are fields, keys or places."""
    return jax.tree_util.keystr(path, simple=True, separator="/")


@contextlib.contextmanager
def _quiet_threads() -> Iterator[None]:
    """Keeps Orbax's threads from printing the errors that they also hand to the caller."""
    before = threading.excepthook, sys.unraisablehook
    threading.excepthook, sys.unraisablehook = lambda error: None, lambda error: None
    try:
        yield
    finally:
        threading.excepthook, sys.unraisablehook = before


def _give_memory_back() -> None:
    """Returns freed memory to the system. Each thread that writes would keep some (glibc)."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def _check_space(folder: Path, content: Any) -> None:
    """Raises OSError if the disk cannot hold a state. Orbax would only find out half-way."""
    needed = sum(array.nbytes for array in jax.tree.leaves(content))
    free = shutil.disk_usage(folder).free
    if free < needed:
        megabytes = f"{needed / 1e6:.1f} MB needed, {free / 1e6:.1f} MB free"
        raise OSError(f"No space left on device: {megabytes}")


def _plain(state: TrainState) -> TrainState:
    """The state with its random key as integers, which is what a file can hold."""
    return state.replace(key=jax.random.key_data(state.key))


def _reason(error: Exception) -> str:
    """The first line of an error's message."""
    return (str(error).strip() or type(error).__name__).splitlines()[0]


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
