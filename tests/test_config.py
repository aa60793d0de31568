"""Configurations: defaults, presets, JSON and errors."""

from __future__ import annotations

import dataclasses
import json
import re
import sys
from pathlib import Path

import pytest

from tdanet_jax import config as configs
from tdanet_jax.config import PAPER, LearnerConfig, NetworkConfig, TrainConfig


def test_json_round_trip_is_the_identity():
    for config in configs.PRESETS.values():
        assert configs.from_json(json.loads(json.dumps(configs.to_json(config)))) == config


def test_paper_preset_has_the_reference_constants():
    learner = PAPER.learner
    assert (learner.gamma, learner.gae_lambda, learner.entropy_weight) == (0.99, 1.0, 0.01)
    assert (learner.learning_rate, learner.amsgrad, learner.max_grad_norm) == (1e-4, True, 100.0)
    assert (learner.step_limit, learner.value_weight) == (30, 0.5)
    assert PAPER.episodes == 6_000_000
    assert PAPER.network.rows == "object"


@pytest.mark.parametrize(
    ("config", "flag"),
    [
        (TrainConfig(split="17/5"), "--split 17/5"),
        (TrainConfig(split="Mug,CD,Mug"), "--split Mug,CD,Mug: Mug is given twice"),
        (
            TrainConfig(split="Painting,Laptop,Television,RemoteControl,Vase", validation=True),
            "no class to train on in living_room besides the one that --validation holds out",
        ),
        (TrainConfig(model="cnn"), "--model cnn"),
        (TrainConfig(variants=-1), "--variants -1: must not be negative"),
        (TrainConfig(variants=401), "--variants 401: must be at most 400"),
        (TrainConfig(generated=-1), "--generated -1: must not be negative"),
        (TrainConfig(generated=10**5), "--generated 100000: must be at most 10,000"),
        (TrainConfig(generated_only=True), "--generated-only: needs --generated"),
        (TrainConfig(generated=1, generated_only=True, variants=1), "not with --variants"),
        (TrainConfig(steps=0), "--steps 0"),
        (TrainConfig(minutes=-1.0), "--minutes -1.0"),
        (TrainConfig(episodes=2**31), "--episodes 2147483648: must be at most 2,147,483,647"),
        (TrainConfig(steps=10**400), "--steps 1000"),
        (TrainConfig(network=NetworkConfig(width=10**9)), "--width 1000000000: must be at most"),
        (TrainConfig(learner=LearnerConfig(step_limit=2**40)), "--step-limit 1099511627776"),
        (TrainConfig(learner=LearnerConfig(learning_rate=10**400)), "--learning-rate 1000"),
        (TrainConfig(learner=LearnerConfig(num_envs=0)), "--num-envs 0"),
        (TrainConfig(learner=LearnerConfig(num_minibatches=0)), "--num-minibatches 0"),
        (
            TrainConfig(learner=LearnerConfig(num_envs=10, num_minibatches=4)),
            "--num-minibatches 4: must divide --num-envs 10",
        ),
        (TrainConfig(learner=LearnerConfig(clip_coef=0.0)), "--clip-coef 0.0"),
        (TrainConfig(learner=LearnerConfig(gamma=1.5)), "--gamma 1.5"),
        (TrainConfig(network=NetworkConfig(dropout=1.0)), "--dropout 1.0"),
        (
            TrainConfig(network=NetworkConfig(dropout=0.003)),
            "--dropout 0.003: must be 0, or from 1/256 to 255/256",
        ),
        (TrainConfig(network=NetworkConfig(dropout=0.999)), "--dropout 0.999: must be 0, or"),
        (TrainConfig(learner=LearnerConfig(learning_rate=float("nan"))), "--learning-rate nan"),
        (TrainConfig(network=NetworkConfig(odometry=1)), "--odometry 1"),
        (TrainConfig(network=NetworkConfig(odometry=True, triangulation=1)), "--triangulation 1"),
        (
            TrainConfig(network=NetworkConfig(triangulation=True)),
            "--triangulation: needs --odometry (or use --no-triangulation)",
        ),
        (
            TrainConfig(network=NetworkConfig(odometry=True, robust_triangulation=True)),
            "--robust-triangulation: needs --triangulation",
        ),
        (
            TrainConfig(network=NetworkConfig(odometry=True, reach_threshold=0.5)),
            "--reach-threshold: needs --triangulation",
        ),
        (
            TrainConfig(
                network=NetworkConfig(odometry=True, triangulation=True, reach_threshold=1.0)
            ),
            "--reach-threshold 1.0: must be at least 0 and below 1",
        ),
        (TrainConfig(network=NetworkConfig(temperature=0)), "--temperature 0: must be between"),
        (TrainConfig(network=NetworkConfig(done_bias=-101.0)), "--done-bias -101.0: must be"),
        (TrainConfig(network=NetworkConfig(done_bias=float("nan"))), "--done-bias nan: must be"),
        (
            TrainConfig(network=NetworkConfig(odometry=True, triangulation=True, rows="class")),
            "--triangulation: needs a box of every object, which --rows class does not show",
        ),
        (TrainConfig(learner=LearnerConfig(size_noise=-0.1)), "--size-noise -0.1: must be between"),
        (TrainConfig(learner=LearnerConfig(size_noise=2.1)), "--size-noise 2.1: must be between"),
        (TrainConfig(learner=LearnerConfig(size_noise=float("nan"))), "--size-noise nan"),
    ],
)
def test_a_value_out_of_range_is_named_in_one_line(config, flag):
    with pytest.raises(ValueError, match=re.escape(flag)) as caught:
        config.check()
    assert "\n" not in str(caught.value)


