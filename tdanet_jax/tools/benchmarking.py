"""Speed of this machine and of each part of the software, with compilation and run time apart.

Every value is the median over repetitions. Each function returns a row of results by name.
"""

from __future__ import annotations

import functools
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh

from tdanet_jax.agent import agent as saved_agents
from tdanet_jax.agent import numpy_agent
from tdanet_jax.agent.detection import Detection
from tdanet_jax.config import LearnerConfig
from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams, Observation
from tdanet_jax.eval_config import EvalConfig
from tdanet_jax.evaluation import episodes, policies, rollout, saved_networks
from tdanet_jax.models import actor_critic, parameter_count
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.task import Task, load_task
from tdanet_jax.tools.arithmetic import UPDATE_OPERATIONS, forward_macs
from tdanet_jax.training import devices, history, learner
from tdanet_jax.vocabulary import NUM_ACTIONS
from tdanet_jax.workflows.export import check as check_export
from tdanet_jax.workflows.export import export

Row = dict[str, Any]


def timed(call: Callable[[], Any], repeats: int, inner: int = 1) -> tuple[float, float]:
    """Seconds of the first call, including compilation, and the median of later ones.

    Args:
      call: what to time.
      repeats: number of repetitions.
      inner: calls in a repetition; the median is per call.
    """
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


def machine_row(repeats: int) -> Row:
    """The limits of the machine: rate of matrix products, and memory bandwidth."""
    times = 5 if jax.default_backend() == "cpu" else 200  # an accelerator takes microseconds

    @jax.jit
    def multiply(a: jax.Array, b: jax.Array) -> jax.Array:
        def again(_: jax.Array, a: jax.Array) -> jax.Array:
            product = jnp.dot(a, b, preferred_element_type=jnp.float32)
            # The next product depends on all of this one.
            return (product[:, :1024] + product[:, 1024:]).astype(a.dtype)

        return jax.lax.fori_loop(0, times, again, a)

    add_one = jax.jit(lambda x: x + 1)
    row: Row = {"part": "machine"}
    for name, dtype in (("float32", jnp.float32), ("bfloat16", jnp.bfloat16)):
        best = 0.0
        for batch in (512, 1024, 2048):
            a = jax.random.normal(jax.random.key(0), (batch, 1024)).astype(dtype)
            b = (jax.random.normal(jax.random.key(1), (1024, 2048)) / 45).astype(dtype)
            _, seconds = timed(functools.partial(multiply, a, b), 4 * repeats)
            best = max(best, times * 2 * batch * 1024 * 2048 / seconds / 1e9)
        row[f"{name}_gflops"] = round(best, 1)
    big = jnp.zeros(2**26, jnp.float32)
    _, seconds = timed(functools.partial(add_one, big), repeats, inner=2)
    row["bandwidth_gb_per_s"] = round(2 * big.nbytes / seconds / 1e9, 1)
    return row


def environment_row(task: Task, count: int, observed: bool, repeats: int, mesh: Mesh) -> Row:
    """Random actions with auto-reset; with `observed`, every observation is computed."""
    steps = 64
    params = jax.device_put(task.train_params, devices.everywhere(mesh))

    def split(tree: Any) -> Any:
        return jax.lax.with_sharding_constraint(tree, devices.split(mesh))

    @jax.jit
    def play(key: jax.Array, params: EnvParams) -> tuple[jax.Array, Observation]:
        reset_key, key = jax.random.split(key)
        keys = jax.random.split(reset_key, count)
        state = split(jax.vmap(dynamics.reset_state, (0, None))(keys, params))

        def body(carry: tuple, key: jax.Array) -> tuple[tuple, None]:
            state, obs, total = carry
            action_key, step_key = jax.random.split(key)
            action = jax.random.randint(action_key, (count,), 0, NUM_ACTIONS, jnp.uint8)
            keys = jax.random.split(step_key, count)
            following, state, reward, *_ = jax.vmap(dynamics.step, (0, 0, 0, None))(
                keys, state, action, params
            )
            state, following = split((state, following))
            return (state, following if observed else obs, total + reward), None

        # Everything carried is written in every step and returned, so that XLA cannot drop it.
        obs = split(jax.vmap(dynamics.observe, (0, None))(state, params))
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


