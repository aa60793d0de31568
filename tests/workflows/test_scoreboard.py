"""The scoreboard: its rows agree with their episodes, its pages with its rows."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from matplotlib.image import imread

from tdanet_jax.analysis import figures
from tdanet_jax.config import BEST, PRESETS, ROBUST, to_json
from tdanet_jax.tools import scoreboard as tool
from tdanet_jax.training import run_file
from tdanet_jax.training.run_file import Process
from tdanet_jax.workflows import scoreboard, scoreboard_page

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
NAMES = [
    path.parent.relative_to(RESULTS).as_posix()
    for kind in ("*", "validation/*")
    for path in sorted(RESULTS.glob(f"{kind}/results.json"))
]
#: Rows whose actions every run of the tests takes again, which needs up to ten seconds a row.
REPLAYED = ("18-4-best-0", "22-0-shortest-path")
COMMAND = "tdanet train --split 18/4 --seed 7 --out /home/me/runs/x --word-vectors=/home/me/w.txt"


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """The pages and pictures of the documentation, to be changed."""
    shutil.copytree(ROOT / "docs", tmp_path / "docs")
    shutil.copy(ROOT / "README.md", tmp_path)
    return tmp_path


def test_the_pages_are_those_that_write_makes(clone: Path) -> None:
    """After a change of results/: python -m tdanet_jax.tools.scoreboard write."""
    rows = scoreboard.rows(RESULTS)
    assert [row.name for row in rows] == NAMES
    pages = scoreboard_page.pages(clone, rows)
    assert {path.name for path in pages} >= {"scoreboard.md", "results.md"}
    assert scoreboard_page.write(clone, rows) == []


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.slow] * (name not in REPLAYED)) for name in NAMES],
)
def test_a_row_agrees_with_its_own_episodes(name: str) -> None:
    scoreboard.check(RESULTS / name, scoreboard.read(RESULTS / name, name))


@pytest.mark.parametrize("name", NAMES)
def test_a_row_says_how_it_was_made_and_names_nobody(name: str) -> None:
    processes = run_file.read(RESULTS / name)
    assert processes
    assert all(process.command for process in processes)
    for file in ("run.json", "config.json", "results.json"):
        if (RESULTS / name / file).exists():
            assert not re.search(r'["= ](/|~|[A-Z]:\\)', (RESULTS / name / file).read_text()), file


def test_a_changed_figure_changes_the_pages(clone: Path) -> None:
    rows = scoreboard.rows(RESULTS)
    (changed,) = (row for row in rows if row.name == "18-4-random")
    changed.results["unseen"]["L>=1"]["SR"] += 1.0  # type: ignore[index]
    written = scoreboard_page.write(clone, rows)
    assert {path.name for path in written} == {"results.md", "scoreboard.md"}
    for path in written:
        before = (ROOT / path.relative_to(clone)).read_text().splitlines()
        after = path.read_text().splitlines()
        differing = [new for old, new in zip(before, after, strict=True) if old != new]
        assert differing
        assert all("random" in line for line in differing)


def test_pictures_are_those_of_their_rows(clone: Path) -> None:
    rows, picture = scoreboard.rows(RESULTS), clone / "docs" / "scoreboard-18-4.png"
    (learned,) = (row for row in rows if row.name == "18-4-robust-1")
    learned.metrics[-1]["success"] -= 0.1
    before = picture.read_bytes()
    assert scoreboard_page.write(clone, rows) == [picture]
    assert picture.read_bytes() != before
    assert scoreboard_page.write(clone, rows) == []
    rows = [dataclasses.replace(row, metrics=[]) for row in rows]
    assert picture in scoreboard_page.write(clone, rows)
    assert not picture.exists()


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A finished run of its own seed, with word vectors and a learning curve."""
    folder = tmp_path / "run"
    shutil.copytree(RESULTS / "18-4-robust-0", folder)
    edit(folder / "results.json", seed=7, evaluation_seed=7)
    learner = to_json(ROBUST)["learner"]  # the row's has another number of environments
    edit(folder / "config.json", seed=7, word_vectors="/home/me/w.txt", learner=learner)
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
            "results.json: Not the official test: at most 50 episodes",
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
        (
            ("results.json", {"commit": "abc-dirty"}),
            "run: made with changes that are not committed, abc-dirty",
        ),
        (("results.json", {"unseen": None}), "results.json: unseen: not what the episodes give"),
        (("results.json", {"by_target": {}}), "results.json: by_target: not what the episodes"),
        (("results.json", {"actions": {}}), "results.json: actions: not what the episodes give"),
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


