"""Rooms that are too many to be held at once: whose turn it is, and loading the next meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable

from tdanet_jax.config import TrainConfig
from tdanet_jax.env.types import EnvParams
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.task import Task

#: What the tables of the first pool are lengthened by, as a share, so that those of the next ones
#: fit as well: a pool with longer ones is compiled anew.
SPARE = 0.05


class Pools:
    """The environments in a run's pools of rooms, which take turns; turns are numbered from 0."""

    def __init__(self, task: Task, config: TrainConfig) -> None:
        self._task = task
        self._config = config
        self._count = 1 + len(task.further_pools)
        chunks = max(1, round(config.pool_updates / config.chunk_updates))
        self._updates = chunks * config.chunk_updates  # in a turn
        self._loading: _Loading | None = None

    def turn(self, updates: int) -> int:
        """The turn in which an update after so many takes place; always 0 with a single pool."""
        return updates // self._updates if self._count > 1 else 0

    def prepare(self, turn: int) -> None:
        """Begins to load the environment of a turn in the background, if the budget reaches it."""
        number, steps = turn % self._count, turn * self._updates * self._config.steps_per_update
        if number and self._loading is None and self._config.spent(steps, 0, 0.0) < 1.0:
            self._loading = _Loading(number, self._task.further_pools[number - 1])

    def waits(self, turn: int, seconds: float) -> tuple[float, int] | None:
        """Waits at most so long for the environment of a turn: (rooms done, rooms); None if loaded.

        Its rooms count only while they are built.
        """
        number = turn % self._count
        if not number:
            return None
        if self._loading is None or self._loading.number != number:
            self.close()
            self._loading = _Loading(number, self._task.further_pools[number - 1])
        return self._loading.waits(seconds)

    def params(self, turn: int) -> EnvParams:
        """The environment of a turn, when it is loaded.

        Raises:
          ValueError: its rooms cannot be built or read.
        """
        if turn % self._count == 0:
            first = self._task.train_params
            return first if self._count == 1 else first.padded(first, SPARE)
        while self.waits(turn, 1.0) is not None:
            pass
        assert self._loading is not None
        loaded, self._loading = self._loading, None
        return loaded.result()

    def close(self) -> None:
        """Stops loading."""
        if self._loading is not None:
            self._loading.stop()
            self._loading = None


class _Loading:
    """A pool that a thread loads. It ends with the process, or between two rooms if stopped."""

    def __init__(self, number: int, load: Callable[[Progress], EnvParams]) -> None:
        self.number = number
        self._load = load
        self._found: EnvParams | Exception | None = None
        self._done = (0.0, 1)
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="rooms", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            self._found = self._load(self._report)
        except Exception as error:  # raised by `result`
            self._found = error

    def _report(self, done: float, total: int) -> None:
        if self._stopped:
            raise InterruptedError
        self._done = done, total

    def waits(self, seconds: float) -> tuple[float, int] | None:
        self._thread.join(seconds)
        return self._done if self._thread.is_alive() else None

    def result(self) -> EnvParams:
        assert self._found is not None
        if isinstance(self._found, Exception):
            raise self._found
        return self._found

    def stop(self) -> None:
        self._stopped = True
