"""The wheel that is built from the checkout holds all that the package reads, and finds it."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

from tdanet_jax.__main__ import COMMANDS

ROOT = Path(__file__).parents[2]
#: Reads the page's template and every bundled file, whose checksums are looked at.
READ = """
import importlib.resources, json
from tdanet_jax.io import assets
names = json.loads((assets.folder() / assets.CHECKSUMS).read_text())
print(*[assets.path(name) for name in names], sep="\\n")
print(importlib.resources.files("tdanet_jax").joinpath("analysis/replay.html"))
"""
#: The names of the bundled agents, and where the first is.
AGENTS = """
from tdanet_jax.io.bundled_agents import find_run, names
print(*names(), find_run(names()[0]))
"""
#: The help of every command, without the package `experiments` of a clone that is installed.
HELP = """
import sys
sys.modules["experiments"] = None
from tdanet_jax.__main__ import COMMANDS, main
from tdanet_jax.commands import scenes
for words in [*map(str.split, COMMANDS), *(["scenes", name] for name in scenes.COMMANDS)]:
    try:
        main([*words, "--help"])
    except SystemExit as end:
        assert not end.code, words
"""


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    """A folder with the content of the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    (built,) = WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(built) as wheel:
        wheel.extractall(folder / "unpacked")
    return folder / "unpacked"


def test_it_holds_every_file_of_the_package(unpacked):
    for path in (ROOT / "tdanet_jax").rglob("*"):
        if path.is_file() and "__pycache__" not in path.parts:
            assert (unpacked / path.relative_to(ROOT)).read_bytes() == path.read_bytes()


def test_it_brings_one_package(unpacked):
    (information,) = unpacked.glob("*.dist-info")
    assert {path.name for path in unpacked.iterdir()} == {"tdanet_jax", information.name}


def run(unpacked, folder, *arguments):
    """What Python prints in an empty folder, with the content of the wheel."""
    done = subprocess.run(
        [sys.executable, *arguments], cwd=folder, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(unpacked)},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_it_has_the_agents_and_the_command(unpacked, tmp_path):
    (points,) = unpacked.glob("*.dist-info/entry_points.txt")
    assert "tdanet = tdanet_jax.__main__:script" in points.read_text()
    *names, folder = run(unpacked, tmp_path, "-c", AGENTS).split()
    assert names == sorted(path.name for path in (ROOT / "agents").iterdir())
    assert Path(folder).is_relative_to(unpacked)
    for path in (ROOT / "agents" / names[0]).iterdir():
        if path.is_file():
            assert (Path(folder) / path.name).read_bytes() == path.read_bytes()


def test_type_checkers_are_told_that_it_is_typed(unpacked):
    assert (unpacked / "tdanet_jax" / "py.typed").is_file()


def test_it_finds_what_it_reads_from_any_folder(unpacked, tmp_path):
    found = [Path(line) for line in run(unpacked, tmp_path, "-c", READ).splitlines()]
    assert {path.name for path in found} == {
        "ithor.npz", "labels.json", "open.json", "words.npz", "episodes.npz", "NOTICE",
        "furniture.json.gz", "replay.html",
    }  # fmt: skip
    assert all(path.is_file() and path.is_relative_to(unpacked) for path in found)


@pytest.mark.slow
def test_its_commands_need_no_clone(unpacked, tmp_path):
    said = run(unpacked, tmp_path, "-c", HELP)
    assert all(f"usage: tdanet {name} " in said for name in COMMANDS)
    assert "Laptop in FloorPlan228" in run(
        unpacked, tmp_path, "-m", "tdanet_jax", "demo", "--no-show"
    )
    assert [path.name for path in tmp_path.rglob("*.*")] == ["demo.html"]


@pytest.mark.slow
def test_the_snippets_of_the_pages_need_no_clone(unpacked, tmp_path):
    for name in ("tests", "docs"):
        shutil.copytree(ROOT / name, tmp_path / name)
    for name in ("README.md", "CONTRIBUTING.md", "pyproject.toml"):
        shutil.copy(ROOT / name, tmp_path)
    blocks = "tests/docs/test_snippets.py", "-k", "blocks", "-m", "", "-n", "0"
    assert " passed" in run(unpacked, tmp_path, "-m", "pytest", *blocks)
