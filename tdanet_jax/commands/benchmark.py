"""Measures speed on this machine, with compilation and run time apart.

    tdanet benchmark --out benchmark.jsonl

Every value is the median over repetitions. Shares of the peak count 6 floating-point operations
(forward and backward) for each multiply-accumulate of a forward step, which are counted in the
model's program; work that is done twice counts once. The peak is the best rate of a float32 product
of batch x 1024 by 1024 x 2048, measured in the same run.
"""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TextIO, get_args

from rich.table import Table

from tdanet_jax.commands.console import (
    RunPath,
    check_positive,
    console,
    fail,
    one_line_errors,
    parse,
)
from tdanet_jax.config import PRESETS, TrainConfig
from tdanet_jax.targets import naming

if TYPE_CHECKING:
    from jax.sharding import Mesh

    from tdanet_jax.task import Task
    from tdanet_jax.tools.benchmarking import Row

Part = Literal[
    "tables", "import", "startup", "machine", "environment", "rollout", "update", "profile",
    "evaluation", "decision", "agent", "quality",
]  # fmt: skip
#: The parts of training.
TRAINED = ("rollout", "update", "profile")
#: The agent of the `agent` part.
BUNDLED = "18-4-best"
#: What is measured if `--parts` is not given: all that takes no training.
SHORT = tuple(part for part in get_args(Part) if part != "quality")
#: Flags of the `quality` part, and what the training command calls them.
OWN_NAMES = (
    ("--units", "--width"),
    ("--units", "--hidden"),
    ("--most-steps", "--steps"),
    ("--seeds", "--seed"),
)
Precision = Literal["auto", "float32", "bfloat16"]


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures the speed of environment, rollout, update, evaluation and decisions."""

    parts: tuple[Part, ...] = SHORT
    """What to measure; `quality`, which trains for minutes, only if it is named."""
    environments: tuple[int, ...] = (1024, 4096, 16384)
    """Numbers of environments in the `environment` part."""
    batches: tuple[int, ...] = (64, 256, 1024)
    """Numbers of environments in the `rollout`, `update` and `profile` parts."""
    precisions: tuple[Literal["float32", "bfloat16"], ...] = ("float32", "bfloat16")
    """Precision of the matrix products in these parts."""
    networks: tuple[int, ...] = (1,)
    """Numbers of networks that are evaluated in one call; 20 is a run's history."""
    checkpoint: RunPath | None = None
    """Run whose trained network the `evaluation` part plays, by default an untrained one, and with
    which the `agent` part acts, by default 18-4-best."""
    models: tuple[str, ...] = ("tdanet",)
    """Models of the `rollout`, `update`, `profile` and `decision` parts."""
    preset: Literal["default", "best", "robust", "paper-inputs", "paper"] = "default"
    """Preset whose network and update these parts measure, and that the `quality` part trains, on
    validation, until two evaluations in a row reach the paper's figures on split 18/4."""
    odometry: bool = False
    """Add odometry to the preset, as the training command does."""
    triangulation: bool = False
    """With odometry, also add triangulation."""
    context: int | None = None
    """Units of the context, instead of the preset's; 0: none."""
    units: int | None = None
    """Units of each layer of the encoder and of the LSTM, instead of the preset's."""
    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote, instead of the bundled ones."""
    devices: int = 1
    """Devices that the environments of the `environment` part are split over; a CPU is split into
    as many."""
    num_envs: int | None = None
    """Environments of the `quality` part, instead of the preset's."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the `quality` part, one run each."""
    most_steps: int = 6_000_000
    """Budget of each run of the `quality` part, in environment steps."""
    repeats: int = 5
    """Repetitions of each measurement but those of `agent` and `quality`."""
    out: Path | None = None
    """File for the results, one JSON object per line, written as they come; must not exist."""

    def config(self, model: str, precision: Precision = "auto") -> TrainConfig:
        """The run whose model, update and rooms are measured."""
        chosen = PRESETS[self.preset]
        network = dataclasses.replace(
            chosen.network,
            odometry=self.odometry or chosen.network.odometry,
            triangulation=self.triangulation or chosen.network.triangulation,
            precision=precision,
        )
        if self.context is not None:
            network = dataclasses.replace(network, context=self.context)
        if self.units is not None:
            network = dataclasses.replace(network, width=self.units, hidden=self.units)
        return dataclasses.replace(chosen, model=model, network=network, data=self.data)

    def trained(self) -> list[TrainConfig]:
        """The runs of the `quality` part."""
        chosen = self.config("tdanet")
        if self.num_envs is not None:
            learner = dataclasses.replace(chosen.learner, num_envs=self.num_envs)
            chosen = dataclasses.replace(chosen, learner=learner)
        chosen = dataclasses.replace(chosen, episodes=None, steps=self.most_steps, validation=True)
        return [dataclasses.replace(chosen, seed=seed) for seed in self.seeds]

    def settings(self, config: TrainConfig) -> Row:
        """What the rows of a run say of its model."""
        network = config.network
        return {
            "model": config.model,
            "preset": self.preset,
            "units": network.width,
            "context": network.context,
            "odometry": network.odometry,
            "triangulation": network.triangulation,
        }

    def check_parts(self) -> None:
        """Raises ValueError if a flag is given that none of the `parts` heeds."""
        timed = ("machine", "environment", *TRAINED, "evaluation", "decision")
        networks = ("preset", "odometry", "triangulation", "context", "units")
        for names, parts in (
            (("models",), (*TRAINED, "decision")),
            (networks, (*TRAINED, "decision", "quality")),
            (("batches", "precisions"), TRAINED),
            (("environments", "devices"), ("environment",)),
            (("networks",), ("evaluation",)),
            (("checkpoint",), ("evaluation", "agent")),
            (("num_envs", "seeds", "most_steps"), ("quality",)),
            (("repeats",), timed),
            (("data",), ("import", *timed[1:], "quality")),
        ):
            for name in names:
                given = getattr(self, name) != getattr(Command, name)
                if given and not {*parts} & {*self.parts}:
                    flag, known = name.replace("_", "-"), ", ".join(parts)
                    raise ValueError(f"--{flag}: is for --parts {known}")


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet benchmark")
        if command.out is not None and command.out.exists():
            fail(f"--out {command.out}: exists")
        check_positive(
            repeats=command.repeats,
            devices=command.devices,
            environments=command.environments,
            batches=command.batches,
            networks=command.networks,
            most_steps=command.most_steps,
            num_envs=1 if command.num_envs is None else command.num_envs,
            units=1 if command.units is None else command.units,
        )
        with contextlib.ExitStack() as named:
            for ours, instead_of in OWN_NAMES:
                named.enter_context(naming(ours, instead_of))
            for config in (*map(command.config, command.models), *command.trained()):
                config.check()
        command.check_parts()
        if command.checkpoint is not None:
            from tdanet_jax.evaluation import saved_networks

            saved_networks.find(command.checkpoint)  # an error shows now, not after minutes
        from tdanet_jax.training import devices

        mesh = devices.connect(command.devices)
        if "environment" in command.parts:
            for count in command.environments:
                devices.check_divides(count, mesh, "environments")
        rows: list[Row] = []
        with (
            contextlib.nullcontext() if command.out is None else written(command.out, rows) as file
        ):
            for row in measure(command, mesh):
                rows.append(row)
                line = json.dumps(row)
                console.print(line)
                if file is not None:
                    file.write(line + "\n")
                    file.flush()
        console.print(as_table(rows))


