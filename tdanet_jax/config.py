"""All settings of a training run, as frozen dataclasses. Imports no JAX."""

from __future__ import annotations

import dataclasses
import json
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal

from tdanet_jax import sense_noise
from tdanet_jax.decisions import Decisions
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import FileError, jsons, regular
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.registry import MODELS, SENSORS
from tdanet_jax.settings import Settings
from tdanet_jax.splits import OF_VALIDATION, OPEN, file_name, make_split, split_name
from tdanet_jax.targets import PAPER as PAPER_TARGETS
from tdanet_jax.targets import canonical, known_classes, naming

#: Environment steps of a run without a budget.
DEFAULT_STEPS = 12_000_000
#: Units of a run's budget; if several are given, training stops when the first runs out.
BUDGETS = ("steps", "episodes", "minutes")
#: Name of the file in a run's folder that holds its configuration.
CONFIG_FILE = "config.json"
#: Name of the file in a run's folder that holds a copy of the vectors of --word-vectors.
WORD_VECTORS_FILE = "word_vectors.npz"
#: Most variants of a room.
MOST_VARIANTS = 400
#: Most generated rooms.
MOST_GENERATED = 10_000
#: Environment variable: comma-separated modules of custom models and sensors that a run's config
#: may import.
TRUST = "TDANET_TRUST"


@dataclasses.dataclass(frozen=True)
class LearnerConfig(Settings):
    """The update's hyperparameters.

    `--preset paper` has those of the reference implementation, except for `rollout_steps`: that
    code updates after every episode, of at most 30 steps.
    """

    num_envs: int = 64
    """Environments that step together (B)."""
    rollout_steps: int = 20
    """Actions per environment and update (T)."""
    num_minibatches: int = 1
    """Minibatches that a rollout is split into by environment, one optimiser step each (PPO). For
    GPUs, which need more environments than one step should learn from."""
    update_epochs: int = 1
    """Passes over each rollout (PPO)."""
    clip_coef: float = 0.2
    """PPO's clip of the probability ratio; no effect if an update is one optimiser step."""
    learning_rate: float = 5e-4
    """Adam's initial learning rate."""
    final_learning_rate: float = 0.0
    """Learning rate at the end of the budget; decays linearly."""
    amsgrad: bool = False
    """AMSGrad instead of Adam, as in the reference."""
    adam_epsilon: float = 1e-8
    """Term added to Adam's denominator."""
    max_grad_norm: float = 0.5
    """Gradients are clipped to this global norm."""
    gamma: float = 0.99
    """Discount factor per action."""
    gae_lambda: float = 0.95
    """Lambda of generalised advantage estimation; the reference's tau is 1."""
    entropy_weight: float = 0.01
    """Initial weight of the policy's entropy (nats) in the loss."""
    final_entropy_weight: float = 0.01
    """Weight of the entropy at the end of the budget; changes linearly."""
    value_weight: float = 0.5
    """Weight of the value loss, half the squared error."""
    imitation_weight: float = 0.0
    """Initial weight of imitation in the loss: minus the logarithm of the probability, among all
    actions but Done, of the moves that begin a shortest path to the target, once it has been seen.
    Falls linearly to 0. Not in the paper (docs/method.md)."""
    imitation_until: float = 0.5
    """Share of the budget at which the weight of imitation reaches 0."""
    step_limit: int = 50
    """Actions after which a training episode is truncated."""
    partial_reward: Literal["parents", "similarity", "none"] = "parents"
    """Reward before the target is found. parents: for seeing a parent of the target (Eq. 3).
    similarity: 0.1 times the cosine between the word vectors of the target and of a class in view,
    whenever it is the largest of the episode so far (SSNet). none: no such reward."""
    size_noise: float = 0.0
    """Augmentation: scales the target's box sides by a per-episode factor, log-uniform in
    [e^-x, e^x], so that the policy cannot rely on apparent size. Not in the paper."""
    noise: str = "none"
    """Senses that err in training: none, detector, wheels, mix, or levels such as
    misses=0:0.3,jitter=0.1. From a range, each episode draws its own level (docs/noise.md)."""
    bootstrap_truncated: bool = True
    """Bootstrap the return from the last state's value when an episode times out. False treats a
    time-out as termination, as the reference does."""

    @property
    def optimizer_steps(self) -> int:
        """Optimiser steps in an update; with several, its loss is PPO's."""
        return self.num_minibatches * self.update_epochs