def without(episode: dict[str, Any], name: str) -> dict[str, Any]:
    return {key: value for key, value in episode.items() if key != name}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda e: e[:5], "episodes.jsonl: not the 2,000 test episodes of 18/4"),
        (lambda e: [*e, e[-1]], "episodes.jsonl: not the 2,000 test episodes of 18/4"),
        (lambda e: [e[1], e[0], *e[2:]], "line 1: not what these actions do in this episode"),
        (lambda e: [e[0] | {"success": False}, *e[1:]], "line 1: not what these actions do"),
        (lambda e: [e[0] | {"actions": ["Done"]}, *e[1:]], "line 1: not what these actions do"),
        (lambda e: [e[0] | {"actions": ["RotateLeft"]}, *e[1:]], "line 1: not what these actions"),
        (lambda e: [e[0] | {"actions": ["Done"] * 999}, *e[1:]], "line 1: not what these actions"),
        (lambda e: [without(e[0], "actions"), *e[1:]], "line 1: actions is not a list"),
        (
            lambda e: [e[0] | {"actions": ["Done"], "e": 1, "success": False}, *e[1:]],
            "results.json: seen: not what the episodes give",
        ),
    ],
)
def test_episodes_that_are_not_the_official_ones_are_refused(
    run: Path, tmp_path: Path, change: Callable[[list[dict[str, Any]]], list[Any]], message: str
) -> None:
    path = run / "episodes.jsonl"
    episodes = change([json.loads(line) for line in path.read_text().splitlines()])
    path.write_text("".join(json.dumps(episode) + "\n" for episode in episodes))
    with pytest.raises(ValueError, match=re.escape(message)) as error:
        scoreboard.add(run, "mine", tmp_path / "results")
    assert str(error.value).startswith(str(run))
    assert "\n" not in str(error.value)
    assert not (tmp_path / "results").exists()


def test_code_that_was_not_committed_is_refused(run: Path, tmp_path: Path) -> None:
    run_file.add(run, Process(command="tdanet train --resume x", commit="abd-dirty"))
    with pytest.raises(ValueError, match="run: made with changes that are not committed, abd-dirt"):
        scoreboard.add(run, "mine", tmp_path / "results")


@pytest.mark.parametrize(
    ("words", "kept"),
    [
        (["tdanet", "train", "--out", "~/runs/x", "--data=../me/x"], "--out x --data=x"),
        (["tdanet", "train", "--out=~me", "--data", "a/../me/x"], "--out= --data x"),
        (["tdanet", "train", "--word-vectors", "/home/A B/w.txt"], "--word-vectors w.txt"),
        (["tdanet", "train", "--per-model", "a: --data=/me/x"], "--per-model 'a: --data=x'"),
        (["tdanet", "train", "--split", "18/4", "--out", "a/b..c"], "--split 18/4 --out a/b..c"),
        (["/home/me/bin/tdanet", "train", "--x", "a;b"], "--x 'a;b'"),
    ],
)
def test_a_recorded_command_names_no_folder_of_its_owner(
    run: Path, tmp_path: Path, words: list[str], kept: str
) -> None:
    run_file.write(run, [Process(command=shlex.join(words))])
    out = scoreboard.add(run, "mine", tmp_path / "results")
    (process,) = run_file.read(out)
    assert process.command == f"tdanet train {kept}"


def test_a_command_that_is_given_is_a_plain_one(run: Path, tmp_path: Path) -> None:
    (run / "run.json").unlink()
    for number, sign in enumerate(["&", ";", "|", "$", "~", "<", ">", "`", "\n", "*", "\\"]):
        with pytest.raises(ValueError, match=r"^--command: give one plain command, ") as no:
            scoreboard.add(run, f"{number}", tmp_path / "results", f"tdanet train {sign} x")
        assert "\n" not in str(no.value)
    command = "PYTHONPATH=/home/me/code:../me/x tdanet train --out='/home/me/a b' --seed 7"
    out = scoreboard.add(run, "mine", tmp_path / "results", command)
    (process,) = run_file.read(out)
    assert process.command == "PYTHONPATH=code:x tdanet train '--out=a b' --seed 7"