def rollout_row(task: Task, config: LearnerConfig, repeats: int) -> Row:
    """Acting alone: environment, network, and what the gradient will need."""
    model = task.model
    state = learner.init(jax.random.key(0), config, model, task.train_words, task.train_params)

    @jax.jit
    def act(state: Any, words: jax.Array, params: Any) -> Any:
        return learner.rollout(state, jax.random.key(1), config, model, words, params)

    def call() -> Any:
        return act(state, task.train_words, task.train_params)

    first, seconds = timed(call, repeats, inner=5)
    return {
        "part": "rollout",
        "environments": config.num_envs,
        "compile_seconds": round(first - seconds, 2),
        "steps_per_second": round(config.num_envs * config.rollout_steps / seconds),
    }


def update_row(task: Task, config: LearnerConfig, repeats: int) -> Row:
    """Rollout, gradient and optimiser step, as in training."""
    cost = update_cost(task.model, task.train_words, task.train_params, config, repeats)
    return {"part": "update", **cost}


def operations_per_step(task: Task) -> int:
    """Operations of the products that an update needs for one environment step.

    Args:
      task: with a model that multiplies in float32: some are padded with zeros in bfloat16.
    """
    return UPDATE_OPERATIONS * forward_macs(task.model, task.train_words, task.train_params)


def share_of_peak(operations: int, update: Row, peak: float | None) -> Row:
    """What an update multiplies in a second, and the share of the peak that this is.

    Args:
      operations: per environment step, from `operations_per_step`.
      update: its `update_row`.
      peak: rate of float32 products, GFLOP/s; None if it was not measured.
    """
    gflops = operations * update["steps_per_second"] / 1e9
    return {
        "megaflop_per_step": round(operations / 1e6, 2),
        "gflops": round(gflops, 1),
        "share_of_float32_peak": round(gflops / peak, 3) if peak else None,
    }


def update_cost(
    model: ActorCritic, words: jax.Array, params: EnvParams, config: LearnerConfig, repeats: int
) -> Row:
    """Time and memory of an update, and XLA's count of its operations.

    XLA counts the body of a loop once, and an update loops over its T steps. Its count divided by
    the number of environments is thus that of one environment step, plus what is done once per
    update.
    """
    count, updates = config.num_envs, 5
    chunk = learner.make_train(config, model, updates)
    state = learner.init(jax.random.key(0), config, model, words, params)
    share = jnp.zeros(2)
    began = time.perf_counter()
    compiled = chunk.lower(state, share, words, params).compile()
    compile_seconds = time.perf_counter() - began
    memory: Any = compiled.memory_analysis()
    cost: Any = compiled.cost_analysis() or {}  # not every backend counts

    def per_step(name: str, unit: float) -> float | None:
        return round(cost[name] / count / unit, 2) if name in cost else None

    def call() -> Any:
        nonlocal state
        state, metrics = compiled(state, share, words, params)
        return metrics

    _, seconds = timed(call, repeats)
    return {
        "environments": count,
        "compile_seconds": round(compile_seconds, 2),
        "steps_per_second": round(count * config.rollout_steps * updates / seconds),
        "megaflop_per_step_compiled": per_step("flops", 1e6),
        "kilobytes_per_step_compiled": per_step("bytes accessed", 1e3),
        "arguments_mb": round(memory.argument_size_in_bytes / 1e6, 1),
        "temporary_mb": round(memory.temp_size_in_bytes / 1e6, 1),
    }


def evaluation_row(
    run: Path | None, task: Task, networks: int, repeats: int, data: str | None = None
) -> Row:
    """All episodes of a split with sampled actions, for several networks in one call.

    Args:
      run: folder of a trained run, whose network plays; None takes an untrained one, whose episodes
        are shorter.
      task: what an untrained network plays.
      networks: number of networks.
      repeats: number of repetitions.
      data: file of rooms in which a trained network plays; by default, its own.
    """
    if run is None:
        weights = task.model.initialise(jax.random.key(0), task.words)
    else:
        network = saved_networks.find(run, test=EvalConfig(data=data))[0]
        task, weights = load_task(network.located), network.load().weights
        history.check_fit(run, weights, task.model.parameter_shapes(*task.words.shape))
    stacked = jax.tree.map(lambda leaf: jnp.stack([leaf] * networks), weights)
    policy = policies.network(task.model, task.words)
    lists = episodes.load(task.tables, task.split, task.extras)

    def call() -> Any:
        played = rollout.evaluate_stacked(policy, stacked, task.eval_params, lists, 0)
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


#: Objects in each frame of `agent_row`, frames that are timed, and robots that decide together.
IN_VIEW, FRAMES, ROBOTS = 12, 200, 100


