"""Every Python block of every page runs unchanged; training is cut short."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

import tdanet_jax
from tdanet_jax.config import TrainConfig
from tdanet_jax.io.bundled_agents import find_run
from tests.support.pages import PAGES, ROOT, Block, blocks

#: Pages whose blocks take long: by hand.
SLOW = ("docs/analysis.md", "docs/trainers.md")


def runs(one: Block) -> bool:
    return one.language == "python" and not one.note


@pytest.fixture
def small_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    """`tdanet_jax.train` makes two updates of a tiny network."""
    train = tdanet_jax.train

    def briefly(config: TrainConfig, *given: Any, **options: Any) -> Any:
        config = dataclasses.replace(
            config,
            steps=80,
            episodes=None,
            minutes=None,
            history=0,
            learner=dataclasses.replace(config.learner, num_envs=8, rollout_steps=5),
            network=dataclasses.replace(config.network, width=16, hidden=16),
        )
        return train(config, *given, **options)

    monkeypatch.setattr(tdanet_jax, "train", briefly)


@pytest.mark.usefixtures("few_episodes", "small_runs")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.slow] if page in SLOW else [])
        for page in PAGES
        if any(map(runs, blocks(page)))
    ],
)
def test_the_blocks_of_a_page_run(
    page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One after the other, as a reader would type them; `runs/A` is the bundled agent."""
    shutil.copytree(find_run("18-4-best"), tmp_path / "runs" / "A")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"__name__": "snippet"}
    for one in filter(runs, blocks(page)):
        code = "\n" * (one.line - 1) + one.code  # so that a traceback names the page's line
        exec(compile(code, ROOT / page, "exec"), names)


@pytest.mark.parametrize("page", PAGES)
def test_an_excerpt_is_in_its_file(page: str) -> None:
    for one in blocks(page):
        if one.note.startswith("from "):
            source = (ROOT / one.note.removeprefix("from ")).read_text()
            assert one.code in source, f"{page}:{one.line} is not in {one.note}"


@pytest.mark.parametrize("page", PAGES)
def test_json_is_json(page: str) -> None:
    for one in blocks(page):
        if one.language == "json":
            json.loads(one.code)


@pytest.mark.parametrize("page", PAGES)
def test_a_named_block_has_a_test_of_its_own(page: str) -> None:
    tests = "".join(path.read_text() for path in (ROOT / "tests").rglob("test_*.py"))
    ci = (ROOT / ".ci" / "run").read_text()
    for one in blocks(page):
        if one.note and not re.match(r"(not run: |from )", one.note):
            assert f'"{one.note}")' in tests or f"<!-- {one.note} -->" in ci, one.note
