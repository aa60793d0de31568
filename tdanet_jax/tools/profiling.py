"""Where the time of a training update goes: JAX's profiler, its operations sorted into parts."""

from __future__ import annotations

import re
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax.config import LearnerConfig
from tdanet_jax.task import Task
from tdanet_jax.tools.benchmarking import Row
from tdanet_jax.training import learner

#: Updates in the one call that is profiled.
UPDATES = 5
#: Part of an update -> what the name of one of its operations, or the place that it was written at,
#: has in it. An operation belongs to the first part that matches; XLA names a fusion after its last
#: operation.
PARTS = {
    "products": r"/dot_general$",
    "copies": r"^copy|^transpose|_copy|/transpose$|/optimization_barrier$|^wrapped_broadcast"
    r"|dynamic-update-slice|/dynamic_update_slice$|/dynamic_slice$",
    "optimizer": r"/optimizer/",
    "random_numbers": r"_uniform|_gumbel|random_|threefry|_bernoulli|_randint|_categorical",
    "environment": r"/environment/",
    "lstm_gates": r"/lstm/",
    "lookups": r"/gather$|scatter",
    "encoder": r"/encoder",
    "other": "",
}
_INSTRUCTION = re.compile(r"^\s*(?:ROOT )?%?([\w.-]+) = (.*)$", re.MULTILINE)
_PLACE = re.compile(r'op_name="([^"]*)"')


def profile_row(task: Task, config: LearnerConfig) -> Row:
    """Shares of the parts of an update in the time of all its operations.

    Operations that run side by side count each in full. The profiler itself slows an update down by
    a few per cent.

    Args:
      task: whose model is trained.
      config: the update.
    """
    chunk = learner.make_train(config, task.model, UPDATES)
    arguments = jnp.zeros(2), task.train_words, task.train_params
    key = jax.random.key(0)
    state = learner.init(key, config, task.model, task.train_words, task.train_params)
    compiled = chunk.lower(state, *arguments).compile()
    state, _ = jax.block_until_ready(compiled(state, *arguments))
    with tempfile.TemporaryDirectory() as place:
        options = jax.profiler.ProfileOptions()
        options.python_tracer_level = 0
        with jax.profiler.trace(place, profiler_options=options):
            began = time.perf_counter()
            jax.block_until_ready(compiled(state, *arguments))
            seconds = time.perf_counter() - began
        durations = _durations(Path(place))
    spent = sort(durations, places(compiled.as_text() or ""))
    total = sum(spent.values())
    if not total:
        raise ValueError("profile: this device's profiler names no operations")
    shares: dict[str, Any] = {part: round(spent[part] / total, 3) for part in PARTS}
    return {
        "part": "profile",
        "environments": config.num_envs,
        "milliseconds_per_update": round(1e3 * seconds / UPDATES, 1),
        **shares,
    }


def places(program: str) -> dict[str, str]:
    """Where each operation of a compiled program was written, by its name.

    Args:
      program: as XLA prints it.
    """
    out = {}
    for name, rest in _INSTRUCTION.findall(program):
        found = _PLACE.search(rest)
        out[name] = found[1] if found else ""
    return out


def sort(durations: Counter[str], places: dict[str, str]) -> Counter[str]:
    """Time of each part, from the time of each operation.

    Loops and calls, whose time is that of the operations in them, and operations of other programs
    are left out.
    """
    spent: Counter[str] = Counter()
    for name, duration in durations.items():
        if name in places and not re.match(r"while|call|conditional", name):
            spent[part_of(name, places[name])] += duration
    return spent


def part_of(name: str, place: str) -> str:
    """The part of an update to which an operation belongs.

    Args:
      name: of the operation: dot.3.
      place: where it was written: jit(chunk)/while/body/ActorCritic/lstm/dot_general.
    """
    return next(
        part
        for part, pattern in PARTS.items()
        if re.search(pattern, name) or re.search(pattern, place)
    )


def _durations(folder: Path) -> Counter[str]:
    """Nanoseconds of each operation in the profile that JAX wrote into a folder."""
    out: Counter[str] = Counter()
    for event in _events(folder):
        operation = dict(event.stats).get("hlo_op")
        if operation is not None:
            out[str(operation)] += event.duration_ns
    return out


def _events(folder: Path) -> Iterator[Any]:
    for path in folder.rglob("*.xplane.pb"):
        for plane in jax.profiler.ProfileData.from_file(str(path)).planes:
            for line in plane.lines:
                yield from line.events
