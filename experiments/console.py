"""What the commands share at the edge: errors in one line, progress, and stopping on a signal."""

from __future__ import annotations

import contextlib
import io
import itertools
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
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

Arguments = TypeVar("Arguments")

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
        lines = [line.strip("│ ") for line in said.getvalue().splitlines()[1:]]
        fail(" ".join(itertools.takewhile(lambda line: not line.startswith("─"), lines)))


def parse(command: type[Arguments], arguments: Sequence[str] | None, **options: Any) -> Arguments:
    """`tyro.cli`, with errors in one line."""
    with one_line_usage():
        return tyro.cli(command, args=arguments, **options)


@contextlib.contextmanager
def one_line_errors() -> Iterator[None]:
    """Turns errors that a user can cause (ValueError, OSError) into one line."""
    try:
        yield
    except (ValueError, OSError) as error:
        fail(error)


class StopRequest:
    """Remembers the first SIGTERM or Ctrl-C inside its `with` block; a second one interrupts."""

    def __init__(self) -> None:
        self.signal: int | None = None

    def __enter__(self) -> StopRequest:
        signals = (signal.SIGTERM, signal.SIGINT)
        self._before = {number: signal.signal(number, self._remember) for number in signals}
        return self

    def __exit__(self, *error: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _remember(self, number: int, frame: Any) -> None:
        if self.signal is not None:
            raise KeyboardInterrupt
        self.signal = number


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
def reporter(
    title: str, every: int = 1, transient: bool = False
) -> Iterator[Callable[[float, str], None]]:
    """Shows progress: `report(share, figures)`, a live bar on a terminal, else a line now and then.

    Args:
      title: what is going on.
      every: without a terminal, print only every so many reports.
      transient: on a terminal, take the bar away at the end.
    """
    if console.is_terminal:
        with progress_bar(transient) as bar:
            task = bar.add_task(title, total=1.0, figures="")

            def live(share: float, figures: str) -> None:
                bar.update(task, completed=min(share, 1.0), figures=figures)

            yield live
        return
    count = 0

    def plain(share: float, figures: str) -> None:
        nonlocal count
        count += 1
        if count % every == 0 or share >= 1.0:
            console.print(f"{title} {100 * min(share, 1.0):5.1f} %  {figures}")

    yield plain


def print_summary(results: Mapping[str, Any]) -> None:
    """One line per group: seen targets, 1000 episodes: SR 75.1 (70.2 to 80.0), SPL ..."""
    for group in ("seen", "unseen"):
        if results[group] is None:
            continue
        bucket = results[group]["L>=1"]
        parts = []
        for name in ("SR", "SPL"):
            low, high = bucket[f"{name}_ci"]
            parts.append(f"{name} {bucket[name]:.1f} ({low:.1f} to {high:.1f})")
        console.print(f"{group} targets, {bucket['n']} episodes: {', '.join(parts)}")