def test_the_robust_preset_is_the_best_with_senses_that_err():
    noise = (
        "misses=0:0.3,small_misses=0:0.6,swaps=0:0.1,jitter=0:0.2,scores=0:1,distance_bias=0:0.1,"
        "distance_noise=0:0.1,turn_bias=0:0.1,turn_noise=0:0.1,heading_error=0:3"
    )
    assert configs.PRESETS["robust"].learner.noise == noise
    assert configs.PRESETS["robust"].network.spec.sensors == ("odometry", "robust-triangulation")
    changed = {"noise", "robust_triangulation", "scores", "reach_threshold", "imitation_weight"}
    changed |= {"temperature", "done_bias"}
    assert configs.ROBUST.extra_targets is None
    differ = set()
    for part in ("learner", "network"):
        ours, theirs = (vars(getattr(one, part)) for one in (configs.ROBUST, configs.BEST))
        differ |= {name for name in ours if ours[name] != theirs[name]}
    assert differ == changed
    configs.ROBUST.check()


def test_the_preset_with_the_inputs_of_the_paper_has_no_others():
    ours, default = configs.PRESETS["paper-inputs"], configs.PRESETS["default"]
    assert ours == dataclasses.replace(
        default,
        extra_targets="all",
        learner=dataclasses.replace(default.learner, gamma=0.97, imitation_weight=0.3),
        network=dataclasses.replace(default.network, context=64, temperature=0.7),
    )
    assert ours.network.spec.sensors == ()
    ours.check()


@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
def test_size_noise_may_be_as_much_as_two(noise):
    TrainConfig(learner=LearnerConfig(size_noise=noise)).check()


def test_a_run_is_kept_under_the_one_name_of_its_split_and_with_absolute_paths(tmp_path):
    config = TrainConfig(split="vase, Mug", data=str(tmp_path / "rooms.npz"), word_vectors="a.txt")
    config.check()
    kept = config.normalised()
    assert kept.split == "Mug,Vase"
    assert (kept.data, kept.word_vectors) == (config.data, str(Path("a.txt").absolute()))
    assert kept == kept.normalised() == configs.from_json(configs.to_json(kept))
    assert TrainConfig(split="Pillow,Laptop,Toaster,ToiletPaper").normalised() == TrainConfig()


def test_one_row_per_class_is_fine_without_triangulation():
    TrainConfig(network=NetworkConfig(odometry=True, rows="class")).check()