def agent_row(run: Path | str) -> Row:
    """What a robot waits for: the steps of a trained agent, with random boxes in view.

    Returns:
      Median milliseconds of `Agent.act`, of `Agent.act_many` for `ROBOTS` robots, and of the same
      agent without JAX; and the seconds from the start of Python to the first action, with the
      programs compiled before, and without JAX. A model that is not exported has no figures
      without JAX.
    """
    agent, rng = saved_agents.load(run), np.random.default_rng(0)
    names = [agent.classes.names[i] for i in rng.integers(0, len(agent.classes.names), IN_VIEW)]

    def frame() -> list[Detection]:
        low = rng.uniform(0, 0.8, (IN_VIEW, 2))
        boxes = np.concatenate([low, low + rng.uniform(0.02, 0.2, (IN_VIEW, 2))], axis=1)
        return [Detection(n, *map(float, box)) for n, box in zip(names, boxes, strict=True)]

    frames = [frame() for _ in range(FRAMES)]

    def milliseconds(who: Any) -> float:
        state, taken = who.start(), []
        for seen in (*frames[:10], *frames):
            began = time.perf_counter()
            state, _ = who.act(state, seen, names[0], blocked=False)
            taken.append(time.perf_counter() - began)
        return round(1e3 * statistics.median(taken[10:]), 3)

    states = [agent.start()] * ROBOTS
    together = functools.partial(
        agent.act_many, states, frames[:ROBOTS], names[:1] * ROBOTS, None, [False] * ROBOTS
    )
    row: Row = {
        "part": "agent",
        "milliseconds": milliseconds(agent),
        f"milliseconds_{ROBOTS}_robots": round(1e3 * timed(together, 20)[1], 3),
    }
    with tempfile.TemporaryDirectory() as place:
        started = [sys.executable, "-c", FIRST_ACTION.format(run=str(run))]
        compiled = os.environ | {"JAX_COMPILATION_CACHE_DIR": f"{place}/compiled"}
        compiled |= {"JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
        row["seconds_to_first_action"] = _seconds(started, compiled)
        try:
            check_export(agent)
        except ValueError:  # this model needs JAX
            return row
        folder = export(run, Path(place) / "exported")
        row["milliseconds_without_jax"] = milliseconds(numpy_agent.load(folder))
        code = FIRST_ACTION.format(run=str(folder)) + WITHOUT_JAX
        alone = {**os.environ, "PYTHONPATH": str(folder)}
        # -P: a clone in the current folder would come before the exported package.
        started = [sys.executable, "-P", "-c", code]
        row["seconds_to_first_action_without_jax"] = _seconds(started, alone)
    return row


#: A program that ends with an agent's first action.
FIRST_ACTION = """
import tdanet_jax
agent = tdanet_jax.load({run!r})
agent.act(agent.start(), [tdanet_jax.Detection("mug", 0.2, 0.3, 0.4, 0.5)], "mug")
"""
#: Appended for the exported agent: fails if anything has imported JAX.
WITHOUT_JAX = """
import sys
assert "jax" not in sys.modules
"""


def _seconds(command: list[str], variables: Mapping[str, str]) -> float:
    """The median of three runs of a program, after one that compiles."""
    taken = []
    for _ in range(4):
        began = time.perf_counter()
        subprocess.run(command, env=variables, check=True, stdout=subprocess.DEVNULL)
        taken.append(time.perf_counter() - began)
    return round(statistics.median(taken[1:]), 2)


def decision_row(task: Task, count: int, repeats: int) -> Row:
    """One decision of an untrained model: an observation in, action probabilities out."""
    model = task.model
    weights = jax.jit(model.initialise)(jax.random.key(0), task.words)
    class_table = jax.jit(actor_critic.prepare, static_argnums=0)(model, weights, task.words)
    keys = jax.random.split(jax.random.key(1), count)
    obs, _ = jax.jit(jax.vmap(dynamics.reset, (0, None)))(keys, task.eval_params)
    state = actor_critic.initial_state(model, weights, count)

    @jax.jit
    def decide(weights: Any, class_table: Any, state: Any, obs: Any) -> Any:
        return actor_critic.act(model, weights, class_table, state, obs)

    inner = 20 if count == 1 else 1
    first, seconds = timed(lambda: decide(weights, class_table, state, obs), 4 * repeats, inner)
    return {
        "part": "decision",
        "batch": count,
        "parameters": parameter_count.count(model, *task.words.shape).trained,
        "compile_seconds": round(first - seconds, 2),
        "milliseconds": round(1e3 * seconds, 3),
    }
