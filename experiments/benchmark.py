"""Measures this machine and the software on it; compile time and run time apart.

    python -m experiments.benchmark --out benchmark.jsonl

Every figure is the median over repetitions. Shares of the peak count 6 floating-point operations
(forward and backward) per multiply-accumulate of one forward step, by hand formula: work that is
done twice earns nothing. The peak is the best rate of a float32 product of batch x 1024 by
1024 x 2048, measured in the same run.
"""

from __future__ import annotations

import dataclasses
import functools
import json
import os
import platform
import statistics
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from rich.table import Table

from experiments.console import check_positive, console, fail, one_line_errors, parse
from tdanet_jax import files
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig

if TYPE_CHECKING:
    import jax
    from jax.sharding import Mesh

    from tdanet_jax.env import EnvParams
    from tdanet_jax.models.actor_critic import ActorCritic
    from tdanet_jax.task import Task

Row = dict[str, Any]
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
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, in place of the bundled ones."""
    devices: int = 1
    """Devices that the environments of the `environment` part are split over; a CPU is split into
    as many."""
    repeats: int = 5
    """Timed repetitions of each figure."""
    out: Path | None = None
    """File for the figures, one JSON object per line; must not exist."""


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
            TrainConfig(model=name).check()
        rows = []
        for row in measure(command):
            rows.append(row)
            console.print(json.dumps(row))
        console.print(as_table(rows))
        if command.out is not None:
            files.write_text(command.out, "".join(json.dumps(row) + "\n" for row in rows))


def measure(command: Command) -> Iterator[Row]:
    """All figures that were asked for, one row each."""
    import jax

    from tdanet_jax import devices
    from tdanet_jax.task import load_task

    mesh = devices.connect(command.devices)
    yield {
        "part": "start",
        "device": str(jax.devices()[0]),
        "processor": processor(),
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
        machine = machine_row(command.repeats)
        peak = machine["float32_gflops"]
        yield machine
    if "environment" in command.parts:
        for count in command.environments:
            for observed in (False, True):
                yield environment_row(task, count, observed, command.repeats, mesh)
    if "evaluation" in command.parts:
        for networks in command.networks:
            yield evaluation_row(command.checkpoint, task, networks, command.repeats)
    for name in command.models:
        for row in model_rows(command, name, peak):
            yield {"part": row.pop("part"), "model": name, **row}


def model_rows(command: Command, name: str, peak: float | None) -> Iterator[Row]:
    """What was asked for of a model: acting, updates, and one decision.

    Args:
      peak: of float32 products, GFLOP/s; None if it was not measured.
    """
    from tdanet_jax.task import load_task

    acts = {"rollout", "update"} & set(command.parts)
    for precision in command.precisions if acts else ():
        network = NetworkConfig(precision=precision)
        task = load_task(TrainConfig(model=name, network=network, data=command.data))
        for count in command.batches:
            if "rollout" in command.parts:
                yield {**rollout_row(task, count, command.repeats), "precision": precision}
            if "update" in command.parts:
                row = update_row(task, count, command.repeats)
                share = share_of_peak(task, row, peak) if name == "tdanet" else {}
                yield {**row, **share, "precision": precision}
    if "decision" in command.parts:
        task = load_task(TrainConfig(model=name, data=command.data))
        for count in (1, 1024):
            yield decision_row(task, count, command.repeats)


def timed(call: Callable[[], Any], repeats: int, inner: int = 1) -> tuple[float, float]:
    """Seconds of the first call (compilation included) and the median of later ones.

    A repetition makes `inner` calls; the median is per call.
    """
    import jax

    began = time.perf_counter()
    jax.block_until_ready(call())
    first = time.perf_counter() - began
    taken = []
    for _ in range(repeats):
        began = time.perf_counter()
        for _ in range(inner):
            out = call()
        jax.block_until_ready(out)
        taken.append((time.perf_counter() - began) / inner)
    return first, statistics.median(taken)


def tables_row() -> Row:
    """From the bundled rooms to tables, to a file, and from the file; peak memory so far."""
    import resource
    import tempfile

    from tdanet_jax.scenes import ithor
    from tdanet_jax.scenes.tables import SceneTables, build

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
        subprocess.run([*command, "--out", str(out)], check=True, capture_output=True)
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
                        raise RuntimeError("startup: the training command ended early")
                    time.sleep(0.01)
                row[f"seconds_{name}"] = round(time.perf_counter() - began, 2)
                process.kill()
    began = time.perf_counter()
    subprocess.run([*train, "--help"], check=True, stdout=subprocess.DEVNULL)
    return row | {"seconds_help": round(time.perf_counter() - began, 2)}


def machine_row(repeats: int) -> Row:
    """The machine's own limits: matrix products and memory."""
    import jax
    import jax.numpy as jnp

    @jax.jit
    def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
        return jnp.dot(a, b, preferred_element_type=jnp.float32)

    add_one = jax.jit(lambda x: x + 1)
    row: Row = {"part": "machine"}
    for name, dtype in (("float32", jnp.float32), ("bfloat16", jnp.bfloat16)):
        best = 0.0
        for batch in (512, 1024, 2048):
            a = jax.random.normal(jax.random.key(0), (batch, 1024)).astype(dtype)
            b = jax.random.normal(jax.random.key(1), (1024, 2048)).astype(dtype)
            _, seconds = timed(functools.partial(multiply, a, b), 4 * repeats, inner=5)
            best = max(best, 2 * batch * 1024 * 2048 / seconds / 1e9)
        row[f"{name}_gflops"] = round(best, 1)
    big = jnp.zeros(2**26, jnp.float32)
    _, seconds = timed(functools.partial(add_one, big), repeats, inner=2)
    row["bandwidth_gb_per_s"] = round(2 * big.nbytes / seconds / 1e9, 1)
    return row


