"""`run.json`: the processes that have worked on a run, each with its command and its machine."""

from __future__ import annotations

import dataclasses
import datetime
import json
import platform
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
from jax.sharding import Mesh

import tdanet_jax
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.training import devices

RUN_FILE = "run.json"


@dataclasses.dataclass(frozen=True)
class Process:
    """A process that has worked on a run: the first, or one that resumed it.

    None is what nobody knows any more.
    """

    command: str | None = None  # as typed; None if it was started from Python
    commit: str | None = None  # of the code, as in `results.json`
    tdanet_jax: str | None = None  # version
    jax: str | None = None  # version
    python: str | None = None  # version
    machine: str | None = None  # AMD EPYC 7B13, 2 cores; NVIDIA H200, 1 device
    started: str | None = None  # UTC: 2026-01-31T12:00:00+00:00


def this_process(command: str | None, commit: str, mesh: Mesh) -> Process:
    """This process, which begins to work on a run.

    Args:
      command: how it was started.
      commit: of the code.
      mesh: the devices that the run is trained on.
    """
    return Process(
        command=command,
        commit=commit,
        tdanet_jax=tdanet_jax.__version__,
        jax=jax.__version__,
        python=platform.python_version(),
        machine=devices.machine(mesh),
        started=datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    )


def read(folder: Path | str) -> list[Process]:
    """The processes in a folder's `run.json`, oldest first; none if there is no such file.

    Raises:
      FileError: it is not what a run writes.
    """
    path = Path(folder) / RUN_FILE
    if not path.exists() and not path.is_symlink():
        return []
    content = jsons.load(path, links=False)
    listed = content.get("processes") if isinstance(content, dict) else None
    if not isinstance(listed, list) or not all(map(_is_process, listed)):
        raise FileError(path, "not a list of the processes of a run")
    return [Process(**one) for one in listed]


def _is_process(values: Any) -> bool:
    names = [field.name for field in dataclasses.fields(Process)]
    return isinstance(values, dict) and all(
        name in names and (value is None or (isinstance(value, str) and value.isprintable()))
        for name, value in values.items()
    )


def write(folder: Path | str, processes: Sequence[Process]) -> None:
    """Writes a folder's `run.json`."""
    content = {"processes": [dataclasses.asdict(process) for process in processes]}
    files.write_text(Path(folder) / RUN_FILE, json.dumps(content, indent=2) + "\n")


def add(folder: Path | str, process: Process) -> None:
    """Adds a process to a folder's `run.json`; one that cannot be read begins anew, with a warning.

    Raises:
      OSError: it cannot be written.
    """
    try:
        before = read(folder)
    except FileError as error:
        warnings.warn(f"{error}; begun anew", stacklevel=2)
        before = []
    write(folder, [*before, process])
