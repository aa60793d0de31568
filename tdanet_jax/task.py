"""Puts a configuration's rooms, classes, words and network together."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax import poses
from tdanet_jax import words as word_vectors
from tdanet_jax.config import TrainConfig
from tdanet_jax.env import dynamics, zero_shot
from tdanet_jax.env.dynamics import TEST_STEP_LIMITS, EnvParams
from tdanet_jax.env.reward import (
    Parents,
    cosines,
    find_parents,
    greatest_similarity,
    no_parents,
    published_parents,
)
from tdanet_jax.models import class_graph
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import Classes, make_classes
from tdanet_jax.models.registry import make_model, resolve_precision
from tdanet_jax.scenes.dataset import Extras, Rooms, load_rooms, with_own_rooms
from tdanet_jax.scenes.offline import importer
from tdanet_jax.scenes.tables import Progress, SceneTables
from tdanet_jax.splits import Split, make_split
from tdanet_jax.vocabulary import ROOM_TYPES
from tdanet_jax.words import WordVectors


@dataclasses.dataclass(frozen=True)
class Task:
    """What a run trains and is evaluated on.

    Attributes:
      tables: all rooms.
      split: which rooms and classes train.
      classes: the vocabulary, and what of it training may know.
      model: the network.
      train_params: the training rooms, hidden classes filtered out.
      eval_params: all rooms and classes, with the test step limits; `reset` begins in the rooms of
        the evaluation alone.
      train_words: [C, D], zero for hidden classes.
      words: [C, D], vectors of all classes.
      extras: what came with imported rooms; None with the bundled ones.
    """

    tables: SceneTables
    split: Split
    classes: Classes
    model: ActorCritic
    train_params: EnvParams
    eval_params: EnvParams
    train_words: jax.Array
    words: jax.Array
    extras: Extras | None = None

    @property
    def image(self) -> str | None:
        """What the model sees in words, if it looks at an image."""
        if not self.model.encoder.IMAGE:
            return None
        maps = "ResNet-18's feature map of the frame"
        return maps if self.model.encoder.maps else "the class in each of 7 x 7 cells of the frame"

    def check_known(self, run: Path | str, names: tuple[str, ...]) -> None:
        """Raises ValueError if the model knows classes by number, and by that of other classes.

        Args:
          run: what to call the model.
          names: the classes of its training rooms; empty if nobody knows.
        """
        numbered = self.model.encoder.ROWS == "class" or self.model.encoder.IMAGE
        if numbered and names and names != self.tables.classes:
            raise ValueError(
                f"{run}: the model knows classes by their number in the rooms of its training, "
                "and these rooms have others"
            )


def load_task(config: TrainConfig, progress: Progress | None = None) -> Task:
    """The task of a configuration on the rooms and with the word vectors that it names.

    Args:
      progress: called with (rooms done, rooms in all) while bundled rooms are rebuilt.

    Raises:
      ValueError: a file is broken, or does not hold what the split needs; names the file.
    """
    return task_in(load_rooms(config.data, progress), config)


def task_in(rooms: Rooms, config: TrainConfig) -> Task:
    """The task of a configuration in these rooms, whichever rooms it names itself.

    Raises:
      ValueError: a file is broken, or the rooms do not hold what the split or the model needs.
    """
    vectors = word_vectors.load(config.word_vectors, rooms.tables.classes)
    data = None if rooms.path is None else str(rooms.path)
    config, features = resolve(dataclasses.replace(config, data=data)), None
    if rooms.path is not None and config.network.image == "features":
        features = importer.load_features(rooms.path, rooms.tables)
    try:
        return make_task(config, rooms.tables, vectors, rooms.extras, features)
    except ValueError as error:
        if rooms.path is None:
            raise
        raise ValueError(f"{rooms.path}: {error}") from None


def make_task(
    config: TrainConfig,
    tables: SceneTables,
    vectors: WordVectors,
    extras: Extras | None = None,
    features: np.ndarray | None = None,
) -> Task:
    """The task of a configuration on the given rooms; the split is what they hold of it.

    Args:
      config: the run's configuration.
      tables: all rooms.
      vectors: the word vectors.
      extras: what came with imported rooms. Their parents and class graph, where there are any,
        replace those found in the training rooms. Hidden classes are in neither.
      features: [S, 512, 7, 7], ResNet-18's maps of all poses, for the models that look at an image.
        Pictures show hidden classes, too: nothing can be filtered out of them.

    Raises:
      ValueError: the rooms hold none to train or to evaluate in, a class has no word vector, or
        the model looks at feature maps and there are none.
    """
    split = make_split(config.split, config.validation)
    split = with_own_rooms(split, Rooms(tables, extras), config.validation)
    split = split.within(tables.scenes, tables.classes)
    seen_rooms = zero_shot.hide_classes(tables.subset(split.train_scenes), split.hidden)
    adjacency = None if extras is None else extras.class_graph(tables.classes)
    if adjacency is None:
        adjacency = class_graph.co_occurrence(seen_rooms)
    classes = make_classes(tables.classes, split.hidden, adjacency)
    model = make_model(config, classes)
    if model.encoder.maps and features is None:
        raise ValueError(f"{config.model} looks at feature maps, and these rooms have none")
    shown = (model.encoder.ROWS or config.network.rows) == "class", model.encoder.IMAGE
    maps = _feature_maps(features) if features is not None and model.encoder.maps else None
    trains = np.isin(np.array(tables.scenes), split.train_scenes)[tables.position_scene]  # [P]
    parents = _parents(seen_rooms, split, extras)
    paid = config.learner.partial_reward
    limits = [config.learner.step_limit] * len(ROOM_TYPES)
    words = vectors.table(tables.classes, config.network.word_norm)
    train_words = zero_shot.hide_words(words, tables.classes, split.hidden)
    targets = {room: split.seen[room] + split.unseen[room] for room in ROOM_TYPES}
    return Task(
        tables=tables,
        split=split,
        classes=classes,
        model=model,
        train_params=dynamics.make_params(
            seen_rooms,
            split.seen,
            parents if paid == "parents" else no_parents(seen_rooms),
            limits,
            *shown,
            greatest_similarity(seen_rooms, cosines(train_words)) if paid == "similarity" else None,
            _places(maps, trains),
            odometry=model.odometry,
            triangulation=model.triangulation,
            size_noise=config.learner.size_noise,
        ),
        eval_params=dynamics.make_params(
            tables,
            targets,
            parents,
            TEST_STEP_LIMITS,
            *shown,
            features=_places(maps, trains | True),
            scenes=split.eval_scenes,
            odometry=model.odometry,
            triangulation=model.triangulation,
        ),
        train_words=jnp.asarray(train_words),
        words=jnp.asarray(words),
        extras=extras,
    )


def _feature_maps(features: np.ndarray) -> jax.Array:
    """[S, 512, 7, 7] -> [S, 49, 512], cells before channels."""
    flat = features.reshape(*features.shape[:2], -1)
    return jnp.asarray(np.ascontiguousarray(flat.swapaxes(1, 2)))


def _places(maps: jax.Array | None, chosen: np.ndarray) -> tuple[jax.Array, np.ndarray] | None:
    """The maps, and where among them the chosen positions [P] begin: nothing is copied."""
    return None if maps is None else (maps, poses.join(np.flatnonzero(chosen)))


def _parents(seen_rooms: SceneTables, split: Split, extras: Extras | None) -> Parents:
    """Those that came with the rooms, else those found in the training rooms."""
    if extras is not None and extras.parents:
        return published_parents(seen_rooms, split.seen, extras.parents, split.hidden)
    return find_parents(seen_rooms, split.seen)


def resolve(config: TrainConfig) -> TrainConfig:
    """The configuration with every `auto` replaced by what suits this machine and the data."""
    network = resolve_precision(config.network)
    if network.image == "auto":
        imported = config.data is not None and importer.features_path(Path(config.data)).is_file()
        network = dataclasses.replace(network, image="features" if imported else "raster")
    return dataclasses.replace(config, network=network)
