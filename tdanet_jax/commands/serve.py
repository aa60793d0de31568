"""Answers frames with actions: one JSON frame a line in, one JSON action a line out.

    tdanet serve --checkpoint agents/18-4-best --hfov 69 --vfov 55

A line names what to look for, once, and lists what is detected:

    {"target": "mug", "detections": [{"label": "sink", "box": [0.1, 0.3, 0.5, 0.8]}]}

The answer is {"action": "RotateLeft", "steps": 1, "finished": false, "outcome": null}, or
{"error": ...} for a line that is not a frame, after which the next line is read. docs/robots.md
lists the fields.
"""

from __future__ import annotations

import dataclasses
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

import tyro

from tdanet_jax.agent.camera import Camera
from tdanet_jax.agent.navigator import Navigator, NavigatorConfig
from tdanet_jax.commands.console import RunPath, fail, one_line_errors, parse
from tdanet_jax.decisions import OWN_DECISIONS, Decisions
from tdanet_jax.poses import ITHOR, SIZES, TURNS, PoseGrid

#: Bytes of a line.
LONGEST = 1 << 20


@dataclasses.dataclass(frozen=True)
class Command:
    """Answers frames with actions: one JSON frame a line in, one JSON action a line out."""

    checkpoint: RunPath
    """Folder of a run, a point of its history, or a bundled agent's name."""
    navigator: tyro.conf.OmitArgPrefixes[NavigatorConfig]
    hfov: float | None = None
    """Horizontal field of view of the camera, in degrees; by default boxes are taken to be those of
    a camera with 90 degrees in both directions."""
    vfov: float | None = None
    """Vertical field of view, in degrees; or give --aspect."""
    aspect: float | None = None
    """Width of the image over its height."""
    horizon: float = 0.0
    """Degrees that the camera looks down where the robot does not tilt it."""
    grid_size: float = ITHOR.grid_size
    """Metres of a step of the robot straight ahead, from 0.05 to 0.5."""
    turn: float = ITHOR.turn
    """Degrees of a turn of the robot."""
    horizons: tuple[int, ...] = ITHOR.horizons
    """Degrees down to which the robot can tilt its camera, ascending, with 0. If it cannot, leave
    this and use --forbid LookUp LookDown."""
    word_vectors: Path | None = None
    """File of word vectors in place of the run's copy."""
    words: Path | None = None
    """File of further words, in GloVe's text format: a word and its numbers on each line."""
    synonyms: Path | None = None
    """JSON file of other names: {"Mug": ["beaker"]}."""
    decisions: tyro.conf.OmitArgPrefixes[Decisions] = OWN_DECISIONS

    @property
    def camera(self) -> Camera:
        """The robot's camera. Raises ValueError if a value is out of range."""
        if self.hfov is None and (self.vfov is not None or self.aspect is not None):
            raise ValueError("--vfov and --aspect need --hfov")
        try:
            if self.hfov is None:
                return Camera(90, 90, horizon=self.horizon)
            return Camera(self.hfov, self.vfov, self.aspect, horizon=self.horizon)
        except ValueError as error:
            problem = str(error).removeprefix("camera: ")
            if getattr(self, name := problem.split()[0], None) is None:  # it is no flag's value
                problem = f"{'aspect' if name == 'vfov' else 'hfov'}: {problem}"
            raise ValueError(f"--{problem}") from None

    @property
    def grid(self) -> PoseGrid:
        """The robot's turns and steps. Raises ValueError if a value is not possible."""
        if not SIZES[0] <= self.grid_size <= SIZES[1]:
            least, most = SIZES
            raise ValueError(
                f"--grid-size {self.grid_size:g}: must be from {least} to {most} metres"
            )
        if self.turn not in TURNS:
            raise ValueError(f"--turn {self.turn:g}: choose one of {', '.join(map(str, TURNS))}")
        try:
            return PoseGrid(self.grid_size, round(360 / self.turn), self.horizons)
        except ValueError as error:  # the others are possible
            raise ValueError(f"--{error}") from None


def main(arguments: list[str] | None = None) -> None:
    """Runs the command."""
    with one_line_errors():
        command = parse(Command, arguments, prog="tdanet serve", description=__doc__)
        command.navigator.check()
        if command.decisions.temperature is not None and command.navigator.seed is None:
            fail("--temperature: has no effect without --seed")
        camera, grid = command.camera, command.grid
        from tdanet_jax.agent import load
        from tdanet_jax.training import devices

        devices.start()
        devices.keep_compiled()
        agent = load(
            command.checkpoint,
            word_vectors=command.word_vectors,
            synonyms=command.synonyms,
            decisions=command.decisions,
            grid=grid,
            more_words=command.words,
        )
        serve(Navigator(agent, camera, command.navigator), sys.stdin.buffer)


def serve(navigator: Navigator, stream: BinaryIO) -> None:
    """Answers every line on standard output, until there are no more."""
    from tdanet_jax.agent import lines

    print(f"ready: {'; '.join(navigator.camera.limits())}", file=sys.stderr, flush=True)
    for number, line in enumerate(read_lines(stream), 1):
        source = f"line {number}"
        if line is None:
            reply = {"error": f"{source}: longer than {LONGEST} bytes"}
        elif not line.strip():
            continue
        else:
            reply = lines.answer(navigator, line.decode("utf-8-sig", "replace"), source)
        print(json.dumps(reply), flush=True)


def read_lines(stream: BinaryIO) -> Iterator[bytes | None]:
    """The lines of a stream; None for one that is too long, which is not kept."""
    while line := stream.readline(LONGEST):
        whole = line.endswith(b"\n") or len(line) < LONGEST
        while line and not line.endswith(b"\n") and len(line) == LONGEST:
            line = stream.readline(LONGEST)
        yield line if whole else None
