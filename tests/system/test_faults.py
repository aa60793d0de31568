"""What goes wrong around a training run, from the command that a user types.

Disks are filled by the system's own limit on the size of files: writes fail as on a full disk.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import resource
import shlex
import shutil
import signal
import struct
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tdanet_jax.commands import evaluate as evaluating
from tdanet_jax.commands import train_zero_shot
from tdanet_jax.evaluation import rollout
from tdanet_jax.io import assets, files
from tdanet_jax.scenes import cache
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.training.journal import METRICS_FILE, Journal, read_metrics, tensorboard_sink
from tdanet_jax.training.run import Run
from tdanet_jax.workflows import train as training
from tests.support import command
from tests.training.test_checkpoint import flip, halve

#: Three chunks, a checkpoint after each.
SHORT = ("--split", "14/8", "--steps", "1200", "--checkpoint-minutes", "1e-6", *command.TINY)


@contextlib.contextmanager
def full_disk(size: int) -> Iterator[None]:
    """Inside, no file of this process grows beyond `size` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def ends(*arguments: str | Path) -> int | str | None:
    """The exit status of the training command; None if it runs to its end."""
    try:
        train_zero_shot.main(list(map(str, arguments)))
    except SystemExit as stopped:
        return stopped.code
    return None


def said_error(capsys: pytest.CaptureFixture[str]) -> str:
    """The one line on standard error."""
    [line] = capsys.readouterr().err.splitlines()
    return line


def assert_trained(out: Path) -> None:
    """All rows and checkpoints are there, and nothing half-written."""
    assert [row["steps"] for row in read_metrics(out)] == [400, 800, 1200]
    assert Checkpoints(out).latest() == 30
    assert not list(out.rglob(f"{files.PARTIAL}*"))


@pytest.fixture
def own_assets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the bundled files that the commands read in place of them."""
    copy = tmp_path / "assets"
    shutil.copytree(assets.folder(), copy)
    monkeypatch.setattr(assets, "folder", lambda: copy)
    assets.path.cache_clear()
    yield copy
    assets.path.cache_clear()


DAMAGES = (flip, halve, Path.unlink)


@pytest.mark.usefixtures("ithor")  # the rooms are there: no line about waiting for them
@pytest.mark.parametrize(
    ("name", "damage"),
    [
        *itertools.product(["ithor.npz", "words.npz", "checksums.json"], DAMAGES),
        ("episodes.npz", flip),
        # After a start of the command in full.
        *(pytest.param("episodes.npz", how, marks=pytest.mark.slow) for how in DAMAGES[1:]),
    ],
)
def test_a_damaged_asset_is_one_line_and_nothing_is_written(
    own_assets: Path, capsys: pytest.CaptureFixture[str], name: str, damage: Callable[[Path], None]
) -> None:
    damage(own_assets / name)
    out = own_assets.parent / "run"
    assert ends(*SHORT, "--out", out) == 2
    assert name in said_error(capsys)
    assert not out.exists()


@pytest.mark.parametrize(
    ("updates", "left"),
    [(0, "there is no other"), pytest.param(20, "the one before it is 10", marks=pytest.mark.slow)],
)
def test_a_disk_that_is_full_stops_the_run_before_it_loses_anything(
    ithor: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    updates: int,
    left: str,
) -> None:
    """At 0 updates: who cannot save learns it before training."""
    out = tmp_path / "run"
    save = Checkpoints.save

    def save_in_full(self: Checkpoints, state: Any, meta: dict[str, Any]) -> None:
        with full_disk(5_000 if int(state.updates) == updates else 10_000_000):
            save(self, state, meta)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "save", save_in_full)
        assert ends(*SHORT, "--out", out) == 2
    line = said_error(capsys)
    assert line.startswith(f"error: {out}/checkpoints/{updates}: checkpoint not written (")
    assert line.endswith(f"; {left}")
    assert (out / METRICS_FILE).exists() == (updates > 0)
    if updates:
        monkeypatch.setattr(training, "_report", lambda *_: None)  # to save time
        assert ends("--resume", out) is None
        assert_trained(out)


@pytest.mark.slow  # the fast form is in tests/training/test_run.py
def test_an_update_that_is_not_finite_stops_the_run_with_its_state(
    ithor: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "run"
    diverging = ("--learning-rate", "1e30", "--max-skipped", "5")
    assert ends(*SHORT, *diverging, "--out", out) == 2
    captured = capsys.readouterr()
    assert "updates skipped because the loss or gradient was not finite" in captured.err
    assert "; the state is saved as checkpoint " in captured.err
    assert len(captured.err.splitlines()) == 1
    [*_, last] = read_metrics(out)
    assert last["skipped"] >= 5
    assert Checkpoints(out).snapshot().updates == last["updates"]
    assert not (out / "results.json").exists()


#: What is being called when a signal comes, one after the other, and how the last line begins.
PHASES: tuple[tuple[Any, str, str], ...] = (
    (training, "load_task", "stopped; the run had not begun"),
    (Run, "_begin", "stopped; the run had not begun"),
    (Run, "_compile", "stopped; 10 updates are saved; continue with: "),
    (Checkpoints, "save", "stopped; 20 updates are saved; continue with: "),
    (rollout, "evaluate_lists", "stopped; 30 updates are saved; continue with: "),
)


@pytest.mark.slow
def test_a_signal_in_any_phase_ends_in_one_line_and_the_run_goes_on(
    ithor: Any,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "run"
    for number, (place, name, message) in enumerate(PHASES):
        sent = (signal.SIGTERM, signal.SIGINT)[number % 2]
        original = getattr(place, name)

        def struck(*args: Any, call: Any = original, sent: int = sent, **options: Any) -> Any:
            os.kill(os.getpid(), sent)
            return call(*args, **options)

        with monkeypatch.context() as patch:
            patch.setattr(place, name, struck)
            begun = (out / "config.json").exists()
            again = ("--resume", out) if begun else (*SHORT, "--out", out)
            assert ends(*again) == 128 + sent
        captured = capsys.readouterr()
        assert captured.err == ""
        assert captured.out.splitlines()[-1].startswith(message)
        assert out.exists() == ("saved" in message)
    assert ends("--resume", out) is None
    assert_trained(out)
    assert json.loads((out / "results.json").read_text())["steps"] == 1200


#: Sends a signal when a module is about to be imported, and tells at the end what was imported.
STRIKER = """
import atexit, os, sys

