"""What a caller of `tdanet_jax.train` hears while runs train, and how it stops them."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tdanet_jax.training.journal import Row
    from tdanet_jax.training.run import Run


class Callbacks:
    """What a caller hears while runs train. Override the methods that you need."""

    command: str | None = None
    """The command line that trains the runs, for their `run.json`."""

    def on_rooms(self, done: float, total: int) -> None:
        """So many of the rooms that are needed next are there: bundled rooms on a machine's first
        start, variants and generated rooms until they are cached, a pool of them for its turn."""

    def on_note(self, text: str) -> None:
        """Something worth a line."""

    def on_rows(self, runs: Sequence[Run], rows: Sequence[Row]) -> None:
        """A chunk of updates is done: a row of metrics for each of the runs that took part."""

    def on_results(self, folder: Path, results: Mapping[str, Any]) -> None:
        """A run is finished: its report is in `folder`; `results` as in its `results.json`."""

    def should_stop(self) -> bool:
        """Whether to save and stop after this chunk."""
        return False

    def on_stop(self) -> None:
        """The runs stop early, here or because another process does, and are being saved."""

    def shield(self) -> AbstractContextManager[None]:
        """Entered around work that no signal may interrupt."""
        return contextlib.nullcontext()
