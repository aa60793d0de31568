"""Every shell command on every page is one that its program accepts."""

from __future__ import annotations

import argparse
import importlib
import re
import runpy
import shlex
import sys
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import tyro

from tdanet_jax import __main__ as tdanet
from tests.support.pages import PAGES, ROOT, blocks

#: Other programs that the pages may name.
OTHERS = {"mkdir", "cd", "git", "mkdocs", "mypy", "ruff", "sha256sum", "."}

#: The functions that parse command lines.
PARSERS: tuple[tuple[Any, str], ...] = (
    (tyro, "cli"),
    (tyro.extras, "subcommand_cli_from_dict"),
    (argparse.ArgumentParser, "parse_known_args"),
)


class Parsed(BaseException):
    """The arguments are accepted; raised instead of running the command."""


def lines(code: str) -> Iterator[list[str]]:
    """The commands of a block, each as its words, without variables set for it."""
    for line in code.replace("\\\n", " ").splitlines():
        for command in line.split("&&"):
            words = shlex.split(command, comments=True)
            while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
                words.pop(0)
            if words:
                yield words


def all_commands() -> list[Any]:
    """Every command of every page, with a name by which a failure says where it is."""
    return [
        pytest.param(words, id=f"{page}:{one.line}:{' '.join(words)}"[:120])
        for page in PAGES
        for one in blocks(page)
        if one.language in ("bash", "sh") and not one.note.startswith("not run: ")
        for words in lines(one.code)
    ]


def raising(parse: Callable[..., Any]) -> Callable[..., Any]:
    """A parser that ends the command once it has accepted everything."""

    def parse_and_stop(*given: Any, **options: Any) -> Any:
        accepted = parse(*given, **options)
        if options.get("return_unknown_args"):  # a sweep hands the rest to the training command
            return accepted
        raise Parsed

    return parse_and_stop


@pytest.mark.parametrize("words", all_commands())
def test_a_command_is_accepted(
    words: list[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    program, *rest = words
    if program in ("python", "python3") and rest[0] != "-m":
        example = ROOT / rest[0]
        if "tyro.cli" in example.read_text():
            monkeypatch.setattr(tyro, "cli", raising(tyro.cli))
            monkeypatch.setattr(sys, "argv", rest)
            with pytest.raises((Parsed, ModuleNotFoundError)):  # PyTorch need not be installed
                runpy.run_path(str(example), run_name="__main__")
    elif program in ("python", "python3"):
        _, module, *arguments = rest
        if module == "venv":
            return
        ours = ("experiments.", "tests.", "tdanet_jax.tools.")
        assert module.startswith(ours), f"no module of ours: {module}"
        for place, name in PARSERS:
            monkeypatch.setattr(place, name, raising(getattr(place, name)))
        monkeypatch.setattr(sys, "argv", [module, *arguments])
        monkeypatch.chdir(tmp_path)
        with pytest.raises(Parsed):
            importlib.import_module(module).main()
    elif program == "tdanet":
        for place, name in PARSERS:
            monkeypatch.setattr(place, name, raising(getattr(place, name)))
        monkeypatch.chdir(tmp_path)
        if ">" in rest:
            rest = rest[: rest.index(">")]
        with pytest.raises((Parsed, SystemExit)) as ended:
            tdanet.main(rest)
        assert ended.type is Parsed or not ended.value.code
    elif program == "pip":
        assert rest[0] == "install"
        project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
        known = {*project["optional-dependencies"], ""}
        for target in rest[1:]:
            if target.startswith("."):
                assert set(target[1:].strip("[]").split(",")) <= known, f"no such extra: {target}"
    elif program == "pytest":
        for word in rest:
            assert "/" not in word or (ROOT / word).exists(), f"no such file: {word}"
    elif program == "export":
        assert rest[0].startswith("TDANET_")
    else:
        assert program in OTHERS, f"unknown program: {program}"
