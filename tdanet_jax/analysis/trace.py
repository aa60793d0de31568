"""An episode step by step: the agent's path, what was in view, and what its network computed.

A trace is made from actions that were already taken, by `rollout.evaluate` or as read from a run's
`episodes.jsonl`: they lead through the same poses again, and the network runs at each of them with
the recurrent state that it had there. So a recorded episode is shown as it happened.
"""

from __future__ import annotations

import dataclasses
import functools
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from tdanet_jax import config as configs
from tdanet_jax.agent import agent
from tdanet_jax.analysis import attention
from tdanet_jax.config import CONFIG_FILE, TrainConfig, find_word_vectors, with_decisions
from tdanet_jax.decisions import OWN_DECISIONS, Decisions
from tdanet_jax.env import dynamics
from tdanet_jax.env.types import EnvParams, EnvState
from tdanet_jax.evaluation import policies, rollout
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.evaluation.policies import Policy
from tdanet_jax.evaluation.rollout import Records
from tdanet_jax.io.bundled_agents import find_run, folder_of
from tdanet_jax.models import actor_critic
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.scenes import camera_view
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.task import Task, task_in
from tdanet_jax.training import history
from tdanet_jax.vocabulary import Action


@dataclasses.dataclass(frozen=True)
class Player:
    """Who plays: a trained network, or the shortest path if there is no network.

    Attributes:
      name: what pictures call it.
      task: the rooms, as its configuration shows them.
      model, weights: the network, or None.
      greedy: takes the most probable action instead of sampling one.
    """

    name: str
    task: Task
    model: ActorCritic | None = None
    weights: Any = None
    greedy: bool = False

    @functools.cached_property
    def policy(self) -> Policy:
        """How it chooses its actions; one object, so that it is compiled once."""
        if self.model is None:
            return policies.shortest_path()
        return policies.network(self.model, self.task.words, self.greedy)

    @property
    def attends(self) -> bool:
        """Whether the network has weights over the detections."""
        if self.model is None:
            return False
        one, task = jnp.zeros(1, jnp.int32), self.task
        arguments = (self.weights, task.words, one, one, task.eval_params)
        shapes = jax.eval_shape(functools.partial(attention.attend, self.model), *arguments)
        return shapes[1].attention is not None


def load_player(
    run: Path | str,
    rooms: Rooms,
    greedy: bool = False,
    word_vectors: Path | str | None = None,
    decisions: Decisions = OWN_DECISIONS,
) -> Player:
    """The agent of a training run, or of a point of its history, on the given rooms.

    Args:
      run: the run's folder, or a file `history/<updates>.npz` in it; or the name of a bundled
        agent.
      rooms: where it plays.
      greedy: take the most probable action instead of sampling one.
      word_vectors: file of word vectors in place of the run's copy.
      decisions: how the agent decides, in place of the run's settings.

    Returns:
      A player with the name of the run's folder, or of the point.

    Raises:
      ValueError: the folder holds no run, its checkpoint cannot be read, the network needs feature
        maps that the rooms do not have, it knows classes by index and the rooms have others, or
        `decisions` do not fit the run.
    """
    run = find_run(run)
    config, weights, classes = agent.read(run)
    config = with_decisions(config, decisions, run)
    config = _in_these_rooms(run, config, word_vectors)
    task = task_in(rooms, config)
    task.check_known(run, classes.names)
    expected = task.model.parameter_shapes(*task.words.shape)
    width = None if config.word_vectors is None else task.words.shape[1]
    history.check_fit(run, weights, expected, width)
    return Player(Path(run).resolve().name, task, task.model, weights, greedy)


def load_task(run: Path | str, rooms: Rooms, word_vectors: Path | str | None = None) -> Task:
    """The given rooms as a run's configuration shows them; arguments as for `load_player`.

    The run's network is not read.

    Raises:
      ValueError: the folder holds no run, or a file cannot be read.
    """
    run = find_run(run)
    return task_in(rooms, _in_these_rooms(run, configs.load(run / CONFIG_FILE), word_vectors))


def _in_these_rooms(run: Path, config: TrainConfig, word_vectors: Path | str | None) -> TrainConfig:
    """A run's configuration for the rooms that it is shown in, with the right word vectors."""
    path = find_word_vectors(config, folder_of(run), word_vectors)
    return dataclasses.replace(config.for_tests(), word_vectors=path)


@dataclasses.dataclass(frozen=True)
class Trace:
    """One player's episode of T actions. Fields that a player does not have are None.

    Attributes:
      player: its name.
      scene, target: names.
      pose: [T + 1] int, before each action and at the end, in the full tables.
      actions: [T] int.
      success: Done with the target visible.
      shortest: L, actions on the optimal path with Done.
      probabilities: [T, 6], of the actions.
      value: [T], expected discounted return.
      attention: T arrays [n], weight of each of the n objects in view, in the tables' order. For
        a network with a row per class, every object of the class has the row's weight.
      correspondence: the same, before the softmax (Eq. 1).
      difference: [T], mean over the units of the Siamese comparison's absolute difference.
      reach: [T], estimated probability of the target being within reach; NaN where it is not seen.
    """

    player: str
    scene: str
    target: str
    pose: np.ndarray
    actions: np.ndarray
    success: bool
    shortest: int
    probabilities: np.ndarray | None = None
    value: np.ndarray | None = None
    attention: tuple[np.ndarray, ...] | None = None
    correspondence: tuple[np.ndarray, ...] | None = None
    difference: np.ndarray | None = None
    reach: np.ndarray | None = None

    @property
    def outcome(self) -> str:
        """How it ended, in words."""
        count = len(self.actions)
        if self.success:
            how = "success"
        elif self.actions[-1] == Action.DONE:
            how = "failure (Done without the target)"
        else:
            how = "failure (step limit)"
        return f"{how}, {count} action{'s'[: count != 1]}, shortest {self.shortest}"


