"""What all commands share: arguments, errors in one line, and progress."""

from __future__ import annotations

import contextlib
import datetime
import difflib
import io
import itertools
import logging
import math
import re
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TypeVar

import tyro
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from tdanet_jax.commands.signals import Stopped, StopRequest
from tdanet_jax.commands.streams import ends_with_its_reader
from tdanet_jax.io import files
from tdanet_jax.io.bundled_agents import find_run, is_bundled
from tdanet_jax.io.escaping import in_line, in_terminal
from tdanet_jax.splits import GROUPS

if TYPE_CHECKING:
    from tdanet_jax.scenes.dataset import Rooms

Arguments = TypeVar("Arguments")

#: Without a terminal, progress is a line at most this often.
SECONDS_BETWEEN_LINES = 10.0
#: What JAX calls its own error, now and in older versions.
OF_JAX = ("JaxRuntimeError", "XlaRuntimeError")
#: Columns from which a terminal has room for a bar next to the figures of training.
WIDE = 104


class PlainConsole(Console):
    """Prints names from files as they are, without markup or control characters, and leaves it to
    us what happens when a pipe breaks.
    """

    def print(self, *texts: object, **options: Any) -> None:
        """Prints as `Console` does."""
        plain = (in_terminal(text) if isinstance(text, str) else text for text in texts)
        super().print(*plain, **options)

    def on_broken_pipe(self) -> None:
        """Raises the error on, in place of ending the program."""
        raise


console = PlainConsole(stderr=False, highlight=False, soft_wrap=True, markup=False)


def fail(message: object) -> NoReturn:
    """Ends the program with one line on standard error and exit status 2."""
    with contextlib.suppress(BrokenPipeError):
        print(f"error: {in_line(message)}", file=sys.stderr)
    raise SystemExit(2)


@contextlib.contextmanager
def one_line_usage(where: str = "") -> Iterator[None]:
    """Reduces tyro's boxed usage error to one line: `where`, its first paragraph, and the known
    flags that are nearest to unknown ones.
    """
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said), _registry:
            yield
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [line.strip("│ ") for line in said.getvalue().splitlines()[1:]]  # [0]: a title
        words = itertools.dropwhile(_is_rule, lines)
        message = " ".join(itertools.takewhile(lambda line: not _is_rule(line), words))
        fail(where + message + _did_you_mean(message, lines))


def _did_you_mean(message: str, lines: Sequence[str]) -> str:
    """The flags that tyro's box lists below an error that are nearest to unknown ones."""
    if not message.startswith("Unrecognized options: "):
        return ""
    listed = [line.split()[0].rstrip(",") for line in lines if line.startswith("--")]
    unknown = re.findall(r"--[\w-]+", message)
    near = [name for one in unknown for name in difflib.get_close_matches(one, listed, 1)]
    return f"; did you mean {', '.join(near)}?" if near else ""


def _is_rule(line: str) -> bool:
    """Whether a line of tyro's box is one of its horizontal lines."""
    return line.startswith(("─", "---"))


_registry = tyro.constructors.ConstructorRegistry()


@_registry.primitive_rule
def _whole_numbers(
    kind: tyro.constructors.PrimitiveTypeInfo,
) -> tyro.constructors.PrimitiveConstructorSpec[int] | None:
    """How an integer flag is read."""
    if kind.type is not int:
        return None
    return tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="INT",
        instance_from_str=lambda words: whole_number(words[0]),
        is_instance=lambda value: isinstance(value, int),
        str_from_instance=lambda value: [str(value)],
    )


#: A flag that says where a run is: its folder, a point of its history, or a bundled agent's name.
RunPath = Annotated[
    Path,
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="RUN",
        instance_from_str=lambda words: find_run(words[0]),
        is_instance=lambda value: isinstance(value, Path),
        str_from_instance=lambda value: [str(value)],
    ),
]


def whole_number(text: str) -> int:
    """An integer as people type it: 1000000, 1_000_000, 1e6, 1.5e6.

    Raises:
      ValueError: it is none.
    """
    try:
        return int(text)
    except ValueError:
        number = float(text) if re.fullmatch(r"[\d.]+e\+?\d\d?", text.lower()) else math.nan
        if not number.is_integer():
            raise
        return int(number)


def parse(
    command: type[Arguments], arguments: Sequence[str] | None, where: str = "", **options: Any
) -> Arguments:
    """`tyro.cli`, with errors in one line that starts with `where`."""
    with one_line_usage(where):
        return tyro.cli(command, args=arguments, **options)


@contextlib.contextmanager
def one_line_errors(if_memory_ends: str = "") -> Iterator[None]:
    """Reduces warnings, user errors (ValueError, OSError) and signals to one line each.

    Args:
      if_memory_ends: what helps if there is not enough memory, which is a line, too.
    """
    with warnings.catch_warnings(), StopRequest().receiving():
        warnings.showwarning = _show_warning  # type: ignore[assignment]
        # Without a home, Matplotlib would add its own long warning to the one about our cache.
        logging.getLogger("matplotlib").setLevel(logging.ERROR)
        try:
            with ends_with_its_reader():
                yield
        except OSError as error:
            fail(f"{error.filename}: {error.strerror}" if error.filename else error)
        except ValueError as error:
            fail(error)
        except RuntimeError as error:
            if (wanted := _not_enough(error)) is None:
                raise
            fail("; ".join(part for part in (f"out of memory: {wanted}", if_memory_ends) if part))
        except Stopped as stopped:
            print("stopped", file=sys.stderr)
            stopped.answer()


