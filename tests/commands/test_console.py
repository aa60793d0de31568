"""Progress where there is no terminal: few lines, with the time left. Signals."""

from __future__ import annotations

import contextlib
import importlib
import io
import os
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import pytest
from jax._src import xla_bridge

from tdanet_jax.commands import console, evaluate, running


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """The time in seconds, to be set by the test."""
    now = [1000.0]
    monkeypatch.setattr(console.time, "monotonic", lambda: now[0])
    return now


def test_lines_come_at_most_every_ten_seconds_and_say_what_is_left(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with console.reporter("training") as show:
        for second in range(0, 41, 4):  # 4 seconds and 10 % a report, the first at 0 %
            clock[0] = 1000.0 + second
            show(second / 40, f"SR {second}")
    assert capsys.readouterr().out.splitlines() == [
        "training   0.0 %  SR 0",
        "training  30.0 %  SR 12  0:00:28 left",
        "training  60.0 %  SR 24  0:00:16 left",
        "training  90.0 %  SR 36  0:00:04 left",
        "training 100.0 %  SR 40",
    ]


def test_a_slow_report_is_a_line_each(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with console.reporter("training") as show:
        for report in range(3):
            clock[0] = 1000.0 + 3600 * report
            show(0.25, "")  # no progress: nothing to estimate from
    assert capsys.readouterr().out.splitlines() == ["training  25.0 %"] * 3


def test_a_share_that_falls_starts_again(
    clock: list[float], capsys: pytest.CaptureFixture[str]
) -> None:
    with console.reporter("rooms") as show:
        for phase in (0, 100):
            for second in (0, 20, 40):
                clock[0] = 1000.0 + phase + second
                show(second / 40, "ready")
    assert capsys.readouterr().out.splitlines() == [
        "rooms   0.0 %  ready",
        "rooms  50.0 %  ready  0:00:20 left",
        "rooms 100.0 %  ready",
    ] * 2  # fmt: skip


def test_a_bar_starts_again(clock: list[float], monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = console.PlainConsole(file=io.StringIO(), force_terminal=True, width=120)
    monkeypatch.setattr(console, "console", terminal)
    bars, make = [], console.Progress
    monkeypatch.setattr(
        console, "Progress", lambda *a, **k: bars.append(make(*a, get_time=lambda: clock[0], **k))
        or bars[0],
    )  # fmt: skip
    with console.reporter("rooms") as show:
        for second, share in ((0, 0.0), (10, 0.5), (20, 1.0), (100, 0.0), (110, 0.25), (120, 0.5)):
            clock[0] = 1000.0 + second
            show(share, "")
        assert bars[0].tasks[0].time_remaining == 20


def strike() -> None:
    os.kill(os.getpid(), signal.SIGTERM)


class Struck:
    """A signal comes when it is collected, where Python drops whatever is raised."""

    def __del__(self) -> None:
        strike()


def drop() -> None:
    """As a library that drops what is raised below it."""
    with contextlib.suppress(BaseException):
        strike()


def drop_in_a_thread() -> None:
    """As a library that keeps what is raised below it until a thread of its own is done."""
    kept: list[BaseException] = []
    try:
        strike()
    except BaseException as error:
        kept.append(error)
    thread = threading.Thread(target=kept.clear)
    thread.start()
    thread.join()


def status(body: Callable[[], object], seconds: float = 60.0) -> int | str | None:
    """The exit status of a command that waits after `body`; None if it runs to its end."""
    try:
        with console.one_line_errors():
            body()
            time.sleep(seconds)
    except SystemExit as stopped:
        return stopped.code
    return None


@pytest.fixture
def module(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Imports a module of the given text."""
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr("sys.dont_write_bytecode", True)

    def load(text: str) -> None:
        name = f"written_by_{tmp_path.name}"
        (tmp_path / f"{name}.py").write_text(text)
        importlib.invalidate_caches()
        monkeypatch.delitem(importlib.sys.modules, name, raising=False)
        importlib.import_module(name)

    return load


@pytest.fixture
def heard() -> Iterator[list[int]]:
    """The signals that came to somebody else's handlers."""
    numbers: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: numbers.append(number))
        for number in (signal.SIGTERM, signal.SIGALRM)
    }
    yield numbers
    signal.setitimer(signal.ITIMER_REAL, 0)
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("dropped", [Struck, drop, drop_in_a_thread])
def test_a_stop_that_is_dropped_comes_again(
    dropped: Callable[[], object], capsys: pytest.CaptureFixture[str]
) -> None:
    assert status(dropped) == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "stopped\n"


STRIKE = "from tests.commands.test_console import status, strike\n"


def test_a_signal_waits_for_an_import_but_a_second_one_does_not(
    module: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    text = STRIKE + "strike()\nimport time; time.sleep(0.2)\nprint('once')\n"
    assert status(lambda: module(text)) == 128 + signal.SIGTERM
    assert capsys.readouterr() == ("once\n", "stopped\n")
    assert status(lambda: module(text + "strike()\nprint('twice')")) == 128 + signal.SIGTERM
    assert capsys.readouterr() == ("once\n", "stopped\n")


def test_a_signal_waits_until_jax_has_started_a_device(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def make(*_: object) -> None:
        strike()
        time.sleep(0.2)
        print("started")

    monkeypatch.setattr(xla_bridge, "make_tpu_client", make)
    # The function starts a thread that the program waits for, unless it is left in good order.
    assert status(lambda: xla_bridge.tpu_client_timer_callback(60.0)) == 128 + signal.SIGTERM
    assert capsys.readouterr() == ("started\n", "stopped\n")
    assert not any(isinstance(thread, threading.Timer) for thread in threading.enumerate())


def test_a_command_that_an_imported_script_calls_is_stopped(
    module: Callable[[str], None], capsys: pytest.CaptureFixture[str]
) -> None:
    module(STRIKE + "print(status(strike))")
    assert capsys.readouterr() == (f"{128 + signal.SIGTERM}\n", "stopped\n")


def test_what_waits_at_the_end_goes_to_whoever_had_the_signals(
    module: Callable[[str], None], heard: list[int]
) -> None:
    handlers = [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGALRM)]
    assert status(lambda: module(STRIKE + "strike()"), seconds=0.0) is None
    assert heard == [signal.SIGTERM]
    assert signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert handlers == [signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGALRM)]


def test_somebody_elses_alarm_rings(heard: list[int]) -> None:
    assert status(lambda: signal.setitimer(signal.ITIMER_REAL, 0.05), seconds=0.1) is None
    assert heard == [signal.SIGALRM]


def test_a_signal_that_is_ignored_stays_so() -> None:
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert status(lambda: signal.raise_signal(signal.SIGINT), seconds=0.0) is None
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_command_runs_in_a_thread(capsys: pytest.CaptureFixture[str]) -> None:
    with ThreadPoolExecutor() as pool:
        error = pool.submit(
            evaluate.main, ["--policy", "random", "--checkpoint", "run"]
        ).exception()
    assert isinstance(error, SystemExit)
    assert error.code == 2
    assert capsys.readouterr().err == "error: --policy random takes no --checkpoint\n"


def test_names_from_files_are_printed_as_they_are(capsys: pytest.CaptureFixture[str]) -> None:
    """No markup, no escape sequences, and one line for an error or a warning."""
    console.console.print("[/x] [red]a[/red]\x1b[2J")
    with console.reporter("[/y]") as show:
        show(0.5, "[/z]\x07")
    assert capsys.readouterr().out == "[/x] [red]a[/red]?[2J\n[/y]  50.0 %  [/z]?\n"
    with console.one_line_errors():
        warnings.warn("[/x]\x1b[2J\nwarning: more", stacklevel=1)
    with pytest.raises(SystemExit), console.one_line_errors():
        raise ValueError("[/x]\x1b[2J\nerror: more")
    assert capsys.readouterr().err == (
        "warning: [/x]?[2J warning: more\nerror: [/x]?[2J error: more\n"
    )


@pytest.mark.parametrize(
    ("advice", "said"),
    [
        ("", "error: out of memory: allocating 40 bytes\n"),
        ("fewer --num-envs", "error: out of memory: allocating 40 bytes; fewer --num-envs\n"),
    ],
)
def test_memory_that_does_not_suffice_is_one_line(
    advice: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    text = "RESOURCE_EXHAUSTED: Out of memory allocating 40 bytes.\nA list of buffers"
    with pytest.raises(SystemExit), console.one_line_errors(advice):
        raise jax.errors.JaxRuntimeError(text)
    assert capsys.readouterr().err == said
    for other in (jax.errors.JaxRuntimeError("INTERNAL: a fault"), RuntimeError(text)):
        with pytest.raises(RuntimeError), console.one_line_errors(advice):
            raise other


@pytest.mark.parametrize(("width", "bar"), [(80, False), (120, True)])
def test_the_progress_of_training_fits_a_line(
    width: int, bar: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = io.StringIO()
    terminal = console.PlainConsole(file=written, force_terminal=True, width=width)
    monkeypatch.setattr(console, "console", terminal)
    figures = running.figures_of(
        {
            "steps_per_second": 18_428.0,
            "success": 0.891,
            "spl": 0.472,
            "entropy": 0.27,
            "skipped": 0,
        }
    )
    with console.reporter("training") as show:
        show(0.998, figures)
    last = written.getvalue().rstrip("\x1b[?25h\n").splitlines()[-1]
    assert " ".join(figures.split()) in last  # nothing is cut off
    assert ("━" in last) == bar


def test_a_bar_shows_names_as_they_are(monkeypatch: pytest.MonkeyPatch) -> None:
    written = io.StringIO()
    terminal = console.PlainConsole(
        file=written, force_terminal=True, highlight=False, markup=False, width=120
    )
    monkeypatch.setattr(console, "console", terminal)
    with console.reporter("rooms") as show:
        show(1.0, "[/z]\x07")
        terminal.print("[/x]\x1b]0;title\x07")
    assert "[/z]?" in written.getvalue()
    assert "[/x]?]0;title?" in written.getvalue()
    assert "\x07" not in written.getvalue()
