"""`tdanet NAME`, and `python -m experiments.MODULE` from a clone."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tdanet_jax import __main__ as tdanet
from tdanet_jax import __version__
from tests.commands.test_arguments import CASES

ROOT = Path(__file__).resolve().parents[2]
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


@pytest.mark.parametrize("shell", ["bash", "zsh"])
def test_shells_complete_commands_and_flags(shell: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as stopped:
        tdanet.main(["--completion", shell])
    assert not stopped.value.code
    script = capsys.readouterr().out
    for word in (*tdanet.COMMANDS, "--checkpoint", "--preset", "inspect"):
        assert word in script


#: The script that an installation makes.
SCRIPT = """
from tdanet_jax.__main__ import script
script()
"""


def test_as_a_program_with_a_model_of_the_working_folder(tmp_path: Path) -> None:
    for folder in ("bin", "my_lab"):
        (tmp_path / folder).mkdir()
    (tmp_path / "bin" / "tdanet").write_text(SCRIPT)
    (tmp_path / "my_lab" / "empty.py").touch()
    done = subprocess.run(
        [sys.executable, "bin/tdanet", "train", "--model", "my_lab.empty"],
        cwd=tmp_path,
        env=os.environ | {"PYTHONSAFEPATH": ""},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 2
    assert done.stderr == "error: --model my_lab.empty: the module has no function `make`\n"


#: A file of `experiments/`.
FROM_A_CLONE = """\
\"""`{command}`, from a clone.\"""

from __future__ import annotations

from tdanet_jax.{module} import main

if __name__ == "__main__":
    main()
"""


def test_a_clone_has_a_file_for_every_command() -> None:
    written = {path.stem: path.read_text() for path in (ROOT / "experiments").glob("*.py")}
    del written["__init__"]
    known = [("__main__", "__main__", "tdanet")]
    known += [(m, f"commands.{m}", f"tdanet {name}") for name, (m, _) in tdanet.COMMANDS.items()]
    assert written == {
        file: FROM_A_CLONE.format(command=command, module=module) for file, module, command in known
    }
