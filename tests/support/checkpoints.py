"""All arrays of a run's newest checkpoint, by the names of today."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from tdanet_jax.io.untrusted import orbax
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.training.renames import renamed


def arrays_of(run: Path) -> dict[str, np.ndarray]:
    """Name -> array of everything that the checkpoint holds."""
    folder = run / "checkpoints" / str(Checkpoints(run).latest())
    written = json.loads((folder / "meta" / "metadata").read_text())["format"]
    found = renamed(orbax.describe(folder / "state"), written)
    return {name: one.read() for name, one in found.items()}