def environment_row(task: Task, count: int, observed: bool, repeats: int, mesh: Mesh) -> Row:
    """Random actions, auto-reset included; with `observed`, every detection is read."""
    import jax
    import jax.numpy as jnp

    from tdanet_jax import devices, env
    from tdanet_jax.vocabulary import NUM_ACTIONS

    steps = 64
    params = jax.device_put(task.train_params, devices.everywhere(mesh))

    def split(tree: Any) -> Any:
        return jax.lax.with_sharding_constraint(tree, devices.split(mesh))

    @jax.jit
    def play(key: jax.Array, params: env.EnvParams) -> tuple[jax.Array, env.Observation]:
        reset_key, key = jax.random.split(key)
        keys = jax.random.split(reset_key, count)
        state = split(jax.vmap(env.reset_state, (0, None))(keys, params))

        def body(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            state, obs, total = carry
            action_key, step_key = jax.random.split(key)
            action = jax.random.randint(action_key, (count,), 0, NUM_ACTIONS, jnp.uint8)
            keys = jax.random.split(step_key, count)
            following, state, reward, *_ = jax.vmap(env.step, (0, 0, 0, None))(
                keys, state, action, params
            )
            state, following = split((state, following))
            return (state, following if observed else obs, total + reward), None

        # What is carried is written in every step, and returned, so that it cannot be left out.
        obs = split(jax.vmap(env.observe, (0, None))(state, params))
        total = split(jnp.zeros(count))
        (_, obs, total), _ = jax.lax.scan(body, (state, obs, total), jax.random.split(key, steps))
        return total, obs

    first, seconds = timed(lambda: play(jax.random.key(0), params), repeats)
    return {
        "part": "environment",
        "environments": count,
        "observations": observed,
        "devices": mesh.size,
        "compile_seconds": round(first - seconds, 2),
        "steps_per_second": round(count * steps / seconds),
    }


def tdanet_forward_macs(model: ActorCritic, words_width: int) -> int:
    """Multiply-accumulates of one forward step of TDANet, by the sizes of its layers.

    What is done once per update for the table of classes is not counted.
    """
    from tdanet_jax.vocabulary import NUM_ACTIONS

    width, hidden = model.encoder.width, model.hidden
    encoder = (3 + words_width) * width + 3 * width * width
    action = NUM_ACTIONS * model.action_width
    lstm = (width + model.action_width + hidden) * 4 * hidden
    return encoder + action + lstm + hidden * (NUM_ACTIONS + 1)


def rollout_row(task: Task, count: int, repeats: int) -> Row:
    """Acting alone: environment, network and what the gradient needs later."""
    import jax

    from tdanet_jax import learner

    model, config = task.model, LearnerConfig(num_envs=count)
    state = learner.init(jax.random.key(0), config, model, task.train_words, task.train_params)

    @jax.jit
    def act(state: Any, words: jax.Array, params: Any) -> Any:
        return learner.rollout(state, jax.random.key(1), config, model, words, params)

    def call() -> Any:
        return act(state, task.train_words, task.train_params)

    first, seconds = timed(call, repeats, inner=5)
    return {
        "part": "rollout",
        "environments": count,
        "compile_seconds": round(first - seconds, 2),
        "steps_per_second": round(count * config.rollout_steps / seconds),
    }


def update_row(task: Task, count: int, repeats: int) -> Row:
    """Rollout, gradient and optimiser step, as the training command runs them."""
    cost = update_cost(task.model, task.train_words, task.train_params, count, repeats)
    return {"part": "update", **cost}


def share_of_peak(task: Task, update: Row, peak: float | None) -> Row:
    """Operations of TDANet's update by hand formula, and their share of the peak."""
    by_hand = 6 * tdanet_forward_macs(task.model, task.train_words.shape[1])
    gflops = by_hand * update["steps_per_second"] / 1e9
    return {
        "megaflop_per_step_by_hand": round(by_hand / 1e6, 2),
        "gflops": round(gflops, 1),
        "share_of_float32_peak": round(gflops / peak, 3) if peak else None,
    }


def update_cost(
    model: ActorCritic, words: jax.Array, params: EnvParams, count: int, repeats: int
) -> Row:
    """Time and memory of an update of `count` environments, and XLA's count of its operations.

    XLA counts the body of a loop once. The work of an update is in loops over the T steps, so its
    count over the number of environments is that of one environment step, and what is done once
    per update comes on top.
    """
    import jax
    import jax.numpy as jnp

    from tdanet_jax import learner

    config, updates = LearnerConfig(num_envs=count), 5
    chunk = learner.make_train(config, model, updates)
    state = learner.init(jax.random.key(0), config, model, words, params)
    share = jnp.zeros(2)
    began = time.perf_counter()
    compiled = chunk.lower(state, share, words, params).compile()
    compile_seconds = time.perf_counter() - began
    memory: Any = compiled.memory_analysis()
    cost: Any = compiled.cost_analysis()

    def call() -> Any:
        nonlocal state
        state, metrics = compiled(state, share, words, params)
        return metrics

    _, seconds = timed(call, repeats)
    return {
        "environments": count,
        "compile_seconds": round(compile_seconds, 2),
        "steps_per_second": round(count * config.rollout_steps * updates / seconds),
        "megaflop_per_step_compiled": round(cost["flops"] / count / 1e6, 2),
        "kilobytes_per_step_compiled": round(cost["bytes accessed"] / count / 1e3, 1),
        "arguments_mb": round(memory.argument_size_in_bytes / 1e6, 1),
        "temporary_mb": round(memory.temp_size_in_bytes / 1e6, 1),
    }


def evaluation_row(run: Path | None, task: Task, networks: int, repeats: int) -> Row:
    """All episodes of a split with sampled actions, for several networks in one call.

    Args:
      run: folder of a trained run, whose network plays; None takes an untrained one, which says
        Done early and is done sooner.
    """
    import jax
    import jax.numpy as jnp

    from tdanet_jax import episodes, evaluation, policies, saved
    from tdanet_jax.task import load_task

    if run is None:
        weights = task.model.initialise(jax.random.key(0), task.words)
    else:
        network = saved.find(run)[0]
        task, weights = load_task(network.config), network.load().weights
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf] * networks), weights)
    policy = policies.network(task.model, task.words)
    lists = episodes.load(task.tables, task.split, task.extras)

    def call() -> Any:
        played = evaluation.evaluate_stacked(policy, stacked, task.eval_params, lists, 0)
        return [records.length for one in played for _, records in one.values()]

    first, seconds = timed(call, repeats)
    return {
        "part": "evaluation",
        "networks": networks,
        "trained": run is not None,
        "episodes": networks * sum(len(chosen) for chosen in lists.values()),
        "compile_seconds": round(first - seconds, 2),
        "seconds": round(seconds, 2),
    }


