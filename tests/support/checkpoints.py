"""All arrays of a run's newest checkpoint, by the names of today."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tdanet_jax.io.untrusted import npz, orbax
from tdanet_jax.training.checkpoint import ARRAYS, Checkpoints
from tdanet_jax.training.renames import renamed


def arrays_of(run: Path) -> dict[str, np.ndarray]:
    """Name -> array of everything that the checkpoint holds."""
    folder = run / "checkpoints" / str(Checkpoints(run).latest())
    if (folder / ARRAYS).exists():
        return npz.read(folder / ARRAYS)
    with orbax.as_npz(folder / "state") as file:
        return renamed(npz.read(file), written=1)  # format 2 had the names of today
