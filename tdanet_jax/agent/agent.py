"""A trained agent without any rooms: the detections of any detector in, an action out.

agent = tdanet_jax.load("runs/my-run")
state = agent.start()
state, decision = agent.act(state, [Detection("mug", 0.2, 0.3, 0.25, 0.4)], target="mug")
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax import config as configs
from tdanet_jax import words
from tdanet_jax.agent.base import BaseAgent, Decision, sigmoid, softmax, without
from tdanet_jax.agent.detection import Detection
from tdanet_jax.config import CONFIG_FILE, TrainConfig, find_word_vectors, with_decisions
from tdanet_jax.decisions import OWN_DECISIONS, Decisions
from tdanet_jax.env.types import Observation
from tdanet_jax.io.bundled_agents import find_run, folder_of
from tdanet_jax.labels import Synonyms
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic, Output, RecurrentState
from tdanet_jax.models.classes import ClassVocabulary, load_vocabulary
from tdanet_jax.models.factory import make_model
from tdanet_jax.poses import ITHOR, PoseGrid
from tdanet_jax.sensors import suite
from tdanet_jax.sensors.sensor import NO_SLIP, Frame, Motion, Start
from tdanet_jax.sensors.shared import MeasuredPose
from tdanet_jax.training import history
from tdanet_jax.training.checkpoint import newest
from tdanet_jax.vocabulary import NUM_ACTIONS, Action
from tdanet_jax.words import WordVectors

#: Rows and labels are padded to multiples of these, so that few shapes are ever compiled.
ROW_BLOCK, LABEL_BLOCK = 16, 64


class AgentState(NamedTuple):
    """What the agent carries from step to step of one episode."""

    recurrent: RecurrentState  # of the network, a batch of one
    action: jax.Array | np.int32  # the previous action; 6 at the start
    sensors: Mapping[str, Any]  # states of the sensors before that action
    target: jax.Array  # int32, what it looked for in the previous step; -1 at the start


class Agent(BaseAgent):
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
        more_words: Mapping[str, Sequence[float]] | Path | str | None = None,
    ) -> None:
        self.config = config
        self.classes = ClassVocabulary() if classes is None else classes
        self.model: ActorCritic = make_model(config, self.classes)
        spec = dataclasses.replace(self.model.spec, grid=grid)
        super().__init__(self.classes.names, vectors, spec, synonyms, more_words)
        self.weights = jax.device_put(weights)  # NumPy arrays would be copied in each step
        self._table: Any = None
        self._table_rows = 0
        self._begin = jax.jit(self._first)
        self._decide = jax.jit(self._forward)
        self._decide_many = jax.jit(jax.vmap(self._forward, (None, None, 0, 0, 0, 0)))

    def start(self, rotation: float = 0, horizon: float = 0, measured: bool = False) -> AgentState:
        """The state at the start of an episode.

        Args:
          rotation: degrees clockwise, a multiple of the grid's turn (in iTHOR 45); multiples of 90
            lie along the grid on which the agent moves. Only networks with sensors (`--odometry`)
            need it.
          horizon: degrees down, among the grid's (in iTHOR 0 and 30); likewise.
          measured: whether `act` will be told the `pose`.

        Raises:
          ValueError: the grid has no such rotation or horizon.
        """
        turn, down = self.grid.nearest_view(rotation, horizon)
        start = Start(jnp.asarray(turn), jnp.asarray(down), NO_SLIP if measured else None)
        state: AgentState = self._begin(self.weights, start)
        return state

    def act(
        self,
        state: AgentState,
        detections: Sequence[Detection],
        target: str,
        key: jax.Array | None = None,
        blocked: bool | None = None,
        *,
        forbidden: Collection[Action] = (),
        pose: MeasuredPose | None = None,
    ) -> tuple[AgentState, Decision]:
        """One step.

        The returned state assumes that the decision is carried out (otherwise replace its
        `action`), and that MoveAhead leads to the next point of the grid: one cell along one axis,
        or along both on a diagonal (`PoseGrid.steps`). The boxes must be those of a camera with a
        field of view of 90 degrees in both directions; `Camera` maps those of others.

        Args:
          state: from `start` or the previous step.
          detections: the objects in view, in any order.
          target: what to look for, in English. Detections of it are those whose label means the
            same (`labels`): "tv", "TVs" and "Television_2" do.
          key: samples the action, at the agent's temperature; None takes the most probable one.
          blocked: whether the previous action failed to move the agent (AI2-THOR's
            `lastActionSuccess` was False). Networks with sensors need it after a MoveAhead, and
            after no other action.
          forbidden: actions that are not taken; the others' probabilities are renormalised.
          pose: where the agent stands, in an episode that began with `start(measured=True)`.

        Raises:
          LabelError: a label means nothing known, and has a word without a word vector.
          ValueError: the model needs an image instead of detections; it has sensors and is not
            told whether its MoveAhead was blocked; every action is forbidden, or one that does
            not exist; or a pose is given where none is expected, is missing, or is not from
            `measured_pose`.
        """
        self._checked(state, blocked, pose, forbidden)
        obs, owner = self._observe(detections, target)
        state, out, attention = self._decide(
            self.weights, self._prepared(), state, obs, np.bool_(blocked), pose
        )
        return _decision(state, out, attention, owner, key, forbidden)

    def act_many(
        self,
        states: Sequence[AgentState],
        frames: Sequence[Sequence[Detection]],
        targets: Sequence[str],
        keys: Sequence[jax.Array | None] | None = None,
        blocked: Sequence[bool | None] | None = None,
        *,
        forbidden: Collection[Action] = (),
        poses: Sequence[MeasuredPose] | None = None,
    ) -> list[tuple[AgentState, Decision]]:
        """`act` for N robots at once, in one compiled program for each N.

        Args:
          states: of each robot, from `start`, `act` or this.
          frames: the detections of each.
          targets: what each looks for.
          keys: as in `act`, of each; None takes the most probable actions.
          blocked: as in `act`, of each.
          forbidden: actions that none of them takes.
          poses: as in `act`, of each or of none.

        Returns:
          What `act` gives for each robot.

        Raises:
          LabelError, ValueError: as `act`; or the arguments are not equally many.
        """
        count = len(states)
        told: Sequence[bool | None] = [None] * count if blocked is None else blocked
        nowhere: list[MeasuredPose | None] = [None] * count
        where: Sequence[MeasuredPose | None] = nowhere if poses is None else poses
        given = states if keys is None else keys
        if {*map(len, (frames, targets, told, where, given))} != {count}:
            raise ValueError(
                f"{count} states: give as many frames, targets, keys, blocked and poses"
            )
        if len({pose is None for pose in where}) > 1:
            raise ValueError("poses: give one for each robot, or none")
        for one in zip(states, told, where, strict=True):
            self._checked(*one, forbidden)
        if not count:
            return []
        rows = max(map(len, frames))
        observed = [self._observe(*one, rows) for one in zip(frames, targets, strict=True)]
        state, obs, pose = (
            jax.tree.map(lambda *leaves: np.stack(leaves), *jax.device_get(parts))
            for parts in ([*states], [obs for obs, _ in observed], [*where])
        )
        out = jax.device_get(
            self._decide_many(
                self.weights, self._prepared(), state, obs, np.array(told, bool), pose
            )
        )
        decided = []
        for i, (_, owner) in enumerate(observed):
            own, values, attention = jax.tree.map(lambda leaf, i=i: leaf[i], out)
            key = None if keys is None else keys[i]
            decided.append(_decision(own, values, attention, owner, key, forbidden))
        return decided

    def key(self, seed: int, step: int) -> jax.Array:
        """The `key` with which `act` samples an action; another one for each seed and step."""
        return jax.random.fold_in(jax.random.key(seed), step)

    def add_words(self, more: Mapping[str, Sequence[float]] | Path | str) -> int:
        """As `BaseAgent.add_words`."""
        added = super().add_words(more)
        self._table = None
        return added

    def check_input(self) -> None:
        """As `BaseAgent.check_input`."""
        if self.model.encoder.IMAGE:
            raise ValueError(
                f"{self.config.model} needs an image; an agent is shown detections alone"
            )

    def _checked(
        self,
        state: AgentState,
        blocked: bool | None,
        pose: MeasuredPose | None,
        forbidden: Collection[Action],
    ) -> None:
        """Raises ValueError if the arguments of `act` do not go together."""
        self.check_input()
        odometry = state.sensors.get("odometry")
        measured = odometry is not None and odometry.deviation is not None
        self._check(int(state.action), measured, blocked, pose, forbidden)

    def _observe(
        self, detections: Sequence[Detection], target: str, least_rows: int = 0
    ) -> tuple[Observation, np.ndarray]:
        """The frame as the network sees it, and the row of each detection.

        A row per detection; for a model made for it, a row per class. The rest, up to `least_rows`
        at least, is padding.
        """
        labels, found, owner = self._shown(detections)
        count = len(labels)
        rows = max(-(-max(count, least_rows) // ROW_BLOCK), 1) * ROW_BLOCK
        classes = np.zeros((1, rows), np.int32)
        boxes = np.zeros((1, rows, found.shape[1]), np.float32)
        classes[0, :count], boxes[0, :count] = labels, found
        arrays: dict[str, Any] = {  # of NumPy: the compiled step takes them sooner than JAX's
            "classes": classes,
            "boxes": boxes,
            "mask": np.arange(rows)[None] < count,
            "target": np.full(1, self._index(target), np.int32),
            "empty": np.full(1, not detections),
        }
        return Observation(**arrays), owner

    def _prepared(self) -> Any:
        if self._table is None or self._table_rows != len(self._row_names):
            self._table_rows, norm = len(self._row_names), self.config.network.word_norm
            table = np.stack([self._vector(row, norm) for row in range(self._table_rows)])
            rest = -len(table) % LABEL_BLOCK
            self._table = _prepare(self.model, self.weights, np.pad(table, ((0, rest), (0, 0))))
        return self._table

    def _first(self, weights: Any, start: Start) -> AgentState:
        return AgentState(
            recurrent=actor_critic.initial_state(self.model, weights, 1),
            action=jnp.int32(NUM_ACTIONS),
            sensors=suite.init(self.spec, start),
            target=jnp.int32(-1),
        )

    def _forward(
        self,
        weights: Any,
        class_table: Any,
        state: AgentState,
        obs: Observation,
        blocked: jax.Array,
        pose: MeasuredPose | None,
    ) -> tuple[AgentState, Output, jax.Array | None]:
        """The state but for the next action, policy and value, and the attention.

        The logit of reach is NaN where the target is not in view.
        """
        spec = self.spec
        frame = Frame(obs.classes[0], obs.boxes[0], obs.mask[0], obs.target[0])
        sensors = suite.update(
            spec, state.sensors, Motion(jnp.asarray(state.action), blocked, measured=pose)
        )
        sensors = suite.clear(spec, sensors, state.target != frame.target)
        sensors = suite.observe(spec, sensors, frame)
        readings = jax.tree.map(lambda x: x[None], suite.read(spec, sensors))
        recurrent, out, kept = actor_critic.act(
            self.model, weights, class_table, state.recurrent, obs.replace(sensors=readings),
            collections=("intermediates",),
        )  # fmt: skip
        if out.reach_logit is not None:
            logit = jnp.where(obs.target_in_view, out.reach_logit, jnp.nan)
            out = out._replace(reach_logit=logit)
        (attention,) = kept["intermediates"]["attention"]
        return AgentState(recurrent, state.action, sensors, frame.target), out, attention


_prepare = jax.jit(actor_critic.prepare, static_argnums=0)
_sample = jax.jit(jax.random.categorical)


def _decision(
    state: AgentState,
    out: Output,
    attention: jax.Array | None,
    owner: np.ndarray,
    key: jax.Array | None,
    forbidden: Collection[Action],
) -> tuple[AgentState, Decision]:
    """The state after a step, and the decision, from what `Agent._forward` gives."""
    # In NumPy: each single operation of JAX would be compiled, and take longer than the network.
    logits = np.asarray(out.logits)[0]
    if forbidden:
        logits = without(logits, forbidden)
    reach = None
    if out.reach_logit is not None and np.isfinite(logit := np.asarray(out.reach_logit)[0]):
        reach = float(sigmoid(logit))
    action = Action(int(np.argmax(logits) if key is None else _sample(key, logits)))
    decision = Decision(
        action=action,
        probabilities=softmax(logits),
        value=float(np.asarray(out.value)[0]),
        attention=None if attention is None else np.asarray(attention)[0][owner],
        reach=reach,
    )
    return state._replace(action=np.int32(action)), decision


def load(
    run: Path | str,
    grid: PoseGrid = ITHOR,
    word_vectors: Path | str | None = None,
    synonyms: Synonyms | Path | str | None = None,
    decisions: Decisions = OWN_DECISIONS,
    more_words: Mapping[str, Sequence[float]] | Path | str | None = None,
) -> Agent:
    """The agent of a run's newest checkpoint, or of a point of its history. Needs no rooms.

    Args:
      run: the run's folder, or a file `history/<updates>.npz` in it; or the name of a bundled
        agent, "18-4-best".
      grid: the turns and steps of the world in which the agent acts, if it has sensors; it may
        have been trained on another.
      word_vectors: file of word vectors in place of the run's copy, for example with more words;
        they must be as wide.
      synonyms: other names of things, {"Mug": ["beaker"]}, or a JSON file of them.
      decisions: how the agent decides, in place of the run's settings.
      more_words: further words, as for `add_words`; synonyms may be of these, too.

    Raises:
      ValueError: the folder holds no run, its checkpoint cannot be read, its word vectors are
        missing or of another width, `decisions` do not fit the run, or `more_words` are not words
        with vectors of the same width.
    """
    run = find_run(run)
    config, weights, classes = read(run)
    config = with_decisions(config, decisions, run)
    path = find_word_vectors(config, folder_of(run), word_vectors)
    vectors = words.load_word_vectors(path, classes.names)
    agent = Agent(config, weights, vectors, classes, grid, synonyms, more_words)
    shape = max(len(classes.names), 1), vectors.vectors.shape[1]
    expected, width = agent.model.parameter_shapes(*shape), None if path is None else shape[1]
    history.check_fit(run, weights, expected, width)
    return agent


def read(run: Path | str) -> tuple[TrainConfig, Any, ClassVocabulary]:
    """What `load` makes an agent of: configuration, parameters, vocabulary."""
    path, folder = Path(run), folder_of(run)
    config = configs.load(folder / CONFIG_FILE)
    snapshot = newest(folder) if path == folder else history.read(path)
    return config, snapshot.weights, load_vocabulary(folder)
