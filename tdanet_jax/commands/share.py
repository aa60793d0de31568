"""Makes a small folder of a trained agent, to keep or to pass on.

    tdanet share --checkpoint runs/... --out agents/mine

A fiftieth of the run's size: its newest network with 16 bits per parameter, configuration, classes,
results and records, and a copy of its word vectors unless they are the bundled ones. Enough to
load, evaluate and replay the agent anywhere; not to continue training. The rooms of --data are not
included: whoever evaluates or replays the agent in them needs their file.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from tdanet_jax import config as configs
from tdanet_jax.commands.console import RunPath, console, one_line_errors, parse
from tdanet_jax.config import CONFIG_FILE, WORD_VECTORS_FILE
from tdanet_jax.io import files


@dataclasses.dataclass(frozen=True)
class Command:
    """Makes a small folder of a trained agent."""

    checkpoint: RunPath
    """Folder of a run, or a bundled agent's name."""
    out: Path
    """Folder to write; must be new or empty."""
    word_vectors: Path | None = None
    """File of the run's word vectors, if it holds no copy of them and the file was moved."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet share", description=__doc__)
        files.check_new_folder(command.out)
        from tdanet_jax.evaluation import saved_networks
        from tdanet_jax.training import devices

        devices.start()
        saved_networks.share(command.checkpoint, command.out, command.word_vectors)
        size = sum(path.stat().st_size for path in command.out.rglob("*") if path.is_file())
        console.print(f"{size / 1e6:.1f} MB in {command.out}")
        if (command.out / WORD_VECTORS_FILE).exists():
            console.print("with a copy of its word vectors")
        if (data := configs.load(command.out / CONFIG_FILE).data) is not None:
            console.print(
                f"without its rooms, {data}: to evaluate or replay it, others need this file and "
                "give its place with --data; tdanet_jax.load needs no rooms"
            )