class Striker:
    def find_spec(self, name, *_):
        if name == {name!r}:
            atexit.register(lambda: print({name!r} in sys.modules))
            os.kill(os.getpid(), {sent})

sys.meta_path.insert(0, Striker())
"""


@pytest.mark.usefixtures("ithor")  # the rooms are there: no line about computing them
@pytest.mark.parametrize(
    ("module", "arguments", "name", "sent"),
    [
        ("train_zero_shot", (*SHORT, "--out"), "jax.numpy", signal.SIGINT),
        pytest.param(
            "evaluate",
            ("--policy", "random", "--out"),
            "jax.numpy",
            signal.SIGTERM,
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "scenes",
            ("inspect", "FloorPlan1", "--out"),
            "matplotlib.figure",
            signal.SIGINT,
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_signal_waits_until_a_library_is_loaded(
    tmp_path: Path, module: str, arguments: tuple[str, ...], name: str, sent: int
) -> None:
    """An import that is broken off may end in a traceback, or in a crash of the process.

    The command is stopped soon after the import, but how far it has come by then is up to the
    machine: training may have begun, and then it is saved and says more.
    """
    (tmp_path / "sitecustomize.py").write_text(STRIKER.format(name=name, sent=int(sent)))
    path = {"PYTHONPATH": os.pathsep.join((str(tmp_path), os.environ["PYTHONPATH"]))}
    done = command.run(module, *arguments, tmp_path / "out.png", variables=path)
    assert done.returncode == 128 + sent, done.stderr
    *said, loaded = done.stdout.splitlines()
    assert loaded == "True"
    if done.stderr:
        assert done.stderr == "stopped\n"
        assert said in ([], ["playing the episodes ..."])
    else:
        assert [line for line in said if "stop" in line] == said[-1:]
        assert said[-1].startswith("stopped; ")
        assert len(said) == 1 or module == "train_zero_shot"
    begun = bool(said) and said[-1] != "stopped; the run had not begun"
    assert begun or not (tmp_path / "out.png").exists()
    assert not (tmp_path / "out.png" / "results.json").exists()


def test_ctrl_c_ends_a_command_that_has_not_begun_without_a_word(tmp_path: Path) -> None:
    (tmp_path / "sitecustomize.py").write_text(STRIKER.format(name="tyro", sent=2))
    path = {"PYTHONPATH": os.pathsep.join((str(tmp_path), os.environ["PYTHONPATH"]))}
    done = command.run("evaluate", "--help", variables=path)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def in_shell(tmp_path: Path, line: str, name: str, sent: int) -> tuple[int, str, str]:
    """Exit status, output and errors of a shell's line; `name` and `sent` as above."""
    (tmp_path / "sitecustomize.py").write_text(STRIKER.format(name=name, sent=int(sent)))
    path = {"PYTHONPATH": os.pathsep.join((str(tmp_path), os.environ["PYTHONPATH"]))}
    words = ["sh", "-c", line.replace("python", shlex.quote(sys.executable))]
    done = subprocess.run(words, env=os.environ | path, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


def test_a_script_may_ignore_ctrl_c_for_its_commands(tmp_path: Path) -> None:
    """As shells do for what a script starts in the background."""
    line = "trap '' INT; exec python -m experiments.evaluate --help"
    status, said, error = in_shell(tmp_path, line, "tyro", signal.SIGINT)
    assert (status, error) == (0, "")
    assert "--policy" in said


def test_a_command_without_standard_output_is_stopped_in_one_line(tmp_path: Path) -> None:
    line = f"exec python -m experiments.evaluate --policy random --out {tmp_path / 'out'} >&-"
    done = in_shell(tmp_path, line, "jax.numpy", signal.SIGTERM)
    assert done == (128 + signal.SIGTERM, "", "stopped\n")


@pytest.mark.parametrize("sent", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_ends_any_command_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, sent: int
) -> None:
    monkeypatch.setattr(evaluating, "play", lambda *_: os.kill(os.getpid(), sent))
    with pytest.raises(SystemExit) as stopped:
        evaluating.main(["--policy", "random", "--out", str(tmp_path / "out")])
    assert stopped.value.code == 128 + sent
    assert said_error(capsys) == "stopped"


def row(number: int) -> dict[str, Any]:
    return {"updates": number, "steps": 40 * number, "episodes": number, "success": 0.5}


def test_rows_that_cannot_be_written_wait_and_come_in_order(tmp_path: Path) -> None:
    journal = Journal(tmp_path / METRICS_FILE, 0)
    journal.write(row(1))
    size = journal.path.stat().st_size
    with warnings.catch_warnings(record=True) as caught, full_disk(size + 10):
        journal.write(row(2))
        journal.write(row(3))
    [warning] = caught
    assert "metrics.jsonl: cannot be written" in str(warning.message)
    assert read_metrics(tmp_path) == [row(1)]  # and a line cut short
    journal.write(row(4))
    assert read_metrics(tmp_path) == [row(n) for n in (1, 2, 3, 4)]
    assert len(journal.path.read_text().splitlines()) == 4


def test_a_damaged_row_costs_no_other(tmp_path: Path) -> None:
    path = tmp_path / METRICS_FILE
    lines = [json.dumps(row(n)).encode() + b"\n" for n in range(4)]
    lines[1] = b'\xff{"updates": 1\n'
    path.write_bytes(b"".join(lines) + b'{"updates": 4, "st')
    assert read_metrics(tmp_path) == [row(0), row(2), row(3)]
    Journal(path, 2).write(row(3))
    assert [json.loads(line) for line in path.read_text().splitlines()] == [row(0), row(2), row(3)]


def events(folder: Path) -> list[tuple[int, str, float]]:
    """Step, name and value of every event: TFRecord's length and two checksums around each."""
    from tensorboardX.proto.event_pb2 import Event

    [path] = folder.iterdir()
    content, at, found = path.read_bytes(), 0, []
    while at < len(content):
        (length,) = struct.unpack("<Q", content[at : at + 8])
        event = Event.FromString(content[at + 12 : at + 12 + length])
        found += [(event.step, v.tag, v.simple_value) for v in event.summary.value]
        at += length + 16
    return found


def test_tensorboard_gets_every_figure(tmp_path: Path) -> None:
    sink = tensorboard_sink(tmp_path)
    sink(row(1))
    sink(row(2))
    found = events(tmp_path / "tensorboard")
    assert found == [
        (40, "train/updates", 1.0), (40, "train/episodes", 1.0), (40, "train/success", 0.5),
        (80, "train/updates", 2.0), (80, "train/episodes", 2.0), (80, "train/success", 0.5),
    ]  # fmt: skip


def test_training_goes_on_without_tensorboard(tmp_path: Path) -> None:
    sink = tensorboard_sink(tmp_path)
    with warnings.catch_warnings(record=True) as caught:
        sink(row(1))
        with full_disk(300):
            for number in range(2, 40):  # more than any queue would hold
                sink(row(number))
    [warning] = caught
    assert "tensorboard: given up" in str(warning.message)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 200 kB of its own."""
    if os.geteuid() != 0:
        pytest.skip("only root can mount")
    mount = ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(tmp_path)]
    if subprocess.run(mount, check=False, capture_output=True).returncode:
        pytest.skip("this machine mounts nothing")
    yield tmp_path
    subprocess.run(["umount", "--lazy", str(tmp_path)], check=True)


@pytest.mark.slow
def test_a_disk_that_is_really_full_and_one_that_is_read_only(small_disk: Path) -> None:
    out = small_disk / "run"
    done = command.run("train_zero_shot", *SHORT, "--out", out)
    assert done.returncode == 2
    assert "checkpoint not written" in done.stderr
    assert "No space left" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    for arguments in (("--resume", out), (*SHORT, "--out", small_disk / "other")):
        done = command.run("train_zero_shot", *arguments)
        assert done.returncode == 2
        assert "Read-only file system" in done.stderr
        assert len(done.stderr.splitlines()) == 1


@pytest.mark.slow
def test_damaged_compiled_programs_are_compiled_again(ithor, tmp_path: Path) -> None:
    home = tmp_path / "cache"
    said = []
    for name in ("sound", "damaged"):
        variables = {cache.VARIABLE: str(home)}
        done = command.run("train_zero_shot", *SHORT, "--out", tmp_path / name, variables=variables)
        assert done.returncode == 0, done.stderr
        said.append(done.stderr.splitlines())
        programs = list((home / "compiled").glob("*-cache"))
        assert programs
        for i, path in enumerate(programs):
            (flip if i % 2 else halve)(path)
    assert said[0] == []
    assert said[1]
    assert all(line.startswith("warning: Error reading") for line in said[1])
    rows = [read_metrics(tmp_path / name) for name in ("sound", "damaged")]
    for row in rows[0] + rows[1]:
        del row["seconds"], row["steps_per_second"]
    assert rows[0] == rows[1]
