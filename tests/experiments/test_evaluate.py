"""The evaluation command, as a user types it."""

import json
import os
import subprocess
import sys

import pytest

COMMAND = [sys.executable, "-m", "experiments.evaluate"]


def run(*arguments, cwd=None):
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    return subprocess.run(
        [*COMMAND, *arguments], capture_output=True, text=True, cwd=cwd, env=environment
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--policy sample needs --checkpoint"),
        (["--policy", "random", "--checkpoint", "full"], "--policy random takes no --checkpoint"),
        (["--policy", "random", "--split", "17/5"], "--split 17/5: choose one of"),
        (["--checkpoint", "nowhere"], "nowhere/config.json: no such file"),
        (["--policy", "random", "--out", "full"], "--out full: exists and is not empty"),
    ],
)
def test_wrong_arguments_give_one_line_and_write_nothing(tmp_path, arguments, message):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "precious").write_text("kept")
    done = run(*arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1
    assert [p.name for p in tmp_path.rglob("*")] == ["full", "precious"]


def test_the_shortest_path_policy_scores_100(ithor, tmp_path):
    """Through the whole command: every test episode can be solved, in exactly L actions."""
    out = tmp_path / "oracle"
    done = run("--policy", "shortest_path", "--split", "14/8", "--out", str(out))
    assert done.returncode == 0, done.stderr
    results = json.loads((out / "results.json").read_text())
    for group in ("seen", "unseen"):
        assert results[group]["L>=1"]["SR"] == results[group]["L>=1"]["SPL"] == 100
        assert results[group]["L>=1"]["n"] == 1000
    records = [json.loads(line) for line in (out / "episodes.jsonl").read_text().splitlines()]
    assert len(records) == 2000
    assert all(record["e"] == record["L"] == len(record["actions"]) for record in records)
