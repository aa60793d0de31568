"""Files of a folder that came from someone else: no links, pipes or devices."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from tdanet_jax import config as configs
from tdanet_jax.analysis import episode_lookup
from tdanet_jax.evaluation import results_file, saved_networks
from tdanet_jax.io.untrusted import FileError, regular
from tdanet_jax.models.classes import load_vocabulary
from tdanet_jax.training import history, journal, run_file
from tdanet_jax.training.checkpoint import Checkpoints
from tests.support import handmade

PLANTED = {"link": "a link", "pipe": "not a regular file", "folder": "not a regular file"}


def plant(path: Path, kind: str, secret: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if kind == "link":
        path.symlink_to(secret)
    elif kind == "pipe":
        os.mkfifo(path)
    else:
        path.mkdir()


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    path = tmp_path / "secret"
    path.write_text("{}")
    return path


#: The files of a run's folder, and what reads each.
READERS: dict[str, Callable[[Path], object]] = {
    "config.json": lambda run: configs.load(run / "config.json"),
    "classes.json": load_vocabulary,
    "metrics.jsonl": journal.read_metrics,
    "episodes.jsonl": lambda run: episode_lookup.read_record(run, 0, handmade.lopsided()),
    "run.json": run_file.read,
    "results.json": lambda run: results_file.read(run / "results.json"),
    "network.npz": lambda run: history.read(run / "network.npz"),
    "history/00000001.npz": lambda run: history.read(history.points(run)[0]),
}


@pytest.mark.parametrize("kind", PLANTED)
@pytest.mark.parametrize("name", READERS)
def test_readers_of_runs_open_regular_files_alone(
    tmp_path: Path, secret: Path, name: str, kind: str
) -> None:
    plant(tmp_path / "run" / name, kind, secret)
    with pytest.raises(FileError, match=PLANTED[kind]) as caught:
        READERS[name](tmp_path / "run")
    assert Path(name).name in str(caught.value)


@pytest.mark.parametrize("kind", ["link", "pipe"])
@pytest.mark.parametrize("name", ["results.md", "results.json", "episodes.jsonl"])
def test_a_shared_agent_takes_no_secret_along(
    tmp_path: Path, secret: Path, name: str, kind: str
) -> None:
    bundled = Path(__file__).parents[3] / "agents" / "18-4-best"
    for path in bundled.iterdir():
        if path.name != name:
            (tmp_path / "run" / path.name).parent.mkdir(exist_ok=True)
            (tmp_path / "run" / path.name).write_bytes(path.read_bytes())
    plant(tmp_path / "run" / name, kind, secret)
    with pytest.raises(FileError, match=PLANTED[kind]):
        saved_networks.share(tmp_path / "run", tmp_path / "out")
    assert not os.path.lexists(tmp_path / "out" / name)


def test_folders_of_a_run_are_no_links(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    for name in ("checkpoints", "history"):
        (tmp_path / "run" / name).parent.mkdir(exist_ok=True)
        (tmp_path / "run" / name).symlink_to(tmp_path / "elsewhere")
    with pytest.raises(FileError, match="history: a link"):
        history.drop_after(tmp_path / "run", 0)
    with pytest.raises(FileError, match="checkpoints: a link"):
        Checkpoints(tmp_path / "run").latest()
    with pytest.raises(FileError, match="a link"):
        regular.check_tree(tmp_path / "run")


@pytest.mark.parametrize("kind", ["link", "pipe"])
def test_a_checkpoint_holds_regular_files_alone(tmp_path: Path, secret: Path, kind: str) -> None:
    (tmp_path / "checkpoints" / "3").mkdir(parents=True)
    plant(tmp_path / "checkpoints" / "3" / "state" / "d" / "x", kind, secret)
    with pytest.raises(FileError, match=f"state/d/x: {PLANTED[kind]}"):
        Checkpoints(tmp_path).snapshot()


def test_a_tree_of_files_is_measured_and_devices_are_not_opened(tmp_path: Path) -> None:
    (tmp_path / "a" / "b").mkdir(parents=True)
    (tmp_path / "a" / "b" / "c").write_bytes(b"123")
    (tmp_path / "d").write_bytes(b"45")
    assert regular.check_tree(tmp_path) == 5
    with pytest.raises(FileError, match="/dev/zero: not a regular file"):
        regular.read_bytes(Path("/dev/zero"))
