"""The scoreboard: its rows agree with their episodes, its pages with its rows."""

from __future__ import annotations

import json
import re
import shutil
import statistics
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

from tdanet_jax.splits import NAMED
from tdanet_jax.tools import scoreboard as tool
from tdanet_jax.training import run_file
from tdanet_jax.training.run_file import Process
from tdanet_jax.workflows import scoreboard, scoreboard_page

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
NAMES = sorted(path.name for path in RESULTS.iterdir())
COMMAND = "tdanet train --split 18/4 --seed 7 --out /home/me/runs/x --word-vectors=/home/me/w.txt"


def test_the_pages_are_those_that_write_makes() -> None:
    """After a change of results/: python -m tdanet_jax.tools.scoreboard write."""
    rows = scoreboard.rows(RESULTS)
    assert [row.name for row in rows] == NAMES
    pages = scoreboard_page.pages(ROOT, rows)
    assert {path.name for path in pages} >= {"scoreboard.md", "results.md"}
    for path, text in pages.items():
        assert path.read_text() == text, path
    for split in NAMED:
        drawn = any(row.metrics for row in rows if row.results["split"] == split)
        assert (ROOT / "docs" / scoreboard_page.picture(split)).exists() == drawn, split


@pytest.mark.parametrize("name", NAMES)
def test_a_row_agrees_with_its_own_episodes(name: str) -> None:
    results = json.loads((RESULTS / name / "results.json").read_text())
    lines = (RESULTS / name / "episodes.jsonl").read_text().splitlines()
    episodes = [json.loads(line) for line in lines]
    assert {episode["group"] for episode in episodes} == {
        group for group in ("seen", "unseen") if results[group] is not None
    }
    for group in {episode["group"] for episode in episodes}:
        for bucket, least in (("L>=1", 1), ("L>=5", 5)):
            chosen = [e for e in episodes if e["group"] == group and e["L"] >= least]
            free = [e["success"] and not e["collided"] for e in chosen]
            share = [e["L"] / max(e["L"], e["e"]) for e in chosen]
            expected = {
                "SR": [e["success"] for e in chosen],
                "SPL": [e["success"] * part for e, part in zip(chosen, share, strict=True)],
                "CF-SR": free,
                "CF-SPL": [won * part for won, part in zip(free, share, strict=True)],
            }
            assert results[group][bucket]["n"] == len(chosen) > 100
            for measure, values in expected.items():
                percent = 100 * statistics.fmean(values)
                assert results[group][bucket][measure] == pytest.approx(percent, abs=0.0051)


@pytest.mark.parametrize("name", NAMES)
def test_a_row_says_how_it_was_made_and_names_nobody(name: str) -> None:
    processes = run_file.read(RESULTS / name)
    assert processes
    assert all(process.command for process in processes)
    for file in ("run.json", "config.json", "results.json"):
        if (RESULTS / name / file).exists():
            assert not re.search(r'["= ](/|~|[A-Z]:\\)', (RESULTS / name / file).read_text()), file


