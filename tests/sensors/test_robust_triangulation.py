"""Robust triangulation: its definition ray by ray, and targets seen along wrong bearings."""

from __future__ import annotations

import copy
import math

import numpy as np
import pytest
from hypothesis import given, settings

from tdanet_jax.observation_spec import ObservationSpec
from tests.sensors.test_odometry import SlowOdometry
from tests.sensors.test_triangulation import (
    AHEAD,
    SPEC,
    STORIES,
    Box,
    Ray,
    SlowEstimate,
    angle,
    assert_as_told,
    axes,
    box_of,
    camera,
    filled,
    frames_of,
    told,
    walked,
)

ROBUST = ObservationSpec(sensors=("odometry", "robust-triangulation"))


class SlowRobustEstimate(SlowEstimate):
    """Rays whose errors are worth something for where the target was estimated."""

    def ray_to(self, agent: SlowOdometry, box: Box) -> Ray:
        plain, after = super().ray_to(agent, box), copy.copy(self)
        after.rays = [*self.rays, plain]
        place = after.seen_from(agent)
        error = math.sin(math.radians(angle(plain.along, place)))
        return plain._replace(pull=2 * error**2 * place)

    def tolerance(self, agent: SlowOdometry) -> list[float]:
        return [4 * off for off in super().tolerance(agent)]


@settings(max_examples=60)
@given(**STORIES)
def test_every_step_is_that_of_the_slow_estimate(
    diagonal: bool, horizon: int, runs: list, seed: int, noise: float
) -> None:
    story = told(diagonal, horizon, runs, seed, noise, SlowRobustEstimate)
    assert_as_told(story, diagonal, horizon, ROBUST)


@pytest.mark.parametrize("degrees", [0.0, 3.0])
def test_errors_of_bearings_bring_targets_less_near(degrees: float) -> None:
    rng = np.random.default_rng(0)
    off: dict[ObservationSpec, list[float]] = {SPEC: [], ROBUST: []}
    for _ in range(60):
        side, ahead = rng.uniform(0.3, 1.0), rng.uniform(3.0, 4.0)
        place, agent, seen = np.array([side, -0.3, ahead]), SlowOdometry(False, 0), []
        for t in range(9):
            if t:
                agent.update(*AHEAD[0])
            box = box_of(agent, place, 0.3)
            assert box is not None
            seen.append(
                [box._replace(x=box.x + math.tan(math.radians(rng.normal(0, degrees))) / 2)]
            )
        for spec in off:
            *_, found = walked(False, 0, *filled(8 * AHEAD), frames_of(seen, rng), spec)
            true = (place - camera(agent)) @ axes(0)[2]
            off[spec].append(4 * float(found[8, 2]) - true)
    plain, robust = (float(np.median(off[spec])) for spec in (SPEC, ROBUST))
    if degrees:  # metres
        assert plain < -0.5
        assert abs(robust) < 0.3
    else:
        assert plain == pytest.approx(0, abs=0.1)
        assert robust == pytest.approx(0, abs=0.1)
