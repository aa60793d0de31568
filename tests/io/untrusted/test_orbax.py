"""Checkpoints that Orbax wrote, read in a process of its own."""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.io.untrusted import FileError, npz, orbax

STATE = Path(__file__).parents[2] / "data" / "run_format_1" / "checkpoints" / "2" / "state"


#: As chunks that unpack to more than they declare, which nothing but the process's limit finds out.
TOO_MUCH = """
from tdanet_jax.io.untrusted import orbax
orbax._OWN_MEMORY = 1 << 29
orbax._limit()
bytearray(6 << 30)
"""


def with_start(code: str) -> str:
    """What the process runs, with something else before it."""
    return orbax._CHILD.replace("orbax.main(", f"{code}\norbax.main(")


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where temporary folders are made."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_it_is_read_by_the_same_package_wherever_one_stands_and_without_jax(
    tmp_path: Path, temporary: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("numpy", "tensorstore", "tdanet_jax"):
        (tmp_path / f"{name}.py").write_text("raise SystemExit(3)")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", *sys.path])
    started = f"""
assert orbax.__file__ == {orbax.__file__!r}
orbax._arrays(orbax.Path({str(STATE)!r}))
assert not {{{{"jax", "flax", "orbax"}}}} & {{{{*sys.modules}}}}
"""
    monkeypatch.setattr(orbax, "_CHILD", with_start(started))
    with orbax.as_npz(STATE) as file:
        arrays = npz.read(file)
    assert arrays["updates"] == 2
    assert arrays["updates"].dtype == np.int32
    assert arrays["params/actor/kernel"].any()
    assert list(temporary.iterdir()) == []


@pytest.mark.parametrize(
    ("child", "seconds", "reason"),
    [
        ("import os; os.kill(os.getpid(), 11)", 60, r"crashed its reader \(status -11\)"),
        ("while True: pass", 0.1, "could not be read within 0.1 seconds"),
        ("print('\\x1b[2J' * 10**6); raise SystemExit(1)", 60, r"\?\[2J"),
        (TOO_MUCH, 60, r"crashed its reader \(status 1\)"),
    ],
)
def test_whatever_happens_to_its_reader_is_one_line(
    temporary: Path, monkeypatch: pytest.MonkeyPatch, child: str, seconds: float, reason: str
) -> None:
    monkeypatch.setattr(orbax, "_CHILD", child)
    monkeypatch.setattr(orbax, "SECONDS", seconds)
    match = f"checkpoints/2/state: .*{reason}"
    with pytest.raises(FileError, match=match) as caught, orbax.as_npz(STATE):
        pass
    assert str(caught.value).isprintable()
    assert list(temporary.iterdir()) == []


def test_budgets_hold_before_any_array_is_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TDANET_BUDGETS", "unpacked=1000")
    monkeypatch.setattr(orbax, "_CHILD", with_start("orbax._read = None"))
    match = r"state: unpacks to \d+ bytes, more than 1000; if you"
    with pytest.raises(FileError, match=match), orbax.as_npz(STATE):
        pass


def test_faults_that_are_found_later_name_the_checkpoint(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(orbax, "_CHILD", "open({out!r}, 'w')")
    match = "checkpoints/2/state: not an npz archive"
    with pytest.raises(FileError, match=match), orbax.as_npz(STATE) as file:
        npz.read(file)


@pytest.mark.parametrize("name", ["file", "allow_pickle"])
def test_a_name_that_numpy_takes_for_an_argument_is_refused(tmp_path: Path, name: str) -> None:
    key = {"key_metadata": [{"key": name}], "value_metadata": {"value_type": "jax.Array"}}
    (tmp_path / orbax.METADATA).write_text(json.dumps({"tree_metadata": {"x": key}}))
    with pytest.raises(FileError, match=f"{name} is not the name of an array"):
        orbax._places(tmp_path)
