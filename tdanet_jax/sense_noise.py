"""How an agent's senses err: levels of noise as one value. Imports no JAX.

`tdanet_jax.sensors.noise` does what is defined here; docs/noise.md has the equations.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

#: A level that every episode has, or the ends of a range from which each episode draws its own.
Level = float | tuple[float, float]


#: Upper bounds of levels that are no rates or shares, or have others.
_MOST: Mapping[str, float] = {
    "false_positives": 4,
    "duplicates": 0.5,
    "truncation": 0.45,
    "heading_drift": 45,
    "heading_error": 180,
}


#: Levels of what a detector sees; all others are of motion.
_OF_DETECTIONS = (
    "misses", "small_misses", "false_positives", "duplicates", "swaps", "confusions", "jitter",
    "truncation", "scores",
)  # fmt: skip

#: Side of a box, as a share of the image's, at which misses of small boxes have fallen to 1/e.
SMALL_SIDE = 0.1


def highest(name: str) -> float:
    """The upper bound of the level with this name."""
    return _MOST.get(name, 1)


@dataclasses.dataclass(frozen=True)
class SenseNoise:
    """Levels of noise; 0 is a perfect sense. Rates are probabilities.

    The world stays as it is: visibility, rewards and success do not depend on noise. What an agent
    is shown does.
    """

    misses: Level = 0.0
    """Rate at which a detection is missed, whatever its size."""
    small_misses: Level = 0.0
    """Rate at which a tiny detection is missed in addition. It falls as e^(-side / 0.1), where the
    side is the square root of the box's area as a share of the image. A box shows what is not
    hidden, so the rate rises with occlusion, too."""
    false_positives: Level = 0.0
    """Mean number of detections per frame of what is not there: class and box of one drawn from all
    detections of all views."""
    duplicates: Level = 0.0
    """Mean number of second detections for each detection, at most 4 per frame."""
    swaps: Level = 0.0
    """Rate at which a label is replaced by that of any other known class."""
    confusions: Level = 0.0
    """Rate at which a label is replaced by that of a class that looks alike or has a similar
    name."""
    jitter: Level = 0.0
    """Standard deviation of a box's centre, and of the logarithm of its sides, as a share of each
    side. Boxes are cut at the border of the image."""
    truncation: Level = 0.0
    """Width of a border of the image in which the detector sees nothing, as a share of its side.
    Boxes are cut there, and those that lie in it are missed."""
    scores: Level = 0.0
    """How uncertain the detector is, for agents that are shown scores: 0 gives 1 to all detections,
    1 to right ones the larger of two uniform numbers and to wrong ones the smaller."""
    distance_bias: Level = 0.0
    """Share by which an episode's steps all seem longer, or all shorter, with equal probability."""
    distance_noise: Level = 0.0
    """Standard deviation of the believed length of each step, as a share of it."""
    turn_bias: Level = 0.0
    """Share by which an episode's turns all seem larger, or all smaller, with equal probability."""
    turn_noise: Level = 0.0
    """Standard deviation of the believed angle of each turn, as a share of it."""
    heading_drift: Level = 0.0
    """Degrees that the believed heading drifts before each MoveAhead, to one side in an episode."""
    heading_error: Level = 0.0
    """Standard deviation in degrees of an error of the heading that is drawn anew in each pose and
    does not accumulate."""
    short_steps: Level = 0.0
    """Rate of steps that fall short of what the agent believes: it takes them for longer by a
    uniform share from 0 to 1."""
    failed_turns: Level = 0.0
    """Rate of turns that fail, while the agent believes that it has turned."""

    def check(self, flag: str = "--noise") -> None:
        """Raises ValueError, with one line that names the flag and field, if a level is wrong."""
        for field in dataclasses.fields(self):
            low, high = ends(getattr(self, field.name))
            most = highest(field.name)
            if not 0 <= low <= high <= most:
                raise ValueError(
                    f"{flag} {field.name}: must be a level from 0 to {most}, or a range of them"
                )

    def check_image(self) -> None:
        """Raises ValueError if a level of detections is above 0: an image stays as it is."""
        for name in _OF_DETECTIONS:
            if ends(getattr(self, name))[1] > 0:
                raise ValueError(
                    f"--noise {name}: is of detections, and this model looks at an image, which "
                    "stays as it is; choose noise of motion, or a model without an image"
                )

    @property
    def any(self) -> bool:
        """Whether any level can be above 0."""
        return any(ends(level)[1] > 0 for level in vars(self).values())

    def __str__(self) -> str:
        """The levels as `parse` reads them: misses=0.2,jitter=0:0.1; "none" without any."""
        shown = {name: ends(level) for name, level in vars(self).items() if ends(level)[1] > 0}
        parts = (
            f"{name}={low:g}" if low == high else f"{name}={low:g}:{high:g}"
            for name, (low, high) in shown.items()
        )
        return ",".join(parts) or "none"


def ends(level: Level) -> tuple[float, float]:
    """The ends of the range that an episode's level is drawn from."""
    return level if isinstance(level, tuple) else (level, level)


