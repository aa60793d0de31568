"""Checkpoints of a run (Orbax): everything that is needed to go on bit for bit.

`DIR/checkpoints/<updates>/` holds `state` (parameters, optimiser, episodes in progress, recurrent
state, random key, counters) and `meta` (JSON: format version, training time, data version).
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import orbax.checkpoint as ocp

from tdanet_jax.learner import TrainState

FORMAT = 1
FOLDER = "checkpoints"
KEPT = 2

logging.getLogger("absl").setLevel(logging.ERROR)  # Orbax narrates every file it touches


class Checkpoints:
    """The checkpoints of one run's folder."""

    def __init__(self, run: Path) -> None:
        options = ocp.CheckpointManagerOptions(
            max_to_keep=KEPT, enable_async_checkpointing=False, create=True
        )
        self._manager = ocp.CheckpointManager((run / FOLDER).absolute(), options=options)

    def save(self, state: TrainState, meta: dict[str, Any]) -> None:
        """Writes a checkpoint; it appears complete or not at all."""
        self._manager.save(
            int(state.updates),
            args=ocp.args.Composite(
                state=ocp.args.StandardSave(_plain(state)),
                meta=ocp.args.JsonSave({**meta, "format": FORMAT}),
            ),
        )

    def latest(self) -> int | None:
        """The number of updates of the newest complete checkpoint."""
        return self._manager.latest_step()

    def restore(self, make_state: Callable[[], TrainState]) -> tuple[TrainState, dict[str, Any]]:
        """The newest checkpoint.

        Args:
          make_state: makes a state of the right shapes; only traced, never run.

        Raises:
          ValueError: there is no checkpoint, or it does not fit this configuration.
        """
        state, meta = self._read(jax.eval_shape(_plain, jax.eval_shape(make_state)))
        return state.replace(key=jax.random.wrap_key_data(state.key)), meta

    def weights(self) -> Any:
        """The parameters of the newest checkpoint, without knowing anything else of the run.

        Raises:
          ValueError: there is no checkpoint, or it cannot be read.
        """
        return self._read(None)[0]["params"]

    def _read(self, shapes: Any) -> tuple[Any, dict[str, Any]]:
        latest = self.latest()
        if latest is None:
            raise ValueError(f"{self._manager.directory}: no checkpoint")
        try:
            restored = self._manager.restore(
                latest,
                args=ocp.args.Composite(
                    state=ocp.args.StandardRestore(shapes), meta=ocp.args.JsonRestore()
                ),
            )
        except Exception as error:  # Orbax raises many kinds for a damaged folder
            reason = str(error).strip().splitlines()[0]
            raise ValueError(
                f"{self._manager.directory / str(latest)}: unreadable checkpoint ({reason})"
            ) from error
        return restored["state"], dict(restored["meta"])


def _plain(state: TrainState) -> TrainState:
    """The state with its random key as integers, which is what a file can hold."""
    return state.replace(key=jax.random.key_data(state.key))
