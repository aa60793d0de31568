"""Every documented function that takes a path takes text as well."""

from __future__ import annotations

import importlib
import inspect
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import tdanet_jax
from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.agent import agent
from tdanet_jax.analysis import episode_lookup
from tdanet_jax.config import TrainConfig
from tdanet_jax.eval_config import OWN_TASK
from tdanet_jax.evaluation import report, saved_networks
from tdanet_jax.models import classes
from tdanet_jax.scenes import SceneTables, collect, dataset, metadata, room_names
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.training import checkpoint, history, journal
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.workflows import sweep, train
from tests.conftest import TINY

PAGES = Path(__file__).parents[1] / "docs" / "reference"
#: Values that this package makes, which hold a path.
VALUES = {"SavedNetwork", "FinishedRun", "Rooms"}


def documented() -> Iterator[tuple[str, Callable[..., Any]]]:
    """The functions and methods of the API reference."""
    pages = (page.read_text().splitlines() for page in sorted(PAGES.glob("*.md")))
    for line in (line for lines in pages for line in lines if line.startswith("::: ")):
        name = line.split()[1]
        try:
            module = importlib.import_module(name)
        except ModuleNotFoundError:
            package, _, last = name.rpartition(".")
            yield name, getattr(importlib.import_module(package), last)
            continue
        for key, value in vars(module).items():
            if key.startswith("_") or getattr(value, "__module__", None) != name:
                continue
            if inspect.isfunction(value):
                yield f"{name}.{key}", value
            elif inspect.isclass(value) and key not in VALUES:
                for method in vars(value):
                    found = getattr(value, method)
                    public = method == "__init__" or not method.startswith("_")
                    if public and (inspect.isfunction(found) or inspect.ismethod(found)):
                        yield f"{name}.{key}.{method}", found


def test_every_path_may_be_text() -> None:
    """By their signatures, to which mypy holds the functions."""
    checked = 0
    for name, function in documented():
        if name.endswith("Callbacks.on_results") or not inspect.isroutine(function):
            continue  # it is given a path
        with_paths = {
            parameter.name: str(parameter.annotation)
            for parameter in inspect.signature(function).parameters.values()
            if "Path" in str(parameter.annotation)
        }
        for parameter, annotation in with_paths.items():
            assert "str" in annotation, f"{name}: {parameter}: {annotation}"
            checked += 1
    assert checked > 50


@pytest.fixture
def place(opinionated_run: Path, rooms_file: Path, tmp_path: Path) -> Path:
    """A folder with a run, a file of rooms and a scene file."""
    shutil.copytree(opinionated_run, tmp_path / "run")
    shutil.copy(rooms_file, tmp_path / "rooms.npz")
    (tmp_path / "rooms.csv").write_text("name\n")
    return tmp_path


#: What is done with the text of a folder, and with the tables of its rooms.
USES: dict[str, Callable[[str, SceneTables], object]] = {
    "tdanet_jax.load": lambda at, tables: tdanet_jax.load(f"{at}/run"),
    "agent.read": lambda at, tables: agent.read(f"{at}/run"),
    "dataset.load": lambda at, tables: dataset.load(f"{at}/rooms.npz"),
    "dataset.save_rooms": lambda at, tables: dataset.save_rooms(
        Rooms(tables, None), f"{at}/new.npz"
    ),
    "SceneTables.save, load": lambda at, tables: (
        tables.save(f"{at}/new.npz"), SceneTables.load(f"{at}/new.npz")
    ),
    "collect.write_scenes": lambda at, tables: collect.write_scenes([], f"{at}/scenes.json"),
    "room_names.read_table": lambda at, tables: room_names.read_table(f"{at}/rooms.csv"),
    "config.save, load": lambda at, tables: (
        configs.save(TrainConfig(), f"{at}/new.json"), configs.load(f"{at}/new.json")
    ),
    "EvalConfig.locate": lambda at, tables: OWN_TASK.locate(TrainConfig(), f"{at}/run"),
    "saved_networks.find": lambda at, tables: saved_networks.find(f"{at}/run"),
    "saved_networks.share": lambda at, tables: saved_networks.share(f"{at}/run", f"{at}/shared"),
    "report.write_rows": lambda at, tables: report.write_rows(at, []),
    "classes.load_vocabulary, save": lambda at, tables: classes.load_vocabulary(f"{at}/run").save(
        at
    ),
    "checkpoint.newest": lambda at, tables: checkpoint.newest(f"{at}/run"),
    "Checkpoints": lambda at, tables: Checkpoints(f"{at}/run").latest(),
    "history": lambda at, tables: (
        path := str(history.write(f"{at}/run", checkpoint.newest(f"{at}/run"))),
        history.read(path), history.points(f"{at}/run"),
        history.drop_after(f"{at}/run", 0),
    ),
    "journal": lambda at, tables: (
        journal.Journal(f"{at}/metrics.jsonl", 0).write({"updates": 1}), journal.read_metrics(at)
    ),
    "words": lambda at, tables: (
        words.load_bundled().save_copy(f"{at}/words.npz", []),
        words.load_word_vectors(f"{at}/words.npz"),
    ),
    "episode_lookup.read_record": lambda at, tables: episode_lookup.read_record(
        f"{at}/run", 0, tables
    ),
    "sweep.find": lambda at, tables: (sweep.find(at), sweep.find_others(at)),
    "train.resumed": lambda at, tables: train.resumed(f"{at}/run"),
}  # fmt: skip


@pytest.mark.parametrize("use", USES)
def test_a_path_as_text(place: Path, some_rooms: SceneTables, use: str) -> None:
    USES[use](str(place), some_rooms)


@pytest.mark.parametrize(
    ("read", "name", "message"),
    [
        (
            tdanet_jax.load,
            "rooms.npz",
            "/config.json: no such file",
        ),  # looks like a point of a history
        (tdanet_jax.load, "rooms.csv", "rooms.csv/config.json: Not a directory; is this the fo"),
        (tdanet_jax.evaluate, "rooms.csv", "rooms.csv/config.json: Not a directory; is this the"),
        (tdanet_jax.load, "nowhere", "nowhere/config.json: no such file; is this the folder"),
        (configs.load, "run", "run: not a regular file"),
        (classes.load_vocabulary, "rooms.csv", "rooms.csv: not the folder of a run"),
        (metadata.read_scenes, "run", "run: not a regular file"),
        (dataset.load, "run", "run: not a regular file"),
    ],
)
def test_a_path_of_another_kind_is_a_value_error(
    place: Path, read: Callable[[str], object], name: str, message: str
) -> None:
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        read(f"{place}/{name}")
    assert "\n" not in str(error.value)


def test_files_with_a_byte_order_mark_are_read(place: Path) -> None:
    for name in ("run/config.json", "run/classes.json", "run/episodes.jsonl"):
        path = place / name
        path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert configs.load(place / "run/config.json") == TINY
    assert classes.load_vocabulary(place / "run").names
    tables = dataset.load(place / "rooms.npz").tables
    assert episode_lookup.read_record(place / "run", 0, tables)
    (place / "glove.txt").write_bytes(b"\xef\xbb\xbfmug 1 2\ncup 3 4\n")
    assert list(words.load_word_vectors(place / "glove.txt").index) == ["mug", "cup"]
