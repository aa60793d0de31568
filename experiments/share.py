"""Makes a small folder of a trained agent, to keep or to pass on.

    python -m experiments.share --checkpoint runs/... --out agents/mine

A fiftieth of the run's size: its newest network with 16 bits per parameter, configuration, classes,
results and records. Enough to load, evaluate and replay the agent; not to continue training. Custom
rooms and word vectors (--data, --word-vectors) are not included: share them as well.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from experiments.console import console, one_line_errors, parse
from tdanet_jax.io import files


@dataclasses.dataclass(frozen=True)
class Command:
    """Makes a small folder of a trained agent."""

    checkpoint: Path
    """Folder of a run."""
    out: Path
    """Folder to write; must be new or empty."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    command = parse(Command, arguments, prog="share", description=__doc__)
    with one_line_errors():
        files.check_empty(command.out)
        from tdanet_jax.evaluation import saved_networks

        saved_networks.share(command.checkpoint, command.out)
        size = sum(path.stat().st_size for path in command.out.rglob("*") if path.is_file())
        console.print(f"{size / 1e6:.1f} MB in {command.out}")


if __name__ == "__main__":
    main()
