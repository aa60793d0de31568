"""The cache: built once, checked when read, safe among processes."""

import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.scenes import cache, ithor, tables, toy

# Builds (slowly enough to overlap) and prints the tables' version.
BUILDER = """
import time
import numpy as np
from tdanet_jax.scenes import cache, ithor, toy
def rooms():
    time.sleep(1.0)
    return [toy.random_room(np.random.default_rng(0))]
ithor.load_scenes = rooms
print(cache.load_tables().data_version)
"""


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv(cache.VARIABLE, str(tmp_path / "cache"))
    rooms = [toy.random_room(np.random.default_rng(0))]
    monkeypatch.setattr(ithor, "load_scenes", lambda: rooms)
    return tmp_path / "cache"


def forbid_building(monkeypatch: pytest.MonkeyPatch) -> None:
    def build(*_: object, **__: object) -> None:
        raise AssertionError("built although cached")

    monkeypatch.setattr(tables, "build", build)


def test_built_once(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[tuple[int, int]] = []
    first = cache.load_tables(lambda done, total: calls.append((done, total)))
    assert calls == [(1, 1)]
    forbid_building(monkeypatch)
    assert cache.load_tables().data_version == first.data_version
    assert not [path for path in folder.iterdir() if path.name.startswith(".")]


@pytest.mark.parametrize("damage", ["flip", "truncate", "empty", "no checksum"])
def test_damage_is_noticed_and_repaired(folder: Path, damage: str) -> None:
    first = cache.load_tables()
    [path] = folder.glob("*.npz")
    content = bytearray(path.read_bytes())
    if damage == "flip":
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
    elif damage == "no checksum":
        path.with_suffix(".sha256").unlink()
    else:
        path.write_bytes(content[: 100 if damage == "truncate" else 0])
    with pytest.warns(UserWarning, match="damaged") as caught:
        again = cache.load_tables()
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    assert again.data_version == first.data_version
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert cache.load_tables().data_version == first.data_version


def test_other_sources_other_file(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = cache.key()
    monkeypatch.setattr(cache.inspect, "getsource", lambda module: "changed")
    assert cache.key() != before


def test_a_cache_that_cannot_be_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.write_text("a file where the folder should be")
    with pytest.warns(UserWarning, match="not cached"):
        assert len(cache.load_tables().scenes) == 1


def test_two_processes_at_once(tmp_path: Path) -> None:
    environment = {**os.environ, cache.VARIABLE: str(tmp_path), "PYTHONWARNINGS": "error"}
    command = [sys.executable, "-c", BUILDER]
    running = [
        subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    results = {(process.communicate(timeout=120)[0], process.returncode) for process in running}
    assert len(results) == 1
    assert results.pop()[1] == 0
    assert len(list(tmp_path.iterdir())) == 2


def test_the_platforms_place_by_default(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(cache.VARIABLE, raising=False)
    assert "tdanet_jax" in str(cache.folder())
