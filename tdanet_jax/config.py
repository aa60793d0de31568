"""Everything that can be set on a training run, as frozen dataclasses. Imports no JAX."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, get_args, get_origin, get_type_hints

from tdanet_jax.io import files
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.registry import MODELS, SENSORS
from tdanet_jax.splits import file_name, make_split, split_name

#: Budget in environment steps where none is given.
DEFAULT_STEPS = 12_000_000
#: What a run's budget can be given in; it ends when one of those given is spent.
BUDGETS = ("steps", "episodes", "minutes")
#: Name of the file in a run's folder that holds its configuration.
CONFIG_FILE = "config.json"
#: Environment variable: comma-separated modules of custom models and sensors that a run's config
#: may import.
TRUST = "TDANET_TRUST"


@dataclasses.dataclass(frozen=True)
class LearnerConfig:
    """The update's constants. The reference's own are those of `--preset paper`."""

    num_envs: int = 256
    """Environments that step together (B)."""
    rollout_steps: int = 20
    """Actions per environment and update (T)."""
    learning_rate: float = 5e-4
    """Adam's step size at the start."""
    final_learning_rate: float = 0.0
    """Adam's step size at the end of the budget; falls linearly."""
    amsgrad: bool = False
    """AMSGrad in place of Adam, as in the reference."""
    adam_epsilon: float = 1e-8
    """Added to Adam's denominator."""
    max_grad_norm: float = 0.5
    """Gradients are scaled down to this norm."""
    gamma: float = 0.99
    """Discount per action."""
    gae_lambda: float = 0.95
    """GAE's lambda; the reference's tau is 1."""
    entropy_weight: float = 0.01
    """Weight of the policy's entropy (nats) in the loss, at the start."""
    final_entropy_weight: float = 0.01
    """Weight of the entropy at the end of the budget; changes linearly."""
    value_weight: float = 0.5
    """Weight of the squared error of the values."""
    step_limit: int = 50
    """Actions after which a training episode is truncated."""
    partial_reward: Literal["parents", "similarity", "none"] = "parents"
    """What earns something before the target is found. parents: the sight of a parent of the target
    (Eq. 3). similarity: 0.1 times the cosine between the word vectors of the target and of a class
    in view, when it is the largest of the episode so far (SSNet). none: nothing."""
    size_noise: float = 0.0
    """In each training episode the sides of the target's boxes are multiplied by another factor,
    between e^-x and e^x, so that the agent does not rely on how large things are. Beyond the
    paper."""
    bootstrap_truncated: bool = True
    """Values the state in which a time-out cut an episode; False takes it for an end, as the
    reference does."""


@dataclasses.dataclass(frozen=True)
class NetworkConfig:
    """The network and what it is shown."""

    width: int = 512
    """Units of every layer of the encoder."""
    hidden: int = 512
    """Units of the LSTM."""
    dropout: float = 0.0
    """Share of the Siamese difference that is dropped in training. The paper's is 0.25; on
    validation it changed nothing but the speed."""
    rows: Literal["class", "object"] = "object"
    """One detection per object, as in the paper, or per class (extent over its instances), as in
    the code of MJOLNIR and SSNet. Per object did better on validation."""
    word_norm: float = 3.0
    """Length that every word vector is scaled to."""
    image: Literal["auto", "raster", "features"] = "auto"
    """What models that look at an image see: the classes of 7 x 7 cells, or the feature maps of
    ResNet-18 that were imported beside --data. auto: the maps where there are any."""
    odometry: bool = False
    """Odometry: the last action and whether it was blocked, the pose relative to the start, and a
    map of where the agent has been. Not in the paper; works with any model."""
    triangulation: bool = False
    """Requires --odometry. Estimates the target's position from the bearings of its past
    detections. Not in the paper; for models that are shown a box of every object."""
    sensors: tuple[str, ...] = ()
    """Further sensors: dotted names of modules of your own that have a function `make`
    (docs/sensors.md)."""
    inner_rate: float = 1e-4
    """Size of the inner gradient steps of the models that adapt."""
    first_order: bool = False
    """Trains the models that adapt without the gradient through their inner steps, but for the
    learned loss."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Operands of the large products; parameters and sums are always float32. auto: bfloat16 where
    the hardware multiplies it faster, on accelerators and on CPUs with AMX."""

    @property
    def spec(self) -> ObservationSpec:
        """What the agent is shown, as far as the flags say it; the model may narrow it."""
        flags = {"odometry": self.odometry, "triangulation": self.triangulation}
        chosen = (*(name for name, on in flags.items() if on), *self.sensors)
        return ObservationSpec(rows=self.rows, sensors=tuple(dict.fromkeys(chosen)))


