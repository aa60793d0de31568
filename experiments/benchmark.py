"""Measures this machine and the software on it; compile time and run time apart.

    python -m experiments.benchmark --out benchmark.jsonl

Every figure is the median over repetitions. Shares of the peak count 6 floating-point operations
(forward and backward) per multiply-accumulate of one forward step, by hand formula: work that is
done twice earns nothing. The peak is the best rate of a float32 product of batch x 1024 by
1024 x 2048, measured in the same run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from rich.table import Table

from experiments.console import check_positive, console, fail, one_line_errors, parse
from tdanet_jax.config import NetworkConfig, TrainConfig

if TYPE_CHECKING:
    from tdanet_jax.task import Task
    from tdanet_jax.tools.benchmarking import Row

Part = Literal[
    "tables", "import", "startup", "machine", "environment", "rollout", "update", "evaluation",
    "decision",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures env, rollout, update, evaluation and one decision on this machine."""

    parts: tuple[Part, ...] = get_args(Part)
    """What to measure."""
    environments: tuple[int, ...] = (1024, 4096, 16384)
    """Numbers of environments in the `environment` part."""
    batches: tuple[int, ...] = (256, 512, 1024)
    """Numbers of environments in the `rollout` and `update` parts."""
    precisions: tuple[Literal["float32", "bfloat16"], ...] = ("float32", "bfloat16")
    """Operands of the products in the `rollout` and `update` parts."""
    networks: tuple[int, ...] = (1,)
    """Numbers of networks that are evaluated in one call; 20 is a run's history."""
    checkpoint: Path | None = None
    """Run whose trained network the `evaluation` part plays; by default an untrained one."""
    models: tuple[str, ...] = ("tdanet",)
    """Models of the `rollout`, `update` and `decision` parts."""
    odometry: bool = False
    """Those models sense their own way, as with the flag of the training command."""
    triangulation: bool = False
    """And, with --odometry, where their target is."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, in place of the bundled ones."""
    devices: int = 1
    """Devices that the environments of the `environment` part are split over; a CPU is split into
    as many."""
    repeats: int = 5
    """Timed repetitions of each figure."""
    out: Path | None = None
    """File for the figures, one JSON object per line, written as they come; must not exist."""

    @property
    def network(self) -> NetworkConfig:
        """What the models sense."""
        return NetworkConfig(odometry=self.odometry, triangulation=self.triangulation)


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    command = parse(Command, arguments, prog="benchmark")
    with one_line_errors():
        if command.out is not None and command.out.exists():
            fail(f"--out {command.out}: exists")
        check_positive(
            repeats=command.repeats,
            devices=command.devices,
            environments=command.environments,
            batches=command.batches,
            networks=command.networks,
        )
        for name in command.models:
            TrainConfig(model=name, network=command.network).check()
        if command.odometry and not {"rollout", "update", "decision"} & set(command.parts):
            fail("--odometry: none of the --parts has a model; choose rollout, update or decision")
        if command.checkpoint is not None:
            from tdanet_jax.evaluation import saved_networks

            saved_networks.find(
                command.checkpoint
            )  # what is not there is noticed now, not after minutes
        rows = []
        with contextlib.nullcontext() if command.out is None else command.out.open("x") as file:
            for row in figures(command):
                rows.append(row)
                line = json.dumps(row)
                console.print(line)
                if file is not None:
                    file.write(line + "\n")
                    file.flush()
        console.print(as_table(rows))


def figures(command: Command) -> Iterator[Row]:
    """All figures that were asked for, one row each."""
    import jax

    from tdanet_jax.task import load_task
    from tdanet_jax.tools import benchmarking
    from tdanet_jax.training import devices

    mesh = devices.connect(command.devices)
    yield {
        "part": "start",
        "device": str(jax.devices()[0]),
        "processor": benchmarking.processor(),
        "jax": jax.__version__,
    }
    if "tables" in command.parts:
        yield tables_row()
    task = load_task(TrainConfig(data=command.data))
    if "import" in command.parts:
        yield import_row(task)
    if "startup" in command.parts:
        yield startup_row()
    peak = None
    if "machine" in command.parts:
        machine = benchmarking.machine_row(command.repeats)
        peak = machine["float32_gflops"]
        yield machine
    if "environment" in command.parts:
        for count in command.environments:
            for observed in (False, True):
                yield benchmarking.environment_row(task, count, observed, command.repeats, mesh)
    if "evaluation" in command.parts:
        for networks in command.networks:
            yield benchmarking.evaluation_row(command.checkpoint, task, networks, command.repeats)
    for name in command.models:
        for row in model_rows(command, name, peak):
            senses = {"odometry": command.odometry, "triangulation": command.triangulation}
            yield {"part": row.pop("part"), "model": name, **senses, **row}


