"""What the commands share at the edge: errors in one line, progress, and stopping on a signal."""

from __future__ import annotations

import contextlib
import datetime
import io
import itertools
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import FrameType
from typing import Any, NoReturn, TypeVar

import tyro
from rich.console import Console
from rich.progress import (
    BarColumn,
    Progress,
    ProgressColumn,
    Task,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.text import Text

import experiments
from tdanet_jax.io.files import LOCK_FILE, PARTIAL
from tdanet_jax.splits import GROUPS

Arguments = TypeVar("Arguments")

#: Without a terminal, progress is a line at most this often.
SECONDS_BETWEEN_LINES = 10.0
#: After which a stop that waits for an import, or was dropped, is tried again.
SECONDS_OF_A_MOMENT = 0.05

console = Console(stderr=False, highlight=False, soft_wrap=True)


def fail(message: object) -> NoReturn:
    """Ends the program with one line on standard error and exit status 2."""
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)


@contextlib.contextmanager
def one_line_usage() -> Iterator[None]:
    """Brings the box that tyro prints about wrong arguments to its first paragraph, in one line."""
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            yield
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [line.strip("│ ") for line in said.getvalue().splitlines()[1:]]  # [0]: a title
        words = itertools.dropwhile(_is_rule, lines)
        fail(" ".join(itertools.takewhile(lambda line: not _is_rule(line), words)))


def _is_rule(line: str) -> bool:
    """Whether a line of tyro's box is one of its horizontal lines."""
    return line.startswith(("─", "---"))


def parse(command: type[Arguments], arguments: Sequence[str] | None, **options: Any) -> Arguments:
    """`tyro.cli`, with errors in one line."""
    with one_line_usage():
        return tyro.cli(command, args=arguments, **options)


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Turns warnings, errors of the user (ValueError, OSError) and signals into one line each."""
    with warnings.catch_warnings(), StopRequest().receiving():
        warnings.showwarning = _show_warning  # type: ignore[assignment]
        try:
            yield
        except OSError as error:
            fail(f"{error.filename}: {error.strerror}" if error.filename else error)
        except ValueError as error:
            fail(error)
        except Stopped as stopped:
            print("stopped", file=sys.stderr)
            stopped.answer()


def _show_warning(message: Warning | str, *_: Any) -> None:
    print(f"warning: {' '.join(str(message).split())}", file=sys.stderr)


def check_empty(folder: Path, instead: str = "") -> None:
    """Fails unless `folder` is new or holds nothing but what a killed process left half-written."""
    if not folder.exists():
        return
    leftover = (LOCK_FILE, PARTIAL)
    if not folder.is_dir() or any(not p.name.startswith(leftover) for p in folder.iterdir()):
        fail(f"--out {folder}: exists and is not empty{instead}")


def check_new_file(path: Path, in_folder: bool = True) -> None:
    """Fails if there is something at the path of --out or, with `in_folder`, no folder to hold it.

    Data are never overwritten; pictures and pages, which are drawn anew at will, are.
    """
    if path.exists():
        fail(f"--out {path}: exists")
    if in_folder and not path.absolute().parent.is_dir():
        fail(f"--out {path}: no such folder")


def check_picture(out: Path) -> None:
    """Fails unless --out ends in a format that pictures can be written in."""
    from tdanet_jax.analysis import drawing

    if out.suffix[1:] not in drawing.formats():
        fail(f"--out {out}: end it in one of .{', .'.join(drawing.formats())}")


def check_at_most(flag: str, value: int, most: int) -> None:
    """Fails if a flag's value is above what there is."""
    if value > most:
        fail(f"--{flag} {value}: at most {most}")


def check_positive(**flags: int | Sequence[int]) -> None:
    """Fails if a flag's value, or one of its values, is below 1."""
    for name, given in flags.items():
        for value in (given,) if isinstance(given, int) else given:
            if value < 1:
                fail(f"--{name} {value}: must be positive")


class Stopped(KeyboardInterrupt):
    """SIGTERM or Ctrl-C came; `signal` is its number.

    Python drops what is raised while it collects garbage, and some libraries drop what is raised
    below them. A stop that was dropped, unless it has been answered, is raised again.
    """

    def __init__(self, number: int, request: StopRequest) -> None:
        super().__init__()
        self.signal = number
        self._request = request

    def __del__(self) -> None:
        self._request.ask_again()

    def answer(self) -> NoReturn:
        """Ends the program."""
        self._request.signal = None
        experiments.exit_status = 128 + self.signal
        raise SystemExit(experiments.exit_status) from None


