"""Atomic file writes."""

from __future__ import annotations

import os
import stat
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
        f"{files.PARTIAL}{os.getpid()}-x/a.npz", f"{files.PARTIAL}1-x/a.npz",
        f"{files.PARTIAL}x/a.npz", f"{begun}-x-y/a.npz", f"{begun}-y/aXnpz",
    }  # fmt: skip
    for name in (*kept, f"{begun}-z/a.npz"):
        (tmp_path / name).parent.mkdir()
        (tmp_path / name).write_text("half")
    (tmp_path / f"{begun}-o" / "out" / "FloorPlan1").mkdir(parents=True)
    assert files.remove_abandoned(tmp_path / "a.npz") == [tmp_path / f"{begun}-z"]
    assert files.remove_abandoned(tmp_path / "out") == [tmp_path / f"{begun}-o"]
    assert {str(p.relative_to(tmp_path)) for p in tmp_path.glob("*/*")} == kept
    assert files.remove_abandoned(tmp_path / "missing" / "a.npz") == []


def test_nobody_else_can_put_a_link_where_a_file_is_being_written(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    with files.replacing(path) as fresh:
        assert fresh.name == path.name  # its ending says in which format a picture is written
        assert stat.S_IMODE(fresh.parent.stat().st_mode) == 0o700
        first = fresh.parent.name
        fresh.write_text("new")
    with files.replacing(path) as fresh:
        assert fresh.parent.name != first
        fresh.write_text("newer")
    usual = tmp_path / "usual"
    usual.write_text("")
    assert path.stat().st_mode == usual.stat().st_mode  # others may read it as any other file


def test_links_are_removed_and_locked_as_links(tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.mkdir()
    (victim / "a").write_text("kept")
    run = tmp_path / "run"
    run.mkdir()
    for name in (f"{files.PARTIAL}1", f"{files.PARTIAL}{2**22 + 1}-x"):
        (run / name).symlink_to(victim)
    assert files.remove_abandoned(run / "a") == []
    assert len(files.remove_partial(run)) == 2
    (run / files.LOCK_FILE).symlink_to(victim / "a")
    with pytest.raises(OSError, match="link"), files.locked(run):
        pass
    assert [(p.name, p.read_text()) for p in victim.iterdir()] == [("a", "kept")]
