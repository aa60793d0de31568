"""What a run logs: rows of metrics in `metrics.jsonl`, and in the formats of `SINKS`."""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import io
import json
import os
import re
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from tdanet_jax.config import CONFIG_FILE
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import jsons

METRICS_FILE = "metrics.jsonl"
CSV_FILE = "metrics.csv"

#: One chunk's metrics by name; `steps` and `updates` count from the start of the run.
Row = dict[str, Any]


class Journal:
    """`metrics.jsonl`. If it cannot be written, training continues and the rows wait in memory."""

    def __init__(self, path: Path | str, updates: int) -> None:
        """Drops the rows after `updates`, whose updates will be done again."""
        path = Path(path)
        self.path = path
        self._waiting: list[str] = []
        self._size = 0  # bytes of whole rows
        if path.exists():
            kept = [row for row in read_metrics(path.parent) if row["updates"] <= updates]
            text = "".join(json.dumps(row) + "\n" for row in kept)
            files.write_text(path, text)
            self._size = len(text)

    def write(self, row: Row) -> None:
        """Appends a row and those that wait; warns when the first has to wait."""
        self._waiting.append(json.dumps(row, allow_nan=False) + "\n")
        try:
            with self.path.open("ab") as file:
                file.truncate(min(self._size, file.tell()))  # what an earlier attempt left
                file.write("".join(self._waiting).encode())
            self._size = self.path.stat().st_size
            self._waiting.clear()
        except OSError as error:
            if len(self._waiting) == 1:
                reason = f"cannot be written ({error.strerror}); training continues"
                warnings.warn(f"{self.path}: {reason}, its rows wait in memory", stacklevel=2)


def read_metrics(folder: Path | str) -> list[Row]:
    """The rows of a run's `metrics.jsonl`; a line that was cut short or damaged is left out."""
    folder = Path(folder)
    rows = []
    for _, row in jsons.load_lines(folder / METRICS_FILE, links=False):
        if isinstance(row, dict) and _is_row(row):
            rows.append(row)
    return rows


def _is_row(row: Mapping[str, Any]) -> bool:
    """Whether all fields of a row are finite numbers or None, and those of the budget are there."""
    numbers = all(
        value is None or (isinstance(value, int | float) and abs(value) < 1e300)
        for value in row.values()
    )
    return numbers and all(type(row.get(name)) is int for name in ("updates", "steps", "episodes"))


def tensorboard_sink(folder: Path | str) -> Callable[[Row], None]:
    """A function that writes rows as TensorBoard events into `folder`/tensorboard.

    If events cannot be written, it gives up with a warning, and training continues.
    """
    folder = Path(folder)
    # Not SummaryWriter: a full disk ends its thread, and its queue then blocks for ever.
    from tensorboardX.event_file_writer import EventsWriter
    from tensorboardX.proto.event_pb2 import Event
    from tensorboardX.summary import scalar

    target = folder / "tensorboard"
    writer: EventsWriter | None = None
    failed = False

    def write(row: Row) -> None:
        nonlocal writer, failed
        if failed:
            return
        try:
            if writer is None:
                target.mkdir(exist_ok=True)
                writer = EventsWriter(str(target / "events"))
            for name in (name for name in row if name != "steps" and row[name] is not None):
                summary = scalar(f"train/{name}", row[name])
                writer.write_event(Event(wall_time=time.time(), step=row["steps"], summary=summary))
            writer.flush()
        except OSError as error:
            failed = True
            warnings.warn(f"{target}: given up ({error.strerror})", stacklevel=2)

    return write


def csv_sink(folder: Path | str) -> Callable[[Row], None]:
    """A function that writes rows into `folder`/metrics.csv, after those of `metrics.jsonl`.

    If they cannot be written, it gives up with a warning, and training continues.
    """
    folder = Path(folder)
    path, failed = folder / CSV_FILE, False
    columns: dict[str, None] = {}

    def text(rows: list[Row], header: bool) -> str:
        out = io.StringIO()
        writer = csv.DictWriter(out, [*columns], lineterminator="\n", extrasaction="ignore")
        if header:
            writer.writeheader()
        writer.writerows(rows)
        return out.getvalue()

    def begin(rows: list[Row]) -> None:
        """The file with these rows; rows of earlier versions may lack some columns."""
        columns.update(dict.fromkeys(name for row in rows for name in row))
        files.write_text(path, text(rows, header=True) if rows else "")

    there: list[Row] | None = read_metrics(folder) if (folder / METRICS_FILE).exists() else []
    begin(there or [])

    def write(row: Row) -> None:
        nonlocal failed, there
        if failed:
            return
        try:
            if there is not None:  # the first row says which columns there are
                earlier = [old for old in there if old["updates"] < row["updates"]]
                begin([*earlier, row])  # without what came after the checkpoint, of a killed run
                there = None
                return
            with path.open("a", encoding="utf-8") as file:
                file.write(text([row], header=False))
        except OSError as error:
            failed = True
            warnings.warn(f"{path}: given up ({error.strerror})", stacklevel=2)

    return write


def wandb_sink(folder: Path | str) -> Callable[[Row], None]:
    """A function that sends rows to Weights & Biases, or with WANDB_MODE=offline keeps them in
    `folder`/wandb.

    The run is called as its folder is, in the project "tdanet_jax" unless WANDB_PROJECT is set, and
    is continued by a run that is resumed. Runs of the same name in other folders are kept apart.

    Raises:
      ValueError: Weights & Biases refuses the run.
    """
    import wandb

    from tdanet_jax.training import run_file  # imports JAX, which the command does later

    folder = Path(folder)
    name = folder.resolve().name
    first = run_file.read(folder)[:1]  # of resumed runs, too
    mark = hashlib.sha256(repr(first).encode()).hexdigest()[:8]
    try:
        run = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "tdanet_jax"),
            name=name,
            id=re.sub(r"[^\w-]", "-", f"{name}-{mark}"),
            dir=str(folder),
            config=jsons.load(folder / CONFIG_FILE),
            resume="allow",
        )
    except wandb.Error as error:
        raise ValueError(f"--log wandb: {' '.join(str(error).split())}") from None

    def write(row: Row) -> None:
        figures = {f"train/{name}": value for name, value in row.items() if value is not None}
        run.log(figures, step=row["steps"])

    return write


def check_log(names: Sequence[str]) -> None:
    """Raises ValueError if a run cannot be logged in one of these, as SINKS calls them."""
    for name in names:
        if name not in SINKS:
            raise ValueError(f"--log {name}: choose {', '.join(SINKS)}")
        package = SINKS[name][0]
        if package is not None and importlib.util.find_spec(package) is None:
            raise ValueError(f"--log {name} needs {package}: pip install {package}")


#: What else a run can be logged in: the package that it needs, if any, and what makes its sink.
SINKS: Mapping[str, tuple[str | None, Callable[[Path | str], Callable[[Row], None]]]] = {
    "tensorboard": ("tensorboardX", tensorboard_sink),
    "wandb": ("wandb", wandb_sink),
    "csv": (None, csv_sink),
}
