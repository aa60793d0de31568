"""Progress where there is no terminal: few lines, with the time left. Signals that are dropped."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable

import pytest

from experiments import console


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


class Struck:
    """A signal comes when it is collected, where Python drops whatever is raised."""

    def __del__(self) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


def drop() -> None:
    """As a library that drops what is raised below it."""
    with contextlib.suppress(BaseException):
        os.kill(os.getpid(), signal.SIGTERM)


@pytest.mark.parametrize("dropped", [Struck, drop])
def test_a_stop_that_is_dropped_comes_again(
    dropped: Callable[[], object], capsys: pytest.CaptureFixture[str]
) -> None:
    def command() -> None:
        with console.one_line_errors():
            dropped()
            time.sleep(10)

    with pytest.raises(SystemExit) as stopped:
        command()
    assert stopped.value.code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "stopped\n"
