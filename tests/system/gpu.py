"""What the programs need of a GPU: compiled for one, without one.

    pip install -e '.[cuda]'  # JAX's CUDA compiler
    python -m tests.system.gpu --num-envs 256 4096 16384

Compiles the update, as the training command runs it, and the evaluation of several networks for a
GPU that is described, not there. Prints a JSON object for each number of environments. Memory is
the compiler's own plan. Kernels and bytes are counted in the compiled program: every kernel reads
its operands and writes its result once. `floor_ms` is the time of these bytes at the GPU's
bandwidth. Nothing runs, so nothing is timed.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import os
import re
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, NamedTuple

if TYPE_CHECKING:
    from tdanet_jax.config import TrainConfig
    from tdanet_jax.task import Task

#: NVIDIA's H200, in the words of XLA's `GpuTargetConfigProto`.
H200 = """
gpu_device_info {
  threads_per_block_limit: 1024
  threads_per_warp: 32
  shared_memory_per_block: 49152
  shared_memory_per_core: 233472
  shared_memory_per_block_optin: 232448
  threads_per_core_limit: 2048
  registers_per_core_limit: 65536
  registers_per_block_limit: 65536
  core_count: 132
  fpus_per_core: 128
  block_dim_limit_x: 2147483647
  block_dim_limit_y: 65535
  block_dim_limit_z: 65535
  thread_dim_limit_x: 1024
  thread_dim_limit_y: 1024
  thread_dim_limit_z: 64
  memory_bandwidth: 4800000000000
  l2_cache_size: 52428800
  clock_rate_ghz: 1.98
  device_memory_size: 151397597184
  cuda_compute_capability { major: 9 }
  driver_version: "12.8.0"
  runtime_version: "12.8.0"
  compile_time_toolkit_version: "12.8.0"
}
platform_name: "CUDA"
dnn_version_info { major: 9 minor: 10 }
device_description_str: "NVIDIA H200"
"""
#: Its bytes a second, by its data sheet.
BANDWIDTH = 4.8e12
#: Instructions that start no kernel.
FREE = {"parameter", "constant", "tuple", "get-tuple-element", "bitcast", "while", "after-all"}
#: Without a GPU to try kernels on, products are cuBLAS's.
FLAGS = "--xla_gpu_autotune_level=0 --xla_gpu_enable_triton_gemm=false"


class Instruction(NamedTuple):
    """A line of a compiled program, `shape name(operands), attributes`."""

    shape: str
    operation: str
    operands: tuple[str, ...]
    attributes: str

    def called(self, attribute: str) -> str:
        """The name of the computation in an attribute."""
        found = re.search(rf"{attribute}=%?([\w.\-]+)", self.attributes)
        assert found, self
        return found[1]


Computation = dict[str, Instruction]


def parse(text: str) -> tuple[dict[str, Computation], str]:
    """The computations of a program as XLA prints it, and the name of the first to run."""
    computations: dict[str, Computation] = {}
    entry, body = "", {}
    for line in text.splitlines():
        if head := re.match(r"(ENTRY )?%?([\w.\-]+) \(.*\{$", line):
            body = computations[head[2]] = {}
            entry = head[2] if head[1] else entry
        elif found := re.match(r"\s+(?:ROOT )?%([\w.\-]+) = (\(.*?\)|\S+) ([\w\-]+)\((.*)$", line):
            operands, _, attributes = found[4].partition(")")
            names = tuple(re.findall(r"%([\w.\-]+)", operands))
            body[found[1]] = Instruction(found[2], found[3], names, attributes)
    return computations, entry


def size(shape: str) -> int:
    """Bytes of an array, or of a tuple of arrays but for cuBLAS's workspace (s8)."""
    total = 0
    for kind, bits, dims in re.findall(r"\b(pred|bf|[fsu])(\d*)\[([\d,]*)\]", shape):
        if (kind, bits) != ("s", "8"):
            total += int(bits or 8) // 8 * math.prod(int(n) for n in dims.split(",") if n)
    return total


def read(body: Computation, name: str) -> int:
    """Bytes that a fusion reads of one parameter: all, or the parts that it looks up."""
    total = 0
    for user, other in body.items():
        if name not in other.operands:
            continue
        if other.operation == "bitcast":
            total += read(body, user)
        elif other.operation in ("dynamic-slice", "gather") and other.operands[0] == name:
            total += size(other.shape)
        elif other.operation != "dynamic-update-slice" or other.operands[0] != name:
            return size(body[name].shape)
    return total


def moved(kernel: Instruction, computation: Computation, fused: Computation | None) -> int:
    """Bytes that a kernel reads and writes; of an array that it updates in place, the update."""
    written = size(kernel.shape)
    if fused is None:
        return written + sum(size(computation[name].shape) for name in kernel.operands)
    for inner in fused.values():
        if inner.operation == "dynamic-update-slice":
            written += size(fused[inner.operands[1]].shape) - size(inner.shape)
    inputs = [name for name, inner in fused.items() if inner.operation == "parameter"]
    return written + sum(read(fused, name) for name in inputs)


