"""A training run on disk: chunks of updates, metrics, checkpoints, and resuming after a stop."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path

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
from tdanet_jax.vocabulary import ACTION_NAMES


class Run:
    """A run in its folder: `state` is its present state, `seconds` its training time so far, `mesh`
    the devices that it trains on.
    """

    def __init__(
        self,
        folder: Path | str,
        config: TrainConfig,
        task: Task,
        mesh: Mesh | None = None,
        pools: Pools | None = None,
    ) -> None:
        """The run in `folder`, new or from its newest checkpoint.

        Args:
          mesh: the devices that the environments are split over; by default the first alone.
          pools: those of another seed, if seeds train together. If this seed's checkpoint has
            another number of rows per frame, it uses its own pools until all are equally far.

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
        self.pools = pools or Pools(task, config, self._shared)
        self._closes_pools = pools is None
        self._turn = 0  # whose rooms the episodes in progress are in
        shapes = jax.eval_shape(self._init, jax.random.key(0), self._words, self.pools.params)
        self._layout = devices.layout(shapes, self.mesh)
        self._begin_again = jax.jit(
            lambda state, params: learner.begin_again(state, config.learner, self.model, params),
            out_shardings=self._layout,
            donate_argnums=0,
        )
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
        if self.config.extra_targets is not None:
            asked += f", extra targets {self.config.extra_targets}"
        return f"{name}, split {self.task.split.name}{asked}, seed {self.config.seed}"

    def _init(self, key: jax.Array, words: jax.Array, params: EnvParams) -> TrainState:
        return learner.init(key, self.config.learner, self.model, words, params)

    def share(self, pools: Pools) -> None:
        """Trains in the pools of another seed from now on."""
        if self.pools is not pools:
            self.pools.close()
        self.pools, self._closes_pools = pools, False

    def _use_frames_of(self, rows: int) -> None:
        """Makes frames so long; if those of shared pools differ, in pools of its own."""
        if not self._closes_pools and self.pools.params.max_detections != rows:
            self.pools = Pools(self.task, self.config, self._shared)
            self._closes_pools = True
        self.pools.lengthen_frames(rows)

    def _begin(self) -> TrainState:
        self._use_frames_of(self.pools.first_rows)
        init = jax.jit(self._init, out_shardings=self._layout)
        return init(jax.random.key(self.config.seed), self._words, self.pools.params)

    def _restore(self) -> TrainState:
        def make_state(rows: int | None) -> TrainState:
            params = self.pools.params
            if rows is not None:
                params = params.replace(max_detections=rows)  # which is all that shapes depend on
            return self._init(jax.random.key(0), self._words, params)

        state, meta = self.checkpoints.restore(make_state)
        if meta["data_version"] != self.task.tables.data_version:
            raise ValueError(
                f"{self.folder}: trained on scene tables {meta['data_version']}, "
                f"these are {self.task.tables.data_version}"
            )
        if meta.get("variants") != self.task.variants_version:
            raise ValueError(
                f"{self.folder}: trained with the added rooms {meta.get('variants')}, "
                f"these are {self.task.variants_version}"
            )
        self.seconds = float(meta["seconds"])
        self._saved = int(state.updates)
        # The last chunk was in these rooms. They are entered only if there is another.
        self._turn = self.pools.turn(max(0, self._saved - self.config.chunk_updates))
        self._use_frames_of(int(meta.get("max_detections", self.pools.params.max_detections)))
        state = jax.device_put(state, self._layout)
        wrap = jax.jit(jax.random.wrap_key_data, out_shardings=self._shared)
        return state.replace(key=wrap(state.key))

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
                meta["max_detections"] = self.pools.params.max_detections
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
        chunk = compiled_for = None
        try:
            while not self._over(until):
                self._change_rooms()
                if compiled_for != (shapes := self.pools.shapes):
                    chunk, compiled_for = self._compile(), shapes
                assert chunk is not None
                before, shares, began = self.progress, self._shares(), time.perf_counter()
                state, metrics = chunk(self.state, shares, self._words, self.pools.params)
                metrics = jax.device_get(metrics)
                took = devices.from_lead(time.perf_counter() - began)
                yield self._record(state, metrics, before, took)
                self._check_finite()
        finally:
            if self._closes_pools:
                self.pools.close()

    def wait_for_rooms(self, seconds: float) -> tuple[float, int] | None:
        """Waits at most so long for the rooms of the next chunk.

        Returns:
          (rooms done, rooms of the pool) while they are not there; None when they are.
        """
        if self.progress >= 1.0:
            return None
        return self.pools.wait(self.pools.turn(int(self.state.updates)), seconds)

    def _change_rooms(self) -> bool:
        """Enters the rooms of the next chunk; True if episodes begin again, in other rooms."""
        turn = self.pools.turn(int(self.state.updates))
        try:
            self.pools.enter(turn)
        except Exception:
            self.save()
            raise
        changed = turn != self._turn
        if changed:
            self.state = self._begin_again(self.state, self.pools.params)
            self._turn = turn
        return changed

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

        Exact for a budget in steps; extrapolated from the pace so far for episodes and minutes.
        Either depends on the saved state alone, so a resumed run has the same schedule.
        """
        config, before = self.config, self.progress
        chunks_done = int(self.state.updates) / config.chunk_updates
        pace = before / chunks_done if chunks_done else 0.0
        steps = self.steps + config.chunk_updates * config.steps_per_update
        after = max(config.spent(steps, 0, 0.0), before + pace)
        return jnp.array([before, min(1.0, after)], jnp.float32)

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
        return chunk.lower(self.state, self._shares(), self._words, self.pools.params).compile()

    def _row(self, metrics: dict[str, np.ndarray], took: float) -> Row:
        """One line of `metrics.jsonl`: means over the chunk's episodes, updates and steps, and the
        share of each action.

        A mean is None if no episode ended, or no value was finite.
        """
        steps = self.config.chunk_updates * self.config.steps_per_update
        taken = metrics["actions"].sum(axis=0)
        shares = taken / max(taken.sum(), 1)
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
            **{name: over_updates(name) for name in _FURTHER_MEANS if name in metrics},
            **{f"actions/{name}": float(n) for name, n in zip(ACTION_NAMES, shares, strict=True)},
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
      runs: seeds of one configuration and task that share their pools, with a budget in steps.

    Raises:
      ValueError: too many updates of a run were skipped, or its rooms cannot be made; the states of
        all are saved first.
    """
    try:
        yield from _chunks_together(runs)
    except Exception:
        for run in runs:
            run.save()
        raise
    finally:
        runs[0].pools.close()


def _chunks_together(runs: Sequence[Run]) -> Iterator[list[Row]]:
    furthest = max(int(run.state.updates) for run in runs)
    for run in runs:
        for row in run.chunks(until=furthest):
            yield [row]
    for run in runs[1:]:
        run.share(runs[0].pools)
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

    lead, stacked = runs[0], together()
    chunk = compiled_for = None
    while lead.progress < 1.0:
        changed = [run._change_rooms() for run in runs]
        if any(changed):
            stacked = together()
        arguments = lead._words, lead.pools.params
        if compiled_for != (shapes := lead.pools.shapes):
            chunk = several.lower(stacked, lead._shares(), *arguments).compile()
            compiled_for = shapes
        assert chunk is not None
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


_UPDATE_MEANS = (
    "policy_loss", "value_loss", "entropy", "explained_variance", "grad_norm", "learning_rate",
)  # fmt: skip
#: Of runs that imitate shortest paths, and of networks that estimate reach.
_FURTHER_MEANS = ("imitation_loss", "reach_loss")