def decision_row(task: Task, count: int, repeats: int) -> Row:
    """One decision of an untrained model: an observation in, action probabilities out."""
    import jax
    import jax.numpy as jnp

    from tdanet_jax import env, parameters
    from tdanet_jax.models import actor_critic

    model = task.model
    weights = jax.jit(model.initialise)(jax.random.key(0), task.words)
    table = jax.jit(actor_critic.prepare, static_argnums=0)(model, weights, task.words)
    keys = jax.random.split(jax.random.key(1), count)
    obs, _ = jax.jit(jax.vmap(env.reset, (0, None)))(keys, task.eval_params)
    carry, fresh = model.initial_carry(count, weights), jnp.zeros(count, bool)
    previous = jnp.zeros((count, 6))

    @jax.jit
    def decide(weights: Any, table: Any, carry: Any, obs: Any) -> Any:
        return actor_critic.forward(model, weights, table, carry, obs, previous, fresh)

    inner = 20 if count == 1 else 1
    first, seconds = timed(lambda: decide(weights, table, carry, obs), 4 * repeats, inner)
    return {
        "part": "decision",
        "batch": count,
        "parameters": parameters.count(model, *task.words.shape).trained,
        "compile_seconds": round(first - seconds, 2),
        "milliseconds": round(1e3 * seconds, 3),
    }


def processor() -> str:
    """The processor's name, as far as the system tells."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def as_table(rows: list[Row]) -> Table:
    """All rows as one table: the part, its setting, and its figures."""
    table = Table("part", "setting", "figures")
    settings = (
        "environments", "devices", "observations", "precision", "model", "batch", "networks",
        "episodes",
    )  # fmt: skip
    for row in rows:
        setting = ", ".join(f"{k} {row[k]}" for k in settings if k in row)
        figures = ", ".join(f"{k} {v}" for k, v in row.items() if k not in (*settings, "part"))
        table.add_row(row["part"], setting, figures)
    return table


if __name__ == "__main__":
    main()
