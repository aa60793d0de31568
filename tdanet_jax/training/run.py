"""A training run on disk: chunks of updates, metrics, checkpoints, and resuming after a stop."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from tdanet_jax.config import TrainConfig
from tdanet_jax.env.types import EnvParams
from tdanet_jax.targets import PAPER
from tdanet_jax.task import Task
from tdanet_jax.training import devices, history, learner
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.training.journal import METRICS_FILE, Journal, Row
from tdanet_jax.training.learner import TrainState
from tdanet_jax.training.pools import Pools


class Run:
    """A run in its folder: `state` is its present state, `seconds` its training time so far, `mesh`
    the devices that it trains on.
    """

    def __init__(
        self, folder: Path | str, config: TrainConfig, task: Task, mesh: Mesh | None = None
    ) -> None:
        """The run in `folder`, new or from its newest checkpoint.

        Args:
          mesh: the devices that the environments are split over; by default the first alone.

        Raises:
          ValueError: the checkpoint does not fit the configuration or the rooms.
        """
        folder = Path(folder)
        self.folder = folder
        self.config = config
        self.task = task
        self.model = task.model
        self.seconds = 0.0
        self.mesh = mesh or devices.first()
        self._shared = devices.everywhere(self.mesh)
        self._words = jax.device_put(task.train_words, self._shared)
        self._pools = Pools(task, config)
        self._turn = 0  # of the pool whose rooms `state` is in
        self._params = jax.device_put(self._pools.params(0), self._shared)
        shapes = jax.eval_shape(self._init, jax.random.key(0), self._words, self._params)
        self._layout = devices.layout(shapes, self.mesh)
        self.checkpoints = Checkpoints(folder)
        self._journal: Journal | None = None
        self._saved: int | None = None  # updates of the checkpoint with the present state
        fresh = self.checkpoints.latest() is None
        self.state: TrainState = self._begin() if fresh else self._restore()
        self._skipped_before = int(self.state.skipped)

    @property
    def title(self) -> str:
        """tdanet, split 18/4, seed 0; or tdanet, --odometry, ..."""
        name = self.task.spec.agent_name(self.config.model)
        asked = "" if self.config.targets == PAPER else f", targets {self.config.targets}"
        return f"{name}, split {self.task.split.name}{asked}, seed {self.config.seed}"

    def _init(self, key: jax.Array, words: jax.Array, params: EnvParams) -> TrainState:
        return learner.init(key, self.config.learner, self.model, words, params)

    def _begin(self) -> TrainState:
        init = jax.jit(self._init, out_shardings=self._layout)
        return init(jax.random.key(self.config.seed), self._words, self._params)

    def _restore(self) -> TrainState:
        def make_state(rows: int | None) -> TrainState:
            more = max(rows or 0, self._params.max_detections)
            return self._init(jax.random.key(0), self._words, self._params.with_rows(more))

        state, meta = self.checkpoints.restore(make_state)
        if meta["data_version"] != self.task.tables.data_version:
            raise ValueError(
                f"{self.folder}: trained on scene tables {meta['data_version']}, "
                f"these are {self.task.tables.data_version}"
            )
        if meta.get("variants") != self.task.variants_version:
            raise ValueError(
                f"{self.folder}: trained in variants {meta.get('variants')}, "
                f"these are {self.task.variants_version}"
            )
        self.seconds = float(meta["seconds"])
        self._saved = int(state.updates)
        self._turn = self._pools.turn(max(0, self._saved - self.config.chunk_updates))
        if self._turn:
            self._enter(self._pools.params(self._turn), meta.get("max_detections", 0))
        return jax.device_put(state, self._layout)

    def _enter(self, params: EnvParams, rows: int = 0) -> None:
        """Takes the rooms of a pool, with tables at least as long as those before.

        Args:
          rows: in a frame, at least.
        """
        params = params.with_rows(max(rows, params.max_detections)).padded(self._params)
        self._params = jax.device_put(params, self._shared)

    def save(self) -> None:
        """Writes a checkpoint of the present state, unless there is one.

        Raises:
          ValueError: it cannot be written; those before it are as they were.
        """
        if self._saved != int(self.state.updates):
            meta = {
                "seconds": self.seconds,
                "data_version": self.task.tables.data_version,
                "variants": self.task.variants_version,
            }
            if self.task.further_pools:
                meta["max_detections"] = self._params.max_detections
            state = devices.whole(self.state, self.mesh)
            if devices.is_lead():
                self.checkpoints.save(state, meta)
            self._saved = int(self.state.updates)

    @property
    def steps(self) -> int:
        """Environment steps so far."""
        return int(self.state.updates) * self.config.steps_per_update

    @property
    def progress(self) -> float:
        """Fraction of the budget that has been used; training ends at 1."""
        return self.config.spent(self.steps, int(self.state.episodes), self.seconds)

    def chunks(self, until: int | None = None) -> Iterator[Row]:
        """Trains to the end of the budget; yields one row of metrics per chunk.

        Of several processes, the lead alone writes files. Compilation does not count as training
        time. To stop early, stop iterating; `save` then keeps the progress.

        Args:
          until: stop after this many updates.

        Raises:
          ValueError: too many updates were skipped; the state is saved first.
        """
        self._open_journal()
        if self._over(until):
            return
        chunk = None
        try:
            while not self._over(until):
                changed = self._change_rooms()
                chunk = self._compile() if chunk is None or changed else chunk
                before, shares, began = self.progress, self._shares(), time.perf_counter()
                state, metrics = chunk(self.state, shares, self._words, self._params)
                metrics = jax.device_get(metrics)
                took = devices.from_lead(time.perf_counter() - began)
                yield self._record(state, metrics, before, took)
                self._check_finite()
        finally:
            self._pools.close()

    def waits_for_rooms(self, seconds: float) -> tuple[float, int] | None:
        """Waits at most so long for the rooms of the next chunk, if they are others.

        Returns:
          (rooms done, rooms in all) while they are being built; None when they are there.
        """
        turn = self._pools.turn(int(self.state.updates))
        if turn == self._turn or self.progress >= 1.0:
            return None
        return self._pools.waits(turn, seconds)

    def _change_rooms(self) -> bool:
        """Enters the rooms of the next chunk, if they are others; True if they are compiled anew.

        Every episode that is in progress ends without a trace, and another begins.
        """
        turn, before = self._pools.turn(int(self.state.updates)), self._params
        if turn != self._turn:
            try:
                self._enter(self._pools.params(turn))
            except ValueError:
                self.save()
                raise
            self._turn = turn
            self._begin_again()
        self._pools.prepare(turn + 1)
        return _shapes(before) != _shapes(self._params)

    def _follow(self, other: Run) -> None:
        """Enters the rooms of another run of the same task."""
        self._params, self._turn = other._params, other._turn
        self._begin_again()

    def _begin_again(self) -> None:
        def again(state: TrainState, params: EnvParams) -> TrainState:
            return learner.begin_again(state, self.config.learner, self.model, params)

        self.state = jax.jit(again, out_shardings=self._layout)(self.state, self._params)

    def _over(self, until: int | None) -> bool:
        stopped = until is not None and int(self.state.updates) >= until
        return stopped or self.progress >= 1.0

    def _open_journal(self) -> None:
        """Opens the journal, in the lead alone; drops what was written after the checkpoint."""
        if devices.is_lead():
            history.drop_after(self.folder, int(self.state.updates))
            self._journal = Journal(self.folder / METRICS_FILE, int(self.state.updates))

    def _shares(self) -> jax.Array:
        """Fractions of the budget that are used before and after the next chunk.

        They are extrapolated from the chunks so far, and thus known from the state alone: a run
        that was stopped continues with the same schedule.
        """
        before = self.progress
        chunks_done = int(self.state.updates) / self.config.chunk_updates
        pace = before / chunks_done if chunks_done else 0.0
        return jnp.array([before, min(1.0, before + pace)], jnp.float32)

    def _record(
        self, state: TrainState, metrics: dict[str, np.ndarray], before: float, took: float
    ) -> Row:
        """Takes the state after a chunk; writes its row and, if one is due, a point."""
        self.state = state
        self.seconds += took
        row = self._row(metrics, took)
        if self._journal is not None:
            self._journal.write(row)
            self._keep_point(before)
        return row

    def _check_finite(self) -> None:
        skipped = int(self.state.skipped) - self._skipped_before
        if skipped >= self.config.max_skipped:
            self.save()
            raise ValueError(
                f"{self.folder}: {skipped} updates skipped because the loss or gradient "
                f"was not finite; the state is saved as checkpoint {int(self.state.updates)}"
            )

    def _keep_point(self, before: float) -> None:
        """Adds to the history if a point of the budget has been passed since `before`.

        A point that cannot be written is left out with a warning; the run does not need it.
        """
        point = history.due(before, self.progress, self.config.history)
        if point:
            try:
                history.write(self.folder, self.snapshot(point))
            except OSError as error:
                warnings.warn(f"{error.filename}: left out ({error.strerror})", stacklevel=3)

    def snapshot(self, point: int = 0) -> history.Snapshot:
        """The network as it is now."""
        return history.Snapshot(
            weights=self.state.params,
            updates=int(self.state.updates),
            episodes=int(self.state.episodes),
            seconds=self.seconds,
            point=point,
            data_version=self.task.tables.data_version,
        )

    def _compile(self) -> jax.stages.Compiled:
        config, places = self.config, (self._layout, self._shared)
        chunk = learner.make_train(config.learner, self.model, config.chunk_updates, places)
        return chunk.lower(self.state, self._shares(), self._words, self._params).compile()

    def _row(self, metrics: dict[str, np.ndarray], took: float) -> Row:
        """One line of `metrics.jsonl`: means over the chunk's episodes, updates and steps.

        A mean is None if no episode ended, or no value was finite.
        """
        steps = self.config.chunk_updates * self.config.steps_per_update
        episodes = int(metrics["episodes"].sum())

        def per_episode(name: str) -> float | None:
            return float(metrics[name].sum()) / episodes if episodes else None

        def over_updates(name: str) -> float | None:
            finite = metrics[name][np.isfinite(metrics[name])]
            return float(finite.mean()) if finite.size else None

        return {
            "updates": int(self.state.updates),
            "steps": self.steps,
            "episodes": int(self.state.episodes),
            "success": per_episode("success_sum"),
            "spl": per_episode("spl_sum"),
            "length": per_episode("length_sum"),
            "reward": float(metrics["reward_sum"].sum()) / steps,
            **{name: over_updates(name) for name in _UPDATE_MEANS},
            "bootstrap_only_steps": int(metrics["bootstrap_only_steps"].sum()),
            "skipped": int(self.state.skipped),
            "seconds": round(self.seconds, 3),
            "steps_per_second": round(steps / took, 1),
        }


def chunks_together(runs: Sequence[Run]) -> Iterator[list[Row]]:
    """`Run.chunks` of several seeds of one configuration, in one vmapped call.

    A run that is behind the others after an interruption first catches up alone; until then, lists
    hold its row alone.

    Args:
      runs: seeds of one configuration and task, with a budget in steps.

    Raises:
      ValueError: too many updates of a run were skipped; its state is saved first.
    """
    furthest = max(int(run.state.updates) for run in runs)
    for run in runs:
        for row in run.chunks(until=furthest):
            yield [row]
    if runs[0].progress >= 1.0:
        return
    config = runs[0].config
    one = learner.make_train(config.learner, runs[0].model, config.chunk_updates)
    several = jax.jit(jax.vmap(one, in_axes=(0, None, None, None)), donate_argnums=0)

    @jax.jit  # one call for all arrays of all seeds
    def apart(stacked: TrainState) -> list[TrainState]:
        return [jax.tree.map(lambda x, i=i: x[i], stacked) for i in range(len(runs))]

    def together() -> TrainState:
        return jax.tree.map(lambda *leaves: jnp.stack(leaves), *(run.state for run in runs))

    lead, stacked, chunk = runs[0], together(), None  # rooms are the lead's
    for run in runs:
        run._open_journal()
    while lead.progress < 1.0:
        turn, changed = lead._turn, lead._change_rooms()
        if lead._turn != turn:
            for run in runs[1:]:
                run._follow(lead)
            stacked = together()
        arguments = lead._words, lead._params
        if chunk is None or changed:
            chunk = several.lower(stacked, lead._shares(), *arguments).compile()
        before, shares, began = lead.progress, lead._shares(), time.perf_counter()
        stacked, metrics = chunk(stacked, shares, *arguments)
        metrics = jax.device_get(metrics)
        took = time.perf_counter() - began
        rows = []
        for i, (run, state) in enumerate(zip(runs, apart(stacked), strict=True)):
            own = {name: values[i] for name, values in metrics.items()}
            rows.append(run._record(state, own, before, took))
        yield rows
        for run in runs:
            run._check_finite()


def _shapes(params: EnvParams) -> tuple[Any, list[tuple[int, ...]]]:
    """All that a program is compiled for."""
    return jax.tree.structure(params), [leaf.shape for leaf in jax.tree.leaves(params)]


_UPDATE_MEANS = (
    "policy_loss", "value_loss", "entropy", "explained_variance", "grad_norm", "learning_rate",
)  # fmt: skip