@dataclasses.dataclass(frozen=True)
class NetworkConfig(Settings):
    """The network, and what it is shown."""

    width: int = 512
    """Units of each layer of the encoder."""
    hidden: int = 512
    """Units of the LSTM."""
    context: int = 0
    """Units of a layer that sees every detection. What it says of the frame, and the target's name,
    go into the LSTM with the rest (docs/method.md). For tdanet; 0: none, as in the paper."""
    dropout: float = 0.0
    """Dropout rate in training, rounded to 1/256: of the Siamese difference, or after both
    convolutions of an image. The reference code's is 0.25, which changed only the speed on
    validation."""
    rows: Literal["class", "object"] = "object"
    """One detection per object, as in the paper, or one per class (the extent of its instances), as
    in the code of MJOLNIR and SSNet. Per object did better on validation."""
    word_norm: float = 3.0
    """Norm to which all word vectors are scaled."""
    image: Literal["auto", "raster", "features"] = "auto"
    """Image of the models that look at one. raster: the class in each of 7 x 7 cells. features:
    ResNet-18's feature maps, imported with the rooms of --data. auto: features if there are any."""
    odometry: bool = False
    """Odometry: the last action and whether it was blocked, the pose relative to the start, and a
    map of where the agent has been. Not in the paper; works with any model."""
    triangulation: bool = False
    """Requires --odometry. Estimates the target's position from the bearings of its past
    detections. Not in the paper; for models that are shown a box of every object."""
    robust_triangulation: bool = False
    """Requires --triangulation, and makes it robust to errors of bearings (docs/noise.md)."""
    reach_threshold: float | None = None
    """Requires --triangulation. After training, Done is only allowed with the target in view, and
    within reach with this probability or more. It is estimated from triangulation alone, and
    therefore for unseen classes, too (docs/method.md). 0: estimated, but Done is always allowed.
    None: not estimated."""
    temperature: float = 1.0
    """Temperature at which actions are sampled after training. Below 1, the most probable ones are
    taken more often than in training. No effect on greedy actions (docs/method.md)."""
    done_bias: float = 0.0
    """Added to the logit of Done after training. Above 0, the agent says it earlier than in
    training (docs/method.md)."""
    scores: bool = False
    """Show the detector's confidence in each detection, 1 without noise. Not in the paper; for
    models that are shown a box of every object."""
    sensors: tuple[str, ...] = ()
    """Further sensors: dotted names of custom modules with a function `make` (docs/sensors.md)."""
    inner_rate: float = 1e-4
    """Learning rate of the inner gradient steps (savn, li)."""
    first_order: bool = False
    """First-order meta-learning (savn, li): do not differentiate through the inner steps, except
    into the learned loss."""
    precision: Literal["auto", "float32", "bfloat16"] = "auto"
    """Precision of the operands of large matrix products; parameters and sums are always float32.
    auto: bfloat16 on accelerators and on CPUs with AMX, where it is faster."""

    @property
    def decisions(self) -> Decisions:
        """How the trained network decides; without a threshold, it does not estimate reach."""
        return Decisions(self.reach_threshold, self.temperature, self.done_bias)

    @property
    def spec(self) -> ObservationSpec:
        """What the flags ask to show the agent; the model decides on rows and image in the end."""
        robust = self.robust_triangulation
        flags = {
            "odometry": self.odometry,
            "triangulation": self.triangulation and not robust,
            "robust-triangulation": self.triangulation and robust,
        }
        chosen = (*(name for name, on in flags.items() if on), *self.sensors)
        sensors = tuple(dict.fromkeys(chosen))
        return ObservationSpec(rows=self.rows, sensors=sensors, scores=self.scores)


