"""Levels of noise as text."""

from __future__ import annotations

import pytest

from tdanet_jax import sense_noise
from tdanet_jax.config import LearnerConfig, TrainConfig
from tdanet_jax.eval_config import EvalConfig, describe_departures
from tdanet_jax.sense_noise import PRESETS, SWEEPS, SenseNoise, parse


@pytest.mark.parametrize(
    ("text", "noise"),
    [
        ("none", SenseNoise()),
        ("mix", sense_noise.MIX),
        ("misses=0.2,jitter=0.1", SenseNoise(misses=0.2, jitter=0.1)),
        ("misses=0:0.3, heading_error=3", SenseNoise(misses=(0, 0.3), heading_error=3)),
    ],
)
def test_levels_are_read_and_written(text: str, noise: SenseNoise) -> None:
    assert parse(text) == noise
    assert parse(str(noise)) == noise


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "--noise : choose none, detector, wheels, mix, or NAME=LEVEL of misses,"),
        ("fog=1", "--noise fog=1: choose"),
        ("misses", "--noise misses=: must be a number"),
        ("misses=1,misses=1", "--noise misses: is given twice"),
        ("misses=nan", "--noise misses=nan: must be a number"),
        ("misses=0:1:2", "--noise misses=0:1:2: must be a number, or a range such as 0:0.2"),
        ("misses=1.5", "--noise misses: must be a level from 0 to 1"),
        ("misses=0.3:0.1", "--noise misses: must be a level"),
        ("jitter=-1", "--noise jitter: must be a level"),
        ("false_positives=5", "--noise false_positives: must be a level from 0 to 4"),
    ],
)
def test_what_is_wrong_is_named(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        parse(text)
    if text:
        with pytest.raises(ValueError, match=message):
            EvalConfig(noise=text).check()
    with pytest.raises(ValueError, match=message):
        TrainConfig(learner=LearnerConfig(noise=text)).check()


def test_a_sweep_has_five_rising_levels_of_every_field() -> None:
    for levels in SWEEPS.values():
        assert len(levels) == 5
        for noise in levels.values():
            noise.check()
        sums = [sum(vars(noise).values()) for noise in levels.values()]
        assert sums == sorted(sums)
    swept = [noise for levels in SWEEPS.values() for noise in levels.values()]
    for name in vars(SenseNoise()):
        assert any(getattr(noise, name) for noise in swept)
    assert all(noise in swept for name, noise in PRESETS.items() if name != "none")


def test_noise_is_no_official_test() -> None:
    assert EvalConfig(noise="none").departures == {}
    departures = EvalConfig(noise="misses=0.2", step_limit=1000).departures
    assert departures == {"step_limit": 1000, "noise": "misses=0.2"}
    assert "1,000 actions per episode; senses that err, misses=0.2" in describe_departures(
        departures
    )
