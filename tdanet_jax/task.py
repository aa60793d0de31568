"""Puts a configuration's rooms, classes, words and network together."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import warnings
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax import sense_noise
from tdanet_jax import words as word_vectors
from tdanet_jax.config import TrainConfig
from tdanet_jax.env import reward, zero_shot
from tdanet_jax.env.environment import Environment
from tdanet_jax.env.params import FeatureMaps, limits_of_tests, make_params, with_noise
from tdanet_jax.env.reward import Parents
from tdanet_jax.env.types import EnvParams
from tdanet_jax.models import class_graph
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary, make_vocabulary
from tdanet_jax.models.factory import make_model, resolve_precision
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import PoseGrid
from tdanet_jax.scenes import generated, pools, tabulation, variants
from tdanet_jax.scenes.dataset import Extras, Rooms, assign_rooms, find_targets, load_rooms
from tdanet_jax.scenes.offline.features import features_path, load_features
from tdanet_jax.scenes.pools import Part
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.scenes.tabulation import Progress
from tdanet_jax.scenes.target_distances import with_targets
from tdanet_jax.splits import Split, make_split
from tdanet_jax.targets import naming
from tdanet_jax.words import WordVectors


@dataclasses.dataclass(frozen=True)
class Task:
    """What a run trains and is evaluated on.

    Attributes:
      tables: all rooms, with the distances to all targets.
      split: which rooms and classes train.
      classes: the vocabulary, and the part of it that training may know.
      model: the network.
      train_params: the training rooms, their variants and generated rooms, without hidden classes.
      eval_params: all rooms and classes, with the test step limits; `reset` begins in the
        evaluation's rooms alone.
      train_words: [C, D], zero for hidden classes.
      words: [C, D], vectors of all classes.
      vectors: the table of word vectors that they are from.
      extras: what came with imported rooms; None with the bundled ones.
      variants_version: hash of the tables of the variants and generated rooms among the training
        rooms, of the first pool if there are several; None without.
      further_pools: each gives the training rooms with a further pool of variants and generated
        rooms in place of the first, if they are too many to be held at once. It is told (rooms
        done, rooms of the pool) while any are built.
    """

    tables: SceneTables
    split: Split
    classes: ClassVocabulary
    model: ActorCritic
    train_params: EnvParams
    eval_params: EnvParams
    train_words: jax.Array
    words: jax.Array
    vectors: WordVectors
    extras: Extras | None = None
    variants_version: str | None = None
    further_pools: tuple[Callable[[Progress], EnvParams], ...] = ()

    @property
    def spec(self) -> ObservationSpec:
        """What the agent is shown."""
        return self.model.spec

    @property
    def image(self) -> str | None:
        """The image that the model is shown, in words, if there is one."""
        return {
            None: None,
            "features": "ResNet-18's feature map of the frame",
            "raster": "the class in each of 7 x 7 cells of the frame",
        }[self.spec.image]

    def check_known(self, run: Path | str, names: tuple[str, ...]) -> None:
        """Raises ValueError if the model knows classes by index, and these rooms have others.

        Args:
          run: what to call the model.
          names: the classes of its training rooms; empty if unknown.
        """
        by_index = self.model.encoder.ROWS == "class" or self.model.encoder.IMAGE
        if by_index and names and names != self.tables.classes:
            raise ValueError(
                f"{run}: the model knows classes by their index in its training rooms, "
                "and these rooms have others"
            )


#: More than can be added to the training rooms.
ALL_ROOMS = 1_000_000
#: What the names of environments begin with.
ITHOR = "ithor-"


def make(
    name: str | None = None,
    split: Literal["train", "test"] = "train",
    config: TrainConfig | None = None,
) -> tuple[Environment, EnvParams]:
    """An environment by name, and its parameters, as `gymnax.make` gives them.

    Args:
      name: "ithor-" and the seen/unseen split, as of `TrainConfig.split`: "ithor-22/0",
        "ithor-18/4", "ithor-14/8", or the unseen classes, "ithor-Mug,Vase,CD,Towel". By
        default, the split of `config`, which without one is 18/4.
      split: "train" has the training rooms and no trace of unseen classes; "test" begins episodes
        in the test rooms, for seen and unseen targets, with the step limits of tests.
      config: what else can be set: sensors, rows, rooms of your own; and in training rooms also the
        step limit, the partial reward and noise, where tests have their own. A name's split
        replaces that of `config`. All variants and generated rooms are in one pool.

    Raises:
      ValueError: no environment has this name, or a file of the configuration is broken.
    """
    config = config or TrainConfig()
    name = f"{ITHOR}{config.split}" if name is None else name
    if not name.startswith(ITHOR):
        raise ValueError(f"{name}: no such environment; try {ITHOR}18/4")
    if split not in ("train", "test"):
        raise ValueError(f"split {split!r}: must be 'train' or 'test'")
    config = dataclasses.replace(config, split=name.removeprefix(ITHOR), pool_rooms=ALL_ROOMS)
    config.check()
    if split == "test":  # not without added rooms: observations have as many rows as these need
        config = dataclasses.replace(config, extra_targets=None)
    task = load_task(config)
    env = environment(task, name, split)
    return env, env.default_params


def environment(task: Task, name: str, split: Literal["train", "test"]) -> Environment:
    """The environment of a task's training or test rooms, under this name.

    Both have as many rows, so that networks of others can go from one to the other.
    """
    rows = max(task.train_params.max_detections, task.eval_params.max_detections)
    params = task.train_params if split == "train" else task.eval_params
    words = task.train_words if split == "train" else task.words
    return Environment(name, params.with_rows(rows), task.tables.classes, words)


def load_task(config: TrainConfig, progress: Progress | None = None) -> Task:
    """The task of a configuration, with the rooms and word vectors that it names.

    Args:
      progress: called with (rooms done, rooms in all) while bundled rooms are rebuilt, variants or
        generated rooms.

    Raises:
      ValueError: a file is broken, or does not hold what the split needs; names the file.
    """
    return task_in(load_rooms(config.data, progress), config, progress)


def task_in(rooms: Rooms, config: TrainConfig, progress: Progress | None = None) -> Task:
    """The task of a configuration in these rooms, whichever rooms it names itself.

    Args:
      progress: called with (rooms done, rooms in all) while variants or generated rooms are built.

    Raises:
      ValueError: a file is broken, or the rooms do not hold what the split or the model needs.
    """
    vectors = word_vectors.load_word_vectors(config.word_vectors, rooms.tables.classes)
    data = None if rooms.path is None else str(rooms.path)
    config, features = resolve(dataclasses.replace(config, data=data)), None
    if rooms.path is not None and config.network.image == "features":
        features = load_features(rooms.path, rooms.tables)
    with _naming_file(rooms.path):
        added: list[Part] = []
        for kind, count in ((variants, config.variants), (generated, config.generated)):
            if count:
                names = _split(config, rooms)[1].train_scenes
                added += kind.parts(rooms, names, count)
        dealt = pools.deal(added, config.pool_rooms)
        first = pools.load(dealt[0], rooms.tables.classes, progress) if dealt else None
        further = [functools.partial(_load_pool, rooms, pool) for pool in dealt[1:]]
        return make_task(config, rooms.tables, vectors, rooms.extras, features, first, further)


@contextlib.contextmanager
def _naming_file(path: Path | None) -> Iterator[None]:
    """Errors inside name the file of imported rooms."""
    try:
        yield
    except ValueError as error:
        if path is None:
            raise
        raise ValueError(f"{path}: {error}") from None


def _load_pool(rooms: Rooms, pool: Sequence[Part], progress: Progress) -> SceneTables:
    with _naming_file(rooms.path):
        return pools.load(pool, rooms.tables.classes, progress)


def make_task(
    config: TrainConfig,
    tables: SceneTables,
    vectors: WordVectors,
    extras: Extras | None = None,
    features: np.ndarray | None = None,
    added: SceneTables | None = None,
    further_pools: Sequence[Callable[[Progress], SceneTables]] = (),
) -> Task:
    """The task of a configuration in the given rooms; the split is limited to what they hold.

    Args:
      config: the run's configuration.
      tables: all rooms. Their objects without a word vector are hidden, with a warning.
      vectors: the word vectors.
      extras: what came with imported rooms. Their parents and class graph, if there are any,
        replace those found in the training rooms. Hidden classes are in neither.
      features: [S, 512, 7, 7], ResNet-18's maps of all poses, for models that are shown an image.
        Images show hidden classes as well: nothing can be filtered out of them.
      added: variants of the training rooms and generated ones, to train in as well, or with
        `generated_only` alone. Parents and class graph are those of the training rooms themselves.
      further_pools: each gives further such rooms, which take turns with `added`.

    Raises:
      ValueError: there are no rooms to train or to evaluate in, a target has no word vector, or the
        model needs feature maps and there are none.
    """
    tables, split = _split(config, Rooms(tables, extras))
    if unnamed := _without_words(tables, split, vectors):
        tables = zero_shot.hide_classes(tables, unnamed)
    seen_rooms = zero_shot.hide_classes(tables.subset(split.train_scenes), split.hidden)
    adjacency = None if extras is None else extras.class_graph(tables.classes)
    if adjacency is None:
        adjacency = class_graph.co_occurrence(seen_rooms)
    classes = make_vocabulary(tables.classes, split.hidden, adjacency)
    model = make_model(config, classes)
    words = vectors.table(tables.classes, config.network.word_norm, blank=True)
    train_words = zero_shot.hide_words(words, tables.classes, split.hidden)
    parents = _parents(seen_rooms, split.seen, split.hidden, extras)
    train_rooms, train_parents, extra = seen_rooms, parents, dict[str, tuple[str, ...]]()
    if config.extra_targets is not None:
        further_tables, extra = _extra_targets(
            config.extra_targets, Rooms(tables, extras), config.validation, split
        )
        train_rooms = further_tables.subset(split.train_scenes)
        train_rooms = zero_shot.hide_classes(train_rooms, split.hidden)
        asked = {room: (*names, *extra.get(room, ())) for room, names in split.seen.items()}
        train_parents = _parents(train_rooms, asked, split.hidden, extras)
    trains = np.isin(np.array(tables.scenes), split.train_scenes)[tables.position_scene]  # [P]
    if added is not None:
        if features is not None and model.encoder.maps:
            flag = "--variants" if config.variants else "--generated"
            raise ValueError(f"{flag}: there are no feature maps of these rooms")
        added = with_targets(added, train_rooms.targets)
    train_maps, eval_maps = _feature_maps(config.model, model, features, trains, tables.grid)
    hidden = frozenset((*split.hidden, *unnamed))
    trained = _TrainingRooms(
        config,
        train_rooms,
        split,
        extra,
        hidden,
        model.spec,
        train_parents,
        train_words,
        train_maps,
    )

    def further(load: Callable[[Progress], SceneTables]) -> Callable[[Progress], EnvParams]:
        return lambda progress: trained.params(with_targets(load(progress), train_rooms.targets))

    return Task(
        tables=tables,
        split=split,
        classes=classes,
        model=model,
        train_params=trained.params(added),
        eval_params=make_params(
            tables,
            {room: split.seen[room] + split.unseen[room] for room in split.seen},
            parents,
            limits_of_tests(tables),
            model.spec,
            features=eval_maps,
            scenes=split.eval_scenes,
        ),
        train_words=jnp.asarray(train_words),
        words=jnp.asarray(words),
        vectors=vectors,
        extras=extras,
        variants_version=None if added is None else added.data_version,
        further_pools=tuple(further(load) for load in further_pools),
    )


@dataclasses.dataclass(frozen=True, eq=False)
class _TrainingRooms:
    """What the environment that a run trains in is made of, but for the rooms that are added."""

    config: TrainConfig
    rooms: SceneTables  # without hidden classes
    split: Split
    extra: Mapping[str, Sequence[str]]  # room type -> the configuration's extra targets
    hidden: frozenset[str]  # classes to hide in added rooms
    spec: ObservationSpec
    parents: Parents
    words: np.ndarray  # [C, D], zero for hidden classes
    maps: FeatureMaps | None

    def params(self, added: SceneTables | None) -> EnvParams:
        """The environment in these rooms and added ones, or in the added ones alone."""
        config, rooms, parents = self.config.learner, self.rooms, self.parents
        if added is not None:
            own = [] if self.config.generated_only else [rooms]
            added = zero_shot.hide_classes(added, self.hidden)
            rooms = tabulation.join([*own, added], rooms.classes)
        similarity = None
        if config.partial_reward == "similarity":
            similarity = reward.greatest_similarity(rooms, reward.cosines(self.words))
        params = make_params(
            rooms,
            self.split.seen,
            parents if config.partial_reward == "parents" else reward.no_parents(rooms),
            [config.step_limit] * len(rooms.room_types),
            self.spec,
            similarity=similarity,
            features=self.maps,
            size_noise=config.size_noise,
            extra=self.extra,
        )
        levels = sense_noise.parse(config.noise)
        if self.spec.image is not None:
            levels.check_image()
        return with_noise(params, rooms, levels, self.words)


def _without_words(tables: SceneTables, split: Split, vectors: WordVectors) -> list[str]:
    """The classes that have no word vector, with a warning: agents do not see such objects.

    Raises:
      ValueError: a target has none.
    """
    named = vectors.described(tables.classes)
    unnamed = [name for name in tables.classes if name not in named]
    if not unnamed:
        return []
    lacking = ", ".join(vectors.missing(unnamed))
    sought = {
        name for part in (split.seen, split.unseen) for names in part.values() for name in names
    }
    if sought & {*unnamed}:
        asked = ", ".join(vectors.missing(name for name in unnamed if name in sought))
        raise ValueError(
            f"no word vectors for the targets {asked}: give a file with --word-vectors, or other "
            "--targets"
        )
    warnings.warn(
        f"no word vectors for {lacking}: agents do not see such objects; to show them, give a file "
        "with --word-vectors, or other names",
        stacklevel=2,
    )
    return unnamed


def _split(config: TrainConfig, rooms: Rooms) -> tuple[SceneTables, Split]:
    """The rooms with the targets of a configuration, and its split, limited to what they hold."""
    tables, targets = find_targets(config.sought, rooms, config.validation)
    split = make_split(config.split, config.validation, targets)
    split = assign_rooms(split, rooms, config.validation)
    return tables, split.within(tables.scenes, tables.classes)


def _feature_maps(
    name: str, model: ActorCritic, features: np.ndarray | None, trains: np.ndarray, grid: PoseGrid
) -> tuple[FeatureMaps | None, FeatureMaps | None]:
    """The maps for the training positions [P] bool, and for all; none if the model needs none."""
    if not model.encoder.maps:
        return None, None
    if features is None:
        raise ValueError(f"{name} needs ResNet-18's feature maps, and these rooms have none")
    flat = features.reshape(*features.shape[:2], -1).swapaxes(1, 2)  # cells before channels
    maps = jnp.asarray(np.ascontiguousarray(flat))  # shared by both: nothing is copied
    chosen = (np.flatnonzero(trains), np.arange(len(trains)))
    train, all_positions = (FeatureMaps(maps, grid.join(positions)) for positions in chosen)
    return train, all_positions


def _extra_targets(
    asked: str, rooms: Rooms, validation: bool, split: Split
) -> tuple[SceneTables, dict[str, tuple[str, ...]]]:
    """The rooms with the distances to the extra targets as well, and these by room type: without
    hidden classes and those that are targets anyway."""
    with naming("--extra-targets"):
        tables, found = find_targets(asked, rooms, validation)
    return tables, {
        room: tuple(c for c in names if c not in (*split.hidden, *split.seen.get(room, ())))
        for room, names in found.items()
    }


def _parents(
    seen_rooms: SceneTables,
    targets: Mapping[str, Sequence[str]],
    hidden: Collection[str],
    extras: Extras | None,
) -> Parents:
    """Those that came with the rooms, else those found in the training rooms."""
    if extras is not None and extras.has_parents:
        return reward.published_parents(seen_rooms, targets, extras.parents, hidden)
    return reward.find_parents(seen_rooms, targets)


def resolve(config: TrainConfig) -> TrainConfig:
    """The configuration with every "auto" replaced by what suits this machine and the data."""
    network = resolve_precision(config.network)
    if network.image == "auto":
        imported = config.data is not None and features_path(Path(config.data)).is_file()
        network = dataclasses.replace(network, image="features" if imported else "raster")
    return dataclasses.replace(config, network=network)