def test_a_policy_of_ones_own_is_an_agent_of_its_own(run: Path, tmp_path: Path) -> None:
    for name in ("config.json", "metrics.jsonl", "run.json"):
        (run / name).unlink()
    edit(run / "results.json", model="custom", policy="custom", steps=0, sensors=[], commit="abc")
    with pytest.raises(ValueError, match="give --command"):
        scoreboard.add(run, "18-4-mine", tmp_path / "results")
    for name in ("18-4-mine", "18-4-theirs"):
        scoreboard.add(run, name, tmp_path / "results", "python own.py", "EPYC")
    lines = scoreboard_page.of_split("18/4", scoreboard.rows(tmp_path / "results"))
    agents = [line for line in lines if line.startswith("| 18-4-")]
    assert agents[0].startswith("| 18-4-mine |  |  |  |  | 91.6 |")
    assert agents[1].startswith("| 18-4-theirs |  |  |  |  | 91.6 |")
    assert "| `results/18-4-mine` |  | EPYC | abc | <code>python own.py</code> |" in lines


@pytest.fixture
def of_validation(run: Path) -> Path:
    """A finished run with --validation in generated rooms alone."""
    edit(run / "results.json", split="18/4-validation")
    rooms = {"validation": True, "generated": 1000, "generated_only": True}
    edit(run / "config.json", **rooms, steps=3_000_000, word_vectors=None)
    (run / "episodes.jsonl").unlink()
    return run


def test_runs_for_choosing_settings_stand_apart(of_validation: Path, tmp_path: Path) -> None:
    run, results = of_validation, tmp_path / "results"
    shutil.copytree(RESULTS / "18-4-random", results / "18-4-random")
    with pytest.raises(ValueError, match=r"split 18/4-validation: call the row validation/NAME"):
        scoreboard.add(run, "mine", results)
    with pytest.raises(ValueError, match="--name validation: is the folder of runs with"):
        scoreboard.add(run, "validation", results)
    with pytest.raises(ValueError, match=r"--name validation/\.\./x: letters"):
        scoreboard.add(run, "validation/../x", results)
    out = scoreboard.add(run, "validation/rooms-generated-7", results)
    assert out == results / "validation" / "rooms-generated-7"
    with pytest.raises(ValueError, match="validation/rooms-generated-7 has this agent with this"):
        scoreboard.add(run, "validation/again", results)
    edit(run / "results.json", seed=8)
    edit(run / "config.json", seed=8)
    scoreboard.add(run, "validation/rooms-generated-8", results)
    edit(run / "results.json", split="18/4")
    with pytest.raises(ValueError, match="split 18/4: call the row NAME"):
        scoreboard.add(run, "validation/test", results)
    rows = scoreboard.rows(results)
    assert [row.name for row in rows] == [
        "18-4-random", "validation/rooms-generated-7", "validation/rooms-generated-8"
    ]  # fmt: skip
    # Nothing of them is on the scoreboard of the test.
    assert not any("generated" in line for line in scoreboard_page.of_split("18/4", rows))
    text = scoreboard_page.filled(
        Path("page.md"), "<!-- scoreboard: validation/rooms-* -->\n<!-- end -->\n", rows
    )
    flags = "--preset robust --steps 3000000 --validation --generated 1000 --generated-only"
    (line,) = (line for line in text.splitlines() if "--generated" in line)
    assert line.startswith(f"| tdanet <code>{flags}")
    assert line.endswith(
        "| 7, 8 | 12.0 M | 6.00 | 91.6 ± 0.0 | 51.6 ± 0.0 | 87.0 ± 0.0 | 54.2 ± 0.0 |"
    )
    both = "<!-- scoreboard: validation/rooms-* 18-4-random -->\n<!-- end -->\n"
    lines = scoreboard_page.filled(Path("page.md"), both, rows).splitlines()
    agents = [line.split(" |")[0] for line in lines[4:-2]]
    assert agents == [f"| tdanet <code>{flags}</code>", "| random"]
    with pytest.raises(ValueError, match=r"no row validation/no-\*"):
        scoreboard_page.filled(
            Path("page.md"), "<!-- scoreboard: validation/no-* -->\n<!-- end -->\n", rows
        )
    one = "<!-- scoreboard: 18-4-rando? -->\n<!-- end -->\n"
    assert "| random |" in scoreboard_page.filled(Path("page.md"), one, rows)


