"""Exports an agent for robots without JAX: NumPy alone, Python 3.10 or newer.

    tdanet export --checkpoint runs/... --out exported

The folder holds the network, the word vectors, and the part of this package that a robot needs.
docs/robots.md says how to use it.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from tdanet_jax.commands.console import RunPath, console, one_line_errors, parse
from tdanet_jax.io import files


@dataclasses.dataclass(frozen=True)
class Command:
    """Exports an agent for robots without JAX."""

    checkpoint: RunPath
    """Folder of a run, a point of its history, or a bundled agent's name."""
    out: Path
    """Folder to write; must be new or empty."""
    word_vectors: Path | None = None
    """File of the run's word vectors, if it holds no copy of them and the file was moved."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet export", description=__doc__)
        files.check_new_folder(command.out)
        from tdanet_jax.training import devices
        from tdanet_jax.workflows import export

        devices.start()
        export.export(command.checkpoint, command.out, command.word_vectors)
        size = sum(path.stat().st_size for path in command.out.rglob("*") if path.is_file())
        console.print(f"{size / 1e6:.1f} MB in {command.out}")