def kernels(computations: dict[str, Computation], name: str, times: int = 1) -> Iterator[tuple]:
    """How often each kernel of a computation starts, loops included, and the bytes it moves."""
    computation = computations[name]
    for instruction in computation.values():
        if instruction.operation == "while":
            trips = re.search(r'known_trip_count":\{"n":"(\d+)"', instruction.attributes)
            turns = times * (int(trips[1]) if trips else 1)
            yield from kernels(computations, instruction.called("body"), turns)
        elif instruction.operation == "call":
            yield from kernels(computations, instruction.called("to_apply"), times)
        elif instruction.operation not in FREE:
            fusion = instruction.operation == "fusion"
            fused = computations[instruction.called("calls")] if fusion else None
            yield times, moved(instruction, computation, fused)


def gpu() -> Any:
    """The GPU that is not there, as a place for arrays. Before anything else of JAX.

    Raises:
      ImportError: JAX's CUDA compiler is not installed.
    """
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {FLAGS}"
    os.environ["JAX_PLATFORMS"] = "cpu"
    import jax
    import jax_plugins.xla_cuda12  # noqa: F401
    from jax.experimental import topologies

    jax.default_backend = lambda: "gpu"  # what the package asks for the form of its programs
    jax.devices("cpu")
    there = topologies.get_topology_desc("", "cuda", target_config=H200, topology="1x1x1")
    return jax.sharding.SingleDeviceSharding(there.devices[0])


def compiled(function: Any, arguments: tuple, place: Any) -> Any:
    """A jitted function compiled for that GPU."""
    import jax

    def there(x: Any) -> Any:
        return jax.ShapeDtypeStruct(x.shape, x.dtype, sharding=place)

    traced = function.trace(*jax.tree.map(there, arguments))
    return traced.lower(lowering_platforms=("cuda",)).compile()


def gigabytes(program: Any) -> float:
    """Memory of a program, its arguments included."""
    memory = program.memory_analysis()
    return round((memory.argument_size_in_bytes + memory.temp_size_in_bytes) / 1e9, 2)


def update(config: TrainConfig, task: Task, place: Any) -> dict[str, Any]:
    """What an update of the training command needs."""
    import jax

    from tdanet_jax.training import learner

    updates, known = config.chunk_updates, (task.train_words, task.train_params)
    state = jax.eval_shape(
        lambda: learner.init(jax.random.key(0), config.learner, task.model, *known)
    )
    chunk = learner.make_train(config.learner, task.model, updates, place)
    program = compiled(chunk, (state, jax.numpy.zeros(2), *known), place)
    found = list(kernels(*parse(program.as_text())))
    traffic = sum(times * amount for times, amount in found) / updates
    return {
        "environments": config.learner.num_envs,
        "steps": config.steps_per_update,
        "gigabytes": gigabytes(program),
        "kernels": round(sum(times for times, _ in found) / updates),
        "gigabytes_moved": round(traffic / 1e9, 3),
        "floor_ms": round(1e3 * traffic / BANDWIDTH, 2),
    }


def evaluation(task: Task, networks: int, place: Any) -> dict[str, Any]:
    """What the evaluation of several networks side by side needs."""
    import jax

    from tdanet_jax.evaluation import episodes, policies, rollout

    chosen = next(iter(episodes.load(task.tables, task.split, task.extras).values()))
    keys = jax.random.split(jax.random.key(0), networks)
    weights = jax.eval_shape(lambda: jax.vmap(task.model.initialise, (0, None))(keys, task.words))
    limit = int(task.eval_params.step_limit.max())
    play = functools.partial(
        rollout._play_each, policies.network(task.model, task.words), limit, True
    )
    arguments = (weights, task.eval_params, chosen.pose, chosen.target, keys)
    program = compiled(jax.jit(play), arguments, place)
    return {
        "networks": networks,
        "episodes": len(chosen.pose),
        "gigabytes": gigabytes(program),
    }


def main() -> None:
    """Runs the command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--preset", default="default", help="as of the training command")
    parser.add_argument("--models", nargs="+", default=["tdanet"])
    parser.add_argument("--num-envs", nargs="*", type=int, default=[256, 4096, 16384])
    parser.add_argument("--networks", nargs="*", type=int, default=[20], help="evaluated together")
    command = parser.parse_args()
    place = gpu()
    from tdanet_jax.config import PRESETS
    from tdanet_jax.task import load_task

    for model in command.models:
        config = dataclasses.replace(PRESETS[command.preset], model=model)
        task = load_task(config)
        for count in command.num_envs:
            learning = dataclasses.replace(config.learner, num_envs=count)
            row = update(dataclasses.replace(config, learner=learning), task, place)
            print(json.dumps({"model": model, **row}), flush=True)
        for count in command.networks:
            print(json.dumps({"model": model, **evaluation(task, count, place)}), flush=True)


if __name__ == "__main__":
    main()