@dataclasses.dataclass(frozen=True)
class TrainConfig(Settings):
    """One training run."""

    split: str = "18/4"
    """Seen/unseen target classes: 22/0, 18/4 or 14/8; or a comma-separated list of unseen classes:
    Mug,Vase,CD,Towel. open: the open-vocabulary benchmark, with targets of its own."""
    targets: str = "paper"
    """Classes to look for. paper: its 22, or those that the rooms of --data name themselves. all:
    every class that can be found in a training room, by room type. Or classes, separated by commas:
    Kettle,Mug,Book; for some room types: 'kitchen: Kettle, Mug; bedroom: Book, Pillow'."""
    model: str = "tdanet"
    """The model: tdanet, one of its ablations (tdanet-no-ta without target attention, tdanet-no-sa
    without the Siamese comparison, tdanet-no-ta-sa without either), ssnet, mjolnir-o, mjolnir-r
    (mjolnir-o with an image), baseline (an image and an LSTM), sp (baseline with scene priors;
    sp-wide has the published size), savn (baseline that keeps learning while it acts), li
    (mjolnir-o that does so), or the dotted name of a custom module with a function `make`
    (docs/models.md)."""
    steps: int | None = None
    """Budget in environment steps, B * T for each update. If several budgets are given, training
    stops when the first runs out; if none is given, after 12,000,000 steps."""
    episodes: int | None = None
    """Budget in training episodes; the paper's is 6,000,000."""
    minutes: float | None = None
    """Budget in minutes of training time, without loading, compilation and evaluation."""
    seed: int = 0
    """Random seed of parameters, episodes, actions and dropout."""
    data: str | None = None
    """File of rooms that `tdanet scenes import` wrote, instead of the bundled ones."""
    word_vectors: str | None = None
    """File of word vectors instead of the bundled GloVe 6B 50d: glove.6B.*.txt, the thor_glove
    HDF5 file, or an npz file with `words` and `vectors`. The network takes their dimension."""
    validation: bool = False
    """For choosing settings: train in 16 of the 20 training rooms of each type with one more class
    held out, and evaluate in the other four."""
    extra_targets: str | None = None
    """Targets that training asks for as well, in about half of its episodes: all, or names, as
    --targets takes them, without those that the split hides. The test is of --targets alone."""
    variants: int = 0
    """Variants of each training room to train in as well: small objects elsewhere, some left out,
    half of the variants mirrored (docs/scenes.md). They are built once and cached."""
    generated: int = 0
    """Generated rooms to train in as well, in all, of all four room types: like the training rooms,
    but with furniture, layouts and sizes of their own (docs/scenes.md). They are built once and
    cached."""
    generated_only: bool = False
    """Requires --generated. Train in generated rooms alone. Parents of targets and the class graph
    are those of the training rooms in any case."""
    pool_rooms: int = 1500
    """About how many variants and generated rooms a pool has: it is made of whole files of 100
    generated rooms, or of a variant of each room. If there are more rooms, pools take turns: the
    first, the present and the next one are in memory, and the next is built or loaded meanwhile."""
    pool_updates: int = 800
    """Updates in a pool before the next one's turn, rounded to whole calls of --chunk-updates."""
    chunk_updates: int = 10
    """Updates per compiled call; progress is reported after each call."""
    checkpoint_minutes: float = 2.0
    """Minutes between checkpoints."""
    history: int = 20
    """Evenly spaced points of the budget at which parameters are kept, for the learning curve of
    `tdanet evaluate --history`; 0 keeps none. A point of TDANet takes 12 MB."""
    max_skipped: int = 20
    """Stop after this many skipped updates since the start or --resume. An update is skipped if its
    loss or gradient is not finite. If it has several optimiser steps, only those that are not
    finite are left out, and it counts as skipped."""
    learner: LearnerConfig = dataclasses.field(default_factory=LearnerConfig)
    """Settings of the update."""
    network: NetworkConfig = dataclasses.field(default_factory=NetworkConfig)
    """Settings of the network."""

    def check(self) -> None:
        """Raises ValueError, with one line that names the flag, if a value is out of range."""
        for part in (self, self.learner, self.network):
            part.check_types()
        check_seed(self.seed)
        if self.split == OPEN and self.targets != PAPER_TARGETS:
            raise ValueError(f"--targets {self.targets}: --split {OPEN} has its own targets")
        split_name(self.split, known_classes(self.targets, self.data))
        if self.targets == PAPER_TARGETS and self.data is None:
            make_split(self.split, self.validation)
        if self.extra_targets is not None:
            with naming("--extra-targets"):
                known_classes(self.extra_targets, self.data)
        if self.model not in MODELS and "." not in self.model:
            known = ", ".join(MODELS)
            raise ValueError(f"--model {self.model}: choose one of {known}, or name a module")
        values = {**vars(self), **vars(self.learner), **vars(self.network)}
        for names, holds, wanted in _RANGES:
            for name in names:
                if values[name] is not None and not holds(values[name]):
                    raise ValueError(f"--{name.replace('_', '-')} {values[name]}: must {wanted}")
        count, parts = self.learner.num_envs, self.learner.num_minibatches
        if count % parts:
            raise ValueError(f"--num-minibatches {parts}: must divide --num-envs {count}")
        if self.network.image == "features" and self.data is None:
            raise ValueError("--image features: needs --data, rooms that were imported with them")
        if self.generated_only and not self.generated:
            raise ValueError("--generated-only: needs --generated, the number of rooms")
        if self.generated_only and self.variants:
            raise ValueError("--generated-only: not with --variants, which are of other rooms")
        sense_noise.parse(self.learner.noise)
        self.network.decisions.check()
        if self.network.robust_triangulation and not self.network.triangulation:
            raise ValueError("--robust-triangulation: needs --triangulation")
        if self.network.reach_threshold is not None and not self.network.triangulation:
            raise ValueError(
                "--reach-threshold: needs --triangulation (or use --reach-threshold None)"
            )
        self.network.spec.check()

    def for_tests(self) -> TrainConfig:
        """The same without what is only for training: extra targets, variants, generated rooms."""
        return dataclasses.replace(
            self, extra_targets=None, variants=0, generated=0, generated_only=False
        )

    def normalised(self) -> TrainConfig:
        """The same run as it is saved: with the canonical name of its split, and absolute paths."""

        def absolute(path: str | None) -> str | None:
            return None if path is None else str(Path(path).absolute())

        return dataclasses.replace(
            self,
            split=split_name(self.split, None),
            targets=canonical(self.targets),
            extra_targets=self.extra_targets and canonical(self.extra_targets),
            data=absolute(self.data),
            word_vectors=absolute(self.word_vectors),
        )

    @property
    def sought(self) -> str:
        """What `dataset.find_targets` is asked for: the targets, or the split that has its own."""
        return OPEN if self.split == OPEN else self.targets

    @property
    def budget(self) -> dict[str, Any]:
        """The given limits by name: steps, episodes, minutes."""
        limits = {name: getattr(self, name) for name in BUDGETS}
        return {name: limit for name, limit in limits.items() if limit is not None}

    @property
    def limits(self) -> dict[str, Any]:
        """The limits that hold, by name: those given, or else of steps."""
        return self.budget or {"steps": DEFAULT_STEPS}

    def with_budget(self, other: TrainConfig) -> TrainConfig:
        """The same run with the budget of another."""
        return dataclasses.replace(self, **{name: getattr(other, name) for name in BUDGETS})

    def spent(self, steps: int, episodes: int, seconds: float) -> float:
        """Fraction of the budget that has been used; training ends at 1."""
        done = {"steps": steps, "episodes": episodes, "minutes": seconds / 60}
        return max(done[name] / limit for name, limit in self.limits.items())

    @property
    def steps_per_update(self) -> int:
        """Environment steps in one update."""
        return self.learner.num_envs * self.learner.rollout_steps


