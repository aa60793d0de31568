"""Measures how the cost of training grows with environments, rooms, classes and detections.

    tdanet scaling --out scaling

Changes one size at a time; the others keep their defaults. Additional rooms repeat the 80 training
rooms; additional classes and detections are rows that never occur. Writes scaling.jsonl and
scaling.png into --out.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from tdanet_jax.commands.console import (
    check_positive,
    console,
    one_line_errors,
    parse,
    reporter,
)
from tdanet_jax.config import TrainConfig

if TYPE_CHECKING:
    import jax

    from tdanet_jax.env.types import EnvParams
    from tdanet_jax.task import Task
    from tdanet_jax.tools.benchmarking import Row
from tdanet_jax.io import files


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures how the cost of training grows with environments, rooms, classes and detections."""

    environments: tuple[int, ...] = (32, 64, 128, 256, 512, 1024, 2048)
    """Numbers of environments."""
    rooms: tuple[int, ...] = (10, 30, 80, 250, 1000)
    """Numbers of training rooms; there are 80."""
    classes: tuple[int, ...] = (117, 250, 500, 1000, 2000)
    """Sizes of the vocabulary; at least 117."""
    detections: tuple[int, ...] = (80, 128, 256, 512)
    """Rows of an observation; at least as many as a frame has detections."""
    repeats: int = 3
    """Timed repetitions of each figure."""
    out: Path = Path("scaling")
    """Folder to write; must be new or empty."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet scaling")
        files.check_empty(command.out)
        check_positive(
            environments=command.environments,
            rooms=command.rooms,
            classes=command.classes,
            detections=command.detections,
            repeats=command.repeats,
        )
        scale(command)


def scale(command: Command) -> None:
    """Measures every size and writes the figures and the plot."""
    from tdanet_jax import scenes, words
    from tdanet_jax.analysis import figures
    from tdanet_jax.task import make_task
    from tdanet_jax.training import devices

    devices.start()
    task = make_task(TrainConfig(), scenes.load_tables(), words.load_bundled())
    sizes = ("environments", "rooms", "classes", "detections")
    total = sum(len(getattr(command, size)) for size in sizes)
    rows, path = [], command.out / "scaling.jsonl"
    measured = measure(command, task)
    command.out.mkdir(parents=True, exist_ok=True)
    with reporter("measuring", transient=True) as show, path.open("w") as file:
        for row in measured:
            rows.append(row)
            file.write(json.dumps(row) + "\n")
            file.flush()
            show(len(rows) / total, f"{row['size']} {row['value']}")
    figures.scaling(rows, command.out / "scaling.png")
    console.print(f"wrote {path} and {command.out / 'scaling.png'}")


def measure(command: Command, task: Task) -> Iterator[Row]:
    """A row for every size and value.

    Raises:
      ValueError: a size is smaller than what the rooms need.
    """
    needed = {"classes": len(task.train_words), "detections": task.train_params.max_detections}
    for size, least in needed.items():
        for value in getattr(command, size):
            if value < least:
                raise ValueError(f"--{size} {value}: the rooms need at least {least}")
    return _measured(command, task)


def _measured(command: Command, task: Task) -> Iterator[Row]:
    import jax.numpy as jnp

    from tdanet_jax.config import LearnerConfig
    from tdanet_jax.tools.benchmarking import update_cost

    model, words, params = task.model, task.train_words, task.train_params
    default = LearnerConfig()

    def row(
        size: str,
        value: int,
        words: jax.Array = words,
        params: EnvParams = params,
        config: LearnerConfig = default,
    ) -> Row:
        cost = update_cost(model, words, params, config, command.repeats)
        return {"size": size, "value": value} | cost

    for value in command.environments:
        yield row("environments", value, config=LearnerConfig(num_envs=value))
    for value in command.rooms:
        yield row("rooms", value, params=with_rooms(task, value))
    for value in command.classes:
        padded = jnp.pad(words, ((0, value - len(words)), (0, 0)))
        yield row("classes", value, words=padded)
    for value in command.detections:
        yield row("detections", value, params=with_detections(params, value))


def with_rooms(task: Task, count: int) -> EnvParams:
    """The environment of `count` training rooms: some of them, or all of them several times."""
    import numpy as np

    from tdanet_jax.env.params import make_params
    from tdanet_jax.env.reward import Parents
    from tdanet_jax.observation_spec import ObservationSpec
    from tdanet_jax.scenes.tabulation import join

    names = task.split.train_scenes
    per_type = len(names) // 4
    parts = [task.tables.subset(names)] * (count // len(names))
    if count % len(names):  # rooms of all types
        by_turn = sorted(names, key=lambda name: names.index(name) % per_type)
        parts.append(task.tables.subset(by_turn[: count % len(names)]))
    old = task.train_params
    parents = Parents(np.asarray(old.parent_class), np.asarray(old.parent_reward))
    tables, limits = join(parts, task.tables.classes), old.step_limit.tolist()
    return make_params(tables, task.split.seen, parents, limits, ObservationSpec())


def with_detections(params: EnvParams, rows: int) -> EnvParams:
    """The same environment with more rows in an observation."""
    import jax.numpy as jnp

    more = rows - params.max_detections
    return params.replace(
        max_detections=rows,
        row_class=jnp.pad(params.row_class, (0, more)),
        row_box=jnp.pad(params.row_box, ((0, more), (0, 0))),
    )
