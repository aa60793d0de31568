"""Commands as a user types them, in a process of their own."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

#: Flags of a training run that is small enough for a test; real rooms all the same.
TINY = ("--num-envs", "8", "--rollout-steps", "5", "--width", "16", "--hidden", "16")


def start(
    module: str, *arguments: str | Path, variables: dict[str, str] | None = None, **options: Any
) -> subprocess.Popen[str]:
    """Starts `python -m experiments.<module>`; its output can be read at once."""
    return subprocess.Popen(
        [sys.executable, "-m", f"experiments.{module}", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"PYTHONUNBUFFERED": "1"} | (variables or {}),
        **options,
    )


def run(module: str, *arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    """Runs `python -m experiments.<module>` to its end."""
    process = start(module, *arguments, **options)
    out, err = process.communicate()
    return subprocess.CompletedProcess(process.args, process.returncode, out, err)