@contextlib.contextmanager
def written(out: Path, rows: Sequence[Row]) -> Iterator[TextIO]:
    """A new file for `rows`; removed on an error before there is a result, for the next try."""
    with out.open("x") as file:
        try:
            yield file
        except BaseException:
            if len(rows) <= 1:  # the first says which machine it is
                out.unlink()
            raise


def measure(command: Command, mesh: Mesh) -> Iterator[Row]:
    """All results that were asked for, one row each.

    Args:
      mesh: the devices that environments are split over.
    """
    import jax

    from tdanet_jax.models.factory import unused_flags
    from tdanet_jax.task import load_task
    from tdanet_jax.tools import benchmarking
    from tdanet_jax.training import devices

    machine = {"processor": devices.processor(), "jax": jax.__version__}
    yield {"part": "start", "device": str(jax.devices()[0]), **machine}
    if "tables" in command.parts:
        yield tables_row()
    task = load_task(TrainConfig(data=command.data))
    if "import" in command.parts:
        yield import_row(task)
    if "startup" in command.parts:
        yield startup_row()
    peak = None
    if "machine" in command.parts:
        row = benchmarking.machine_row(command.repeats)
        peak = row["float32_gflops"]
        yield row
    if "environment" in command.parts:
        for count in command.environments:
            for observed in (False, True):
                yield benchmarking.environment_row(task, count, observed, command.repeats, mesh)
    if "evaluation" in command.parts:
        for networks in command.networks:
            yield benchmarking.evaluation_row(
                command.checkpoint, task, networks, command.repeats, command.data
            )
    for name in command.models if {*TRAINED, "decision"} & {*command.parts} else ():
        config = command.config(name)
        settings = command.settings(config)
        with_context = dataclasses.replace(command, context=1).config(name)
        if "--context" in unused_flags(with_context, task.classes):
            del settings["context"]
        for row in model_rows(command, name, peak):
            yield {"part": row.pop("part"), **settings, **row}
    if "agent" in command.parts:
        yield benchmarking.agent_row(command.checkpoint or BUNDLED)
    if "quality" in command.parts:
        from tdanet_jax.tools import quality

        for config in command.trained():
            row = quality.quality_row(config)
            settings = {**command.settings(config), "environments": config.learner.num_envs}
            yield {"part": row.pop("part"), **settings, **row}


