"""Atomic file writes."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tdanet_jax.io import files


def test_a_file_is_replaced_at_the_end(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    with files.replacing(path) as fresh:
        fresh.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_an_error_leaves_the_old_file_and_nothing_else(
    tmp_path: Path, error: BaseException
) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")

    def write() -> None:
        with files.replacing(path) as fresh:
            fresh.write_text("half")
            raise error

    with pytest.raises(type(error)) as caught:
        write()
    if isinstance(error, OSError):
        assert caught.value.filename == str(path)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_partial_files_are_removed(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("whole")
    (tmp_path / f"{files.PARTIAL}b.json").write_text("half")
    (tmp_path / f"{files.PARTIAL}7" / "state").mkdir(parents=True)
    assert len(files.remove_partial(tmp_path)) == 2
    assert [path.name for path in tmp_path.iterdir()] == ["a.json"]
    assert files.remove_partial(tmp_path / "missing") == []


def test_partial_files_of_killed_processes_are_removed(tmp_path: Path) -> None:
    killed = subprocess.Popen([sys.executable, "-c", ""])
    killed.wait()
    begun = files.PARTIAL + str(killed.pid)
    kept = {
        "a.npz", "a.npz-b", f"{files.PARTIAL}{os.getpid()}-a.npz", f"{files.PARTIAL}1-a.npz",
        f"{files.PARTIAL}a.npz", f"{begun}-b-a.npz", f"{begun}-aXnpz", f"{begun}-a.npz.b",
    }  # fmt: skip
    for name in (*kept, f"{begun}-a.npz"):
        (tmp_path / name).write_text("half")
    (tmp_path / f"{begun}-out" / "FloorPlan1").mkdir(parents=True)
    assert files.remove_abandoned(tmp_path / "a.npz") == [tmp_path / f"{begun}-a.npz"]
    assert files.remove_abandoned(tmp_path / "out") == [tmp_path / f"{begun}-out"]
    assert {path.name for path in tmp_path.iterdir()} == kept
    assert files.remove_abandoned(tmp_path / "missing" / "a.npz") == []
