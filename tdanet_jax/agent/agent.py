"""A trained agent without any rooms: the detections of any detector in, an action out.

agent = tdanet_jax.load("runs/my-run")
state = agent.start()
state, decision = agent.act(state, [Detection("mug", 0.2, 0.3, 0.25, 0.4)], target="mug")
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.config import CONFIG_FILE, TrainConfig, find_word_vectors
from tdanet_jax.env.types import Observation
from tdanet_jax.labels import LabelError, Labels, Synonyms
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic, Output, RecurrentState
from tdanet_jax.models.classes import ClassVocabulary, load_vocabulary
from tdanet_jax.models.factory import make_model
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.sensors import suite
from tdanet_jax.sensors.detections import centre_and_area, merge_classes
from tdanet_jax.sensors.sensor import Frame, Motion, Start
from tdanet_jax.training import history
from tdanet_jax.training.checkpoint import newest
from tdanet_jax.vocabulary import NUM_ACTIONS, Action, class_words
from tdanet_jax.words import WordVectors

#: Rows and labels are padded to multiples of these, so that few shapes are ever compiled.
ROW_BLOCK, LABEL_BLOCK = 16, 64


#: Share of the image by which a detection's box may reach beyond it: a pixel of any image of at
#: least 100 pixels, and more than what rounding adds in half precision or eight bits.
OVERHANG = 0.01


@dataclasses.dataclass(frozen=True)
class Detection:
    """One detected object: a label in English and its box as shares of the image, y down.

    A box that reaches up to 1% (`OVERHANG`) beyond the image, as detectors round, is clipped to the
    image; `clipped` does so with any box.
    """

    label: str
    x1: float
    y1: float
    x2: float
    y2: float

    def __post_init__(self) -> None:
        """Clips the box.

        Raises:
          ValueError: a corner is not finite or too far outside of the image, corners are in the
            wrong order, or the whole box is outside.
        """
        corners = (self.x1, self.y1, self.x2, self.y2)
        if not all(-OVERHANG <= corner <= 1 + OVERHANG for corner in corners):
            raise ValueError(
                f"{self}: corners must be shares of the image; for boxes that reach beyond it, "
                "Detection.clipped"
            )
        for side, corner in zip(("x1", "y1", "x2", "y2"), _clip(self.label, corners), strict=True):
            object.__setattr__(self, side, corner)

    @classmethod
    def clipped(cls, label: str, x1: float, y1: float, x2: float, y2: float) -> Detection:
        """A detection whose box may reach beyond the image however far; it is clipped to it.

        Raises:
          ValueError: a corner is not finite, corners are in the wrong order, or the whole box is
            outside of the image.
        """
        return cls(label, *_clip(label, (x1, y1, x2, y2)))


def _clip(label: str, corners: tuple[float, ...]) -> tuple[float, ...]:
    """The part of a box that is inside the image."""
    x1, y1, x2, y2 = whole = tuple(map(float, corners))
    if not (all(map(math.isfinite, whole)) and x1 <= x2 and y1 <= y2):
        raise ValueError(f"{label} at {whole}: corners must be finite, x1 <= x2 and y1 <= y2")
    left, top, right, bottom = inside = tuple(min(max(corner, 0.0), 1.0) for corner in whole)
    if (left == right and x1 != x2) or (top == bottom and y1 != y2):
        raise ValueError(f"{label} at {whole}: the box is outside of the image")
    return inside


class AgentState(NamedTuple):
    """What the agent carries from step to step of one episode."""

    recurrent: RecurrentState  # of the network, a batch of one
    action: jax.Array  # int32, the previous action; 6 at the start
    sensors: Mapping[str, Any]  # states of the sensors before that action
    target: jax.Array  # int32, what it looked for in the previous step; -1 at the start


class Decision(NamedTuple):
    """What the agent does, and why."""

    action: Action
    probabilities: np.ndarray  # [6], in the order of `Action`
    value: float  # expected discounted return
    attention: np.ndarray | None  # [n], weight of each detection; None if the model has none


class Agent:
    """A trained network with its configuration and word vectors.

    Attributes:
      config: the training run's configuration.
      classes: the training run's vocabulary. A model with a row per class is shown objects of the
        known classes alone; any other model is shown whatever has a name.
      model, weights: the network and its parameters.
      grid: the turns and steps of the world in which it acts, which its sensors must know.
      labels: what the labels of targets and detections mean to it.
    """

    def __init__(
        self,
        config: TrainConfig,
        weights: Any,
        vectors: WordVectors,
        classes: ClassVocabulary | None = None,
        grid: PoseGrid = ITHOR,
        synonyms: Synonyms | Path | str | None = None,
    ) -> None:
        self.config = config
        self.grid = grid
        self.classes = ClassVocabulary() if classes is None else classes
        self.model: ActorCritic = make_model(config, self.classes)
        self.spec = dataclasses.replace(self.model.spec, grid=grid)
        self.weights = weights
        self._vectors = vectors
        self.labels = Labels(self.classes.names, vectors.index, synonyms)
        self._rows = {class_words(name): i for i, name in enumerate(self.classes.names)}
        self._table: Any = None
        self._decide = jax.jit(self._forward)

    def start(self, rotation: float = 0, horizon: float = 0) -> AgentState:
        """The state at the start of an episode.

        Args:
          rotation: degrees clockwise, a multiple of the grid's turn (in iTHOR 45); multiples of 90
            lie along the grid on which the agent moves. Only networks with sensors (`--odometry`)
            need it.
          horizon: degrees down, among the grid's (in iTHOR 0 and 30); likewise.

        Raises:
          ValueError: the grid has no such rotation or horizon.
        """
        turn, down = self.grid.nearest_view(rotation, horizon)
        start = Start(jnp.int32(turn), jnp.int32(down))
        return AgentState(
            recurrent=actor_critic.initial_state(self.model, self.weights, 1),
            action=jnp.int32(NUM_ACTIONS),
            sensors=suite.init(self.spec, start),
            target=jnp.int32(-1),
        )

    def act(
        self,
        state: AgentState,
        detections: Sequence[Detection],
        target: str,
        key: jax.Array | None = None,
        blocked: bool | None = None,
    ) -> tuple[AgentState, Decision]:
        """One step.

        The returned state assumes that the decision is carried out (otherwise replace its
        `action`), and that MoveAhead leads to the next point of the grid: one cell along one axis,
        or along both on a diagonal (`PoseGrid.steps`). With `--triangulation` the camera's field of
        view must be 90 degrees in both directions.

        Args:
          state: from `start` or the previous step.
          detections: the objects in view, in any order.
          target: what to look for, in English. Detections of it are those whose label means the
            same (`labels`): "tv", "TVs" and "Television_2" do.
          key: samples the action, as in training; None takes the most probable one.
          blocked: whether the previous action failed to move the agent (AI2-THOR's
            `lastActionSuccess` was False). Networks with sensors need it after a MoveAhead, and
            after no other action.

        Raises:
          LabelError: a label means nothing known, and has a word without a word vector.
          ValueError: the model needs an image instead of detections; or it has sensors and is not
            told whether its MoveAhead was blocked.
        """
        if self.model.encoder.IMAGE:
            raise ValueError(
                f"{self.config.model} needs an image; an agent is shown detections alone"
            )
        if self.spec.sensors and blocked is None and state.action == Action.MOVE_AHEAD:
            raise ValueError("the agent has odometry: say whether its MoveAhead was `blocked`")
        obs, owner = self._observe(detections, target)
        state, out, attention = self._decide(
            self.weights, self._prepared(), state, obs, jnp.asarray(bool(blocked))
        )
        logits, value = out
        best = jnp.argmax(logits, -1) if key is None else jax.random.categorical(key, logits)
        decision = Decision(
            action=Action(int(best[0])),
            probabilities=np.asarray(state.recurrent.prev_action_probs[0]),
            value=float(value[0]),
            attention=None if attention is None else np.asarray(attention[0])[owner],
        )
        return state._replace(action=best[0]), decision

    def knows(self, label: str) -> bool:
        """Whether a label has a meaning (`labels`), so that it can be detected or looked for."""
        try:
            self.labels.resolve(label)
        except LabelError:
            return False
        return True

    def _observe(
        self, detections: Sequence[Detection], target: str
    ) -> tuple[Observation, np.ndarray]:
        """The frame as the network sees it, and the row of each detection.

        A row per detection; for a model made for it, a row per class.
        """
        labels = np.array([self._index(d.label) for d in detections], np.int32)
        corners = np.array([(d.x1, d.y1, d.x2, d.y2) for d in detections]).reshape(-1, 4)
        if self.spec.rows == "class":
            labels, owner = np.unique(labels, return_inverse=True)
            order = np.argsort(owner, kind="stable")
            _, found = merge_classes(owner[order], corners[order])
        else:
            owner, found = np.arange(len(labels)), centre_and_area(corners)
        if self.spec.scores:
            given = [getattr(one, "score", None) for one in detections]
            scores = [1.0 if score is None else score for score in given]
            found = np.column_stack([found, scores])
        count = len(labels)
        rows = max(-(-count // ROW_BLOCK), 1) * ROW_BLOCK
        classes, boxes = (
            np.zeros((1, rows), np.int32),
            np.zeros((1, rows, found.shape[1]), np.float32),
        )
        classes[0, :count], boxes[0, :count] = labels, found
        observation = Observation(
            classes=jnp.asarray(classes),
            boxes=jnp.asarray(boxes),
            mask=jnp.arange(rows)[None] < count,
            target=jnp.full(1, self._index(target), jnp.int32),
            empty=jnp.full(1, not detections),
        )
        return observation, owner

    def _index(self, label: str) -> int:
        """The row in the table of classes of what a label means; new words get a new row."""
        key = class_words(self.labels.resolve(label))
        if key not in self._rows:
            self._rows[key] = len(self._rows)
            self._table = None
        return self._rows[key]

    def _prepared(self) -> Any:
        if self._table is None:
            names = [" ".join(key) for key in self._rows]
            table = self._vectors.table(names, self.config.network.word_norm)
            rest = -len(table) % LABEL_BLOCK
            padded = jnp.asarray(np.pad(table, ((0, rest), (0, 0))))
            self._table = actor_critic.prepare(self.model, self.weights, padded)
        return self._table

    def _forward(
        self,
        weights: Any,
        class_table: Any,
        state: AgentState,
        obs: Observation,
        blocked: jax.Array,
    ) -> tuple[AgentState, Output, jax.Array | None]:
        """The state but for the next action, policy and value, and the attention."""
        spec = self.spec
        frame = Frame(obs.classes[0], obs.boxes[0], obs.mask[0], obs.target[0])
        sensors = suite.update(spec, state.sensors, Motion(state.action, blocked))
        sensors = suite.clear(spec, sensors, state.target != frame.target)
        sensors = suite.observe(spec, sensors, frame)
        readings = jax.tree.map(lambda x: x[None], suite.read(spec, sensors))
        recurrent, out, kept = actor_critic.act(
            self.model, weights, class_table, state.recurrent, obs.replace(sensors=readings),
            collections=("intermediates",),
        )  # fmt: skip
        (attention,) = kept["intermediates"]["attention"]
        return AgentState(recurrent, state.action, sensors, frame.target), out, attention


def load(
    run: Path | str,
    grid: PoseGrid = ITHOR,
    word_vectors: Path | str | None = None,
    synonyms: Synonyms | Path | str | None = None,
) -> Agent:
    """The agent of a run's newest checkpoint, or of a point of its history. Needs no rooms.

    Args:
      run: the run's folder, or a file `history/<updates>.npz` in it.
      grid: the turns and steps of the world in which the agent acts, if it has sensors; it may
        have been trained on another.
      word_vectors: file of word vectors in place of the run's copy, for example with more words;
        they must be as wide.

    Raises:
      ValueError: the folder holds no run, its checkpoint cannot be read, or its word vectors are
        missing or of another width.
    """
    config, weights, classes = read(run)
    path = find_word_vectors(config, folder_of(run), word_vectors)
    vectors = words.load_word_vectors(path, classes.names)
    agent = Agent(config, weights, vectors, classes, grid, synonyms)
    shape = max(len(classes.names), 1), vectors.vectors.shape[1]
    expected, width = agent.model.parameter_shapes(*shape), None if path is None else shape[1]
    history.check_fit(run, weights, expected, width)
    return agent


def folder_of(run: Path | str) -> Path:
    """The folder of a run, or of the run of a point of history (`history/<updates>.npz`)."""
    path = Path(run)
    return path.parent.parent if path.suffix == history.SUFFIX else path


def read(run: Path | str) -> tuple[TrainConfig, Any, ClassVocabulary]:
    """What `load` makes an agent of: configuration, parameters, vocabulary."""
    path, folder = Path(run), folder_of(run)
    config = configs.load(folder / CONFIG_FILE)
    snapshot = newest(folder) if path == folder else history.read(path)
    return config, snapshot.weights, load_vocabulary(folder)