def test_a_changed_figure_changes_the_pages(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "docs", tmp_path / "docs", ignore=shutil.ignore_patterns("*.png"))
    shutil.copy(ROOT / "README.md", tmp_path)
    rows = scoreboard.rows(RESULTS)
    assert all(path.suffix == ".png" for path in scoreboard_page.write(tmp_path, rows))
    (changed,) = (row for row in rows if row.name == "18-4-random")
    changed.results["unseen"]["L>=1"]["SR"] += 1.0  # type: ignore[index]
    written = [path for path in scoreboard_page.write(tmp_path, rows) if path.suffix == ".md"]
    assert {path.name for path in written} == {"results.md", "scoreboard.md"}
    for path in written:
        before = (ROOT / path.relative_to(tmp_path)).read_text().splitlines()
        after = path.read_text().splitlines()
        differing = [new for old, new in zip(before, after, strict=True) if old != new]
        assert len(differing) == 1
        assert "random" in differing[0]


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run of its own seed, with word vectors and a learning curve."""
    folder = tmp_path / "run"
    shutil.copytree(RESULTS / "18-4-robust-0", folder)
    edit(folder / "results.json", seed=7, evaluation_seed=7)
    edit(folder / "config.json", seed=7, word_vectors="/home/me/w.txt")
    metrics = [
        {"updates": n, "steps": n * 10**6, "episodes": n, "seconds": 1800.0 * n,
         "success": n / 12, "spl": None if n == 1 else n / 24}
        for n in range(1, 13)
    ]  # fmt: skip
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in metrics))
    run_file.write(folder, [Process(command=COMMAND, machine="EPYC, 2 cores", commit="abc")])
    (folder / "learning_curve.png").touch()
    return folder


def edit(path: Path, **values: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | values))


def test_a_row_has_what_it_needs_and_no_folder_of_its_owner(run: Path, tmp_path: Path) -> None:
    out = scoreboard.add(run, "mine", tmp_path / "results")
    assert out == tmp_path / "results" / "mine"
    kept = {"config.json", "metrics.jsonl", "run.json", "results.json", "episodes.jsonl"}
    assert {path.name for path in out.iterdir()} == kept
    for name in kept - {"config.json", "run.json"}:
        assert (out / name).read_bytes() == (run / name).read_bytes()
    row = scoreboard.read(out)
    assert row.config is not None
    assert (row.config.seed, row.config.word_vectors, row.hours) == (7, "w.txt", 6.0)
    assert row.processes == [
        Process(
            command="tdanet train --split 18/4 --seed 7 --out x --word-vectors=w.txt",
            machine="EPYC, 2 cores",
            commit="abc",
        )
    ]
    assert "/home" not in "".join((out / name).read_text() for name in kept)


def test_a_run_of_an_earlier_version_is_told_about(run: Path, tmp_path: Path) -> None:
    (run / "run.json").unlink()
    with pytest.raises(ValueError, match=r"run: no run.json says how it was made; give --command"):
        scoreboard.add(run, "mine", tmp_path / "results")
    out = scoreboard.add(run, "mine", tmp_path / "results", "tdanet train --seed 7", "EPYC")
    (process,) = run_file.read(out)
    assert (process.command, process.machine) == ("tdanet train --seed 7", "EPYC")
    assert process.commit == json.loads((run / "results.json").read_text())["commit"]


@pytest.mark.parametrize(
    ("broken", "message"),
    [
        (("results.json", None), "results.json: no such file; is the run finished?"),
        (("episodes.jsonl", None), "episodes.jsonl: no such file"),
        (("config.json", None), "config.json: no such file; is this the folder of a run?"),
        (("config.json", {"split": 3}), "config.json: "),
        (("run.json", {"processes": 3}), "run.json: not a list of the processes of a run"),
        (
            ("results.json", {"departures": {"episodes": 50}}),
            "results.json: not the official test: at most 50 episodes",
        ),
        (("results.json", {"split": "18/4-validation"}), "results.json: split 18/4-validation: "),
        (("results.json", {"split": "Mug"}), "split Mug: the scoreboard has 22/0, 18/4, 14/8, ope"),
        (("results.json", {"data": "my_rooms.npz"}), "results.json: in the rooms of my_rooms.npz"),
        (
            ("results.json", {"data_version": "d4909be88f83"}),
            "results.json: of scene tables d4909be88f83, today's are 6188ee7cb86d",
        ),
        (("results.json", {"targets": "all"}), "targets all: not those of the split"),
        (("results.json", {"policy": "greedy"}), "greedy actions: the scoreboard is of sampled"),
    ],
)
def test_what_can_be_no_row_is_refused_in_one_line(
    run: Path, tmp_path: Path, broken: tuple[str, Mapping[str, Any] | None], message: str
) -> None:
    name, values = broken
    if values is None:
        (run / name).unlink()
    else:
        edit(run / name, **values)
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        scoreboard.add(run, "mine", tmp_path / "results")
    assert str(error.value).startswith(str(run))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "results").exists()


def test_names_and_seeds_are_taken_once(run: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    scoreboard.add(run, "mine", results)
    with pytest.raises(ValueError, match=r"--name mine: .* exists"):
        scoreboard.add(run, "mine", results)
    with pytest.raises(ValueError, match=r"results/mine has this agent with this seed"):
        scoreboard.add(run, "again", results)
    with pytest.raises(ValueError, match=r"--name \.\./mine: use letters"):
        scoreboard.add(run, "../mine", results)
    for flag, given in (("--command", {"command": "x"}), ("--machine", {"machine": "x"})):
        with pytest.raises(ValueError, match=rf"{flag}: .*run.json says it"):
            scoreboard.add(run, "again", results, **given)
    run_file.write(run, [])
    with pytest.raises(ValueError, match="--command: No closing quotation"):
        scoreboard.add(run, "again", tmp_path / "others", command="tdanet 'train")
    assert [path.name for path in results.iterdir()] == ["mine"]


def test_seeds_are_one_line_and_curves_are_drawn(run: Path, tmp_path: Path) -> None:
    results, page = tmp_path / "results", tmp_path / "docs" / "page.md"
    shutil.copytree(RESULTS / "18-4-random", results / "18-4-random")
    for seed in (7, 8):
        edit(run / "results.json", seed=seed)
        edit(run / "config.json", seed=seed, checkpoint_minutes=seed, word_vectors=None)
        content = json.loads((run / "results.json").read_text())
        content["seen"]["L>=1"]["SR"] = 10.0 * seed
        edit(run / "results.json", seen=content["seen"])
        scoreboard.add(run, f"mine-{seed}", results)
    (tmp_path / "README.md").touch()
    page.parent.mkdir()
    page.write_text("a\n<!-- scoreboard: 18/4 -->\nold\n<!-- end -->\nb\n")
    written = scoreboard_page.write(tmp_path, scoreboard.rows(results))
    picture = tmp_path / "docs" / "scoreboard-18-4.png"
    assert written == [page, picture]
    assert imread(picture).std() > 0.01
    text = page.read_text()
    assert text.startswith("a\n<!-- scoreboard: 18/4 -->\n\n| Agent |")
    assert text.endswith("|\n\n<!-- end -->\nb\n")
    assert "old" not in text
    agents = [line for line in text.splitlines() if line.startswith("| <code>")]
    senses = "odometry, robust-triangulation, scores"
    cells = f"| <code>tdanet --preset robust</code> | {senses} | 7, 8 | 12.0 M | 6.0 | 75.0 ± 7.1 |"
    assert agents[0].startswith(cells)
    assert agents[1].startswith("| <code>random</code> | none |  |  |  | 10.5 |")
    assert "| TDANet (paper) |  |  |  |  | 74.7 | 29.7 | - | 62.9 |" in text
    assert "| `results/mine-8` | 6.00 | EPYC, 2 cores | abc | <code>tdanet train" in text


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<!-- scoreboard: 18/4 -->\n| a |\n", "has no <!-- end -->"),
        (
            "<!-- scoreboard: 18/4 -->\n<!-- scoreboard: 22/0 -->\n<!-- end -->\n",
            "<!-- scoreboard: 18/4 --> has no <!-- end -->",
        ),
        ("<!-- scoreboard: 18-4-random nobody -->\n<!-- end -->\n", "no row nobody"),
    ],
)
def test_a_wrong_block_is_named(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=f"^page.md: .*{message}"):
        scoreboard_page.filled(Path("page.md"), text, scoreboard.rows(RESULTS))


def test_the_tool_as_it_is_typed(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(tool, "ROOT", tmp_path)
    monkeypatch.setattr(tool, "RESULTS", tmp_path / "results")
    with pytest.raises(SystemExit):
        tool.main(["write"])
    assert "belongs to a clone" in capsys.readouterr().err
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("<!-- scoreboard: mine -->\n<!-- end -->\n")
    tool.main(["add", str(run), "--name", "mine"])
    tool.main(["write"])
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("wrote results/mine")
    assert said[1:] == ["wrote README.md", "wrote docs/scoreboard-18-4.png"]
    readme = (tmp_path / "README.md").read_text()
    assert "| `results/mine` | 91.6 (88.6 to 94.3) | 51.6 (49.0 to 54.3) | 87.0 (" in readme
    with pytest.raises(SystemExit):
        tool.main(["add", str(run), "--name", "mine"])
    assert re.fullmatch(r"error: --name mine: .* exists\n", capsys.readouterr().err)