def with_decisions(config: TrainConfig, decisions: Decisions, run: Path | str) -> TrainConfig:
    """A run's configuration with other decisions of its trained network.

    Raises:
      ValueError: there is a threshold of reach, but no estimate in the run; or a value is out of
        range.
    """
    decisions.check()
    if decisions.reach_threshold is not None and config.network.reach_threshold is None:
        raise ValueError(f"--reach-threshold: {run} was trained without it")
    network = dataclasses.replace(config.network, **decisions.replaced)
    return dataclasses.replace(config, network=network)


def find_word_vectors(
    config: TrainConfig, run: Path | str, instead: Path | str | None = None
) -> str | None:
    """The file of a run's word vectors; None if they are the bundled ones.

    Args:
      config: the run's.
      run: its folder.
      instead: a file to take in place of the run's own.

    Raises:
      ValueError: the run holds no copy of them, and the file is not where it was.
    """
    run = Path(run)
    if instead is not None or config.word_vectors is None:
        return None if instead is None else str(instead)
    for path in (run / WORD_VECTORS_FILE, Path(config.word_vectors)):
        if path.is_file():
            return str(path)
    raise ValueError(
        f"{config.word_vectors}: no such file; {run} was trained with these word vectors and holds "
        "no copy: give the file's place with --word-vectors"
    )


