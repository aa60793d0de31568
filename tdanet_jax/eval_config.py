"""How an evaluation departs from a run's own task. Imports no JAX."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from tdanet_jax import sense_noise
from tdanet_jax.config import TrainConfig, check_seed, find_word_vectors, with_decisions
from tdanet_jax.decisions import OWN_DECISIONS, Decisions
from tdanet_jax.sense_noise import SenseNoise
from tdanet_jax.settings import Settings
from tdanet_jax.splits import OF_VALIDATION, OPEN
from tdanet_jax.targets import canonical, known_classes, naming, parse


@dataclasses.dataclass(frozen=True)
class EvalConfig(Settings):
    """Where an evaluation departs from the run's own task."""

    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote, instead of the run's or the bundled
    ones; also the new place of a file that was moved."""
    word_vectors: str | None = None
    """File of word vectors, instead of the run's or the bundled ones. A run keeps a copy of the
    vectors it was trained with, and needs the file only if that lacks the rooms' classes."""
    test_targets: str | None = None
    """Test on these targets instead of the run's, given as for training: paper, all or names. The
    episodes are those of a run with these targets. "Seen" are then all of them that training did
    not hide, whether or not it asked for them."""
    step_limit: int | None = None
    """Actions after which an episode ends, instead of the test's limits for each room type."""
    episodes: int | None = None
    """Play at most this many episodes of each list, evenly spaced, for a quick look."""
    scenes: tuple[str, ...] = ()
    """Play only the episodes in these rooms, such as FloorPlan228."""
    targets: tuple[str, ...] = ()
    """Play only the episodes with these targets, such as Laptop."""
    training_rooms: bool = False
    """Play episodes in the split's training rooms instead of its test rooms, drawn in the same way.
    The difference shows roughly what new rooms cost."""
    noise: str | None = None
    """Senses that err: detector, wheels, mix, or levels such as misses=0.2,jitter=0.1
    (docs/noise.md). The command also takes sweep: five levels of each kind of noise."""
    decisions: Decisions = OWN_DECISIONS
    """How the agent decides, instead of as its run says."""

    def check(self, policy: object = None, seed: int | None = None) -> None:
        """Raises ValueError, with one line that names the flag, if a value is out of range.

        Args:
          policy: how actions are chosen; "greedy" has no temperature.
          seed: of sampled actions.
        """
        self.check_types()
        self.decisions.check(policy)
        if seed is not None:
            check_seed(seed)
        for name, value in (("step-limit", self.step_limit), ("episodes", self.episodes)):
            if value is not None and value < 1:
                raise ValueError(f"--{name} {value}: must be positive")
        if self.step_limit is not None and self.step_limit > 1_000_000:
            raise ValueError(f"--step-limit {self.step_limit}: must be at most 1,000,000")
        if self.test_targets is not None:
            with naming("--test-targets"):
                parse(self.test_targets)
        sense_noise.parse(self.noise or "none")

    @property
    def senses(self) -> SenseNoise:
        """The noise of the senses. Raises ValueError if it is not given as it must be."""
        return sense_noise.parse(self.noise or "none")

    @property
    def departures(self) -> dict[str, Any]:
        """The values, by name, for which this is not the official test; none if it is.

        Custom rooms and targets are not among them: `report.Provenance` records those.
        """
        values = {name: getattr(self, name) for name in ("step_limit", "episodes")}
        values["training_rooms"] = self.training_rooms
        values |= {name: list(getattr(self, name)) for name in ("scenes", "targets")}
        values["word_vectors"] = self.word_vectors
        if self.senses.any:
            values["noise"] = str(self.senses)
        return {name: value for name, value in values.items() if value} | self.decisions.replaced

    def locate(self, config: TrainConfig, run: Path | str) -> TrainConfig:
        """A run's configuration as it is evaluated: with its files, without rooms and targets that
        are only for training.

        Args:
          config: the run's.
          run: its folder.

        Raises:
          ValueError: a file that the run was trained with is not where it was, and the message says
            how to give its new place; there is a threshold of reach, but no estimate in the run;
            or there are other targets for a split that has its own.
        """
        run = Path(run)
        data = self.data
        if data is None and config.data is not None:
            data = config.data
            if not Path(data).is_file():
                raise ValueError(
                    f"{data}: no such file; {run} was trained in these rooms: give the file's "
                    "place with --data"
                )
        config = self.with_targets(dataclasses.replace(config, data=data))
        words = find_word_vectors(config, run, self.word_vectors)
        config = with_decisions(config.for_tests(), self.decisions, run)
        return dataclasses.replace(config, word_vectors=words)

    def with_targets(self, config: TrainConfig) -> TrainConfig:
        """A configuration with the targets of the test, if they are given.

        Raises:
          ValueError: the rooms have no such class, or the split has targets of its own.
        """
        if self.test_targets is None:
            return config
        if config.split == OPEN:
            raise ValueError(
                f"--test-targets {self.test_targets}: --split {OPEN} has targets of its own"
            )
        with naming("--test-targets"):
            known_classes(self.test_targets, config.data)
        return dataclasses.replace(config, targets=canonical(self.test_targets))


def rooms_played(departures: Mapping[str, Any] | None, splits: Iterable[str]) -> str:
    """In which rooms the episodes lie, in words.

    Args:
      departures: `EvalConfig.departures`.
      splits: the names of the splits that were played.
    """
    if (departures or {}).get("training_rooms"):
        return "training rooms"
    kinds = {"validation" if name.endswith(OF_VALIDATION) else "test" for name in splits}
    return f"{' and '.join(sorted(kinds))} rooms"


def describe_departures(departures: Mapping[str, Any]) -> str:
    """`EvalConfig.departures` in words, for reports."""
    texts = {
        "step_limit": "at most {} actions per episode",
        "episodes": "at most {} episodes of each list, evenly spaced",
        "training_rooms": "in the training rooms",
        "scenes": "only in {}",
        "targets": "only for {}",
        "noise": "senses that err, {}",
        "reach_threshold": "Done with a probability of reach of {} or more",
        "temperature": "a temperature of {}",
        "done_bias": "{} added to the logit of Done",
        "word_vectors": "word vectors of {}",
    }
    parts = [
        text.format(
            ", ".join(value)
            if isinstance(value, list)
            else f"{value:,}"
            if isinstance(value, int)
            else value
        )
        for name, text in texts.items()
        if (value := departures.get(name)) is not None
    ]
    return f"Not the official test: {'; '.join(parts)}"


#: An evaluation of a run's own task.
OWN_TASK = EvalConfig()
