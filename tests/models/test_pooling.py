"""Pooling a layer of each detection: against loops, and against all rows at once."""

from __future__ import annotations

import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.env.types import Observation
from tdanet_jax.models import pooling
from tdanet_jax.models.pooling import RowTable, maximum_and_sum
from tests.support import samples
from tests.support.samples import CLASSES, DETECTIONS, observations

U, FRAMES = 5, 12
TABLE = RowTable(names=samples.normal(CLASSES, U, seed=1), boxes=samples.normal(3, U, seed=2))


@pytest.fixture(params=[512, 7], autouse=True)
def block(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """All rows in one block, and several blocks that frames do not end with."""
    monkeypatch.setattr(pooling, "BLOCK", request.param)


def with_gaps(obs: Observation) -> Observation:
    """The same frames, in some of which rows of padding lie between detections, as under noise."""
    missed = np.random.default_rng(3).random(obs.mask.shape) < 0.3
    return obs.replace(mask=obs.mask & ~missed)


def by_loops(obs: Observation) -> tuple[np.ndarray, np.ndarray]:
    names, units = np.asarray(TABLE.names), np.asarray(TABLE.boxes)
    most, total = np.zeros((2, *obs.mask.shape[:-1], U))
    for place in np.ndindex(*obs.mask.shape):
        if obs.mask[place]:
            row = np.maximum(names[obs.classes[place]] + np.asarray(obs.boxes[place]) @ units, 0)
            most[place[:-1]] = np.maximum(most[place[:-1]], row)
            total[place[:-1]] += row
    return most, total


@pytest.mark.parametrize("backend", ["cpu", "gpu"], indirect=True)
@pytest.mark.parametrize("shape", [(1,), (FRAMES,), (4, 3)])
def test_it_is_the_maximum_and_the_sum_of_the_rows_in_view(
    backend: None, shape: tuple[int, ...]
) -> None:
    obs = with_gaps(observations(*shape))
    found = jax.jit(lambda given: maximum_and_sum(TABLE, given))(obs)
    for ours, right in zip(found, by_loops(obs), strict=True):
        np.testing.assert_allclose(ours, right, rtol=1e-5, atol=1e-6)


def test_its_gradient_is_that_of_all_rows(monkeypatch: pytest.MonkeyPatch) -> None:
    obs = with_gaps(observations(FRAMES))
    weights = samples.normal(2, FRAMES, U, seed=4)

    def loss(table: RowTable) -> jax.Array:
        most, total = maximum_and_sum(table, obs)
        return jnp.sum(jnp.stack([most, total]) * weights)

    found = jax.jit(jax.grad(loss))(TABLE)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for ours, right in zip(*map(jax.tree.leaves, (found, jax.grad(loss)(TABLE))), strict=True):
        assert np.abs(right).max() > 1
        np.testing.assert_allclose(ours, right, rtol=1e-5, atol=1e-5)


def test_vmap_is_a_loop() -> None:
    obs = observations(3, FRAMES)
    full = obs.mask.at[0].set(False).at[1].set(True)  # other numbers of blocks
    obs = obs.replace(mask=full)
    tables = jax.tree.map(lambda x: jnp.stack([x, -x, 2 * x]), TABLE)

    def grad(table: RowTable, given: Observation) -> RowTable:
        return jax.grad(lambda table: sum(x.sum() for x in maximum_and_sum(table, given)))(table)

    together = jax.jit(jax.vmap(grad))(tables, obs)
    for i in range(3):
        one = grad(*jax.tree.map(operator.itemgetter(i), (tables, obs)))
        for ours, right in zip(*map(jax.tree.leaves, (together, one)), strict=True):
            np.testing.assert_allclose(ours[i], right, rtol=1e-5, atol=1e-5)


def test_a_frame_without_detections_is_zero_and_so_is_its_gradient() -> None:
    obs = observations(2).replace(mask=jnp.zeros((2, DETECTIONS), bool))
    assert not any(x.any() for x in maximum_and_sum(TABLE, obs))
    grad = jax.grad(lambda table: sum(x.sum() for x in maximum_and_sum(table, obs)))(TABLE)
    assert not any(x.any() for x in jax.tree.leaves(grad))
