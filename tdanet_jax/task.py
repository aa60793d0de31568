"""Puts a configuration's rooms, classes, words and network together."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp

from tdanet_jax import env, zero_shot
from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.env import TEST_STEP_LIMITS, EnvParams
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.tdanet import TDANetEncoder
from tdanet_jax.reward import find_parents
from tdanet_jax.scenes.tables import SceneTables
from tdanet_jax.vocabulary import ROOM_TYPES, Split, make_split
from tdanet_jax.words import WordVectors


@dataclasses.dataclass(frozen=True)
class Task:
    """What a run trains and is evaluated on.

    Attributes:
      tables: all rooms.
      split: which rooms and classes train.
      train_params: the training rooms, hidden classes filtered out.
      eval_params: all rooms and classes, with the test step limits.
      train_words: [C, D], zero for hidden classes.
      words: [C, D], vectors of all classes.
    """

    tables: SceneTables
    split: Split
    train_params: EnvParams
    eval_params: EnvParams
    train_words: jax.Array
    words: jax.Array


def make_task(config: TrainConfig, tables: SceneTables, vectors: WordVectors) -> Task:
    """The task of a configuration on the given rooms."""
    split = make_split(config.split, config.validation)
    merge = config.network.rows == "class"
    seen_rooms = zero_shot.hide_classes(tables.subset(split.train_scenes), split.hidden)
    parents = find_parents(seen_rooms, split.seen)
    limits = [config.learner.step_limit] * len(ROOM_TYPES)
    words = vectors.table(tables.classes, config.network.word_norm)
    targets = {room: split.seen[room] + split.unseen[room] for room in ROOM_TYPES}
    return Task(
        tables=tables,
        split=split,
        train_params=env.make_params(seen_rooms, split.seen, parents, limits, merge),
        eval_params=env.make_params(tables, targets, parents, TEST_STEP_LIMITS, merge),
        train_words=jnp.asarray(zero_shot.hide_words(words, tables.classes, split.hidden)),
        words=jnp.asarray(words),
    )


def resolve_precision(config: NetworkConfig) -> NetworkConfig:
    """The configuration with `auto` replaced by what suits this machine."""
    if config.precision != "auto":
        return config
    cpuinfo = Path("/proc/cpuinfo")
    on_cpu = jax.default_backend() == "cpu"
    has_amx = on_cpu and cpuinfo.exists() and "amx_bf16" in cpuinfo.read_text()
    fast = has_amx or not on_cpu
    return dataclasses.replace(config, precision="bfloat16" if fast else "float32")


def make_model(config: NetworkConfig) -> ActorCritic:
    """The network of a configuration."""
    dtype = jnp.dtype(resolve_precision(config).precision)
    encoder = TDANetEncoder(width=config.width, dropout=config.dropout, dtype=dtype)
    return ActorCritic(encoder, hidden=config.hidden, dtype=dtype)
