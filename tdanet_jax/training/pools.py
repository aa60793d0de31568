"""Rooms that are too many to be held at once: whose turn it is, and loading the next meanwhile."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import jax
from jax.sharding import NamedSharding

from tdanet_jax.config import TrainConfig
from tdanet_jax.env.types import EnvParams
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.task import Task
from tdanet_jax.training import devices

#: Share by which the tables of the first pool are lengthened, so that later ones fit as well: a
#: longer one is compiled anew.
SPARE = 0.05


class Pools:
    """The pools of rooms that a run trains in, or several seeds that train together.

    `count` pools take turns, numbered from 0. `params` is the environment of turn `entered`.
    Observations begin with `first_rows` rows; later pools may need more.
    """

    def __init__(self, task: Task, config: TrainConfig, sharding: NamedSharding) -> None:
        """Enters the first pool.

        Args:
          sharding: where tables lie.
        """
        self._task, self._config, self._sharding = task, config, sharding
        self.count = 1 + len(task.further_pools)
        chunks = max(1, round(config.pool_updates / config.chunk_updates))
        self._updates = chunks * config.chunk_updates  # in a turn
        self._loading: _Loading | None = None
        first = task.train_params
        if self.count > 1:
            first = first.padded(first, SPARE)
        self.entered = 0
        self.first_rows = first.max_detections
        self.params: EnvParams = jax.device_put(first, sharding)

    @property
    def shapes(self) -> tuple[Any, list[tuple[int, ...]]]:
        """All of the environment that a program is compiled for."""
        leaves, tree = jax.tree.flatten(self.params)
        return tree, [leaf.shape for leaf in leaves]

    def turn(self, updates: int) -> int:
        """The turn in which an update after so many takes place; always 0 with a single pool."""
        return updates // self._updates if self.count > 1 else 0

    @property
    def unreached(self) -> int:
        """How many pools a budget in steps leaves out: it ends before their first turn."""
        return sum(self._ends_before(turn) for turn in range(1, self.count))

    def lengthen_frames(self, rows: int) -> None:
        """Makes frames at least so long, as they were when a checkpoint was written.

        With noise, what an episode draws depends on it.
        """
        if rows > self.params.max_detections:
            self.params = jax.device_put(self.params.with_rows(rows), self._sharding)

    def wait(self, turn: int, seconds: float) -> tuple[float, int] | None:
        """Waits at most so long for the environment of a turn.

        Returns:
          (rooms done, rooms of the pool) until it can be entered, then None.
        """
        number = turn % self.count
        if not number or turn == self.entered:
            return None
        return self._load(number).wait(seconds)

    def enter(self, turn: int) -> None:
        """Takes the environment of a turn, with tables at least as long as those before, and begins
        to load the next one if the budget reaches it.

        Raises:
          Exception: the rooms cannot be built or read, here or in another process; nothing has
            changed then.
        """
        if turn != self.entered:
            number, found = turn % self.count, None
            error: Exception | None = None
            try:
                found = self._load(number).result() if number else self._task.train_params
            except Exception as reason:
                error = reason
            if devices.anywhere(error is not None) or found is None:
                raise error or ValueError("another process could not build the next rooms")
            self._loading = None
            self.params = jax.device_put(found.padded(self.params), self._sharding)
            self.entered = turn
        following = (turn + 1) % self.count
        if following and not self._ends_before(turn + 1):
            self._load(following)

    def close(self) -> None:
        """Stops loading."""
        if self._loading is not None:
            self._loading.stop()
            self._loading = None

    def _ends_before(self, turn: int) -> bool:
        """Whether a budget in steps ends before a turn."""
        steps = turn * self._updates * self._config.steps_per_update
        return self._config.spent(steps, 0, 0.0) >= 1.0

    def _load(self, number: int) -> _Loading:
        """Loading of a pool other than the first, begun now or before."""
        if self._loading is None or self._loading.number != number:
            self.close()
            self._loading = _Loading(number, self._task.further_pools[number - 1])
        return self._loading


class _Loading:
    """A pool that a thread loads. It ends between two rooms if stopped.

    Python can crash if it ends while the thread is in native code.
    """

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

    def wait(self, seconds: float | None = None) -> tuple[float, int] | None:
        self._thread.join(seconds)
        return self._done if self._thread.is_alive() else None

    def result(self) -> EnvParams:
        self._thread.join()
        assert self._found is not None
        if isinstance(self._found, Exception):
            raise self._found
        return self._found

    def stop(self) -> None:
        self._stopped = True
        self._thread.join(10.0)
