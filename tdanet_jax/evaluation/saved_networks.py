"""The networks that runs have saved: found on disk, and evaluated together.

Networks of one task are stacked and played in one compiled call: a run's whole history costs one
compilation.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax import config as configs
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tdanet_jax.evaluation import comparison, episodes, policies, report, rollout
from tdanet_jax.evaluation.report import Played
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import regular
from tdanet_jax.models import classes
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic
from tdanet_jax.task import Task, load_task
from tdanet_jax.training import history
from tdanet_jax.training.checkpoint import Checkpoints, is_shared, newest
from tdanet_jax.training.history import Snapshot

#: Networks in one call, at most; bounds the memory.
TOGETHER = 20


@dataclasses.dataclass(frozen=True)
class SavedNetwork:
    """A network on disk."""

    run: Path  # its run's folder
    config: TrainConfig  # of its run
    point: Path | None = None  # a file of the run's history, or None for its newest network
    data: str | None = None  # file of rooms to evaluate in; None for those of its training

    @property
    def rooms(self) -> str | None:
        """File of the rooms that it is evaluated in; None for the bundled ones."""
        return self.config.data if self.data is None else self.data

    def load(self) -> Snapshot:
        """Reads the network. Raises ValueError if it cannot be read."""
        return newest(self.run) if self.point is None else history.read(self.point)


@dataclasses.dataclass(frozen=True)
class Evaluated:
    """A saved network and its evaluation."""

    saved: SavedNetwork
    snapshot: Snapshot  # the progress of its run then; without the weights
    task: Task
    provenance: report.Provenance
    played: Played

    def results(self) -> dict:
        """The content of a `results.json`, with the run's folder, progress and settings.

        `point` and `share` are None unless it is a point of a history.
        """
        point = None if self.saved.point is None else self.snapshot.point
        return {
            "run": str(self.saved.run),
            "point": point,
            "share": None if point is None else point / max(self.saved.config.history, 1),
            "updates": self.snapshot.updates,
            "training_seconds": round(self.snapshot.seconds, 1),
            **report.results(self.provenance, self.task.tables, self.played),
            "settings": comparison.settings(self.saved.config),
        }

    def columns(self) -> dict[str, report.Columns]:
        """Its records by group, as named columns."""
        return {name: report.columns(self.task.tables, *pair) for name, pair in self.played.items()}


def find(run: Path, with_history: bool = False, data: str | None = None) -> list[SavedNetwork]:
    """The newest network of a run, or its whole history, oldest first.

    Args:
      run: its folder.
      with_history: all points of its history.
      data: file of rooms to evaluate in, instead of the run's.

    Raises:
      ValueError: the folder holds no run, or none of its networks.
    """
    config = configs.load(run / CONFIG_FILE)
    if with_history:
        points: list[Path | None] = [*history.points(run)]
        if not points:
            raise ValueError(f"{run / history.FOLDER}: no history; train with --history above 0")
        return [SavedNetwork(run, config, point, data) for point in points]
    if not is_shared(run) and Checkpoints(run).latest() is None:
        raise ValueError(f"{run}: no checkpoint")
    return [SavedNetwork(run, config, None, data)]


def share(run: Path, out: Path) -> None:
    """Makes a small folder of a run's newest network: enough to load, evaluate and look at it.

    It holds the configuration, the classes, the network with 16 bits per parameter, and the run's
    results and records if there are any; training cannot continue from it.

    Raises:
      ValueError: the folder holds no run, or its network cannot be read or does not fit.
    """
    network = find(run)[0]
    out.mkdir(parents=True, exist_ok=True)
    history.save(out / history.NETWORK, network.load(), half=True)
    configs.save(network.config, out / CONFIG_FILE)
    classes.load_vocabulary(run).save(out)
    for name in (report.RESULTS_PAGE, report.EPISODES_FILE, report.RESULTS_FILE):
        if os.path.lexists(run / name):
            content = regular.read_bytes(run / name, links=False)
            with files.replacing(out / name) as fresh:
                fresh.write_bytes(content)


def evaluate(
    networks: Sequence[SavedNetwork], greedy: bool, seed: int | None = None
) -> Iterator[Evaluated]:
    """Plays the fixed test episodes with every network, task by task.

    Args:
      networks: the networks; those of one task are played in one compiled call.
      greedy: choose the most probable actions instead of sampling.
      seed: of sampled actions; None takes each run's own, as at the end of its training.

    Raises:
      ValueError: a network cannot be read, or was trained on other scene tables.
    """
    groups: dict[TrainConfig, list[SavedNetwork]] = {}
    for network in networks:
        groups.setdefault(_task_config(network), []).append(network)
    for config, members in groups.items():
        task = load_task(config)
        lists = episodes.load(task.tables, task.split, task.extras)
        policy = policies.network(task.model, task.words, greedy)
        expected = task.model.parameter_shapes(*task.words.shape)
        for start in range(0, len(members), TOGETHER):
            part = members[start : start + TOGETHER]
            snapshots = [_checked(network, task) for network in part]
            for network, snapshot in zip(part, snapshots, strict=True):
                history.check_fit(network.point or network.run, snapshot.weights, expected)
            weights = jax.tree.map(
                lambda *leaves: jnp.stack(leaves), *(s.weights for s in snapshots)
            )
            seeds = [network.config.seed if seed is None else seed for network in part]
            # In parallel, adaptive networks would take their inner steps in every step.
            batched = False if isinstance(task.model, AdaptiveActorCritic) else None
            played = rollout.evaluate_stacked(
                policy, weights, task.eval_params, lists, seeds, batched
            )
            for network, snapshot, own, drawn in zip(part, snapshots, played, seeds, strict=True):
                yield Evaluated(
                    saved=network,
                    snapshot=dataclasses.replace(snapshot, weights=None),
                    task=task,
                    provenance=report.Provenance.of(
                        task,
                        dataclasses.replace(network.config, data=network.rooms),
                        "greedy" if greedy else "sample",
                        drawn,
                        snapshot.episodes,
                        snapshot.updates,
                    ),
                    played=own,
                )


def _task_config(network: SavedNetwork) -> TrainConfig:
    """The run's config with the evaluation rooms and training-only fields reset.

    Runs of one task thus compare equal.
    """
    kept = ("split", "model", "word_vectors", "validation", "network")
    values: dict[str, Any] = {name: getattr(network.config, name) for name in kept}
    return TrainConfig(data=network.rooms, **values)


def _checked(network: SavedNetwork, task: Task) -> Snapshot:
    snapshot = network.load()
    if network.data is None and snapshot.data_version != task.tables.data_version:
        raise ValueError(
            f"{network.point or network.run}: trained on scene tables {snapshot.data_version}, "
            f"these are {task.tables.data_version}"
        )
    task.check_known(network.run, classes.load_vocabulary(network.run).names)
    return snapshot