#: Names of settings, the condition on their values, and how an error states it.
_RANGES: tuple[tuple[tuple[str, ...], Callable[[float], bool], str], ...] = (
    (
        (
            "steps", "episodes", "minutes", "pool_rooms", "pool_updates", "chunk_updates",
            "checkpoint_minutes", "max_skipped",
            "num_envs", "rollout_steps", "num_minibatches", "update_epochs", "clip_coef",
            "step_limit", "learning_rate", "adam_epsilon",
            "max_grad_norm", "width", "hidden", "word_norm", "inner_rate",
        ),
        lambda value: value > 0,
        "be positive",
    ),
    (
        (
            "history", "variants", "generated", "final_learning_rate", "entropy_weight",
            "final_entropy_weight", "value_weight", "imitation_weight",
        ),
        lambda value: value >= 0,
        "not be negative",
    ),
    (
        ("steps", "minutes", "checkpoint_minutes", "max_skipped"),
        lambda value: value <= 1e15,
        "be at most 1e15",
    ),
    (("episodes",), lambda value: value < 2**31, f"be at most {2**31 - 1:,}"),  # an int32 counts
    (
        (
            "num_envs", "rollout_steps", "num_minibatches", "update_epochs", "step_limit",
            "pool_rooms", "pool_updates", "chunk_updates", "history",
        ),
        lambda value: value <= 1_000_000,
        "be at most 1,000,000",
    ),
    (("width", "hidden"), lambda value: value <= 8192, "be at most 8192"),
    (("context",), lambda value: value == 0 or 2 <= value <= 8192, "be 0, or from 2 to 8192"),
    (("variants",), lambda value: value <= MOST_VARIANTS, f"be at most {MOST_VARIANTS}"),
    (("generated",), lambda value: value <= MOST_GENERATED, f"be at most {MOST_GENERATED:,}"),
    (("size_noise",), lambda value: 0 <= value <= 2, "be between 0 and 2"),
    (("gamma", "gae_lambda"), lambda value: 0 <= value <= 1, "be between 0 and 1"),
    (("imitation_until",), lambda value: 0 < value <= 1, "be above 0 and at most 1"),
    (
        ("dropout",),
        lambda value: value == 0 or 1 / 256 <= value <= 255 / 256,
        "be 0, or from 1/256 to 255/256",
    ),
)  # fmt: skip


def idle_flags(config: TrainConfig) -> dict[str, str]:
    """Flags of training that are set but change nothing, each with the reason."""
    default, learner = TrainConfig(), config.learner
    pools = not (config.variants or config.generated), "without --variants or --generated"
    idle = {
        "clip_coef": (learner.optimizer_steps == 1, "with one optimiser step per update"),
        "imitation_until": (not learner.imitation_weight, "without --imitation-weight"),
        "pool_rooms": pools,
        "pool_updates": pools,
    }
    values = {**vars(config), **vars(learner)}
    defaults = {**vars(default), **vars(default.learner)}
    return {
        f"--{name.replace('_', '-')}": reason
        for name, (is_idle, reason) in idle.items()
        if is_idle and values[name] != defaults[name]
    }


def run_name(config: TrainConfig) -> str:
    """The name of a run's folder: 18-4-tdanet-seed0, Mug-Vase-tdanet-seed0."""
    split = file_name(config.split) + (OF_VALIDATION if config.validation else "")
    return f"{split}-{config.model}-seed{config.seed}"