NONE = SenseNoise()
#: A detector as on a robot: a fifth of the detections are missed, small ones more often.
DETECTOR = SenseNoise(misses=0.15, small_misses=0.3, jitter=0.1, swaps=0.05, scores=1.0)
#: Wheels that drift: 5 % of each step and turn, the same in an episode, and as much at random.
WHEELS = SenseNoise(distance_bias=0.05, distance_noise=0.05, turn_bias=0.05, turn_noise=0.05)
#: Both.
MIX = dataclasses.replace(
    DETECTOR, distance_bias=0.05, distance_noise=0.05, turn_bias=0.05, turn_noise=0.05
)
#: Levels with a name.
PRESETS: Mapping[str, SenseNoise] = {
    "none": NONE, "detector": DETECTOR, "wheels": WHEELS, "mix": MIX
}  # fmt: skip
#: `--noise sweep`: every kind of noise below, one after the other.
SWEEP = "sweep"
#: The rows of a sweep, written after every level.
SWEEP_FILE = "noise.json"


def scaled(noise: SenseNoise, factor: float) -> SenseNoise:
    """Noise with every level times a factor, as far as levels go."""
    values = {
        n: min(round(factor * ends(level)[1], 9), highest(n)) for n, level in vars(noise).items()
    }
    return SenseNoise(**values)


def up_to(noise: SenseNoise, factor: float) -> SenseNoise:
    """Noise whose levels are drawn from 0 to a factor of the given ones, for training."""
    most = vars(scaled(noise, factor)).items()
    return SenseNoise(**{name: (0.0, level) for name, level in most if level})


def _along(levels: tuple[float, ...], *names: str) -> dict[str, SenseNoise]:
    return {f"{level:g}": SenseNoise(**dict.fromkeys(names, level)) for level in levels}


def _times(noise: SenseNoise) -> dict[str, SenseNoise]:
    return {f"x {factor:g}": scaled(noise, factor) for factor in (0.25, 0.5, 1.0, 1.5, 2.0)}


#: What a sweep plays: five levels of each kind of noise, by their names.
SWEEPS: Mapping[str, Mapping[str, SenseNoise]] = {
    "misses": _along((0.1, 0.2, 0.3, 0.4, 0.6), "misses"),
    "misses of small boxes": _along((0.2, 0.4, 0.6, 0.8, 1.0), "small_misses"),
    "false positives": _along((0.25, 0.5, 1.0, 2.0, 4.0), "false_positives"),
    "duplicates": _along((0.02, 0.05, 0.1, 0.2, 0.4), "duplicates"),
    "label swaps": _along((0.02, 0.05, 0.1, 0.2, 0.4), "swaps"),
    "confusions": _along((0.02, 0.05, 0.1, 0.2, 0.4), "confusions"),
    "box jitter": _along((0.05, 0.1, 0.15, 0.2, 0.3), "jitter"),
    "scores": _along((0.2, 0.4, 0.6, 0.8, 1.0), "scores"),
    "truncation": _along((0.02, 0.05, 0.1, 0.15, 0.2), "truncation"),
    "bias of steps": _along((0.05, 0.1, 0.2, 0.4, 0.6), "distance_bias"),
    "bias of turns": _along((0.02, 0.05, 0.1, 0.2, 0.3), "turn_bias"),
    "noise of steps and turns": _along((0.02, 0.05, 0.1, 0.2, 0.4), "distance_noise", "turn_noise"),
    "drift of the heading": _along((0.25, 0.5, 1.15, 2.0, 4.0), "heading_drift"),
    "error of the heading": _along((1.0, 3.0, 5.0, 10.0, 20.0), "heading_error"),
    "steps that fall short": _along((0.05, 0.1, 0.2, 0.3, 0.5), "short_steps"),
    "failed turns": _along((0.01, 0.02, 0.05, 0.1, 0.2), "failed_turns"),
    "detector": _times(DETECTOR),
    "wheels": _times(WHEELS),
    "mix": _times(MIX),
}


def parse(text: str, flag: str = "--noise") -> SenseNoise:
    """Noise from text: a preset's name, or fields and levels, misses=0.2,jitter=0:0.1.

    Raises:
      ValueError: one line that names the flag and what is wrong.
    """
    if text in PRESETS:
        return PRESETS[text]
    names = [field.name for field in dataclasses.fields(SenseNoise)]
    levels: dict[str, Level] = {}
    for part in text.split(","):
        name, _, value = part.strip().partition("=")
        if name not in names:
            known = f"{', '.join(PRESETS)}, or NAME=LEVEL of {', '.join(names)}"
            raise ValueError(f"{flag} {part.strip()}: choose {known}")
        if name in levels:
            raise ValueError(f"{flag} {name}: is given twice")
        try:
            low, high = (float(end) for end in (value.split(":") * 2)[:2])
        except ValueError:
            low = high = math.nan
        if not math.isfinite(low + high) or value.count(":") > 1:
            raise ValueError(f"{flag} {name}={value}: must be a number, or a range such as 0:0.2")
        levels[name] = low if low == high else (low, high)
    noise = SenseNoise(**levels)
    noise.check(flag)
    return noise