def test_a_table_of_agents_gives_the_flags_that_all_share_once() -> None:
    first = scoreboard.read(RESULTS / "18-4-best-0")
    configs = [
        dataclasses.replace(BEST, steps=9, **own)
        for own in ({"variants": 4}, {}, {"targets": "Mug,Bed", "generated": 10}, {})
    ]
    rows = [dataclasses.replace(first, config=config) for config in configs]
    _, said, _, *lines = scoreboard_page.of_agents(rows)
    assert said == "Each is tdanet <code>--preset best --steps 9</code> with what its row says."
    assert [line.split(" |")[0] for line in lines[2:-1]] == [
        "| <code>--variants 4</code>", "| as it is",
        "| <code>--targets Mug,Bed --generated 10</code>",
    ]  # fmt: skip
    assert [line.split(" |")[1] for line in lines[2:-1]] == [" 0", " 0, 0", " 0"]
    models = [dataclasses.replace(config, model="sp") for config in configs[:1]] + configs[1:2]
    rows_of_models = [dataclasses.replace(first, config=config) for config in models]
    _, said, _, *lines = scoreboard_page.of_agents(rows_of_models)
    assert said == "Each has <code>--preset best --steps 9</code> and what its row says."
    assert [line.split(" |")[0] for line in lines[2:-1]] == [
        "| sp <code>--variants 4</code>", "| tdanet"
    ]  # fmt: skip
    _, *alone = scoreboard_page.of_agents(rows[:1])
    assert alone[2].startswith("| tdanet <code>--preset best --steps 9 --variants 4</code> | 0 |")
    random = scoreboard.read(RESULTS / "18-4-random")
    apart = scoreboard_page.of_agents([rows[1], random])
    assert [line.split(" |")[0] for line in apart[3:-1]] == [
        "| tdanet <code>--preset best --steps 9</code>", "| random"
    ]  # fmt: skip


def test_a_run_for_other_targets_has_the_results_of_its_evaluation(
    of_validation: Path, tmp_path: Path
) -> None:
    results, played = tmp_path / "results", tmp_path / "played"
    shutil.copytree(of_validation, played)
    (played / "config.json").unlink()
    edit(of_validation / "config.json", targets="all")
    edit(of_validation / "results.json", targets="all", data_version="of others")
    edit(played / "results.json", trained_targets="all", commit="0123456789ab")
    with pytest.raises(ValueError, match="of scene tables of others, today's are"):
        scoreboard.add(of_validation, "validation/all", results)
    edit(played / "results.json", seed=8)
    with pytest.raises(ValueError, match=r"played/results.json: seed 8: the run has 7$"):
        scoreboard.add(of_validation, "validation/all", results, evaluation=played)
    edit(played / "results.json", seed=7)
    out = scoreboard.add(of_validation, "validation/all", results, evaluation=played)
    (row,) = scoreboard.rows(results)
    assert (row.results["targets"], row.config and row.config.targets) == ("paper", "all")
    assert row.metrics
    *before, last = run_file.read(out)
    assert [process.commit for process in before] == [
        process.commit for process in run_file.read(of_validation)
    ]
    assert last.command == "tdanet evaluate --checkpoint run --test-targets paper"
    assert last.commit == "0123456789ab"