def play(player: Player, tables: SceneTables, episode: Episodes, seed: int = 0) -> Trace:
    """Lets the player play one episode to its end. Equal seeds, equal actions."""
    params, key = player.task.eval_params, jax.random.key(seed)
    records = rollout.evaluate(player.policy, player.weights, params, episode, key)
    return retrace(player, tables, episode, records.actions[0, : records.length[0]])


def retrace(player: Player, tables: SceneTables, episode: Episodes, actions: np.ndarray) -> Trace:
    """The trace of actions [T] that were taken in an episode."""
    pose = follow(episode, actions[None], player.task.eval_params)[0]
    goal = int(episode.target[0])
    trace = Trace(
        player=player.name,
        scene=tables.scenes[tables.position_scene[tables.grid.split(pose[0]).position]],
        target=tables.targets[goal],
        pose=pose,
        actions=np.asarray(actions, int),
        success=bool(actions[-1] == Action.DONE and tables.distance[pose[-1], goal] == 0),
        shortest=int(tables.distance[pose[0], goal]) + 1,
    )
    return trace if player.model is None else _with_network(player, tables, trace, goal)


def follow(episodes: Episodes, actions: np.ndarray, params: EnvParams) -> np.ndarray:
    """Poses [E, N + 1] before each of the actions [E, N] and at the end; -1 is no action."""
    return np.asarray(_follow(jnp.asarray(episodes.pose), jnp.asarray(actions), params))


@jax.jit
def _follow(pose: jax.Array, actions: jax.Array, params: EnvParams) -> jax.Array:
    move = jax.vmap(dynamics.move, (0, 0, None))

    def step(pose: jax.Array, action: jax.Array) -> tuple[jax.Array, jax.Array]:
        after = jnp.where(action < 0, pose, move(pose, action, params))
        return after, after

    _, after = jax.lax.scan(step, pose, actions.T)
    return jnp.concatenate([pose[None], after]).T


def visited(
    episodes: Episodes, records: Records, params: EnvParams
) -> tuple[np.ndarray, np.ndarray]:
    """Pose and target [N] of every frame in which an action was chosen."""
    taken = records.actions >= 0
    pose = follow(episodes, records.actions, params)[:, :-1][taken]
    return pose, np.repeat(episodes.target, taken.sum(axis=1))


#: Steps are padded to multiples of this, the longest test episode: one shape is compiled.
STEP_BLOCK = 200


def _with_network(player: Player, tables: SceneTables, trace: Trace, goal: int) -> Trace:
    """The trace with what the network computed in every step."""
    count = len(trace.actions)
    padded = np.resize(trace.actions, -(-count // STEP_BLOCK) * STEP_BLOCK)
    task, pose = player.task, jnp.asarray(trace.pose[0])
    start = dynamics.start(pose, jnp.int32(goal), task.eval_params)
    outputs = _network(player.model, player.weights, task.words, start, padded, task.eval_params)
    steps = jax.tree.map(lambda x: np.asarray(x, np.float64)[:count], outputs)
    rows = [_rows_of_objects(tables, pose, task.eval_params) for pose in trace.pose[:-1]]

    def by_object(values: np.ndarray | None) -> tuple[np.ndarray, ...] | None:
        if values is None:
            return None
        return tuple(value[row] for value, row in zip(values, rows, strict=True))

    return dataclasses.replace(
        trace,
        probabilities=steps.probabilities,
        value=steps.value,
        attention=by_object(steps.attention),
        correspondence=by_object(steps.correspondence),
        difference=steps.difference,
        reach=steps.reach,
    )


def _rows_of_objects(tables: SceneTables, pose: int, params: EnvParams) -> np.ndarray:
    """The observation's row of each of the n objects in view: [n] int."""
    classes = tables.row_class[camera_view.rows_of_pose(tables, pose)]
    if int(params.row_start[pose + 1] - params.row_start[pose]) == len(classes):
        return np.arange(len(classes))
    return np.unique(classes, return_inverse=True)[1]  # rows are one a class, in the same order


class _NetworkSteps(NamedTuple):
    """What a network computes in each step [N]."""

    probabilities: jax.Array  # [N, 6]
    value: jax.Array  # [N]
    attention: jax.Array | None  # [N, K]
    correspondence: jax.Array | None  # [N, K]
    difference: jax.Array | None  # [N]
    reach: jax.Array | None  # [N]


@functools.partial(jax.jit, static_argnums=0)
def _network(
    model: ActorCritic,
    weights: Any,
    words: jax.Array,
    start: EnvState,
    actions: jax.Array,
    params: EnvParams,
) -> _NetworkSteps:
    class_table = actor_critic.prepare(model, weights, words)

    def step(loop: tuple, action: jax.Array) -> tuple[tuple, _NetworkSteps]:
        state, recurrent = loop
        obs = jax.tree.map(lambda x: x[None], dynamics.observe(state, params))
        recurrent, out, frame = attention.act(model, weights, class_table, recurrent, obs)
        computed = _NetworkSteps(
            probabilities=jax.nn.softmax(out.logits),
            value=out.value,
            attention=frame.attention,
            correspondence=frame.correspondence,
            difference=None if frame.difference is None else frame.difference.mean(-1),
            reach=None
            if out.reach_logit is None
            else jnp.where(obs.target_in_view, jax.nn.sigmoid(out.reach_logit), jnp.nan),
        )
        state = dynamics.transition(state, action, params).state
        return (state, recurrent), jax.tree.map(lambda x: x[0], computed)

    loop = start, actor_critic.initial_state(model, weights, 1)
    return jax.lax.scan(step, loop, actions)[1]
