"""Nothing of a hidden class reaches the learner: perturb all of it and see nothing change.

The path is the one that training takes: `make_task` builds the rooms, parents, rewards and words
that a run learns from. A control perturbs seen classes and must be noticed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection
from typing import Any

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env import dynamics, zero_shot
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.scenes import SceneTables
from tdanet_jax.sense_noise import SenseNoise
from tdanet_jax.sensors.noise import levels_of
from tdanet_jax.splits import Split, make_split
from tdanet_jax.task import make_task
from tdanet_jax.training import learner
from tdanet_jax.vocabulary import ROOM_TYPES, class_words
from tdanet_jax.words import WordVectors
from tests.support.handmade import FRAME

SPLITS = [("18/4", False), ("14/8", False), ("18/4", True), ("Bread,Mug,Towel", True)]
NAMES = ["18/4", "14/8", "18/4-validation", "own-validation"]
#: One of the paper's splits, and a custom one on validation; the others are slow.
OF_EACH_KIND = [
    pytest.param(split, id=name, marks=() if name in (NAMES[0], NAMES[3]) else pytest.mark.slow)
    for split, name in zip(SPLITS, NAMES, strict=True)
]


#: Every way in which a class could be shown that is not there.
ALL_NOISE = "misses=0.2,swaps=0.2,confusions=0.3,false_positives=2,duplicates=0.2,jitter=0.1"


def config_of(
    split: str, validation: bool, rows: Any = "class", sensors: bool = False, noise: str = "none"
) -> TrainConfig:
    return TrainConfig(
        split=split,
        validation=validation,
        learner=LearnerConfig(num_envs=16, rollout_steps=8, step_limit=6, noise=noise),
        network=NetworkConfig(
            width=8, hidden=8, rows=rows, odometry=sensors, triangulation=sensors
        ),
    )


@pytest.fixture(scope="module")
def rooms(ithor: SceneTables) -> SceneTables:
    """Rooms of all types from the training, the validation and the test part."""
    numbers = (1, 4, 18, 29, 202, 208, 219, 225, 301, 310, 317, 330, 401, 406, 420, 428)
    return ithor.subset(f"FloorPlan{n}" for n in numbers)


@pytest.fixture(autouse=True)
def only_these_rooms(monkeypatch: pytest.MonkeyPatch, rooms: SceneTables) -> None:
    """Splits name all 120 rooms; here they are cut down to those of `rooms`."""

    def smaller(*arguments: Any) -> Split:
        split = make_split(*arguments)
        present = set(rooms.scenes)
        return dataclasses.replace(
            split,
            train_scenes=tuple(s for s in split.train_scenes if s in present),
            eval_scenes=tuple(s for s in split.eval_scenes if s in present),
        )

    monkeypatch.setattr("tdanet_jax.task.make_split", smaller)


def perturbed(tables: SceneTables, names: Collection[str], seed: int) -> SceneTables:
    """The same rooms with everything about the objects of some classes replaced by noise.

    Boxes, visibility, object boxes, ids, raster cells and distances change; a third of the
    detections is lost and as many appear in states that had none; one object in two is gone.
    """
    rng = np.random.default_rng(seed)
    marked = np.array([c in names for c in tables.classes])
    of_marked = marked[tables.object_class]  # [O]
    gone = of_marked & (rng.random(len(of_marked)) < 0.5)
    new_object = np.cumsum(~gone) - 1

    row_marked = of_marked[tables.row_object]
    keep = ~gone[tables.row_object] & ~(row_marked & (rng.random(len(row_marked)) < 1 / 3))
    rest = np.flatnonzero(of_marked & ~gone)
    count = row_marked.sum() // 3
    states = [tables.row_state[keep], rng.integers(tables.num_states, size=count, dtype=np.int32)]
    state = np.concatenate(states)
    item = np.concatenate([tables.row_object[keep], rng.choice(rest, count)])
    # A new detection must belong to the room that the state lies in.
    fits = tables.object_scene[item] == tables.position_scene[state // 16]
    pairs = np.concatenate([np.zeros(keep.sum(), bool), np.ones(count, bool)])
    box = np.concatenate([tables.row_box[keep], np.zeros((count, 4), np.int16)])
    near = np.concatenate([tables.row_visible[keep], np.zeros(count, bool)])
    chosen = fits | ~pairs
    state, item, box, near = state[chosen], item[chosen], box[chosen], near[chosen]
    noise = of_marked[item]
    corners = np.sort(rng.integers(FRAME + 1, size=(noise.sum(), 2, 2)), axis=1)
    box[noise] = corners.reshape(-1, 4)
    near[noise] = rng.random(noise.sum()) < 0.5
    order = np.lexsort((item, tables.object_class[item], state))

    object_box = tables.object_box.copy()
    object_box[of_marked] = rng.uniform(-5, 5, (of_marked.sum(), 6))
    distance = tables.distance.copy()
    goals = [t in names for t in tables.targets]
    distance[:, goals] = rng.integers(-1, 40, distance[:, goals].shape)
    raster = tables.raster.copy()
    cells = (raster >= 0) & marked[raster]
    raster[cells] = rng.choice(np.append(np.flatnonzero(marked), -1), cells.sum())
    free = (raster < 0) & (rng.random(raster.shape) < 0.1)
    raster[free] = rng.choice(np.flatnonzero(marked), free.sum())
    counts = np.bincount(state, minlength=tables.num_states)
    ids = [
        f"renamed|{i}" if mark else name
        for i, (name, mark) in enumerate(zip(tables.object_id, of_marked, strict=True))
    ]
    return dataclasses.replace(
        tables,
        row_start=np.concatenate([[0], np.cumsum(counts)]).astype(np.int32),
        row_object=new_object[item[order]].astype(np.int32),
        row_box=box[order],
        row_visible=near[order],
        object_id=tuple(name for name, lost in zip(ids, gone, strict=True) if not lost),
        object_class=tables.object_class[~gone],
        object_scene=tables.object_scene[~gone],
        object_box=object_box[~gone],
        distance=distance,
        raster=raster,
    )


def other_words(
    vectors: WordVectors, names: Collection[str], among: Collection[str]
) -> WordVectors:
    """Vectors in which every word that only the classes `names` use is another one."""
    kept = {word for name in among if name not in names for word in class_words(name)}
    changed = {word for name in names for word in class_words(name)} - kept
    table = vectors.vectors.copy()
    rows = [vectors.index[word] for word in sorted(changed)]
    table[rows] = np.random.default_rng(0).normal(size=(len(rows), vectors.vectors.shape[1]))
    return WordVectors(vectors.index, table)


def assert_identical(first: Any, second: Any) -> None:
    """Bit-equal leaves, types and shapes included; random keys by their data."""

    def plain(tree: Any) -> Any:
        def data(x: Any) -> np.ndarray:
            is_key = isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jax.dtypes.prng_key)
            return np.asarray(jax.random.key_data(x) if is_key else x)

        return jax.tree.map(data, tree)

    chex.assert_trees_all_equal_shapes_and_dtypes(plain(first), plain(second))
    chex.assert_trees_all_equal(plain(first), plain(second))


@jax.jit
def training_walk(params: EnvParams) -> tuple[Any, ...]:
    """All that 32 agents see and earn on a random walk of 60 steps through training episodes."""

    def body(state: EnvState, key: jax.Array) -> tuple[EnvState, tuple[Any, ...]]:
        keys = jax.random.split(key, 33)
        actions = jax.random.randint(keys[32], (32,), 0, 6)
        out = jax.vmap(dynamics.step, (0, 0, 0, None))(keys[:32], state, actions, params)
        return out[1], out

    keys = jax.random.split(jax.random.key(0), 32)
    _, state = jax.vmap(dynamics.reset, (0, None))(keys, params)
    return jax.lax.scan(body, state, jax.random.split(jax.random.key(1), 60))[1]


@pytest.mark.parametrize(
    ("split", "rows", "sensors"),
    [
        (SPLITS[0], "class", False),
        *(pytest.param(split, "class", False, marks=pytest.mark.slow) for split in SPLITS[1:3]),
        (SPLITS[3], "class", False),
        (SPLITS[0], "object", True),
        *(pytest.param(split, "object", True, marks=pytest.mark.slow) for split in SPLITS[1:]),
    ],
    ids=[f"{name}-{rows}" for rows in ("class", "object") for name in NAMES],
)
def test_perturbing_all_hidden_data_changes_nothing_that_training_reads(
    rooms: SceneTables, glove: WordVectors, split: tuple[str, bool], rows: str, sensors: bool
) -> None:
    # With sensors their noise, too: labels and false positives from the training rooms alone.
    config = config_of(*split, rows, sensors, ALL_NOISE if sensors else "none")
    check_perturbed(config, make_split(*split).hidden, rooms, glove)


@pytest.mark.parametrize(
    ("targets", "split"),
    [
        ("all", "Kettle,Book,Laptop,Faucet"),
        pytest.param("Kettle,Book,Mug,Pillow,Towel,Laptop", "Book", marks=pytest.mark.slow),
        pytest.param("paper", "open", marks=pytest.mark.slow),
        pytest.param("kitchen: all; bedroom: Book, Pillow", "Book", marks=pytest.mark.slow),
    ],
)
def test_perturbing_hidden_data_changes_nothing_with_any_targets(
    rooms: SceneTables, glove: WordVectors, targets: str, split: str
) -> None:
    config = dataclasses.replace(config_of(split, False, "object"), targets=targets)
    hidden = make_split("open").hidden if split == "open" else set(split.split(","))
    check_perturbed(config, hidden, rooms, glove)


@pytest.mark.parametrize(
    ("extra", "split"),
    [
        ("all", "18/4"),
        pytest.param("kitchen: all; bedroom: Book, Pillow", "Pillow", marks=pytest.mark.slow),
    ],
)
def test_perturbing_hidden_data_changes_nothing_with_extra_targets(
    rooms: SceneTables, glove: WordVectors, extra: str, split: str
) -> None:
    config = dataclasses.replace(config_of(split, False, "object"), extra_targets=extra)
    check_perturbed(config, make_split(split).hidden, rooms, glove)


def check_perturbed(
    config: TrainConfig, hidden: Collection[str], rooms: SceneTables, glove: WordVectors
) -> None:
    """Fails unless noise in the data of hidden classes changes evaluation alone."""
    task = make_task(config, rooms, glove)
    assert set(task.split.hidden) == set(hidden)
    assert {name for names in task.split.unseen.values() for name in names} <= set(hidden)
    noisy = perturbed(rooms, hidden, seed=1)
    other = make_task(config, noisy, other_words(glove, hidden, rooms.classes))
    assert_identical(task.train_params, other.train_params)
    assert_identical(task.train_words, other.train_words)
    assert task.classes == other.classes
    # The same noise is there for everyone else: evaluation does read it.
    assert_differ(task.eval_params, other.eval_params, "row_box", "visible", "distance")
    assert not np.array_equal(task.words, other.words)


def test_so_it_is_in_variants(rooms: SceneTables, glove: WordVectors) -> None:
    config, hidden = config_of("18/4", False, "object"), make_split("18/4").hidden
    train = rooms.subset(name for name in make_split("18/4").train_scenes if name in rooms.scenes)
    varied = dataclasses.replace(train, scenes=tuple(f"{name}-v01" for name in train.scenes))
    params, same, other = (
        make_task(config, rooms, glove, added=tables).train_params
        for tables in (varied, perturbed(varied, hidden, 1), perturbed(varied, {"Mug"}, 1))
    )
    assert len(params.next_position) == 2 * len(train.position)
    assert_identical(params, same)
    assert_differ(params, other, "row_box", "visible", "pair_starts")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("model", "paid"), [("tdanet", "parents"), ("ssnet", "similarity"), ("mjolnir-o", "parents")]
)
def test_perturbing_all_hidden_data_changes_no_parameter(
    rooms: SceneTables, glove: WordVectors, model: str, paid: Any
) -> None:
    config = config_of("18/4", False)
    paying = dataclasses.replace(config.learner, partial_reward=paid)
    config = dataclasses.replace(config, model=model, learner=paying)
    hidden = make_split("18/4").hidden
    noisy = perturbed(rooms, hidden, seed=2)
    network = make_task(config, rooms, glove).model
    begin = jax.jit(learner.init, static_argnums=(1, 2))
    chunk = learner.make_train(config.learner, network, 2)
    states = []
    for tables, vectors in ((rooms, glove), (noisy, other_words(glove, hidden, rooms.classes))):
        task = make_task(config, tables, vectors)
        assert task.model == network
        start = begin(
            jax.random.key(3), config.learner, network, task.train_words, task.train_params
        )
        chunked = chunk(start, jnp.array([0.0, 0.1]), task.train_words, task.train_params)
        states.append(chunked)
    assert_identical(*states)


def assert_differ(first: Any, second: Any, *fields: str) -> None:
    for field in fields:
        one, two = np.asarray(getattr(first, field)), np.asarray(getattr(second, field))
        assert one.shape != two.shape or (one != two).any(), f"{field} should have changed"


def test_perturbing_a_seen_class_is_noticed(rooms: SceneTables, glove: WordVectors) -> None:
    config = config_of("18/4", False)
    task = make_task(config, rooms, glove)
    for names, fields in (
        ({"Mug"}, ("row_box", "visible", "pair_starts")),  # a target
        ({"CounterTop"}, ("row_box", "visible", "parent_reward")),  # a parent
        ({"Bowl"}, ("row_box", "visible")),  # neither
    ):
        noisy = perturbed(rooms, names, seed=4)
        other = make_task(config, noisy, other_words(glove, names, rooms.classes))
        assert_differ(task.train_params, other.train_params, *fields)
        assert not np.array_equal(task.train_words, other.train_words)
        assert task.classes.edges != other.classes.edges


@pytest.mark.parametrize("split", OF_EACH_KIND)
def test_no_training_episode_shows_or_asks_for_a_hidden_class(
    rooms: SceneTables, glove: WordVectors, split: tuple[str, bool]
) -> None:
    config = config_of(*split)
    hidden = make_split(*split).hidden
    task = make_task(config, rooms, glove)
    obs, *_ = jax.device_get(training_walk(task.train_params))
    shown = {rooms.classes[c] for c in np.unique(obs.classes[obs.mask])}
    asked = {rooms.classes[c] for c in np.unique(obs.target)}
    assert not hidden & (shown | asked)
    assert len(shown) > 40, "the walk should have seen something"
    indices = [rooms.classes.index(name) for name in sorted(hidden)]
    params = jax.device_get(task.train_params)
    assert not np.isin(params.parent_class, indices).any()
    assert not np.isin(params.target_class[params.pair_target], indices).any()
    assert not np.asarray(task.train_words)[indices].any()
    assert not hidden & {rooms.classes[i] for edge in task.classes.edges for i in edge[:2]}


def test_noise_shows_no_hidden_class(rooms: SceneTables, glove: WordVectors) -> None:
    split = ("18/4", False)
    task = make_task(config_of(*split, "object", noise=ALL_NOISE), rooms, glove)
    hidden = [rooms.classes.index(name) for name in make_split(*split).hidden]
    noise = jax.device_get(task.train_params.noise)
    known = np.setdiff1d(np.unique(task.train_params.row_class), hidden)
    np.testing.assert_array_equal(noise.known[: noise.known_count], known)
    assert (noise.known[noise.known_count :] == known[-1]).all()
    assert not np.isin(noise.similar[known], hidden).any()
    alone = SenseNoise(misses=1.0, false_positives=4.0, swaps=0.2, confusions=0.3)
    for levels in ({}, levels_of(alone)):
        params = task.train_params.replace(noise=task.train_params.noise.replace(**levels))
        obs, *_ = jax.device_get(training_walk(params))
        assert not np.isin(obs.classes[obs.mask], hidden).any()
    assert len(np.unique(obs.classes[obs.mask])) > 30, "there should have been false positives"


@pytest.mark.parametrize("model", ["ssnet", "mjolnir-o"])
def test_no_hidden_class_has_a_row_or_a_node(
    rooms: SceneTables, glove: WordVectors, model: str
) -> None:
    config = dataclasses.replace(config_of("18/4", False), model=model)
    task = make_task(config, rooms, glove)
    hidden = [rooms.classes.index(name) for name in make_split("18/4").hidden]
    weights = jax.eval_shape(task.model.initialise, jax.random.key(0), task.words)
    table = task.model.apply(
        {"params": jax.tree.map(lambda x: jnp.ones(x.shape, x.dtype), weights)},
        task.words,
        method="prepare",
    )
    rows = table if model == "ssnet" else table.rows
    count = len(rooms.classes) - len(hidden)
    assert rows.cosine.shape == (len(rooms.classes), count)
    assert (np.asarray(rows.row)[hidden] == count).all()
    assert sorted(np.delete(rows.row, hidden)) == list(range(count))


@pytest.mark.parametrize("split", SPLITS, ids=NAMES)
def test_training_stays_in_the_training_rooms(
    rooms: SceneTables, glove: WordVectors, split: tuple[str, bool]
) -> None:
    task = make_task(config_of(*split), rooms, glove)
    train = rooms.subset(task.split.train_scenes)
    assert 0 < len(train.scenes) < len(rooms.scenes)
    assert task.train_params.next_position.shape == train.next_position.shape
    assert not set(task.split.train_scenes) & set(task.split.eval_scenes)


def test_nothing_of_the_evaluation_rooms_reaches_training(
    rooms: SceneTables, glove: WordVectors
) -> None:
    config = config_of("18/4", False)
    task = make_task(config, rooms, glove)
    fewer = (*task.split.train_scenes, task.split.eval_scenes[0])
    assert len(fewer) < len(rooms.scenes)
    alone = make_task(config, rooms.subset(fewer), glove)
    assert_identical(task.train_params, alone.train_params)
    assert_identical(task.train_words, alone.train_words)
    assert task.classes == alone.classes


def test_evaluation_sees_hidden_classes(rooms: SceneTables, glove: WordVectors) -> None:
    split = make_split("18/4")
    task = make_task(config_of("18/4", False), rooms, glove)
    params = jax.device_get(task.eval_params)
    for room in ROOM_TYPES:
        for name in split.unseen[room]:
            index = rooms.classes.index(name)
            assert (params.row_class == index).any()
            assert (params.visible[:, index // 32] >> (index % 32) & 1).any()
            assert np.asarray(task.words)[index].any()


def test_episodes_of_the_evaluation_begin_in_its_rooms(
    rooms: SceneTables, glove: WordVectors
) -> None:
    task = make_task(config_of("18/4", False), rooms, glove)
    positions = {}
    for name in ("train_params", "eval_params"):
        params = getattr(task, name)
        positions[name] = np.unique(np.asarray(params.start_position))
    scenes = np.array(rooms.scenes)[rooms.position_scene[positions["eval_params"]]]
    assert set(scenes) == set(task.split.eval_scenes)
    trained = rooms.subset(task.split.train_scenes)
    scenes = np.array(trained.scenes)[trained.position_scene[positions["train_params"]]]
    assert set(scenes) == set(task.split.train_scenes)


def test_hide_classes_leaves_no_trace_and_everything_else(rooms: SceneTables) -> None:
    hidden = {"Toaster", "Laptop", "Mug"}
    noisy = dataclasses.replace(
        rooms,
        raster=np.random.default_rng(5)
        .integers(-1, len(rooms.classes), rooms.raster.shape)
        .astype(np.int8),
    )
    kept = zero_shot.hide_classes(noisy, hidden)
    indices = [rooms.classes.index(name) for name in hidden]
    assert not np.isin(kept.object_class, indices).any()
    assert not np.isin(kept.row_class, indices).any()
    assert not np.isin(kept.raster, indices).any()
    assert not any(name.split("|")[0] in hidden for name in kept.object_id)
    for name in hidden:
        assert (kept.distance[:, kept.targets.index(name)] == -1).all()
    assert kept.classes == rooms.classes
    assert kept.targets == rooms.targets
    # What remains is what was there, state by state and object by object.
    assert rows_by_name(kept, hidden) == rows_by_name(noisy, hidden)
    others = [i for i, name in enumerate(rooms.targets) if name not in hidden]
    np.testing.assert_array_equal(kept.distance[:, others], rooms.distance[:, others])
    cells = ~np.isin(noisy.raster, indices)
    np.testing.assert_array_equal(kept.raster[cells], noisy.raster[cells])
    assert (kept.raster[~cells] == -1).all()


def rows_by_name(tables: SceneTables, without: Collection[str]) -> list[tuple]:
    """Every detection of the first 2,000 states but those of some classes, with its object."""
    found = []
    for state in range(2000):
        for row in range(tables.row_start[state], tables.row_start[state + 1]):
            item = tables.row_object[row]
            name = tables.classes[tables.object_class[item]]
            if name not in without:
                place = (int(tables.object_scene[item]), *tables.object_box[item].tolist())
                box = tuple(tables.row_box[row].tolist())
                seen = bool(tables.row_visible[row])
                found.append((state, tables.object_id[item], name, place, box, seen))
    return found


def test_hiding_nothing_changes_nothing(rooms: SceneTables) -> None:
    kept = zero_shot.hide_classes(rooms, ())
    assert kept.data_version == rooms.data_version


def test_hiding_an_unknown_class_is_refused_by_name(rooms: SceneTables) -> None:
    with pytest.raises(ValueError, match="Unicorn"):
        zero_shot.hide_classes(rooms, {"Mug", "Unicorn"})


def test_hidden_words_are_zero_and_the_others_kept() -> None:
    table = np.arange(12, dtype=np.float32).reshape(4, 3) + 1
    hidden = zero_shot.hide_words(table, ("A", "B", "C", "D"), {"B", "D"})
    np.testing.assert_array_equal(hidden, table * np.array([[1], [0], [1], [0]]))
    assert hidden.dtype == np.float32
