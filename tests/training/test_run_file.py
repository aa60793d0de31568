"""`run.json` names every process that has worked on a run, and never stops one."""

from __future__ import annotations

import dataclasses
import json
import platform
import re
from datetime import UTC, datetime
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import jax
import pytest

import tdanet_jax
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.training import devices, run_file
from tdanet_jax.training.run_file import Process

FIRST = Process(command="tdanet train --out x", commit="abc", machine="EPYC, 2 cores")
SECOND = Process(command="tdanet train --resume x", commit="abd", machine="EPYC, 4 cores")


def test_a_process_describes_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "processor", lambda: "EPYC")
    monkeypatch.setattr("os.sched_getaffinity", lambda _: {3}, raising=False)
    process = run_file.this_process("tdanet train", "abc", devices.first())
    started = datetime.fromisoformat(process.started or "")
    assert abs((datetime.now(UTC) - started).total_seconds()) < 60
    assert dataclasses.replace(process, started=None) == Process(
        command="tdanet train",
        commit="abc",
        tdanet_jax=tdanet_jax.__version__,
        jax=jax.__version__,
        python=platform.python_version(),
        machine="EPYC, 1 core",
    )


def test_accelerators_are_named_and_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    device = SimpleNamespace(platform="gpu", device_kind="NVIDIA H200")
    mesh = cast(Any, SimpleNamespace(devices=SimpleNamespace(flat=[device]), size=8))
    assert devices.machine(mesh) == "NVIDIA H200, 8 devices"
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    assert devices.machine(mesh) == "NVIDIA H200, 8 devices, 2 processes"


def test_processes_are_added_in_their_order(tmp_path: Path) -> None:
    assert run_file.read(tmp_path) == []  # as in the run of an earlier version
    run_file.add(tmp_path, FIRST)
    run_file.add(tmp_path, SECOND)
    assert run_file.read(tmp_path) == [FIRST, SECOND]
    assert [path.name for path in tmp_path.iterdir()] == ["run.json"]


@pytest.mark.parametrize(
    "content",
    [
        "{", "[]", '{"processes": 3}', '{"processes": [3]}', '{"processes": [{"command": 3}]}',
        '{"processes": [{"host": "x"}]}', '{"processes": [{"command": "a\\nb"}]}',
    ],
)  # fmt: skip
def test_a_damaged_file_is_named_and_stops_no_run(tmp_path: Path, content: str) -> None:
    path = tmp_path / "run.json"
    path.write_text(content)
    with pytest.raises(FileError, match=re.escape(str(path))):
        run_file.read(tmp_path)
    with pytest.warns(UserWarning, match="run.json: .*; begun anew"):
        run_file.add(tmp_path, FIRST)
    assert json.loads(path.read_text())["processes"][0]["machine"] == "EPYC, 2 cores"
