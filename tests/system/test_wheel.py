"""The wheel that is built from the checkout holds all that the package reads, and finds it."""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.wheel import WheelBuilder

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


@pytest.fixture(scope="module")
def unpacked(tmp_path_factory):
    """A folder with the content of the wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    (built,) = WheelBuilder(str(ROOT)).build(directory=str(folder), versions=["standard"])
    with zipfile.ZipFile(built) as wheel:
        wheel.extractall(folder / "unpacked")
    return folder / "unpacked"


def test_it_holds_every_file_of_the_packages(unpacked):
    for package in ("tdanet_jax", "experiments"):
        for path in (ROOT / package).rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                assert (unpacked / path.relative_to(ROOT)).read_bytes() == path.read_bytes()


def test_it_has_the_agents_and_the_command(unpacked, tmp_path):
    (points,) = unpacked.glob("*.dist-info/entry_points.txt")
    assert "tdanet = experiments.__main__:script" in points.read_text()
    done = subprocess.run(
        [sys.executable, "-c", AGENTS], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(unpacked)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *names, folder = done.stdout.split()
    assert names == sorted(path.name for path in (ROOT / "agents").iterdir())
    assert Path(folder).is_relative_to(unpacked)
    for path in (ROOT / "agents" / names[0]).iterdir():
        if path.is_file():
            assert (Path(folder) / path.name).read_bytes() == path.read_bytes()


def test_type_checkers_are_told_that_it_is_typed(unpacked):
    assert (unpacked / "tdanet_jax" / "py.typed").is_file()


def test_it_finds_what_it_reads_from_any_folder(unpacked, tmp_path):
    done = subprocess.run(
        [sys.executable, "-c", READ], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(unpacked)},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    found = [Path(line) for line in done.stdout.splitlines()]
    assert {path.name for path in found} == {
        "ithor.npz", "labels.json", "open.json", "words.npz", "episodes.npz", "NOTICE",
        "furniture.json.gz", "replay.html",
    }  # fmt: skip
    assert all(path.is_file() and path.is_relative_to(unpacked) for path in found)
