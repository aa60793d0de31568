"""`tdanet NAME` is `python -m experiments.MODULE`, under one name."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import experiments
from experiments import __main__ as tdanet
from experiments.running import how_to_continue
from tdanet_jax import __version__
from tdanet_jax.config import CONFIG_FILE, TrainConfig
from tests.experiments.test_arguments import CASES

Capture = pytest.CaptureFixture[str]


def test_it_has_every_command() -> None:
    assert {module for module, _ in tdanet.COMMANDS.values()} == set(CASES)


@pytest.mark.parametrize("words", [[], ["--help"], ["-h"]])
def test_it_lists_them(words: list[str], capsys: Capture) -> None:
    tdanet.main(words)
    said = capsys.readouterr().out
    for name, (_, what) in tdanet.COMMANDS.items():
        assert f"  {name} " in said
        assert what in said
    assert max(map(len, said.splitlines())) <= 80


def test_its_version(capsys: Capture) -> None:
    tdanet.main(["--version"])
    assert capsys.readouterr().out == f"tdanet_jax {__version__}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["trian"], "trian: no such command; did you mean train?"),
        (["fly"], "fly: no such command; choose one of demo, train, "),
        (["--completion"], "--completion: choose bash or zsh"),
        (["--completion", "fish"], "--completion: choose bash or zsh"),
        (["serve"], "Missing from tdanet serve: --checkpoint RUN"),
        (["scenes", "fly"], "Unrecognized options: fly"),
    ],
)
def test_wrong_arguments_are_one_line(words: list[str], message: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as stopped:
        tdanet.main(words)
    assert stopped.value.code == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {message}")
    assert said.count("\n") == 1
    assert experiments.subcommand is None


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_shells_complete_commands_and_flags(shell: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as stopped:
        tdanet.main(["--completion", shell])
    assert not stopped.value.code
    script = capsys.readouterr().out
    for word in (*tdanet.COMMANDS, "--checkpoint", "--preset", "inspect"):
        assert word in script


def test_a_stopped_run_says_how_to_continue_under_the_same_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / CONFIG_FILE).touch()
    ends = f" --resume {tmp_path}"
    assert how_to_continue(tmp_path, TrainConfig()).endswith(
        f"python -m experiments.train_zero_shot{ends}"
    )
    monkeypatch.setattr(experiments, "subcommand", "train")
    assert how_to_continue(tmp_path, TrainConfig()).endswith(f": tdanet train{ends}")


#: What the script does that an installation makes.
SCRIPT = """
import sys
from experiments.__main__ import script
sys.argv = ["/bin/tdanet", "evaluate", "--policy", "x"]
script()
"""


def test_as_a_program() -> None:
    done = subprocess.run(
        [sys.executable, "-c", SCRIPT], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    assert done.stderr.startswith("error: invalid choice 'x'")
    assert done.stderr.count("\n") == 1
