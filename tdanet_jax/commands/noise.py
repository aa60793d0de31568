"""Measures the noise of a detector on labelled images, as `--noise` takes it.

    tdanet noise --truth instances.json --found predictions.json

Both files are in COCO's formats; ultralytics writes the second with `val(save_json=True)`. Agents
can then be evaluated and trained with the noise of the detector that they will work with:

    tdanet evaluate --checkpoint 18-4-robust --noise misses=0.12,jitter=0.08
"""

from __future__ import annotations

import dataclasses
import warnings
from pathlib import Path

from tdanet_jax.commands.console import console, fail, one_line_errors, parse


@dataclasses.dataclass(frozen=True)
class Command:
    """Measures the noise of a detector on labelled images."""

    truth: Path
    """JSON file with the images, their labelled objects and the categories."""
    found: Path
    """JSON file with the list of detections in the same images."""
    min_score: float = 0.25
    """Detections with a lower score are left out, as on your robot."""
    iou: float = 0.5
    """Overlap, intersection over union, from which a detection is one of an object."""


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet noise", description=__doc__)
        if not 0 <= command.min_score <= 1:
            fail(f"--min-score {command.min_score}: must be from 0 to 1")
        if not 0 < command.iou < 1:
            fail(f"--iou {command.iou}: must be between 0 and 1")
        from tdanet_jax.agent import measured_noise

        there, seen = measured_noise.read_coco(command.truth, command.found, command.min_score)
        found = measured_noise.measure(there, seen, command.iou)
        console.print(
            f"{found.images:,} images, {found.objects:,} objects: {found.found:,} found, of these "
            f"{found.mislabelled:,} with a wrong label; {found.duplicated:,} duplicates and "
            f"{found.invented:,} false positives"
        )
        console.print(f"--noise {found.noise}")
        if found.mislabelled > found.found / 2:
            warnings.warn(f"most labels are wrong: {measured_noise.NUMBERS}", stacklevel=1)
