"""The devices of a run: environments are split over them, everything else is replicated.

XLA partitions the compiled update by the sharding of its arguments; the learner knows nothing of
devices. Random numbers depend on an environment's index in the whole batch: an update on many
devices equals one on a single device, except for the order in which gradients are added.

Several machines, or several processes on one, run the same command, started by SLURM or Open MPI,
or with the variables JAX_COORDINATOR_ADDRESS (host:port of the first), JAX_NUM_PROCESSES and
JAX_PROCESS_ID (`cluster`).
"""

from __future__ import annotations

import contextlib
import logging
import os
import platform
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from tdanet_jax.io import files
from tdanet_jax.scenes import cache
from tdanet_jax.training.cluster import ADDRESS, LAUNCHERS, PROCESS, PROCESSES, launcher
from tdanet_jax.training.learner import TrainState

AXIS = "environments"
PLATFORMS = "JAX_PLATFORMS"
#: Size of the cache of compiled programs, in bytes.
COMPILED_SIZE = 2**30

# JAX logs why it cannot join a launcher's processes, and raises, too.
logging.getLogger("jax._src.clusters.cluster").setLevel(logging.CRITICAL)


def keep_compiled() -> None:
    """Caches compiled programs, so that a second start does not compile again.

    Does nothing if the cache cannot be written.
    """
    folder = cache.folder() / "compiled"
    try:
        files.check_writable(folder)
    except ValueError:
        return  # JAX would warn of every program
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_compilation_cache_max_size", COMPILED_SIZE)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    jax.config.update("jax_persistent_cache_min_entry_size_bytes", -1)


def start() -> None:
    """Starts JAX, which otherwise happens at its first use.

    Raises:
      ValueError: it cannot be started; one line that names the variable.
    """
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # AssertionError: no such device
        chosen = os.environ.get(PLATFORMS)
        what = "JAX cannot be started"
        if chosen:
            what = f"{PLATFORMS}={chosen}: JAX finds no such device here"
        reason = f" ({_first_line(error)})" if str(error) else ""
        raise ValueError(f"{what}{reason}") from None


def _first_line(error: Exception) -> str:
    return str(error).partition("\n")[0]


def connect(count: int = 1) -> Mesh:
    """Joins the other processes, if any, and returns the mesh; call it before any use of JAX.

    Args:
      count: devices to use in this process; a CPU is split into as many.

    Raises:
      ValueError: there are fewer devices, JAX cannot be started, or the variables of a process are
        incomplete or wrong.
    """
    if count < 1:
        raise ValueError(f"--devices {count}: must be positive")
    if count > 1:  # a CPU that is in use already cannot be split: too few devices, below
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", count)
    if address := os.environ.get(ADDRESS):
        _join_at(address)
    elif name := launcher():
        variable = f"{LAUNCHERS[name]}={os.environ[LAUNCHERS[name]]}"
        try:
            _join(variable, cluster_detection_method=name)
        except ValueError as error:
            own = f"{ADDRESS}, {PROCESSES} and {PROCESS}"
            raise ValueError(f"{error}; set {own} to say who is who") from None
    start()
    if jax.local_device_count() < count:
        raise ValueError(f"--devices {count}: this process has {jax.local_device_count()}")
    chosen: list[Any] = []
    for process in range(jax.process_count()):
        chosen += [d for d in jax.devices() if d.process_index == process][:count]
    return Mesh(np.array(chosen), (AXIS,))


