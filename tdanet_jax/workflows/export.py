"""Exports an agent for robots without JAX: NumPy alone, Python 3.10 or newer."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import jax
import numpy as np
from flax import traverse_util

import tdanet_jax
from tdanet_jax import labels, words
from tdanet_jax.agent import agent as agents
from tdanet_jax.agent.agent import Agent
from tdanet_jax.agent.numpy_agent import FORMAT, META_FILE, MODEL_FILE, WORDS_FILE
from tdanet_jax.config import find_word_vectors
from tdanet_jax.io import archive, assets, files
from tdanet_jax.io.bundled_agents import find_run, folder_of
from tdanet_jax.models import reach
from tdanet_jax.models.actor_critic import SENSOR_UNITS
from tdanet_jax.models.tdanet import TARGET_BOX
from tdanet_jax.sensors.numpy_sensors import WIDTHS

#: What `robot` imports: the modules that are copied, which need NumPy alone.
MODULES = (
    "agent/__init__", "agent/base", "agent/camera", "agent/detection", "agent/detectors",
    "agent/navigator", "agent/numpy_agent", "decisions", "io/__init__", "io/archive", "io/assets",
    "io/escaping", "io/files", "io/untrusted/__init__", "io/untrusted/budgets",
    "io/untrusted/hdf5", "io/untrusted/jsons", "io/untrusted/npz", "io/untrusted/regular",
    "labels", "observation_spec", "poses", "registry", "sensors/__init__", "sensors/detections",
    "sensors/numpy_sensors", "sensors/shared", "settings", "vocabulary", "words",
)  # fmt: skip
#: The package's name in the exported folder, too.
PACKAGE = "tdanet_jax"


def export(run: Path | str, folder: Path | str, word_vectors: Path | str | None = None) -> Path:
    """Writes an agent's folder for robots without JAX.

    It holds the network's parameters (`model.npz`), the word vectors (`words.npz`), what the agent
    is shown (`meta.json`), and `tdanet_jax`: the part of this package that a robot needs, which
    needs NumPy alone.

    Args:
      run: as `tdanet_jax.load` takes it.
      folder: must be new or empty.
      word_vectors: where the run's word vectors are, if it holds no copy and the file was moved.

    Returns:
      The folder.

    Raises:
      ValueError: the run cannot be loaded, its model or a sensor is only there in JAX, or the
        folder is not empty.
    """
    run, folder = find_run(run), Path(folder)
    files.check_new_folder(folder)
    agent = agents.load(run, word_vectors=word_vectors)
    check(agent)
    path = find_word_vectors(agent.config, folder_of(run), word_vectors)
    with files.new_folder(folder) as fresh:
        _write_agent(agent, path, fresh)
        _copy_package(fresh / PACKAGE)
    return folder


def check(agent: Agent) -> None:
    """Raises ValueError, with one line that names the flag, if an agent needs JAX."""
    if agent.config.model != "tdanet":
        raise ValueError(f"--model {agent.config.model}: only tdanet is there without JAX")
    for name in agent.spec.sensors:
        if name not in WIDTHS:
            raise ValueError(f"--sensors {name}: only {', '.join(WIDTHS)} are there without JAX")


def _write_agent(agent: Agent, word_vectors: str | None, folder: Path) -> None:
    spec, network = agent.spec, agent.config.network
    meta = {
        "format": FORMAT,
        "version": tdanet_jax.__version__,
        "classes": agent.classes.names,
        "rows": spec.rows,
        "sensors": spec.sensors,
        "scores": spec.scores,
        "word_norm": float(network.word_norm),
        "width": network.width,
        "hidden": network.hidden,
        "action_units": agent.model.action_width,
        "sensor_units": SENSOR_UNITS if spec.sensors else 0,
        "reach_threshold": float(network.reach_threshold or 0),
        "temperature": float(network.temperature),
        "done_bias": float(network.done_bias),
        "reach_units": 0 if network.reach_threshold is None else reach.UNITS,
        "target_box": TARGET_BOX[: spec.columns],
        "context": network.context,
    }
    weights = traverse_util.flatten_dict(jax.device_get(agent.weights), sep="/")
    arrays = {name: np.asarray(array, np.float32) for name, array in sorted(weights.items())}
    archive.write(folder / MODEL_FILE, arrays)
    if word_vectors is None:
        shutil.copy(assets.path(words.ASSET), folder / WORDS_FILE)
    else:
        agent._vectors.save_copy(folder / WORDS_FILE, agent.classes.names)
    files.write_text(folder / META_FILE, json.dumps(meta, indent=2) + "\n")


def _copy_package(package: Path) -> None:
    """Copies the part of this package that needs NumPy alone, with the files that it reads."""
    source = Path(tdanet_jax.__file__).parent
    for name in MODULES:
        path = package / f"{name}.py"
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(source / f"{name}.py", path)
    shutil.copy(source / "robot.py", package / "__init__.py")
    (package / "assets").mkdir()
    shutil.copy(assets.path(labels.ASSET), package / "assets")
    assets.record(package / "assets", [labels.ASSET])
