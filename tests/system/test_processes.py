"""Processes that tests start run the code under test, wherever the tests are started from."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import tdanet_jax
from tests.support import command

ROOT = Path(__file__).resolve().parents[2]
SHOW = "import tdanet_jax, experiments; print(tdanet_jax.__file__, *experiments.__path__)"


@pytest.fixture
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder: another checkout, whose packages are broken."""
    for package in ("tdanet_jax", "experiments", "tests"):
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text("raise ImportError('the wrong code')")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.usefixtures("elsewhere")
def test_a_process_imports_the_code_under_test() -> None:
    done = subprocess.run([sys.executable, "-c", SHOW], capture_output=True, text=True)
    assert done.stderr == ""
    assert done.stdout.split() == [tdanet_jax.__file__, str(ROOT / "experiments")]


@pytest.mark.usefixtures("elsewhere")
def test_a_command_is_the_one_under_test() -> None:
    done = command.run("share")
    assert (done.returncode, done.stdout) == (2, "")
    assert "Missing from tdanet share: --checkpoint RUN" in done.stderr


def test_no_test_takes_the_working_folder_for_the_checkout() -> None:
    name = "get" + "cwd"
    users = [p.name for p in (ROOT / "tests").rglob("*.py") if f"os.{name}()" in p.read_text()]
    assert users == []
