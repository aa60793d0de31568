"""NumPy's numbers and paths are taken; other values are refused, with the type they must have."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax import config as configs
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.decisions import Decisions
from tdanet_jax.eval_config import EvalConfig


def test_numbers_of_other_types_become_plain_ones() -> None:
    config = TrainConfig(
        seed=np.int64(3),  # type: ignore[arg-type]
        minutes=np.float32(0.5),  # type: ignore[arg-type]
        validation=np.True_,  # type: ignore[arg-type]
        data=Path("rooms.npz"),  # type: ignore[arg-type]
        learner=LearnerConfig(gamma=np.float32(0.5), num_envs=np.array(8)),  # type: ignore[arg-type]
        network=NetworkConfig(dropout=np.float64(0.25)),
    )
    config.check()
    plain = TrainConfig(
        seed=3,
        minutes=0.5,
        validation=True,
        data="rooms.npz",
        learner=LearnerConfig(gamma=0.5, num_envs=8),
        network=NetworkConfig(dropout=0.25),
    )
    assert repr(config) == repr(plain)
    assert configs.from_json(json.loads(json.dumps(configs.to_json(config)))) == plain
    changed = dataclasses.replace(config, steps=np.int32(10))  # type: ignore[arg-type]
    assert type(changed.steps) is int
    decisions = Decisions(temperature=np.float64(0.5))
    decisions.check()
    assert type(decisions.temperature) is float
    EvalConfig(step_limit=np.int64(20)).check()  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("part", "values", "message"),
    [
        (TrainConfig, {"steps": 1e6}, "--steps 1000000.0: must be a whole number"),
        (TrainConfig, {"seed": np.float64(1.0)}, "--seed 1.0: must be a whole number"),
        (TrainConfig, {"seed": True}, "--seed True: must be a whole number"),
        (TrainConfig, {"minutes": "5"}, "--minutes 5: must be a number"),
        (TrainConfig, {"split": 3}, "--split 3: must be a string"),
        (TrainConfig, {"learner": 3}, "--learner 3: must be a LearnerConfig"),
        (LearnerConfig, {"num_envs": 64.0}, "--num-envs 64.0: must be a whole number"),
        (LearnerConfig, {"gamma": True}, "--gamma True: must be a number"),
        (LearnerConfig, {"gamma": float("nan")}, "--gamma nan: must be finite"),
        (LearnerConfig, {"gamma": np.float64("inf")}, "--gamma inf: must be finite"),
        (LearnerConfig, {"gamma": 1e300}, "--gamma 1e+300: must be between -1e300 and 1e300"),
        (
            LearnerConfig,
            {"partial_reward": "x"},
            "--partial-reward x: must be one of parents, similarity, none",
        ),
        (NetworkConfig, {"scores": 1}, "--scores 1: must be True or False"),
        (NetworkConfig, {"sensors": (3,)}, "--sensors (3,): must be a tuple of strings"),
        (Decisions, {"temperature": "1"}, "--temperature 1: must be a number"),
        (EvalConfig, {"scenes": "FloorPlan1"}, "--scenes FloorPlan1: must be a tuple of strings"),
        (EvalConfig, {"training_rooms": "no"}, "--training-rooms no: must be True or False"),
        (EvalConfig, {"step_limit": 2.5}, "--step-limit 2.5: must be a whole number"),
        (Decisions, {"done_bias": float("inf")}, "--done-bias inf: must be finite"),
    ],
)
def test_a_value_of_another_type_is_named_with_what_it_must_be(
    part: Any, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match="must be") as error:
        part(**values).check_types()
    assert str(error.value) == message
