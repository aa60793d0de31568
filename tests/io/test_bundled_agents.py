"""Bundled agents are found by name, and do not hide what is there."""

from __future__ import annotations

from pathlib import Path

import pytest

import tdanet_jax
from tdanet_jax.commands.console import folder_for
from tdanet_jax.io import bundled_agents
from tdanet_jax.io.bundled_agents import find_run, is_bundled

ROOT = Path(__file__).parents[2]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_every_folder_of_an_agent_has_a_name() -> None:
    assert bundled_agents.names() == sorted(path.name for path in (ROOT / "agents").iterdir())
    assert bundled_agents.names() == sorted(bundled_agents.SHIPPED)
    assert "18-4-best" in bundled_agents.names()


@pytest.mark.parametrize("run", ["18-4-best", "agents/18-4-best", Path("18-4-best")])
def test_it_is_found_from_any_folder(run: Path | str) -> None:
    assert find_run(run) == ROOT / "agents" / "18-4-best"
    assert is_bundled(find_run(run))
    assert tdanet_jax.load(run).config.split == "18/4"


@pytest.mark.parametrize("run", ["runs/18-4-best", "18-4", "agents/none", "a/agents/18-4-best", ""])
def test_other_names_stay_as_they_are(run: str) -> None:
    assert find_run(run) == Path(run)
    assert not is_bundled(find_run(run))


def test_what_exists_comes_first(tmp_path: Path) -> None:
    (tmp_path / "18-4-best").mkdir()
    assert find_run("18-4-best") == Path("18-4-best")
    assert not is_bundled(Path("18-4-best"))


def test_what_is_made_of_an_agent_of_ones_own_lies_with_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`agents/mine` of a checkout is not `runs/mine`, which may be another."""
    monkeypatch.setattr(bundled_agents, "folder", lambda: tmp_path / "agents")
    mine, shipped = tmp_path / "agents" / "mine", tmp_path / "agents" / "18-4-best"
    assert folder_for(mine) == mine
    assert folder_for(shipped) == Path("runs/18-4-best")