def test_rooms_and_targets_and_what_they_give_are_drawn(
    of_validation: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    results = tmp_path / "results"
    for name, values in {
        "rooms-generated": {},
        "rooms-real": {"generated": 0, "generated_only": False},
        "rooms-both": {"generated_only": False, "variants": 2},
        "targets-two": {"variants": 0, "targets": "kitchen: Apple,Bread,Mug,Toaster"},
        "targets-all": {"targets": "all"},
    }.items():
        edit(of_validation / "config.json", **values)
        scoreboard.add(of_validation, f"validation/{name}", results)
    drawn: list[Any] = []
    draw = figures.data_curve

    def noted(points: Any, path: Path, mark: str) -> None:
        drawn.append(points)
        draw(points, path, mark)

    monkeypatch.setattr(figures, "data_curve", noted)
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").touch()
    picture = tmp_path / "docs" / "data_curve.png"
    assert scoreboard_page.write(tmp_path, scoreboard.rows(results)) == [picture]
    assert scoreboard_page.write(tmp_path, scoreboard.rows(results)) == []
    (points,) = drawn
    unseen = json.loads((of_validation / "results.json").read_text())["unseen"]["L>=1"]
    # Toaster is unseen in 18/4, and Bread in its validation.
    assert {(what, kind, count) for what, kind, count, _ in points} == {
        ("training rooms", "generated rooms", 1000),
        ("training rooms", "real rooms", 64),
        ("training rooms", "real rooms and variants", 192),
        ("pairs of a room type and a target", "real rooms", 14),
        ("pairs of a room type and a target", "real rooms", 2),
        ("pairs of a room type and a target", "real rooms", 180),
    }
    assert all(found["unseen"] == {m: unseen[m] for m in ("SR", "SPL")} for *_, found in points)
    assert imread(picture).std() > 0.01


def test_an_agent_is_called_by_its_flags() -> None:
    row, paper = scoreboard.read(RESULTS / "18-4-best-0"), PRESETS["paper"]
    assert dataclasses.replace(row, config=BEST).agent == "tdanet --preset best"
    network = dataclasses.replace(BEST.network, triangulation=False, reach_threshold=None)
    own = {"reach_threshold": None, "temperature": 1.0, "done_bias": 0.0}
    for config, agent in (
        (  # nearer to robust, but for the senses
            dataclasses.replace(
                BEST,
                extra_targets=None,
                learner=dataclasses.replace(BEST.learner, imitation_weight=0.0),
                network=dataclasses.replace(BEST.network, **own),
            ),
            "tdanet --preset best --extra-targets None --imitation-weight 0.0 "
            "--reach-threshold None --temperature 1.0 --done-bias 0.0",
        ),
        (
            dataclasses.replace(BEST, network=network),
            "tdanet --preset best --no-triangulation --reach-threshold None",
        ),
        (
            dataclasses.replace(paper, episodes=None, minutes=9.0),
            "tdanet --preset paper --minutes 9.0",
        ),
        (  # 1,500 rooms are one pool, and one more are two
            dataclasses.replace(BEST, generated=1500, pool_updates=9),
            "tdanet --preset best --generated 1500",
        ),
        (
            dataclasses.replace(BEST, generated=1501, pool_updates=9),
            "tdanet --preset best --generated 1501 --pool-updates 9",
        ),
        (
            dataclasses.replace(BEST, variants=19, pool_updates=9),
            "tdanet --preset best --variants 19 --pool-updates 9",
        ),
    ):
        assert dataclasses.replace(row, config=config).agent == agent


def test_names_and_seeds_are_taken_once(run: Path, tmp_path: Path) -> None:
    results = tmp_path / "results"
    scoreboard.add(run, "mine", results)
    with pytest.raises(ValueError, match=r"--name mine: .* exists"):
        scoreboard.add(run, "mine", results)
    with pytest.raises(ValueError, match=r"results/mine has this agent with this seed"):
        scoreboard.add(run, "again", results)
    for name in ("../mine", ".mine", "-mine", "my mine", ""):
        with pytest.raises(ValueError, match=f"^--name {re.escape(name)}: letters, digits and _;"):
            scoreboard.add(run, name, results)
    with pytest.raises(ValueError, match="--name open: is the name of a split"):
        scoreboard.add(run, "open", results)
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
        path = scoreboard.add(run, f"mine-{seed}", results) / "results.json"
        content = json.loads(path.read_text())
        content["seen"]["L>=1"]["SR"] = 10.0 * seed
        edit(path, seen=content["seen"])
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
    agents = [line for line in text.splitlines() if line.startswith(("| tdanet ", "| random "))]
    senses = "odometry, robust-triangulation, scores"
    cells = (
        f"| tdanet <code>--preset robust</code> | {senses} | 7, 8 | 12.0 M | 6.00 | 75.0 ± 7.1 |"
    )
    assert agents[0].startswith(cells)
    assert agents[1].startswith("| random |  |  |  |  | 10.5 |")
    assert "| TDANet (paper) |  |  |  |  | 74.7 | 29.7 | - | 62.9 |" in text
    assert "| `results/mine-8` | 6.00 | EPYC, 2 cores | abc | <code>tdanet train" in text
    (results / "mine-7" / "metrics.jsonl").unlink()  # so that the hours of one seed are unknown
    scoreboard_page.write(tmp_path, scoreboard.rows(results))
    assert f"{senses} | 7, 8 | 12.0 M |  | 75.0 ± 7.1 |" in page.read_text()


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
    tool.main(["write"])
    assert capsys.readouterr().out == "everything is up to date\n"
    readme = (tmp_path / "README.md").read_text()
    assert "| `results/mine` | 91.6 (88.6 to 94.3) | 51.6 (49.0 to 54.3) | 87.0 (" in readme
    with pytest.raises(SystemExit):
        tool.main(["add", str(run), "--name", "mine"])
    assert re.fullmatch(r"error: --name mine: .* exists\n", capsys.readouterr().err)
