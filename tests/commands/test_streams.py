"""Output whose reader has ended, or whose terminal was closed."""

from __future__ import annotations

import errno
import io
import os
import signal
import sys
from collections.abc import Callable, Iterator

import pytest

from tdanet_jax.commands import console, streams
from tests.commands.test_arguments import CASES, main_of


class Broken(io.StringIO):
    """A stream that takes some lines and then fails."""

    def __init__(self, number: int, lines: int = 0) -> None:
        super().__init__()
        self.number, self.left = number, lines

    def write(self, text: str) -> int:
        self._check()
        self.left -= text.count("\n")
        return super().write(text)

    def flush(self) -> None:
        self._check()

    def _check(self) -> None:
        if self.left <= 0:
            raise OSError(self.number, os.strerror(self.number))  # EPIPE: BrokenPipeError


@pytest.fixture(autouse=True)
def own_console(monkeypatch: pytest.MonkeyPatch) -> None:
    """A console that keeps nothing of what could not be written."""
    monkeypatch.setattr(console, "console", console.PlainConsole(soft_wrap=True))


@pytest.fixture
def hang_up() -> Iterator[None]:
    """Puts the handler of SIGHUP back that a failed test may leave."""
    before = signal.getsignal(signal.SIGHUP)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.mark.parametrize("name", CASES)
def test_help_whose_reader_has_ended_ends_without_a_word(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of every command: so all of them read their arguments where errors are one line."""
    monkeypatch.setattr(sys, "stdout", Broken(errno.EPIPE))
    with pytest.raises(SystemExit) as stopped:
        main_of(name)(["--help"])
    assert stopped.value.code == 128 + signal.SIGPIPE
    assert capsys.readouterr().err == ""


def say_plainly() -> None:
    print("a line\na line", flush=True)


def say_on_the_console() -> None:
    console.console.print("a line")
    console.console.print("a line")


@pytest.mark.parametrize("say", [say_plainly, say_on_the_console])
def test_a_command_ends_with_its_reader(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], say: Callable[[], None]
) -> None:
    monkeypatch.setattr(sys, "stdout", Broken(errno.EPIPE, lines=1))
    with pytest.raises(SystemExit) as stopped, console.one_line_errors():
        say()
    assert stopped.value.code == 128 + signal.SIGPIPE
    assert capsys.readouterr().err == ""


def test_another_broken_pipe_is_an_error(capsys: pytest.CaptureFixture[str]) -> None:
    """For example the one to a simulator that has ended."""
    with pytest.raises(SystemExit) as stopped, console.one_line_errors():
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "error: [Errno 32] Broken pipe\n"


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EIO, errno.ENOSPC])
def test_training_goes_on_without_its_output(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    hang_up: None,
    number: int,
) -> None:
    out, done = Broken(number, lines=1), []
    monkeypatch.setattr(sys, "stdout", out)
    with console.one_line_errors():
        with streams.output_may_break():
            for i in range(3):
                console.console.print(f"line {i}")
                os.kill(os.getpid(), signal.SIGHUP)  # as of a terminal that was closed
                done.append(i)
        monkeypatch.setattr(sys, "stdout", sys.__stdout__)
    assert done == [0, 1, 2]
    assert out.getvalue() == "line 0\n"
    [line] = capsys.readouterr().err.splitlines()
    assert line.startswith("warning: output cannot be written (")
    assert line.endswith("); the work goes on without it")


def test_training_goes_on_if_nothing_can_be_written(
    monkeypatch: pytest.MonkeyPatch, hang_up: None
) -> None:
    before = signal.getsignal(signal.SIGHUP)  # ignored under nohup
    monkeypatch.setattr(sys, "stdout", Broken(errno.EIO))
    monkeypatch.setattr(sys, "stderr", Broken(errno.EIO))
    with streams.output_may_break():
        console.console.print("a line")
        print("a warning", file=sys.stderr)
    assert isinstance(sys.stdout, Broken)  # as before
    assert signal.getsignal(signal.SIGHUP) == before
