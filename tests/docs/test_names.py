"""Files, modules, names and flags that the pages mention exist."""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import io
import re
from typing import Any

import pytest

from tdanet_jax import __main__ as tdanet
from tdanet_jax.commands import scenes
from tests.support.pages import PAGES, ROOT, prose

#: Flags of other programs, and of the examples, that the pages mention.
FOREIGN = {
    "--array", "--check", "--durations", "--evaluation", "--fix", "--gpus-per-node",
    "--gpus-per-task", "--help", "--total-timesteps",
    "--xla_cpu_multi_thread_eigen", "--xla_gpu_deterministic_ops",
}  # fmt: skip
#: Where the files are that a page may name.
FOLDERS = (
    "tests/", "tdanet_jax/", "experiments/", "docs/", "assets/", "agents/1", "agents/2",
    "notebooks/", "results/", ".ci/",
)  # fmt: skip

pages = pytest.mark.parametrize("page", PAGES)


def code(page: str) -> list[str]:
    """The inline code of a page."""
    return re.findall(r"`([^`]+)`", prose(page))


@pages
def test_files_that_a_page_names_exist(page: str) -> None:
    named = {word for word in code(page) if re.fullmatch(r"[\w./-]+", word)}
    missing = [word for word in named if word.startswith(FOLDERS) and not (ROOT / word).exists()]
    assert missing == []


@pages
def test_modules_that_a_page_runs_exist(page: str) -> None:
    for module in re.findall(r"python -m ([\w.]+)", (ROOT / page).read_text()):
        assert importlib.util.find_spec(module) is not None, module


@pages
def test_commands_that_a_page_mentions_exist(page: str) -> None:
    for words in map(str.split, code(page)):
        match words:
            case ["tdanet", "scenes", name, *_]:
                assert name in scenes.COMMANDS, words
            case ["tdanet", name, *_] if not name.startswith("--"):
                assert name in tdanet.COMMANDS, words


@pages
def test_names_of_the_package_that_a_page_mentions_exist(page: str) -> None:
    names = re.findall(r"`(tdanet_jax\.[\w.]+)", prose(page))
    reference = re.findall(r"^::: ([\w.]+)|#(tdanet_jax\.[\w.]+)\)", prose(page), re.MULTILINE)
    for name in [*names, *(one or other for one, other in reference)]:
        found: Any = importlib.import_module("tdanet_jax")
        path = "tdanet_jax"
        for part in name.split(".")[1:]:
            path = f"{path}.{part}"
            if not hasattr(found, part):
                importlib.import_module(path)
            found = getattr(found, part)


@functools.cache
def flags() -> set[str]:
    """The flags of all commands, as their help shows them."""
    known = set()
    commands = [[name] for name in tdanet.COMMANDS if name != "scenes"]
    commands += [["scenes", name] for name in scenes.COMMANDS]
    for command in commands:
        said = io.StringIO()
        with contextlib.redirect_stdout(said), pytest.raises(SystemExit):
            tdanet.main([*command, "--help"])
        known |= set(re.findall(r"--[a-z][\w-]*", said.getvalue()))
    return known


@pages
def test_flags_that_a_page_mentions_exist(page: str) -> None:
    text = "\n".join(code(page))
    assert set(re.findall(r"(?<![\w-])--[a-z][\w-]*", text)) - flags() - FOREIGN == set()
