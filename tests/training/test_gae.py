"""Advantages of rollouts with bootstrap-only steps against the sum that defines them."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.training.gae import advantages
from tests.support.oracle import Step, generalised_advantages

ENDS = ("done", "time-out", "rollout")
LONGEST = 4 * (5 + 1)  # of `rollouts`: four pieces of five steps, each with a step that only values
compiled = jax.jit(advantages)
numbers = st.floats(-5, 5, allow_nan=False, width=32)


@dataclasses.dataclass(frozen=True)
class Piece:
    """A piece of an episode within a rollout, and what comes after it."""

    steps: tuple[Step, ...]
    end: str  # one of ENDS
    final_value: float  # of the state after the last step; counts unless it was terminal


def pieces(ends: tuple[str, ...]) -> st.SearchStrategy[Piece]:
    steps = st.lists(st.builds(Step, numbers, numbers), min_size=1, max_size=5).map(tuple)
    return st.builds(Piece, steps, st.sampled_from(ends), numbers)


@st.composite
def rollouts(draw: st.DrawFn) -> list[Piece]:
    """Episodes one after the other; the last one may be cut by the end of the rollout."""
    whole = draw(st.lists(pieces(("done", "time-out")), max_size=3))
    return [*whole, draw(pieces(ENDS))]


def laid_out(parts: list[Piece], gamma: float, lam: float) -> dict[str, list]:
    """The rollout's arrays: a time-out is followed by a step that only values its last state."""
    columns: dict[str, list] = {
        name: [] for name in ("reward", "value", "terminal", "bootstrap_only", "expected")
    }

    def add(reward: float, value: float, terminal: bool, only: bool, expected: float) -> None:
        row = (reward, value, terminal, only, expected)
        for column, item in zip(columns.values(), row, strict=True):
            column.append(item)

    for part in parts:
        final = 0.0 if part.end == "done" else part.final_value
        expected = generalised_advantages(part.steps, final, gamma, lam)
        for t, step in enumerate(part.steps):
            last = t == len(part.steps) - 1
            add(step.reward, step.value, last and part.end == "done", False, expected[t])
        if part.end == "time-out":
            add(0.0, part.final_value, True, True, 0.0)
    return columns


def computed(columns: dict[str, list], last_value: float, gamma: float, lam: float) -> np.ndarray:
    def column(name: str, dtype: type) -> jnp.ndarray:
        return jnp.asarray(np.array(columns[name], dtype)[:, None])

    return np.asarray(
        compiled(
            column("reward", np.float32), column("value", np.float32),
            jnp.array([last_value], jnp.float32), column("terminal", bool),
            column("bootstrap_only", bool), gamma, lam,
        )
    )[:, 0]  # fmt: skip


@settings(max_examples=60)
@given(rollouts(), st.sampled_from((0.0, 0.9, 0.99, 1.0)), st.sampled_from((0.0, 0.95, 1.0)))
def test_advantages_are_the_defining_sum_per_episode(
    parts: list[Piece], gamma: float, lam: float
) -> None:
    # An episode before the others makes all rollouts equally long: one compilation.
    before = LONGEST + 1 - len(laid_out(parts, gamma, lam)["reward"])
    first = Piece((Step(1.0, -2.0),) * before, "done", 0.0)
    columns = laid_out([first, *parts], gamma, lam)
    # The last value is of the state that the rollout's last step led to.
    last_value = parts[-1].final_value
    found = computed(columns, last_value, gamma, lam)
    # float32 sums of a dozen numbers below 10.
    np.testing.assert_allclose(found, columns["expected"], rtol=1e-4, atol=1e-4)


def test_a_time_out_in_the_last_step_is_valued_by_the_state_after_the_rollout() -> None:
    # The bootstrap-only step falls into the next rollout: the last value is that of its state.
    columns = laid_out([Piece((Step(1.0, 2.0), Step(-1.0, 0.5)), "rollout", 3.0)], 0.9, 0.5)
    found = computed(columns, 3.0, 0.9, 0.5)
    last = -1.0 + 0.9 * 3.0 - 0.5
    np.testing.assert_allclose(found, [1.0 + 0.9 * 0.5 - 2.0 + 0.45 * last, last], atol=1e-6)


def test_a_bootstrap_only_step_first_in_a_rollout_has_no_advantage() -> None:
    flags = {"terminal": [True, True], "bootstrap_only": [True, False]}
    columns = {"reward": [0.0, 1.0], "value": [4.0, 2.0], **flags}
    np.testing.assert_allclose(computed(columns, 9.0, 0.9, 0.5), [0.0, -1.0], rtol=1e-6)


def test_lambda_one_gives_discounted_returns() -> None:
    rng = np.random.default_rng(0)
    steps = tuple(Step(float(r), float(v)) for r, v in rng.normal(size=(6, 2)))
    columns = laid_out([Piece(steps, "rollout", 0.7)], 0.9, 1.0)
    returns = [
        sum(0.9**k * step.reward for k, step in enumerate(steps[t:])) + 0.9 ** (6 - t) * 0.7
        for t in range(6)
    ]
    np.testing.assert_allclose(
        computed(columns, 0.7, 0.9, 1.0) + np.array(columns["value"]), returns, rtol=1e-5
    )


def test_environments_do_not_mix() -> None:
    rng = np.random.default_rng(1)
    reward, value = rng.normal(size=(2, 5, 3)).astype(np.float32)
    terminal, only = rng.random((2, 5, 3)) < 0.3
    last = rng.normal(size=3).astype(np.float32)
    both = advantages(*map(jnp.asarray, (reward, value, last, terminal, only)), 0.9, 0.8)
    for b in range(3):
        one = (reward[:, b : b + 1], value[:, b : b + 1], last[b : b + 1])
        flags = (terminal[:, b : b + 1], only[:, b : b + 1])
        alone = advantages(*map(jnp.asarray, (*one, *flags)), 0.9, 0.8)
        assert alone[:, 0] == pytest.approx(np.asarray(both[:, b]), rel=1e-6)
