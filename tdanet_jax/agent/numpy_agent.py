"""An agent without JAX: NumPy alone, Python 3.10. `tdanet export` writes its folder.

agent = load("exported")
state = agent.start()
state, decision = agent.act(state, [Detection("mug", 0.2, 0.3, 0.25, 0.4)], target="mug")

It is used as an `agent.Agent`, by a `Navigator` too, and decides the same.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple, get_args

import numpy as np

from tdanet_jax import words
from tdanet_jax.agent.base import BaseAgent, Decision, sigmoid, softmax, without
from tdanet_jax.agent.detection import Detection
from tdanet_jax.decisions import OWN_DECISIONS, Decisions
from tdanet_jax.io.untrusted import FileError, jsons, npz
from tdanet_jax.labels import Synonyms
from tdanet_jax.observation_spec import TRACKING, ObservationSpec, Rows
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.sensors import numpy_sensors
from tdanet_jax.sensors.shared import MeasuredPose
from tdanet_jax.vocabulary import NUM_ACTIONS, OUT_OF_REACH, Action
from tdanet_jax.words import WordVectors

#: Files of an exported agent: what it is shown, its parameters, and its words.
META_FILE, MODEL_FILE, WORDS_FILE = "meta.json", "model.npz", "words.npz"
#: Version of the files' layout; `load` refuses another one.
FORMAT = 1
MOST = 1e6  # a number in `meta.json` is at most as large


@dataclasses.dataclass(frozen=True)
class Meta:
    """What `meta.json` says."""

    classes: tuple[str, ...]  # class names, in the order of the run's vocabulary
    rows: Rows  # as in ObservationSpec
    sensors: tuple[str, ...]
    scores: bool
    word_norm: float  # length to which the vectors of names are scaled
    width: int  # units of each layer of the encoder
    hidden: int  # units of the LSTM
    action_units: int  # that embed the previous step's action probabilities
    sensor_units: int  # that embed what the sensors say; 0 without sensors
    reach_threshold: float  # as in NetworkConfig; 0 if reach is not estimated, too
    temperature: float  # as in NetworkConfig
    done_bias: float  # as in NetworkConfig
    reach_units: int  # of each hidden layer of the estimate of reach; 0 without it
    target_box: tuple[float, ...]  # [F], of the target's row, before its word vector
    context: int  # as in NetworkConfig

    @property
    def spec(self) -> ObservationSpec:
        """What the agent is shown."""
        return ObservationSpec(rows=self.rows, sensors=self.sensors, scores=self.scores)


#: The fields of `meta.json` and their types in JSON.
_KINDS: dict[str, type] = {
    "classes": list, "rows": str, "sensors": list, "scores": bool, "word_norm": float,
    "width": int, "hidden": int, "action_units": int, "sensor_units": int, "target_box": list,
    "reach_threshold": float, "reach_units": int, "temperature": float, "done_bias": float,
    "context": int,
}  # fmt: skip
#: Fields that folders of older versions lack.
_DEFAULTS = {
    "reach_threshold": 0.0, "reach_units": 0, "temperature": 1.0, "done_bias": 0.0, "context": 0,
}  # fmt: skip


class AgentState(NamedTuple):
    """What the agent carries from step to step of one episode."""

    hidden: np.ndarray  # [H] float32, of the LSTM
    cell: np.ndarray  # [H] float32
    probabilities: np.ndarray  # [6] float32, of its own policy one step before; 0 at first
    action: int  # the previous action; 6 at the start
    sensors: numpy_sensors.States  # before that action
    target: int  # row of what it looked for in the previous step; -1 at the start


class Target(NamedTuple):
    """What the network computes from the target's name alone."""

    query: np.ndarray  # [F + D] float32, whose product with a row is its attention logit
    reference: np.ndarray  # [width] float32, the target's branch of the Siamese comparison
    context: np.ndarray  # [context // 2] float32, what the context says of the target


