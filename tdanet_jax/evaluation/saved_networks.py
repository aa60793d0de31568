"""The networks that runs have saved: found on disk, and evaluated together.

Networks of one task are stacked and played in one compiled call: a run's whole history costs one
compilation.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import traverse_util

from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.config import CONFIG_FILE, WORD_VECTORS_FILE, NetworkConfig, TrainConfig
from tdanet_jax.eval_config import OWN_TASK, EvalConfig
from tdanet_jax.evaluation import comparison, policies, report, rollout, selection
from tdanet_jax.evaluation.report import Played
from tdanet_jax.io import assets, files
from tdanet_jax.io.bundled_agents import find_run
from tdanet_jax.io.untrusted import regular
from tdanet_jax.models import classes
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic
from tdanet_jax.scenes.dataset import Rooms, find_targets, load_rooms
from tdanet_jax.splits import make_split
from tdanet_jax.targets import naming
from tdanet_jax.task import Task, task_in
from tdanet_jax.training import history
from tdanet_jax.training.checkpoint import Checkpoints, is_shared, newest
from tdanet_jax.training.history import Snapshot

_DEFAULT = NetworkConfig()
#: Networks in one call on an accelerator, at most; bounds the memory. A CPU plays one after the
#: other, so there each has a call of its own, and progress can be reported.
TOGETHER = 20


@dataclasses.dataclass(frozen=True)
class SavedNetwork:
    """A network on disk."""

    run: Path  # its run's folder
    config: TrainConfig  # of its run
    point: Path | None = None  # a file of the run's history, or None for its newest network
    test: EvalConfig = OWN_TASK  # how it is evaluated

    @property
    def located(self) -> TrainConfig:
        """The run's configuration with the files that it is evaluated with."""
        return self.test.locate(self.config, self.run)

    @property
    def departures(self) -> dict[str, Any]:
        """`EvalConfig.departures`, without word vectors that are those of the training."""
        found = self.test.departures
        if self.config.word_vectors and not os.path.lexists(self.run / WORD_VECTORS_FILE):
            found.pop("word_vectors", None)  # it says where the file is that the run has no copy of
        return found

    @property
    def data_version(self) -> str:
        """The version of the scene tables of the rooms and targets that it is evaluated in."""
        located = self.located
        with naming("--targets" if self.test.test_targets is None else "--test-targets"):
            tables, _ = find_targets(located.sought, load_rooms(located.data), located.validation)
        return tables.data_version

    def load(self) -> Snapshot:
        """Reads the network. Raises ValueError if it cannot be read."""
        return newest(self.run) if self.point is None else history.read(self.point)

    def fingerprint(self, snapshot: Snapshot) -> str:
        """Twelve hexadecimal digits: of its network, what it is shown, how it decides, its split.

        Settings at their default values do not count, so that agents keep theirs when further ones
        are added.

        Args:
          snapshot: its network, from `load`.
        """
        config = _task_config(self)
        network = {k: v for k, v in vars(config.network).items() if v != getattr(_DEFAULT, k)}
        told = (config.split, config.targets, config.model, config.word_vectors, network)
        digest = hashlib.sha256(json.dumps(told, sort_keys=True).encode())
        arrays = traverse_util.flatten_dict(jax.device_get(snapshot.weights), sep="/")
        for name, array in sorted(arrays.items()):
            digest.update(f"{name} {array.shape} {array.dtype}".encode())
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()[:12]


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
        share = None if point is None else self._share(self.saved.config, self.snapshot)
        return {
            "run": str(self.saved.run),
            "point": point,
            "share": share,
            "updates": self.snapshot.updates,
            "training_seconds": round(self.snapshot.seconds, 1),
            **report.results(self.provenance, self.task.tables, self.played),
            "settings": comparison.settings(
                dataclasses.replace(self.saved.config, network=self.saved.located.network)
            ),
        }

    @staticmethod
    def _share(config: TrainConfig, at: Snapshot) -> float:
        """The share of the budget at a point; of the present one, if a run has got another."""
        points = max(config.history, 1)
        spent = config.spent(at.updates * config.steps_per_update, at.episodes, at.seconds)
        return at.point / points if history.due(0.0, spent, points) == at.point else spent

    def columns(self) -> dict[str, report.Columns]:
        """Its records by group, as named columns."""
        tables, by_class = self.task.tables, self.task.split.is_open
        return {name: report.columns(tables, *pair, by_class) for name, pair in self.played.items()}


def find(
    run: Path | str, with_history: bool = False, test: EvalConfig | None = None
) -> list[SavedNetwork]:
    """The newest network of a run, or its whole history, oldest first.

    Args:
      run: its folder, or the name of a bundled agent.
      with_history: all points of its history.
      test: how to evaluate them.

    Raises:
      ValueError: the folder holds no run, or none of its networks.
    """
    run = find_run(run)
    test = test or OWN_TASK
    config = configs.load(run / CONFIG_FILE)
    if with_history:
        points: list[Path | None] = [*history.points(run)]
        if not points:
            raise ValueError(f"{run / history.FOLDER}: no history; train with --history above 0")
        return [SavedNetwork(run, config, point, test) for point in points]
    if not is_shared(run) and Checkpoints(run).latest() is None:
        raise ValueError(f"{run}: no checkpoint")
    return [SavedNetwork(run, config, None, test)]