def test_every_default_is_in_range():
    for config in configs.PRESETS.values():
        config.check()


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        "{}",
        '{"split": "18/4"}',
        '{"learner": 3, "network": {}}',
        '{"learner": {}, "network": []}',
        '{"learner": {}, "network": {"sensors": 3}}',
        '{"learner": {}, "network": {"sensors": [3]}}',
        "[" * 100_000,
        '{"split": 1e400}',
    ],
)
def test_an_unreadable_config_file_is_named(tmp_path, text):
    path = tmp_path / "config.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=re.escape(str(path))):
        configs.load(path)


@pytest.mark.parametrize("later", [["triangulation"], ["odometry", "triangulation"]])
def test_a_run_from_before_odometry_or_triangulation_has_none(tmp_path, later):
    path = tmp_path / "config.json"
    config = TrainConfig(network=NetworkConfig(odometry="odometry" not in later))
    values = configs.to_json(config)
    for name in later:
        del values["network"][name]
    path.write_text(json.dumps(values))
    assert configs.load(path) == config
    assert not any(getattr(configs.load(path).network, name) for name in later)


def test_an_unknown_field_is_refused(tmp_path):
    path = tmp_path / "config.json"
    values = configs.to_json(TrainConfig()) | {"wings": 2}
    path.write_text(json.dumps(values))
    with pytest.raises(ValueError, match="wings"):
        configs.load(path)


@pytest.mark.parametrize(
    ("budget", "share"),
    [
        ({}, 6e6 / 12e6),
        ({"steps": 8_000_000}, 6e6 / 8e6),
        ({"episodes": 1000}, 0.3),
        ({"minutes": 60.0}, 0.2),
        ({"minutes": 60.0, "episodes": 1000}, 0.3),
        ({"steps": 60_000_000, "minutes": 60.0, "episodes": 3000}, 0.2),
    ],
)
def test_of_several_budgets_the_one_that_is_spent_first_counts(budget, share):
    config = TrainConfig(**budget)
    assert config.spent(6_000_000, 300, 12 * 60.0) == pytest.approx(share)


def test_a_paper_run_ends_with_the_first_of_its_budgets():
    assert dataclasses.replace(PAPER, steps=100).spent(100, 3, 1.0) == 1.0


@pytest.mark.parametrize(
    ("config", "idle"),
    [
        (TrainConfig(), {}),
        (
            TrainConfig(learner=LearnerConfig(clip_coef=0.1, imitation_until=1.0)),
            {
                "--clip-coef": "with one optimiser step per update",
                "--imitation-until": "without --imitation-weight",
            },
        ),
        (
            TrainConfig(
                learner=LearnerConfig(
                    clip_coef=0.1, update_epochs=2, imitation_until=1.0, imitation_weight=0.1
                )
            ),
            {},
        ),
        (
            TrainConfig(pool_rooms=9, pool_updates=9),
            dict.fromkeys(["--pool-rooms", "--pool-updates"], "without --variants or --generated"),
        ),
        (TrainConfig(pool_rooms=9, variants=1), {}),
        (TrainConfig(pool_updates=9, generated=1), {}),
    ],
)
def test_flags_that_change_nothing_are_named_with_the_reason(config, idle):
    assert configs.idle_flags(config) == idle


def test_a_run_of_a_custom_model_is_read_only_by_those_who_trust_it(tmp_path, monkeypatch):
    path, config = tmp_path / "config.json", TrainConfig(model="some_lab.agent")
    configs.save(config, path)
    with pytest.raises(ValueError, match=r"set TDANET_TRUST=some_lab\.agent") as caught:
        configs.load(path)
    assert str(path) in str(caught.value)
    monkeypatch.setenv(configs.TRUST, "another_lab.agent")
    with pytest.raises(ValueError, match="its model is custom code, some_lab"):
        configs.load(path)
    monkeypatch.setenv(configs.TRUST, "another_lab.agent,some_lab.agent")
    assert configs.load(path) == config
    monkeypatch.delenv(configs.TRUST)
    monkeypatch.setitem(sys.modules, "some_lab.agent", sys)
    assert configs.load(path) == config


def test_configs_are_frozen():
    with pytest.raises(dataclasses.FrozenInstanceError):
        TrainConfig().seed = 1