def check_seed(seed: int) -> None:
    """Raises ValueError unless a seed is one of the 2^32 that give different keys."""
    if not 0 <= seed < 2**32:
        raise ValueError(f"--seed {seed}: must be between 0 and {2**32 - 1}")


#: The hyperparameters of the reference implementation, in our environment and update.
PAPER = TrainConfig(
    episodes=6_000_000,
    learner=LearnerConfig(
        num_envs=256,
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
#: What did best on validation, with sensors that the paper does not have (docs/results.md).
BEST = TrainConfig(
    extra_targets="all",
    learner=LearnerConfig(gamma=0.97, size_noise=0.5, imitation_weight=0.3),
    network=NetworkConfig(
        odometry=True, triangulation=True, reach_threshold=0.5, temperature=0.3, done_bias=2.0
    ),
)
#: For robots: senses that err in training, by up to twice the levels of `mix`, and by up to 3
#: degrees of heading, which cost more than all else (docs/noise.md). Of BEST, it lacks what has not
#: been tried with agents that were trained under noise: the estimate of reach, imitation, extra
#: targets, and other decisions than in training.
ROBUST = dataclasses.replace(
    BEST,
    extra_targets=None,
    learner=dataclasses.replace(
        BEST.learner,
        imitation_weight=0.0,
        noise=str(
            dataclasses.replace(sense_noise.up_to(sense_noise.MIX, 2), heading_error=(0.0, 3.0))
        ),
    ),
    network=dataclasses.replace(
        BEST.network,
        robust_triangulation=True,
        scores=True,
        reach_threshold=None,
        temperature=1.0,
        done_bias=0.0,
    ),
)
#: For the inputs that the paper's agent has, chosen on validation; two changes that validation
#: preferred were taken back after they had been no better in the test rooms (docs/results.md).
PAPER_INPUTS = TrainConfig(
    extra_targets="all",
    learner=LearnerConfig(gamma=0.97, imitation_weight=0.3),
    network=NetworkConfig(context=64, temperature=0.7),
)
PRESETS = {
    "default": TrainConfig(),
    "best": BEST,
    "robust": ROBUST,
    "paper-inputs": PAPER_INPUTS,
    "paper": PAPER,
}


def to_json(config: TrainConfig) -> dict[str, Any]:
    """A configuration as plain JSON values."""
    return dataclasses.asdict(config)


def from_json(values: Mapping[str, Any]) -> TrainConfig:
    """The configuration that `to_json` made these values from.

    Raises:
      ValueError: `learner` or `network` is missing, or a field is unknown or out of range. Other
        missing fields, of which files of earlier versions know nothing, have their defaults.
    """
    try:
        for name, value in {"config": values, "learner": values["learner"]}.items():
            if not isinstance(value, Mapping):
                raise TypeError(f"{name} is not an object")
        network = {"sensors": (), **values["network"]}
        network["sensors"] = tuple(network["sensors"])
        parts = {"learner": LearnerConfig(**values["learner"]), "network": NetworkConfig(**network)}
        config = TrainConfig(**{**values, **parts})
    except (KeyError, TypeError) as error:
        raise ValueError(f"not a configuration of this version: {error}") from None
    config.check()
    return config


def save(config: TrainConfig, path: Path | str) -> None:
    """Writes a run's `config.json`."""
    path = Path(path)
    files.write_text(path, json.dumps(to_json(config), indent=2) + "\n")


def load(path: Path | str) -> TrainConfig:
    """Reads a run's `config.json`.

    Raises:
      ValueError: the file is missing or unreadable; or it names a custom model or sensor that is
        neither imported already nor in `TDANET_TRUST`, as making it would run its code. The
        message names the file.
    """
    path = Path(path)
    try:
        config = from_json(jsons.parse(path, regular.read_text(path, links=False)))
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
    except OSError as error:  # the folder is a file, for example
        raise ValueError(f"{path}: {error.strerror}; is this the folder of a run?") from None
    except FileError:
        raise
    except ValueError as error:
        raise FileError(path, error) from None