def _join_at(address: str) -> None:
    """Joins the processes whose first one is at an address, HOST:PORT."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(f"{ADDRESS}={address}: must be HOST:PORT, such as host0:1234")
    try:
        processes, process = int(os.environ[PROCESSES]), int(os.environ[PROCESS])
    except (KeyError, ValueError):
        raise ValueError(f"{ADDRESS} is set: {PROCESSES} and {PROCESS} must be, too") from None
    if not 0 <= process < processes:
        raise ValueError(
            f"{PROCESS}={process}: must be from 0 to {processes - 1}, below {PROCESSES}"
        )
    _join(
        f"{ADDRESS}={address}",
        coordinator_address=address,
        num_processes=processes,
        process_id=process,
        cluster_detection_method="deactivate",
    )


def _join(variable: str, **arguments: Any) -> None:
    """Joins the other processes; an error names the variable that asked for it."""
    # Processes on CPUs deadlock if each reduces in its own order.
    flag = "--xla_cpu_enable_concurrency_optimized_scheduler=false"
    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}"
    try:
        jax.distributed.initialize(**arguments)
    except (RuntimeError, ValueError) as error:  # JAX's own errors, and those of a bad address
        raise ValueError(f"{variable}: {_first_line(error).rstrip('.')}") from None


def first() -> Mesh:
    """The first device alone."""
    return Mesh(np.array(jax.local_devices()[:1]), (AXIS,))


def machine(mesh: Mesh) -> str:
    """What a mesh is made of: AMD EPYC 7B13, 2 cores; NVIDIA H200, 8 devices, 2 processes.

    Of a CPU, the cores that this process may use.
    """
    device = mesh.devices.flat[0]
    if device.platform == "cpu":
        affinity = getattr(os, "sched_getaffinity", None)  # Linux alone tells
        parts = [processor(), _counted(len(affinity(0)) if affinity else os.cpu_count(), "core")]
    else:
        parts = [device.device_kind, _counted(mesh.size, "device")]
    if jax.process_count() > 1:
        parts.append(_counted(jax.process_count(), "process"))
    return ", ".join(parts)


def _counted(number: int | None, noun: str) -> str:
    plural = "es" if noun.endswith("s") else "s"
    return f"{number} {noun}{plural * (number != 1)}"


def processor() -> str:
    """The processor's name, if the system tells it."""
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine()


def is_lead() -> bool:
    """Whether this process writes files and prints; always true for a single process."""
    return jax.process_index() == 0


def from_lead(value: float) -> float:
    """The lead process's value, in every process."""
    return float(multihost_utils.broadcast_one_to_all(np.float64(value)))


def anywhere(flag: bool) -> bool:
    """Whether the flag is set in any process."""
    if jax.process_count() == 1:
        return flag
    return bool(np.any(multihost_utils.process_allgather(np.array(flag))))


def everywhere(mesh: Mesh) -> NamedSharding:
    """Replicated on every device."""
    return NamedSharding(mesh, PartitionSpec())


def whole(tree: Any, mesh: Mesh) -> Any:
    """The arrays, gathered in this process, so that they can be written to a file."""
    if jax.process_count() == 1:
        return tree
    return jax.jit(lambda x: x, out_shardings=everywhere(mesh))(tree)


def wait_for_all(reason: str) -> None:
    """Returns when every process has arrived here."""
    multihost_utils.sync_global_devices(reason)


def split(mesh: Mesh) -> NamedSharding:
    """Split along the first axis."""
    return NamedSharding(mesh, PartitionSpec(AXIS))


def check_divides(
    environments: int, mesh: Mesh, flag: str = "num-envs", minibatches: int = 1
) -> None:
    """Raises ValueError unless the environments of every minibatch can be divided evenly.

    The message says which numbers can be.
    """
    size, rest = mesh.size, environments % mesh.size
    if rest:
        fewer, more = environments - rest, environments - rest + size
        divisors = [n for n in range(1, environments + 1) if environments % n == 0]
        near = [n for n in divisors if n < size][-1:] + [n for n in divisors if n > size][:1]
        raise ValueError(
            f"--{flag} {environments}: cannot be divided evenly over {size} devices; "
            f"{' or '.join(str(n) for n in (fewer, more) if n)} environments can be, or "
            f"{' or '.join(map(str, near))} devices"
        )
    if environments % (minibatches * size):
        raise ValueError(
            f"--{flag} {environments}: must be a multiple of {minibatches * size}, "
            f"--num-minibatches {minibatches} times {size} devices"
        )


def layout(state: Any, mesh: Mesh) -> Any:
    """The sharding of each array of a `TrainState`: split if it has a row per environment.

    Raises:
      ValueError: the environments cannot be divided evenly.
    """
    check_divides(state.bootstrap_only.shape[0], mesh)

    def place(tree: Any, sharding: NamedSharding) -> Any:
        return jax.tree.map(lambda _: sharding, tree)

    per_environment: tuple[str, ...] = TrainState.PER_ENVIRONMENT
    return place(state, everywhere(mesh)).replace(
        **{name: place(getattr(state, name), split(mesh)) for name in per_environment}
    )