def share(run: Path | str, out: Path | str, word_vectors: Path | str | None = None) -> None:
    """Makes a small folder of a run's newest network: enough to load, evaluate and look at it.

    It holds the configuration, the classes, the network with 16 bits per parameter, a copy of the
    word vectors unless they are the bundled ones, and the run's results and records if there are
    any; training cannot continue from it. Rooms of `--data` stay where they are.

    Args:
      run: the run's folder.
      out: folder to write, new or empty; it appears complete or not at all.
      word_vectors: where the run's word vectors are, if it holds no copy and the file was moved.

    Raises:
      ValueError: the folder holds no run, its network cannot be read or does not fit, or its word
        vectors are missing.
    """
    run, out = find_run(run), Path(out)
    network, vocabulary = find(run)[0], classes.load_vocabulary(run)
    snapshot = network.load()
    path = configs.find_word_vectors(network.config, run, word_vectors)
    vectors = None if path is None else words.load_word_vectors(path, vocabulary.names)
    kept = {
        name: regular.read_bytes(run / name, links=False)
        for name in (report.RESULTS_PAGE, report.EPISODES_FILE, report.RESULTS_FILE)
        if os.path.lexists(run / name)
    }
    with files.new_folder(out) as fresh:
        history.save(fresh / history.NETWORK, snapshot, half=True)
        configs.save(network.config, fresh / CONFIG_FILE)
        vocabulary.save(fresh)
        if vectors is not None:
            vectors.save_copy(fresh / WORD_VECTORS_FILE, vocabulary.names)
        for name, content in kept.items():
            (fresh / name).write_bytes(content)


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
    groups: dict[Any, list[SavedNetwork]] = {}
    for network in networks:
        noiseless = dataclasses.replace(network.test, noise=None)
        groups.setdefault((_task_config(network), noiseless), []).append(network)
    for members in groups.values():
        located, test = members[0].located, members[0].test
        rooms = load_rooms(located.data)
        with naming("--targets" if test.test_targets is None else "--test-targets"):
            task = task_in(rooms, located)
        own = {network.config.sought: network.config for network in members}
        versions = {sought: _version(task, rooms, config, test) for sought, config in own.items()}
        params, lists = selection.select(task, test)
        policy = policies.network(task.model, task.words, greedy)
        expected = task.model.parameter_shapes(*task.words.shape)
        width = None if located.word_vectors is None else task.words.shape[1]
        senses = [network.test.senses for network in members]
        worlds = selection.with_senses(task, params, senses)
        alone = jax.default_backend() == "cpu" or len({*senses}) > 1
        together = 1 if alone else TOGETHER
        for start in range(0, len(members), together):
            part, params = members[start : start + together], worlds[start]
            snapshots = [_checked(network, task, versions) for network in part]
            for network, snapshot in zip(part, snapshots, strict=True):
                of = network.point or network.run
                history.check_fit(of, snapshot.weights, expected, width)
            weights = jax.tree.map(
                lambda *leaves: jnp.stack(leaves), *(s.weights for s in snapshots)
            )
            seeds = [network.config.seed if seed is None else seed for network in part]
            # In parallel, adaptive networks would take their inner steps in every step.
            batched = False if isinstance(task.model, AdaptiveActorCritic) else None
            played = rollout.evaluate_stacked(policy, weights, params, lists, seeds, batched)
            for network, snapshot, records, drawn in zip(
                part, snapshots, played, seeds, strict=True
            ):
                yield Evaluated(
                    saved=network,
                    snapshot=dataclasses.replace(snapshot, weights=None),
                    task=task,
                    provenance=report.Provenance.of(
                        task,
                        dataclasses.replace(
                            network.config, data=located.data, targets=located.targets
                        ),
                        "greedy" if greedy else "sample",
                        drawn,
                        snapshot.episodes,
                        snapshot.updates,
                        network.departures,
                        network.config.targets,
                    ),
                    played=records,
                )


def _task_config(network: SavedNetwork) -> TrainConfig:
    """The run's config with the evaluation rooms and training-only fields reset.

    Runs of one task thus compare equal.
    """
    kept = ("split", "targets", "model", "validation", "network", "data", "word_vectors")
    located = network.located
    values: dict[str, Any] = {name: getattr(located, name) for name in kept}
    if located.word_vectors is not None:  # every run has a copy of its own
        values["word_vectors"] = assets.sha256(Path(located.word_vectors))
    return TrainConfig(**values)


def _version(task: Task, rooms: Rooms, config: TrainConfig, test: EvalConfig) -> str:
    """The version of the tables that runs were trained on, which depends on their targets.

    Raises:
      ValueError: a target of the test that should be unseen was a target in training.
    """
    if test.test_targets is None or test.data is not None:  # other rooms have no version to check
        return task.tables.data_version
    tables, own = find_targets(config.sought, rooms, config.validation)
    hidden = make_split(config.split, config.validation, own).hidden
    unseen = {name for names in task.split.unseen.values() for name in names}
    if known := sorted(unseen - hidden):
        raise ValueError(
            f"--test-targets {test.test_targets}: would have {', '.join(known)} as unseen, which "
            "training did not hide"
        )
    return tables.data_version


def _checked(network: SavedNetwork, task: Task, versions: Mapping[str, str]) -> Snapshot:
    snapshot, version = network.load(), versions[network.config.sought]
    if network.test.data is None and snapshot.data_version != version:
        raise ValueError(
            f"{network.point or network.run}: trained on scene tables {snapshot.data_version}, "
            f"these are {version}"
        )
    task.check_known(network.run, classes.load_vocabulary(network.run).names)
    return snapshot