def model_rows(command: Command, name: str, peak: float | None) -> Iterator[Row]:
    """The results of a model: acting, updates, and one decision.

    Args:
      peak: rate of float32 products, GFLOP/s; None if it was not measured.
    """
    import jax.numpy as jnp

    from tdanet_jax.task import load_task
    from tdanet_jax.tools import benchmarking

    repeats, measured = command.repeats, set()
    update = command.config(name).learner
    operations = 0
    if "update" in command.parts:
        operations = benchmarking.operations_per_step(load_task(command.config(name, "float32")))
    for asked in command.precisions if {*TRAINED} & {*command.parts} else ():
        task = load_task(command.config(name, asked))
        precision = jnp.dtype(task.model.dtype).name
        if precision in measured:  # some models always multiply in float32
            continue
        measured.add(precision)
        for count in command.batches:
            learner = dataclasses.replace(update, num_envs=count)
            if "rollout" in command.parts:
                yield benchmarking.rollout_row(task, learner, repeats) | {"precision": precision}
            if "update" in command.parts:
                row = benchmarking.update_row(task, learner, repeats)
                share = benchmarking.share_of_peak(operations, row, peak)
                yield {**row, **share, "precision": precision}
            if "profile" in command.parts:
                from tdanet_jax.tools import profiling

                yield profiling.profile_row(task, learner) | {"precision": precision}
    if "decision" in command.parts:
        task = load_task(command.config(name))
        for count in (1, 1024):
            yield benchmarking.decision_row(task, count, repeats)


def tables_row() -> Row:
    """Time to compute the tables of the bundled rooms, to save and to load them; peak memory."""
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
    """Time to export the rooms to the original offline layout and to import them again.

    The import is the command that a user types; the peak memory is that of its process.
    """
    from tdanet_jax.scenes.offline import exporter

    with tempfile.TemporaryDirectory() as place:
        folder, out = Path(place) / "original", Path(place) / "rooms.npz"
        began = time.perf_counter()
        exporter.write_folder(task.tables, folder, lambda share, name: None)
        written = time.perf_counter()
        command = [sys.executable, "-m", "tdanet_jax", "scenes", "import", "--from", str(folder)]
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
    """Time from the start of the training command to its first update, and of `--help`.

    The rooms' tables are cached; once nothing is compiled, once the first start has compiled it.
    """
    from tdanet_jax.scenes import cache

    train = [sys.executable, "-m", "tdanet_jax", "train"]
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
    """All rows as one table: the part, its setting, and its results."""
    table = Table("part", "setting", "results")
    settings = (
        "environments", "devices", "observations", "precision", "model", "preset", "units",
        "context", "odometry", "triangulation", "batch", "networks", "seed",
    )  # fmt: skip
    for row in rows:
        setting = ", ".join(f"{k} {row[k]}" for k in settings if k in row)
        results = ", ".join(f"{k} {v}" for k, v in row.items() if k not in (*settings, "part"))
        table.add_row(row["part"], setting, results)
    return table