def model_rows(command: Command, name: str, peak: float | None) -> Iterator[Row]:
    """What was asked for of a model: acting, updates, and one decision.

    Args:
      peak: of float32 products, GFLOP/s; None if it was not measured.
    """
    import jax.numpy as jnp

    from tdanet_jax.task import load_task
    from tdanet_jax.tools import benchmarking

    acts = {"rollout", "update"} & set(command.parts)
    measured = set()
    for asked in command.precisions if acts else ():
        network = dataclasses.replace(command.network, precision=asked)
        task = load_task(TrainConfig(model=name, network=network, data=command.data))
        precision = jnp.dtype(task.model.dtype).name
        if precision in measured:  # some models multiply in float32, whatever is asked for
            continue
        measured.add(precision)
        for count in command.batches:
            if "rollout" in command.parts:
                yield {
                    **benchmarking.rollout_row(task, count, command.repeats),
                    "precision": precision,
                }
            if "update" in command.parts:
                row = benchmarking.update_row(task, count, command.repeats)
                share = benchmarking.share_of_peak(task, row, peak) if name == "tdanet" else {}
                yield {**row, **share, "precision": precision}
    if "decision" in command.parts:
        task = load_task(TrainConfig(model=name, network=command.network, data=command.data))
        for count in (1, 1024):
            yield benchmarking.decision_row(task, count, command.repeats)


def tables_row() -> Row:
    """From the bundled rooms to tables, to a file, and from the file; peak memory so far."""
    import resource
    import tempfile

    from tdanet_jax.scenes import ithor
    from tdanet_jax.scenes.tables import SceneTables
    from tdanet_jax.scenes.tabulation import build

    began = time.perf_counter()
    tables = build(ithor.load_scenes())
    built = time.perf_counter()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "tables.npz"
        tables.save(path)
        saved = time.perf_counter()
        SceneTables.load(path)
        loaded = time.perf_counter()
        size = path.stat().st_size
    return {
        "part": "tables",
        "rooms": len(tables.scenes),
        "build_seconds": round(built - began, 2),
        "save_seconds": round(saved - built, 2),
        "load_seconds": round(loaded - saved, 2),
        "peak_memory_gb": round(peak / 1e9, 2),
        "file_mb": round(size / 1e6, 1),
    }


def import_row(task: Task) -> Row:
    """Rooms out to the original offline layout, and in again by the command that a user types;
    the command's own peak memory."""
    import resource
    import subprocess
    import sys
    import tempfile

    from tdanet_jax.scenes.offline import exporter

    with tempfile.TemporaryDirectory() as place:
        folder, out = Path(place) / "original", Path(place) / "rooms.npz"
        began = time.perf_counter()
        exporter.write_folder(task.tables, folder, lambda share, name: None)
        written = time.perf_counter()
        command = [sys.executable, "-m", "experiments.scenes", "import", "--from", str(folder)]
        done = subprocess.run([*command, "--out", str(out)], capture_output=True, text=True)
        if done.returncode:
            raise ValueError(f"import: {done.stderr.strip()}")
        read = time.perf_counter()
        size = sum(path.stat().st_size for path in folder.rglob("*.json"))
    peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
    return {
        "part": "import",
        "rooms": len(task.tables.scenes),
        "folder_mb": round(size / 1e6, 1),
        "export_seconds": round(written - began, 2),
        "import_seconds": round(read - written, 2),
        "peak_memory_gb": round(peak / 1e9, 2),
    }


def startup_row() -> Row:
    """From typing the training command to its first update, the rooms' tables being cached: with
    nothing compiled, and with the compiled programs of the first start; and `--help`."""
    import shutil
    import subprocess
    import sys
    import tempfile

    from tdanet_jax.scenes import cache

    train = [sys.executable, "-m", "experiments.train_zero_shot"]
    row: Row = {"part": "startup"}
    with tempfile.TemporaryDirectory() as place:
        home = Path(place)
        for path in cache.folder().glob(f"ithor-{cache.key()}.*"):
            shutil.copy(path, home)
        for name in ("nothing_compiled", "compiled_before"):
            metrics = home / name / "metrics.jsonl"
            began = time.perf_counter()
            with subprocess.Popen(
                [*train, "--chunk-updates", "1", "--out", str(metrics.parent)],
                env=os.environ | {cache.VARIABLE: str(home)},
                stdout=subprocess.DEVNULL,
            ) as process:
                while not metrics.exists():
                    if process.poll() is not None:
                        raise ValueError("startup: the training command ended early")
                    time.sleep(0.01)
                row[f"seconds_{name}"] = round(time.perf_counter() - began, 2)
                process.kill()
    began = time.perf_counter()
    subprocess.run([*train, "--help"], check=True, stdout=subprocess.DEVNULL)
    return row | {"seconds_help": round(time.perf_counter() - began, 2)}


def as_table(rows: list[Row]) -> Table:
    """All rows as one table: the part, its setting, and its figures."""
    table = Table("part", "setting", "figures")
    settings = (
        "environments", "devices", "observations", "precision", "model", "odometry",
        "triangulation", "batch", "networks", "episodes",
    )  # fmt: skip
    for row in rows:
        setting = ", ".join(f"{k} {row[k]}" for k in settings if k in row)
        figures = ", ".join(f"{k} {v}" for k, v in row.items() if k not in (*settings, "part"))
        table.add_row(row["part"], setting, figures)
    return table


if __name__ == "__main__":
    main()