class StopRequest:
    """Turns SIGTERM and Ctrl-C into `Stopped`, at once or, inside `deferred`, at its end.

    While something is imported the first one waits: a library whose import is broken off may crash.

    Attributes:
      signal: the first one's number, until it is answered.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        self._deferring = False
        self._imports = 0  # how deep in imports we are anyway
        self._alarm: Any = None  # whoever else had SIGALRM
        self._asked = False  # whether the timer is ours

    @contextlib.contextmanager
    def deferred(self) -> Iterator[None]:
        """Inside, the first signal is remembered in `signal`; a second one does not wait."""
        self._check()
        self._deferring = True
        try:
            yield
        finally:
            self._deferring = False
        self._check()

    def _check(self) -> None:
        if self.signal is not None:
            self._stop(self.signal)

    @contextlib.contextmanager
    def receiving(self) -> Iterator[None]:
        """Inside, the signals come here, but for those that are ignored; none to other threads."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        self._imports = _imports(sys._getframe())
        self._alarm = signal.getsignal(signal.SIGALRM)
        before = {
            number: signal.signal(number, self._receive)
            for number in (signal.SIGTERM, signal.SIGINT)
            if signal.getsignal(number) is not signal.SIG_IGN
        }
        before[signal.SIGALRM] = signal.signal(signal.SIGALRM, self._receive_alarm)
        hook = sys.unraisablehook
        # What is dropped is told to this hook, and would be printed.
        sys.unraisablehook = lambda told: isinstance(told.exc_value, Stopped) or hook(told)
        try:
            yield
        finally:
            self._deferring = True  # until whoever had the signals before has them again
            if self._asked:
                signal.setitimer(signal.ITIMER_REAL, 0)
            for number, handler in before.items():
                signal.signal(number, handler)
            sys.unraisablehook = hook
            unanswered, self.signal = self.signal, None
            if unanswered is not None:
                signal.raise_signal(unanswered)

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            self._stop(number)
        self.signal = number
        self._answer(frame)

    def _receive_alarm(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            self._answer(frame)
        elif callable(self._alarm):
            self._alarm(number, frame)

    def _answer(self, frame: FrameType | None) -> None:
        """Raises `Stopped`, now or later."""
        if self._deferring:
            return
        if _imports(frame) > self._imports:
            self.ask_again()
        else:
            self._check()

    def _stop(self, number: int) -> NoReturn:
        signal.setitimer(signal.ITIMER_REAL, 0)  # nothing else breaks off the tidying up
        raise Stopped(number, self)

    def ask_again(self) -> None:
        """Has `Stopped` raised in a moment if a signal is unanswered; callable in any thread."""
        if self.signal is not None and not self._deferring:
            self._asked = True
            signal.setitimer(signal.ITIMER_REAL, SECONDS_OF_A_MOMENT)


def _imports(frame: FrameType | None) -> int:
    """How many calls of the import system a frame is in."""
    stack = traceback.walk_stack(frame)
    return sum(f.f_code.co_filename == "<frozen importlib._bootstrap>" for f, _ in stack)


@contextlib.contextmanager
def stoppable(advice: Callable[[], str]) -> Iterator[StopRequest]:
    """Inside, SIGTERM or Ctrl-C ends the program: one line of advice, status 128 + signal."""
    stop = StopRequest()
    with stop.receiving():
        try:
            yield stop
        except Stopped as stopped:
            console.print(f"stopped; {advice()}")
            stopped.answer()


class _Figures(ProgressColumn):
    """The line of figures that changes with every chunk."""

    def render(self, task: Task) -> Text:
        return Text(str(task.fields.get("figures", "")))


def progress_bar(transient: bool) -> Progress:
    """A bar with share done, figures, time spent and time left; a transient one leaves no trace."""
    return Progress(
        TextColumn("{task.description}"),
        BarColumn(bar_width=24),
        TextColumn("{task.percentage:>5.1f} %"),
        _Figures(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        console=console,
        transient=transient,
    )


@contextlib.contextmanager
def reporter(title: str, transient: bool = False) -> Iterator[Callable[[float, str], None]]:
    """Shows progress: `report(share, figures)`, a live bar on a terminal, else a line now and then.

    Without a terminal the first report, the last, and those in between that come at least ten
    seconds after the line before are printed, with the time left at the pace since the first.

    Args:
      title: what is going on.
      transient: on a terminal, take the bar away at the end.
    """
    if console.is_terminal:
        with progress_bar(transient) as bar:
            task = bar.add_task(title, total=1.0, figures="")

            def live(share: float, figures: str) -> None:
                bar.update(task, completed=min(share, 1.0), figures=figures)

            yield live
        return
    first: tuple[float, float] | None = None  # time and share of the first report
    printed = 0.0

    def plain(share: float, figures: str) -> None:
        nonlocal first, printed
        now, share, left = time.monotonic(), min(share, 1.0), ""
        if first is not None and now - printed < SECONDS_BETWEEN_LINES and share < 1.0:
            return
        if first is None:
            first = now, share
        elif first[1] < share < 1.0:
            seconds = round((now - first[0]) * (1.0 - share) / (share - first[1]))
            left = f"  {datetime.timedelta(seconds=seconds)} left"
        printed = now
        console.print(f"{title} {100 * share:5.1f} %  {figures}{left}".rstrip())

    yield plain


def print_summary(results: Mapping[str, Any]) -> None:
    """One line per group: seen targets, 1000 episodes: SR 75.1 (70.2 to 80.0), SPL ..."""
    from tdanet_jax.evaluation.metrics import shown

    for group in GROUPS:
        if results[group] is None:
            continue
        bucket = results[group]["L>=1"]
        parts = [f"{name} {shown(bucket, name)}" for name in ("SR", "SPL")]
        console.print(f"{group} targets, {bucket['n']} episodes: {', '.join(parts)}")
