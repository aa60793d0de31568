"""What agents with JAX and without have in common. Imports no JAX."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from tdanet_jax.agent.detection import Detection
from tdanet_jax.labels import LabelError, Labels, Synonyms
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.poses import PoseGrid
from tdanet_jax.sensors.detections import centre_and_area, merge_classes
from tdanet_jax.sensors.shared import MeasuredPose
from tdanet_jax.vocabulary import NUM_ACTIONS, Action, class_words
from tdanet_jax.words import WordVectors


class Decision(NamedTuple):
    """What the agent does, and why."""

    action: Action
    #: [6], in the order of `Action`, with which actions are sampled: after temperature, bias for
    #: Done and the rule on reach; 0 for what is forbidden.
    probabilities: np.ndarray
    value: float  # expected discounted return
    attention: np.ndarray | None  # [n], weight of each detection; None if the model has none
    reach: float | None = None  # probability of the target in view being within 1.5 m, if estimated


def softmax(x: np.ndarray) -> np.ndarray:
    """Probabilities from logits, [n]."""
    exponentials = np.exp(x - x.max())
    return exponentials / exponentials.sum()


def sigmoid(x: np.ndarray) -> np.ndarray:
    """The probability from a logit."""
    return (1 + np.tanh(x / 2)) / 2  # for large x of either sign, too


def without(logits: np.ndarray, forbidden: Collection[Action]) -> np.ndarray:
    """The logits of the actions, [6], -inf for those that are forbidden."""
    allowed = logits.copy()
    allowed[[*forbidden]] = -np.inf
    return allowed


class BaseAgent:
    """What labels mean to an agent, and what it is shown of a frame.

    Attributes:
      grid: the turns and steps of the world in which it acts, which its sensors must know.
      spec: what it is shown.
      labels: what the labels of targets and detections mean to it.
    """

    def __init__(
        self,
        classes: Sequence[str],
        vectors: WordVectors,
        spec: ObservationSpec,
        synonyms: Synonyms | Path | str | None,
        more_words: Mapping[str, Sequence[float]] | Path | str | None = None,
    ) -> None:
        self.grid: PoseGrid = spec.grid
        self.spec = spec
        self._own = vectors  # adding words does not change the vectors of the trained classes
        self._described = vectors.described(classes)
        self._synonyms = synonyms
        self._names = tuple(classes)
        self._row_names = [*classes]  # of the table of classes; then what else labels mean
        self._rows: dict[tuple[str, ...], int] = {}
        for row, name in enumerate(classes):
            self._rows.setdefault(class_words(name), row)
        self._know(vectors if more_words is None else vectors.extended(more_words))

    def start(self, rotation: float = 0, horizon: float = 0, measured: bool = False) -> Any:
        """The state at the start of an episode; see `agent.Agent.start`."""
        raise NotImplementedError

    def act(
        self,
        state: Any,
        detections: Sequence[Detection],
        target: str,
        key: Any = None,
        blocked: bool | None = None,
        *,
        forbidden: Collection[Action] = (),
        pose: MeasuredPose | None = None,
    ) -> tuple[Any, Decision]:
        """One step; see `agent.Agent.act`."""
        raise NotImplementedError

    def key(self, seed: int, step: int) -> Any:
        """The `key` with which `act` samples an action; another one for each seed and step."""
        raise NotImplementedError

    def check_input(self) -> None:
        """Raises ValueError if the network needs more than detections to act."""

    def knows(self, label: str) -> bool:
        """Whether a label has a meaning (`labels`), so that it can be detected or looked for."""
        try:
            self.labels.resolve(label)
        except LabelError:
            return False
        return True

    def add_words(self, more: Mapping[str, Sequence[float]] | Path | str) -> int:
        """Gives the agent further words, for labels that it does not know.

        Args:
          more: word -> vector, or a file of vectors as GloVe's (`words.load_word_vectors`), of
            which all words are taken. They must be vectors of the same model and length as those
            with which the agent was trained (by default glove.6B.50d): others tell it nothing.

        Returns:
          The number of words that are new. Words that the agent has keep their vectors.

        Raises:
          ValueError: the file cannot be read, something is not a vector, or vectors are of another
            length; the agent stays as it was.
        """
        vectors = self._vectors.extended(more)
        added = len(vectors.index) - len(self._vectors.index)
        self._know(vectors)
        return added

    def _know(self, vectors: WordVectors) -> None:
        """Takes these vectors for all but the classes that have one already."""
        gained = vectors.described([name for name in self._names if name not in self._described])
        known = self._described.keys() | gained.keys()
        named = (name for name in self._names if name in known)
        self.labels = Labels(named, vectors.index, self._synonyms)
        self._vectors, self._gained = vectors, gained
        self._row_of: dict[str, int] = {}  # by label

    def _vector(self, row: int, norm: float | None) -> np.ndarray:
        """The vector [D] of a row of the table of classes; zeros if its class has none."""
        name = self._row_names[row]
        if row >= len(self._names):
            return self._vectors.embed(name, norm)
        if name in self._described:
            return self._own.embed(self._described[name], norm)
        if name in self._gained:
            return self._vectors.embed(self._gained[name], norm)
        return np.zeros(self._vectors.vectors.shape[1], np.float32)

    def _index(self, label: str) -> int:
        """The row in the table of classes of what a label means; new words get a new row."""
        if label not in self._row_of:
            key = class_words(self.labels.resolve(label))
            if key not in self._rows:
                self._rows[key] = len(self._row_names)
                self._row_names.append(" ".join(key))
            self._row_of[label] = self._rows[key]
        return self._row_of[label]

    def _shown(self, detections: Sequence[Detection]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """A frame as the agent is shown it, n rows: one per object or, if it is so made, per class.

        Returns:
          Each row's class [n] int, its x, y, S and perhaps score [n, F], and the row of each
          detection.
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
            scores = [1.0 if one.score is None else one.score for one in detections]
            found = np.column_stack([found, scores])
        return labels, found, owner

    def _check(
        self,
        action: int,
        measured: bool,
        blocked: bool | None,
        pose: MeasuredPose | None,
        forbidden: Collection[Action],
    ) -> None:
        """Checks that the arguments of `act` go together.

        Args:
          action: the previous action.
          measured: whether the episode began with `start(measured=True)`, of an agent with
            odometry.

        Raises:
          ValueError: they do not.
        """
        if self.spec.sensors and blocked is None and action == Action.MOVE_AHEAD:
            raise ValueError("the agent has sensors: say whether its MoveAhead was `blocked`")
        for one in forbidden:
            is_index = isinstance(one, int | np.integer) and not isinstance(one, bool)
            if not is_index or not 0 <= one < NUM_ACTIONS:
                raise ValueError(f"forbidden {one!r}: must be an Action, 0 to {NUM_ACTIONS - 1}")
        if not isinstance(pose, MeasuredPose | None):
            raise ValueError("pose: must be what `measured_pose` gives")
        if len({*forbidden}) >= NUM_ACTIONS:
            raise ValueError("every action is forbidden")
        if "odometry" in self.spec.sensors and measured != (pose is not None):
            raise ValueError(
                "a pose is measured in every step of an episode that begins with "
                "start(measured=True), and in no other"
            )