def _not_enough(error: RuntimeError) -> str | None:
    """What JAX says of memory that it did not get; None of other errors. Does not import JAX."""
    said = re.match(r"RESOURCE_EXHAUSTED: (?:Out of memory\s*)?(.*?)\.?$", str(error), re.M)
    return said[1] if said and type(error).__name__ in OF_JAX else None


def _show_warning(message: Warning | str, *_: Any) -> None:
    print(f"warning: {in_line(message)}", file=sys.stderr)


def folder_for(run: Path) -> Path:
    """Where what is made of a run goes by default: its folder.

    It is runs/<name> for a bundled agent, and for a row of the scoreboard, which has no network.
    """
    is_row = (run / "run.json").is_file() and not (run / "checkpoints").exists()
    return Path("runs") / run.name if is_bundled(run) or is_row else run


def check_new_file(path: Path, in_folder: bool = True) -> None:
    """Fails if --out exists or, with `in_folder`, if its folder does not.

    Data is never overwritten; pictures and pages, which can be drawn again, are.
    """
    if path.exists():
        fail(f"--out {path}: exists")
    if in_folder and not path.absolute().parent.is_dir():
        fail(f"--out {path}: no such folder")
    files.check_writable(path)


def remove_abandoned(*outs: Path) -> None:
    """Removes the unfinished versions of --out that killed processes left."""
    for out in outs:
        for path in files.remove_abandoned(out):
            console.print(f"removed {path}: half-written when its command was killed")


def check_picture(out: Path) -> None:
    """Fails unless --out ends in a picture format and can be written."""
    from tdanet_jax.analysis import drawing

    if out.suffix[1:] not in drawing.formats():
        fail(f"--out {out}: end it in one of .{', .'.join(drawing.formats())}")
    check_file(out)


def check_file(out: Path, suffixes: Sequence[str] = ()) -> None:
    """Fails unless a file can be written at --out; an existing one will be replaced.

    Args:
      out: the file.
      suffixes: what its name may end in, such as .html; () is anything.
    """
    if out.is_dir():
        fail(f"--out {out}: is a folder")
    if suffixes and out.suffix not in suffixes:
        fail(f"--out {out}: end it in {' or '.join(suffixes)}")
    files.check_writable(out)


def check_folder(out: Path) -> None:
    """Fails unless files can be written into the folder --out; there may be others in it."""
    if out.exists() and not out.is_dir():
        fail(f"--out {out}: is a file")
    files.check_writable(out)


def check_at_most(flag: str, value: int, most: int) -> None:
    """Fails if a flag's value is too large."""
    if value > most:
        fail(f"--{flag} {value}: at most {most:,}")


def check_positive(**flags: int | Sequence[int]) -> None:
    """Fails if a flag's value, or one of its values, is below 1."""
    for name, given in flags.items():
        for value in (given,) if isinstance(given, int) else given:
            if value < 1:
                fail(f"--{name.replace('_', '-')} {value}: must be positive")


@contextlib.contextmanager
def reporter(title: str, transient: bool = False) -> Iterator[Callable[[float, str], None]]:
    """Shows progress with `report(share, figures)`: a live bar on a terminal, otherwise lines.

    Lines are at least ten seconds apart, except for the first and the last; the time left is
    estimated from the pace since the first. A share below the last one starts again.

    Args:
      title: the name of the work.
      transient: on a terminal, remove the bar at the end.
    """
    last = 0.0  # share of the last report
    if console.is_terminal:
        columns = (
            TextColumn("{task.description}"),
            *([BarColumn(bar_width=24)] if console.width >= WIDE else []),
            TextColumn("{task.percentage:>5.1f} %"),
            TextColumn("{task.fields[figures]}", markup=False),
            TimeRemainingColumn(),
            TextColumn("left"),
        )
        with Progress(*columns, console=console, transient=transient) as bar:
            task = bar.add_task(title, total=1.0, figures="")

            def live(share: float, figures: str) -> None:
                nonlocal last
                if share < last:
                    bar.reset(task)
                last = share
                bar.update(task, completed=min(share, 1.0), figures=in_line(figures))

            yield live
        return
    first: tuple[float, float] | None = None  # time and share of the first report
    printed = 0.0

    def plain(share: float, figures: str) -> None:
        nonlocal first, printed, last
        now, share, left = time.monotonic(), min(share, 1.0), ""
        if share < last:
            first = None
        last = share
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


def load_rooms(data: str | None) -> Rooms:
    """The rooms of a file, or the bundled ones, with progress while they are rebuilt."""
    from tdanet_jax.scenes import dataset

    with reporter("rooms", transient=True) as report:
        return dataset.load_rooms(data, lambda done, total: report(done / total, "rebuilt"))


def print_summary(results: Mapping[str, Any]) -> None:
    """One line per group: seen targets, 1000 episodes: SR 75.1 (70.2 to 80.0), SPL ..."""
    from tdanet_jax.eval_config import describe_departures
    from tdanet_jax.evaluation.metrics import MEASURES, shown

    if results.get("departures"):
        console.print(describe_departures(results["departures"]))
    for group in GROUPS:
        if results[group] is None:
            continue
        bucket = results[group]["L>=1"]
        parts = [f"{name} {shown(bucket, name)}" for name in MEASURES if name in bucket]
        console.print(f"{group} targets, {bucket['n']} episodes: {', '.join(parts)}")
