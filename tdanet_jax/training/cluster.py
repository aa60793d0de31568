"""Whether several processes train one run together, as their environment says. Imports no JAX."""

from __future__ import annotations

import os

#: The address (HOST:PORT) of the first process, their number, and this process's own, from 0.
ADDRESS, PROCESSES, PROCESS = "JAX_COORDINATOR_ADDRESS", "JAX_NUM_PROCESSES", "JAX_PROCESS_ID"
#: Launchers that tell their processes who is who, by JAX's names and in its order (mpirun may run
#: within SLURM), and the variable with the number of processes that they started. SLURM's is not
#: set in a job script, but in each step (`srun`).
LAUNCHERS = {"ompi": "OMPI_COMM_WORLD_SIZE", "slurm": "SLURM_STEP_NUM_TASKS"}


def launcher() -> str | None:
    """The launcher that started several processes; None if `ADDRESS` is set, or there is one."""
    if os.environ.get(ADDRESS):
        return None
    counts = {name: os.environ.get(variable, "") for name, variable in LAUNCHERS.items()}
    return next((n for n, count in counts.items() if count.isdecimal() and int(count) > 1), None)


def several() -> bool:
    """Whether other processes take part in the same run."""
    return bool(os.environ.get(ADDRESS)) or launcher() is not None


def leave() -> None:
    """Makes this process one by itself, whichever others a launcher has started."""
    for variable in LAUNCHERS.values():
        os.environ.pop(variable, None)