@dataclasses.dataclass(frozen=True)
class TrainConfig:
    """One training run."""

    split: str = "18/4"
    """Seen/unseen target classes: 22/0, 18/4 or 14/8; or the unseen classes themselves, separated
    by commas: Mug,Vase,CD,Towel."""
    model: str = "tdanet"
    """The model to train: tdanet, one of its ablations (tdanet-no-ta without target attention,
    tdanet-no-sa without the Siamese comparison, tdanet-no-ta-sa without either), ssnet, mjolnir-o,
    mjolnir-r (the same with an image), baseline (an image and an LSTM), sp (the baseline with scene
    priors; sp-wide in the published size), savn (the baseline, which goes on learning while it
    acts), li (mjolnir-o, which does so, too), or the dotted name of a module of your own that has a
    function `make` (docs/models.md)."""
    steps: int | None = None
    """Stop after this many environment steps (actions); of several budgets, at the one that is
    spent first. 12,000,000 where no budget is given."""
    episodes: int | None = None
    """Stop after this many training episodes; the paper's budget is 6,000,000."""
    minutes: float | None = None
    """Stop after this much training time, tables, compilation and evaluation not counted."""
    seed: int = 0
    """Seed of parameters, episodes, actions and dropout."""
    data: str | None = None
    """File of rooms that `experiments.scenes import` wrote, in place of the bundled ones."""
    word_vectors: str | None = None
    """File of word vectors in place of the bundled GloVe 6B 50d: glove.6B.*.txt, the thor_glove
    hdf5, or an npz with `words` and `vectors`; its width is the network's."""
    validation: bool = False
    """Train on 16 of the 20 training rooms of a type, hold one more class out, and evaluate on the
    other four rooms: for every choice that is not the final number."""
    chunk_updates: int = 10
    """Updates in one compiled call, between two looks at the progress."""
    checkpoint_minutes: float = 2.0
    """Time between two checkpoints."""
    history: int = 20
    """Points of the budget, evenly spaced, at which the parameters are kept for the learning curve
    of `experiments.evaluate --history`; 0 keeps none. A point of TDANet takes 12 MB."""
    max_skipped: int = 20
    """Stop after this many updates, since the start or --resume, that were skipped for a loss or
    gradient that is not finite."""
    learner: LearnerConfig = dataclasses.field(default_factory=LearnerConfig)
    """The update."""
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    """The network."""

    def check(self) -> None:
        """Raises ValueError, with one line that names the flag, if a value is out of range."""
        for part in (self, self.learner, self.network):
            for name, kind in get_type_hints(type(part)).items():
                if not _fits(value := getattr(part, name), kind):
                    wanted = "finite" if isinstance(value, float) else f"of type {kind}"
                    raise ValueError(f"--{name.replace('_', '-')} {value}: must be {wanted}")
        check_seed(self.seed)
        make_split(self.split, self.validation)
        if self.model not in MODELS and "." not in self.model:
            known = ", ".join(MODELS)
            raise ValueError(f"--model {self.model}: choose one of {known}, or name a module")
        positive = {
            "--steps": self.steps,
            "--episodes": self.episodes,
            "--minutes": self.minutes,
            "--chunk-updates": self.chunk_updates,
            "--checkpoint-minutes": self.checkpoint_minutes,
            "--max-skipped": self.max_skipped,
            "--num-envs": self.learner.num_envs,
            "--rollout-steps": self.learner.rollout_steps,
            "--step-limit": self.learner.step_limit,
            "--learning-rate": self.learner.learning_rate,
            "--adam-epsilon": self.learner.adam_epsilon,
            "--max-grad-norm": self.learner.max_grad_norm,
            "--width": self.network.width,
            "--hidden": self.network.hidden,
            "--word-norm": self.network.word_norm,
            "--inner-rate": self.network.inner_rate,
        }
        for flag, value in positive.items():
            if value is not None and not value > 0:
                raise ValueError(f"{flag} {value}: must be positive")
        not_negative = {
            "--history": self.history,
            "--final-learning-rate": self.learner.final_learning_rate,
            "--entropy-weight": self.learner.entropy_weight,
            "--final-entropy-weight": self.learner.final_entropy_weight,
            "--value-weight": self.learner.value_weight,
        }
        for flag, value in not_negative.items():
            if value < 0:
                raise ValueError(f"{flag} {value}: must not be negative")
        if self.network.image == "features" and self.data is None:
            raise ValueError("--image features: needs --data, rooms that were imported with them")
        self.network.spec.check()
        if not 0 <= self.learner.size_noise <= 2:
            raise ValueError(f"--size-noise {self.learner.size_noise}: must be between 0 and 2")
        shares = {
            "--gamma": self.learner.gamma,
            "--gae-lambda": self.learner.gae_lambda,
            "--dropout": self.network.dropout,
        }
        for flag, value in shares.items():
            if not 0 <= value <= 1 or (flag == "--dropout" and value == 1):
                raise ValueError(f"{flag} {value}: must be a share between 0 and 1")

    def normalised(self) -> TrainConfig:
        """The same run, as it is kept: its split by its one name, its files by absolute paths."""

        def absolute(path: str | None) -> str | None:
            return None if path is None else str(Path(path).absolute())

        return dataclasses.replace(
            self,
            split=split_name(self.split),
            data=absolute(self.data),
            word_vectors=absolute(self.word_vectors),
        )

    def with_budget(self, other: TrainConfig) -> TrainConfig:
        """The same run with the budget of another."""
        return dataclasses.replace(self, **{name: getattr(other, name) for name in BUDGETS})

    def spent(self, steps: int, episodes: int, seconds: float) -> float:
        """The share of the budget that is spent after so much training; the run is over at 1."""
        done = {"steps": steps, "episodes": episodes, "minutes": seconds / 60}
        limits = {name: getattr(self, name) for name in BUDGETS}
        if set(limits.values()) == {None}:
            limits["steps"] = DEFAULT_STEPS
        return max(done[name] / limit for name, limit in limits.items() if limit is not None)

    @property
    def steps_per_update(self) -> int:
        """Environment steps in one update."""
        return self.learner.num_envs * self.learner.rollout_steps