class NumPyAgent(BaseAgent):
    """A trained TDANet.

    Attributes:
      weights: parameters by name, "encoder/linear1/kernel".
    """

    def __init__(
        self,
        meta: Meta,
        weights: Mapping[str, np.ndarray],
        vectors: WordVectors,
        grid: PoseGrid = ITHOR,
        synonyms: Synonyms | Path | str | None = None,
        more_words: Mapping[str, Sequence[float]] | Path | str | None = None,
    ) -> None:
        spec = dataclasses.replace(meta.spec, grid=grid)
        super().__init__(meta.classes, vectors, spec, synonyms, more_words)
        self.meta = meta
        self.weights = weights
        self._embedded: dict[int, np.ndarray] = {}  # row of a name -> its vector
        self._targets: dict[int, Target] = {}

    def start(self, rotation: float = 0, horizon: float = 0, measured: bool = False) -> AgentState:
        """The state at the start of an episode; arguments and errors as of `agent.Agent.start`."""
        turn, down = self.grid.nearest_view(rotation, horizon)
        zeros = np.zeros(self.meta.hidden, np.float32)
        return AgentState(
            hidden=zeros,
            cell=zeros,
            probabilities=np.zeros(NUM_ACTIONS, np.float32),
            action=NUM_ACTIONS,
            sensors=numpy_sensors.init(self.spec, turn, down, measured),
            target=-1,
        )

    def act(
        self,
        state: AgentState,
        detections: Sequence[Detection],
        target: str,
        key: np.random.Generator | None = None,
        blocked: bool | None = None,
        *,
        forbidden: Collection[Action] = (),
        pose: MeasuredPose | None = None,
    ) -> tuple[AgentState, Decision]:
        """One step; arguments and errors as of `agent.Agent.act`, but `key` is a generator."""
        odometry = state.sensors.get("odometry")
        measured = odometry is not None and odometry.measured
        self._check(state.action, measured, blocked, pose, forbidden)
        goal = self._index(target)
        labels, found, owner = self._shown(detections)
        found = found.astype(np.float32)
        sensors = numpy_sensors.after(
            self.spec, state.sensors, state.action, bool(blocked), pose,
            another_target=goal != state.target, boxes=found[labels == goal],
        )  # fmt: skip
        attention, features = self._encode(goal, labels, found)
        if self.spec.sensors:
            sensed = self._layer("way", numpy_sensors.features(self.spec, sensors))
            features = np.concatenate([features, _relu(sensed)])
        action_features = _relu(self._layer("action_embedding", state.probabilities))
        hidden, cell = self._lstm(features, action_features, state.hidden, state.cell)
        logits = self._layer("actor", hidden)
        probabilities, reach = softmax(logits), None
        logits[Action.DONE] += self.meta.done_bias
        logits /= np.float32(self.meta.temperature)
        if self.meta.reach_units:
            reach = self._reach(sensors) if goal in labels else None
            if (reach or 0.0) < self.meta.reach_threshold:
                logits[Action.DONE] = OUT_OF_REACH
        if forbidden:
            logits = without(logits, forbidden)
        shown, action = softmax(logits), int(np.argmax(logits))
        if key is not None:
            action = int(key.choice(NUM_ACTIONS, p=shown / shown.sum(dtype=float)))
        value = float(self._layer("critic", hidden)[0])
        after = AgentState(hidden, cell, probabilities, action, sensors, goal)
        return after, Decision(Action(action), shown, value, attention[owner], reach)

    def key(self, seed: int, step: int) -> np.random.Generator:
        """The `key` with which `act` samples an action; another one for each seed and step."""
        return np.random.default_rng([seed, step])

    def add_words(self, more: Mapping[str, Sequence[float]] | Path | str) -> int:
        """As `BaseAgent.add_words`."""
        added = super().add_words(more)
        self._embedded, self._targets = {}, {}
        return added

    def _word(self, row: int) -> np.ndarray:
        """The vector [D] of the name in a row of the table of classes."""
        if row not in self._embedded:
            self._embedded[row] = self._vector(row, self.meta.word_norm)
        return self._embedded[row]

    def _target(self, row: int) -> Target:
        if row not in self._targets:
            box = np.array(self.meta.target_box, np.float32)
            inputs = np.concatenate([box, self._word(row)])
            # The bias adds the same to the logits of all rows.
            query = self.weights["encoder/attention/kernel"] @ self._layer(
                "encoder/attention", inputs
            )
            context = np.zeros(0, np.float32)
            if self.meta.context:
                context = _relu(self._layer("encoder/scene_context/target", self._word(row)))
            self._targets[row] = Target(query, self._branch(inputs), context)
        return self._targets[row]

    def _encode(
        self, goal: int, labels: np.ndarray, boxes: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The encoder of `models.tdanet`: attention [n] over the rows, and features."""
        target = self._target(goal)
        inputs = np.zeros((len(labels), len(target.query)), np.float32)  # [n, F + D]
        for row, label, box in zip(inputs, labels.tolist(), boxes, strict=True):
            row[: len(box)], row[len(box) :] = box, self._word(label)
        attention = softmax(inputs @ target.query) if len(inputs) else np.zeros(0, np.float32)
        difference = np.abs(self._branch(attention @ inputs) - target.reference)
        third = _relu(self._layer("encoder/linear3", difference))
        features = _relu(self._layer("encoder/linear4", third))
        if self.meta.context:
            features = np.concatenate([features, self._context(inputs), target.context])
        return attention, features

    def _context(self, inputs: np.ndarray) -> np.ndarray:
        """What `models.context` says of the rows [n, F + D] of a frame."""
        if not len(inputs):
            return np.zeros(2 * self.meta.context, np.float32)
        rows = _relu(self._layer("encoder/scene_context/detection", inputs))
        return np.concatenate([rows.max(axis=0), rows.mean(axis=0)])

    def _reach(self, sensors: numpy_sensors.States) -> float:
        """How probable it is that the target, being in view, is within reach (`models.reach`)."""
        reading = numpy_sensors.read(self.spec, sensors)[self.spec.tracker]
        hidden = _relu(self._layer("reach/linear1", reading))
        hidden = _relu(self._layer("reach/linear2", hidden))
        return float(sigmoid(self._layer("reach/linear3", hidden))[0])

    def _branch(self, inputs: np.ndarray) -> np.ndarray:
        first = _relu(self._layer("encoder/linear1", inputs))
        return _relu(self._layer("encoder/linear2", first))

    def _lstm(
        self, inputs: np.ndarray, skip: np.ndarray, hidden: np.ndarray, cell: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Hidden state and cell after a step."""
        gates = np.concatenate([inputs, hidden]) @ self.weights["lstm/kernel"]
        gates = gates + skip @ self.weights["lstm/kernel_skip"]
        gates = gates + self.weights["lstm/bias_ih"] + self.weights["lstm/bias_hh"]
        i, f, g, o = np.split(gates, 4)
        cell = sigmoid(f) * cell + sigmoid(i) * np.tanh(g)
        return sigmoid(o) * np.tanh(cell), cell

    def _layer(self, name: str, inputs: np.ndarray) -> np.ndarray:
        return inputs @ self.weights[f"{name}/kernel"] + self.weights[f"{name}/bias"]


def load(
    folder: Path | str,
    grid: PoseGrid = ITHOR,
    synonyms: Synonyms | Path | str | None = None,
    decisions: Decisions = OWN_DECISIONS,
    more_words: Mapping[str, Sequence[float]] | Path | str | None = None,
) -> NumPyAgent:
    """An exported agent.

    Args:
      folder: that `tdanet export` wrote.
      grid: the turns and steps of the world in which the agent acts, if it has sensors.
      synonyms: other names of things, {"Mug": ["beaker"]}, or a JSON file of them.
      decisions: how the agent decides, in place of the run's settings.
      more_words: further words, as for `add_words`; synonyms may be of these, too.

    Raises:
      ValueError: a file is missing, damaged or does not fit the others, and the message names it;
        or `decisions` or `more_words` do not fit the agent.
    """
    folder = Path(folder)
    meta = _read_meta(folder / META_FILE)
    decisions.check()
    if decisions.reach_threshold is not None and not meta.reach_units:
        raise ValueError(f"--reach-threshold: {folder} was trained without it")
    meta = dataclasses.replace(meta, **decisions.replaced)
    vectors = words.load_word_vectors(folder / WORDS_FILE)
    weights = npz.read(folder / MODEL_FILE)
    expected = shapes(meta, vectors.vectors.shape[1])
    for name in sorted({*weights, *expected}):
        shape = weights[name].shape if name in weights else "missing"
        if shape != expected.get(name) or weights[name].dtype != np.float32:
            wanted = f"float32 {expected[name]}" if name in expected else "a parameter"
            raise FileError(folder / MODEL_FILE, f"{name} is {shape}, not {wanted}")
        if not np.isfinite(weights[name]).all():
            raise FileError(folder / MODEL_FILE, f"{name} is not finite")
    return NumPyAgent(meta, weights, vectors, grid, synonyms, more_words)


def shapes(meta: Meta, word: int) -> dict[str, tuple[int, ...]]:
    """The parameters by name, for word vectors of this length."""
    spec, gates, features = meta.spec, 4 * meta.hidden, meta.width + meta.sensor_units
    layers = {
        "encoder/attention": (spec.columns + word, meta.width),
        "encoder/linear1": (spec.columns + word, meta.width),
        **{f"encoder/linear{n}": (meta.width, meta.width) for n in (2, 3, 4)},
        "action_embedding": (NUM_ACTIONS, meta.action_units),
        "actor": (meta.hidden, NUM_ACTIONS),
        "critic": (meta.hidden, 1),
    }
    if spec.sensors:
        width = sum(numpy_sensors.WIDTHS[name] for name in spec.sensors)
        layers["way"] = width, meta.sensor_units
    if meta.reach_units:
        layers["reach/linear1"] = numpy_sensors.WIDTHS["triangulation"], meta.reach_units
        layers["reach/linear2"] = meta.reach_units, meta.reach_units
        layers["reach/linear3"] = meta.reach_units, 1
    if meta.context:
        layers["encoder/scene_context/detection"] = spec.columns + word, meta.context
        layers["encoder/scene_context/target"] = word, meta.context // 2
        features += 2 * meta.context + meta.context // 2
    kernels = {f"{name}/kernel": shape for name, shape in layers.items()}
    biases = {f"{name}/bias": shape[1:] for name, shape in layers.items()}
    return {
        **kernels,
        **biases,
        "lstm/kernel": (features + meta.hidden, gates),
        "lstm/kernel_skip": (meta.action_units, gates),
        "lstm/bias_ih": (gates,),
        "lstm/bias_hh": (gates,),
    }


def _read_meta(path: Path) -> Meta:
    values = jsons.load(path)
    values = {**_DEFAULTS, **values} if isinstance(values, dict) else values
    if not isinstance(values, dict) or values.get("format") != FORMAT:
        raise FileError(path, f"not an agent in the format that this version reads, {FORMAT}")
    for name, kind in _KINDS.items():
        if type(values.get(name)) is not kind:
            raise FileError(path, f"{name} is missing, or not of type {kind.__name__}")
    for name in (*values["classes"], *values["sensors"]):
        if not isinstance(name, str):
            raise FileError(path, f"{name} is not a name")
    if unknown := {*values["sensors"]} - {*numpy_sensors.WIDTHS}:
        raise FileError(path, f"no sensor is called {min(unknown)}")
    if values["reach_units"] and not {*TRACKING} & {*values["sensors"]}:
        raise FileError(path, "reach_units: needs triangulation among the sensors")
    if len({*values["sensors"]}) < len(values["sensors"]):
        raise FileError(path, "sensors: one is listed twice")
    if values["rows"] not in get_args(Rows):
        raise FileError(path, f"rows {values['rows']}: must be {' or '.join(get_args(Rows))}")
    for number in (values["word_norm"], *values["target_box"]):
        jsons.number(path, number, "word_norm, or one of target_box,", MOST)
    if values["word_norm"] <= 0:
        raise FileError(path, "word_norm is not positive")
    lists = {name: tuple(values[name]) for name, kind in _KINDS.items() if kind is list}
    meta = Meta(**{name: values[name] for name in _KINDS} | lists)
    names = [field.name for field in dataclasses.fields(Decisions)]
    try:
        Decisions(**{name: values[name] for name in names}).check()
        meta.spec.check()
    except ValueError as error:
        raise FileError(path, error) from None
    if len(meta.target_box) != meta.spec.columns:
        raise FileError(path, f"target_box is not {meta.spec.columns} numbers")
    return meta


def _relu(x: np.ndarray) -> np.ndarray:
    return np.maximum(x, 0)
