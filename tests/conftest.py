"""Fixtures that many tests share; the real rooms' tables are loaded once per session."""

from __future__ import annotations

import dataclasses
import json
import os
import signal
import tempfile
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import settings

from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.config import CONFIG_FILE, NetworkConfig, TrainConfig
from tdanet_jax.evaluation import episodes, policies, report, rollout
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.scenes import SceneTables, dataset, load_tables
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.task import Task, make_task
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.training.learner import TrainState
from tdanet_jax.vocabulary import Action
from tdanet_jax.words import WordVectors
from tests.support import samples

# No deadline: tests do not time anything. Derandomised: the same examples on every run.
settings.register_profile("tests", deadline=None, derandomize=True, database=None)
settings.load_profile("tests")

# Tests that a script starts in the background ignore Ctrl-C, and so would the commands they stop.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Processes that tests start import the code under test, from whichever folder they are started.
_paths = [str(Path(__file__).resolve().parents[1]), *filter(None, [os.environ.get("PYTHONPATH")])]
os.environ |= {"PYTHONPATH": os.pathsep.join(_paths), "PYTHONSAFEPATH": "1"}

# What one test or command has compiled, the next one need not, in whichever process: for this
# session alone. The workers of pytest-xdist inherit the folder; a limit of its size brings locks.
if "PYTEST_XDIST_WORKER" not in os.environ:
    _compiled = tempfile.TemporaryDirectory(prefix="tdanet-compiled-")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = _compiled.name
    os.environ["JAX_COMPILATION_CACHE_MAX_SIZE"] = str(2**31)
    os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"
    # Compiling takes most of the time. As it is shipped: JAX_DISABLE_MOST_OPTIMIZATIONS=0 pytest
    os.environ.setdefault("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    if os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] != "0" and jax.__version_info__ < (0, 11, 1):
        # XLA's older emitters compile two to three times as fast. From JAX 0.11.1 on they are gone,
        # and XLA aborts at a flag that it does not know. Read before the first use of JAX.
        given = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = f"{given} --xla_cpu_use_fusion_emitters=false".lstrip()
for _name, _convert in {
    "jax_compilation_cache_dir": str,
    "jax_compilation_cache_max_size": int,
    "jax_persistent_cache_min_compile_time_secs": float,
    "jax_disable_most_optimizations": lambda value: value != "0",
}.items():
    jax.config.update(_name, _convert(os.environ[_name.upper()]))

#: Two rooms of each type. Parts of FloorPlan204 cannot be reached from the others.
SOME_ROOMS = (
    "FloorPlan7", "FloorPlan29", "FloorPlan204", "FloorPlan229", "FloorPlan303", "FloorPlan321",
    "FloorPlan402", "FloorPlan428",
)  # fmt: skip


@pytest.fixture(scope="session")
def ithor() -> SceneTables:
    """The tables of all 120 rooms."""
    return load_tables()


@pytest.fixture(scope="session")
def some_rooms(ithor: SceneTables) -> SceneTables:
    """The tables of eight rooms, two of each type."""
    return ithor.subset(SOME_ROOMS)


@pytest.fixture(scope="session")
def rooms_file(some_rooms: SceneTables, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same eight rooms in a file, for `--data`."""
    path = tmp_path_factory.mktemp("rooms") / "rooms.npz"
    dataset.save_rooms(Rooms(some_rooms, None), path)
    return path


@pytest.fixture
def few_episodes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A tenth of the test episodes, as evenly over the room types, for tests of other things."""
    load = episodes.load

    def few(*arguments: Any) -> dict[str, Episodes]:
        lists = load(*arguments).items()
        return {name: Episodes(found.pose[::10], found.target[::10]) for name, found in lists}

    monkeypatch.setattr(episodes, "load", few)


@pytest.fixture(scope="session")
def glove() -> WordVectors:
    """The bundled word vectors."""
    return words.load_bundled()


@pytest.fixture(params=["cpu", "gpu"])
def backend(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Programs in the form that they take on each backend; what they compute, a CPU tells."""
    monkeypatch.setattr(jax, "default_backend", lambda: request.param)


#: The network of `opinionated_run`.
TINY = TrainConfig(network=NetworkConfig(width=16, hidden=16, precision="float32"))


@pytest.fixture(scope="session")
def opinionated_run(
    some_rooms: SceneTables, glove: WordVectors, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The folder of a run that nobody trained: a tiny network with opinions, and eight records."""
    folder = tmp_path_factory.mktemp("runs") / "my-run"
    task, weights = save_untrained(TINY, folder, some_rooms, glove)
    chosen = episodes.draw(some_rooms, task.split.eval_scenes, task.split.seen, 2, seed=0)
    policy = policies.network(task.model, task.words)
    records = rollout.evaluate(policy, weights, task.eval_params, chosen, jax.random.key(0))
    rows = report.episode_rows("seen", report.columns(some_rooms, chosen, records), records)
    (folder / "episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    return folder


def save_untrained(
    config: TrainConfig,
    folder: Path,
    tables: SceneTables,
    vectors: WordVectors,
    features: np.ndarray | None = None,
    **counts: int,
) -> tuple[Task, Any]:
    """Makes a run's folder with one checkpoint: drawn parameters, an actor with opinions.

    `counts` are of updates and episodes; 0 without them.
    """
    folder.mkdir()
    (folder / CONFIG_FILE).write_text(json.dumps(configs.to_json(config)))
    task = make_task(config, tables, vectors, features=features)
    task.classes.save(folder)
    if config.network.odometry:
        weights = samples.moving_by_odometry(task.model, task.words)
    else:
        weights = samples.parameters(task.model, task.words)
        weights["actor"]["bias"] = weights["actor"]["bias"].at[Action.DONE].set(-1.0)
    rest = {f.name: jnp.int32(counts.get(f.name, 0)) for f in dataclasses.fields(TrainState)}
    own = {"params": weights, "key": jax.random.key(0), "target_seen": None}
    state = TrainState(**rest | own)
    Checkpoints(folder).save(state, {"seconds": 0.0, "data_version": task.tables.data_version})
    return task, weights
