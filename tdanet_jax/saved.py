"""Networks that training runs have saved: found on disk, and evaluated together.

Networks of one shape and task are stacked and played in one compiled call, so that the learning
curve of a run's whole history costs one compilation.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import jax
import jax.numpy as jnp

from tdanet_jax import classes, episodes, evaluation, history, policies, report
from tdanet_jax import config as configs
from tdanet_jax.checkpoint import Checkpoints
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.episodes import Episodes
from tdanet_jax.evaluation import Records
from tdanet_jax.history import Snapshot
from tdanet_jax.task import Task, load_task

#: Networks in one call; bounds the memory that a long list takes.
TOGETHER = 20

Played = Mapping[str, tuple[Episodes, Records]]


@dataclasses.dataclass(frozen=True)
class Saved:
    """A network on disk.

    Attributes:
      run: its run's folder.
      config: its run's configuration, or with other rooms to be evaluated in.
      point: a file of the run's history, or None for the newest checkpoint.
      other_rooms: the rooms are not those of its training.
    """

    run: Path
    config: TrainConfig
    point: Path | None = None
    other_rooms: bool = False

    def load(self) -> Snapshot:
        """Reads it. Raises ValueError if it cannot be read."""
        return Checkpoints(self.run).snapshot() if self.point is None else history.read(self.point)


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """A saved network, what it was, and what it did.

    Attributes:
      saved: where it is.
      snapshot: where its run was; without the weights.
      task: what it was evaluated on.
      provenance: the head of its results.
      played: its episodes by group.
    """

    saved: Saved
    snapshot: Snapshot
    task: Task
    provenance: report.Provenance
    played: Played

    def results(self) -> dict:
        """The content of a `results.json`, after the run's folder and where the run was."""
        groups = {
            name: report.columns(self.task.tables, *pair) for name, pair in self.played.items()
        }
        return {
            "run": str(self.saved.run),
            "data": self.provenance.data,
            "point": self.snapshot.point,
            "updates": self.snapshot.updates,
            "training_seconds": round(self.snapshot.seconds, 1),
            **report.results(self.provenance, groups),
        }


def find(run: Path, with_history: bool = False, data: str | None = None) -> list[Saved]:
    """The newest network of a run, or its whole history, oldest first.

    Args:
      data: file of rooms to evaluate in, in place of the run's.

    Raises:
      ValueError: the folder holds no run, or none of its networks.
    """
    config = configs.load(run / CONFIG_FILE)
    if data is not None:
        config = dataclasses.replace(config, data=data)
    points: list[Path | None] = [*history.points(run)] if with_history else [None]
    if with_history and not points:
        raise ValueError(f"{run / history.FOLDER}: no history; train with --history above 0")
    if not with_history and Checkpoints(run).latest() is None:
        raise ValueError(f"{run}: no checkpoint")
    return [Saved(run, config, point, data is not None) for point in points]


def evaluate(networks: Sequence[Saved], greedy: bool, seed: int) -> Iterator[Evaluated]:
    """Plays the fixed test episodes with every network; those of one task come together.

    Raises:
      ValueError: a network cannot be read, or was trained on other scene tables.
    """
    groups: dict[TrainConfig, list[Saved]] = {}
    for network in networks:
        groups.setdefault(_task_config(network.config), []).append(network)
    for config, members in groups.items():
        task = load_task(config)
        lists = episodes.load(task.tables, task.split, task.extras)
        policy = policies.network(task.model, task.words, greedy)
        for start in range(0, len(members), TOGETHER):
            part = members[start : start + TOGETHER]
            snapshots = [_checked(network, task) for network in part]
            weights = jax.tree.map(
                lambda *leaves: jnp.stack(leaves), *(s.weights for s in snapshots)
            )
            played = evaluation.evaluate_stacked(policy, weights, task.eval_params, lists, seed)
            for network, snapshot, own in zip(part, snapshots, played, strict=True):
                yield Evaluated(
                    saved=network,
                    snapshot=dataclasses.replace(snapshot, weights=None),
                    task=task,
                    provenance=_provenance(network, snapshot, task, greedy),
                    played=own,
                )


def _task_config(config: TrainConfig) -> TrainConfig:
    """The configuration with all that only training uses at its default."""
    default = TrainConfig()
    names = (
        "steps", "episodes", "minutes", "seed", "chunk_updates", "checkpoint_minutes", "history",
        "max_skipped", "learner",
    )  # fmt: skip
    return dataclasses.replace(config, **{name: getattr(default, name) for name in names})


def _checked(network: Saved, task: Task) -> Snapshot:
    snapshot = network.load()
    if not network.other_rooms and snapshot.data_version != task.tables.data_version:
        raise ValueError(
            f"{network.point or network.run}: trained on scene tables {snapshot.data_version}, "
            f"these are {task.tables.data_version}"
        )
    task.check_known(network.run, classes.load(network.run).names)
    return snapshot


def _provenance(network: Saved, snapshot: Snapshot, task: Task, greedy: bool) -> report.Provenance:
    return report.Provenance(
        split=task.split.name,
        model=network.config.model,
        policy="greedy" if greedy else "sample",
        episodes_trained=snapshot.episodes,
        seed=network.config.seed,
        steps=snapshot.updates * network.config.steps_per_update,
        data_version=task.tables.data_version,
        data=network.config.data,
        image=task.image,
    )
