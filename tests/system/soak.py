"""Trains at full speed for a while and reports what grows: memory, open files, threads.

    python -m tests.system.soak --minutes 60

Runs the training command with its default network and batch on all cores and looks at its process
once a second. Prints one JSON object: the slopes are of straight lines through the second half of
the samples, when everything has been compiled and every buffer been used. Memory goes up and down
with every checkpoint, so its medians over the quarters of the time stand beside the slope. With
--out, the run is kept there, and the samples as soak.csv.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.training.journal import read_metrics

FIELDS = ("seconds", "resident_mb", "files", "threads")


def sample(process: int, began: float) -> tuple[float, ...] | None:
    """Seconds, resident memory in MB, open files and threads of a process; None at its end."""
    proc = Path("/proc") / str(process)
    try:
        status = dict(
            line.split(":", 1) for line in (proc / "status").read_text().splitlines() if ":" in line
        )
        resident = int(status["VmRSS"].split()[0]) / 1024
        open_files = len(list((proc / "fd").iterdir()))
    except (OSError, KeyError):  # a process that has ended has no memory left
        return None
    return time.monotonic() - began, resident, open_files, int(status["Threads"])


def train(minutes: float, folder: Path, arguments: list[str]) -> np.ndarray:
    """Trains for that long; samples [N, 4] taken while it did so."""
    command = [
        sys.executable, "-m", "tdanet_jax", "train", "--minutes",
        str(minutes), "--checkpoint-minutes", "1", "--tensorboard", "--out", str(folder),
        *arguments,
    ]  # fmt: skip
    samples = []
    shipped = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "0"}  # not as tests compile
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=shipped) as process:
        began = time.monotonic()
        while (found := sample(process.pid, began)) is not None:
            if (folder / "learning_curve.png").exists():  # from here on it evaluates
                break
            if (folder / "metrics.jsonl").exists():
                samples.append(found)
            time.sleep(1)
        process.communicate()
    assert process.returncode == 0
    return np.array(samples)


def report(minutes: float, folder: Path, samples: np.ndarray) -> dict[str, Any]:
    """What grew, and whether every chunk has its row."""
    settled = samples[len(samples) // 2 :]
    hours = settled[:, 0] / 3600
    per_hour = {
        f"{name}_per_hour": round(float(np.polyfit(hours, settled[:, i], 1)[0]), 3)
        for i, name in enumerate(FIELDS)
        if name != "seconds"
    }
    quarters = np.array_split(samples, 4)
    rows = read_metrics(folder)
    updates = [row["updates"] for row in rows]
    chunk = updates[0]
    return {
        "minutes": minutes,
        "samples": len(samples),
        "steps": rows[-1]["steps"],
        "steps_per_second": round(rows[-1]["steps"] / rows[-1]["seconds"]),
        **{f"last_{name}": float(samples[-1, i]) for i, name in enumerate(FIELDS)},
        **per_hour,
        "resident_mb_by_quarter": [round(float(np.median(q[:, 1]))) for q in quarters],
        "rows": len(rows),
        "rows_complete": updates == list(range(chunk, updates[-1] + 1, chunk)),
        "cores": len(os.sched_getaffinity(0)),
    }


def soak(minutes: float, arguments: list[str], out: Path | None = None) -> dict[str, Any]:
    """Trains in `out`, or in a folder that is thrown away, and reports."""
    with tempfile.TemporaryDirectory() as folder:
        run = out or Path(folder) / "run"
        samples = train(minutes, run, arguments)
        np.savetxt(run / "soak.csv", samples, "%.1f", ",", header=",".join(FIELDS), comments="")
        return report(minutes, run, samples)


def main() -> None:
    """Runs the command; what it does not know goes to the training command."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--minutes", type=float, default=5.0, help="training time")
    parser.add_argument("--out", type=Path, help="folder of the run, to keep it")
    known, rest = parser.parse_known_args()
    print(json.dumps(soak(known.minutes, rest, known.out), indent=2))


if __name__ == "__main__":
    main()