def run_name(config: TrainConfig) -> str:
    """What a run's folder is called: 18-4-tdanet-seed0, Mug-Vase-tdanet-seed0."""
    split = file_name(config.split) + ("-validation" if config.validation else "")
    return f"{split}-{config.model}-seed{config.seed}"


def check_seed(seed: int) -> None:
    """Raises ValueError if a seed is not one of the 2^32 that give different keys."""
    if not 0 <= seed < 2**32:
        raise ValueError(f"--seed {seed}: must be between 0 and {2**32 - 1}")


def _fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a field's type; numbers must be finite."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(_fits(one, get_args(kind)[0]) for one in value)
    if get_args(kind):
        return any(_fits(value, one) for one in get_args(kind))
    if kind is float:
        return isinstance(value, int | float) and math.isfinite(value)
    return isinstance(value, kind) and isinstance(value, bool) == (kind is bool)


#: The reference's constants, on our environment and update.
PAPER = TrainConfig(
    episodes=6_000_000,
    learner=LearnerConfig(
        learning_rate=1e-4,
        final_learning_rate=1e-4,
        amsgrad=True,
        max_grad_norm=100.0,
        gamma=0.99,
        gae_lambda=1.0,
        entropy_weight=0.01,
        final_entropy_weight=0.01,
        value_weight=0.5,
        step_limit=30,
        bootstrap_truncated=False,
    ),
    network=NetworkConfig(dropout=0.25, rows="object"),
)
#: What did best on validation, beyond the paper (docs/results.md).
BEST = TrainConfig(
    learner=LearnerConfig(gamma=0.97, size_noise=0.5),
    network=NetworkConfig(odometry=True, triangulation=True),
)
PRESETS = {"default": TrainConfig(), "best": BEST, "paper": PAPER}


def to_json(config: TrainConfig) -> dict[str, Any]:
    """A configuration as plain JSON values."""
    return dataclasses.asdict(config)


def from_json(values: Mapping[str, Any]) -> TrainConfig:
    """What `to_json` gave.

    Raises:
      ValueError: a field is missing, unknown or out of range.
    """
    try:
        config = TrainConfig(
            **{
                **values,
                "learner": LearnerConfig(**values["learner"]),
                "network": NetworkConfig(
                    **{**values["network"], "sensors": tuple(values["network"].get("sensors", ()))}
                ),
            }
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"not a configuration of this version: {error}") from None
    config.check()
    return config


def save(config: TrainConfig, path: Path) -> None:
    """Writes a run's `config.json`."""
    files.write_text(path, json.dumps(to_json(config), indent=2) + "\n")


def load(path: Path) -> TrainConfig:
    """Reads a run's `config.json`.

    Raises:
      ValueError: the file is missing or unreadable, or names a model or sensor that is neither one
        of ours, nor imported already, nor in `TDANET_TRUST`: making it would run its code. The
        message names the file.
    """
    try:
        config = from_json(json.loads(path.read_text()))
        trusted = (*MODELS, *SENSORS, *sys.modules, *os.environ.get(TRUST, "").split(","))
        custom = {"model": (config.model,), "sensor": config.network.sensors}
        for kind, names in custom.items():
            for name in (name for name in names if name not in trusted):
                raise ValueError(
                    f"its {kind} is custom code, {name}; if you trust it, set {TRUST}={name}"
                )
        return config
    except FileNotFoundError:
        raise ValueError(f"{path}: no such file; is this the folder of a run?") from None
    except (json.JSONDecodeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
