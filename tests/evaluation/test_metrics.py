"""SR, SPL and their intervals."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tdanet_jax.evaluation import metrics
from tests.support import oracle


@st.composite
def outcomes(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Success, L, e and cluster of some episodes; a success takes at least L actions."""
    count = draw(st.integers(1, 40))
    success = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    least = draw(st.lists(st.integers(1, 30), min_size=count, max_size=count))
    extra = draw(st.lists(st.integers(0, 60), min_size=count, max_size=count))
    group = draw(st.lists(st.integers(0, 5), min_size=count, max_size=count))
    shortest, length = np.array(least), np.array(least) + np.array(extra)
    # A failed Done may come sooner than any success could.
    length = np.where(success, length, np.array(extra) + 1)
    return success, shortest, length, np.array(group)


@given(outcomes())
def test_rates_are_those_of_a_loop_and_spl_is_at_most_sr(episodes: tuple) -> None:
    success, shortest, length, cluster = episodes
    out = metrics.summarise(success, shortest, length, cluster)
    for bucket, least in (("L>=1", 1), ("L>=5", 5)):
        chosen = [i for i in range(len(success)) if shortest[i] >= least]
        assert out[bucket]["n"] == len(chosen)
        if not chosen:
            continue
        rate, spl = oracle.success_rate_and_spl(success[chosen], shortest[chosen], length[chosen])
        assert out[bucket]["SR"] == pytest.approx(rate, abs=0.006)  # reported with two decimals
        assert out[bucket]["SPL"] == pytest.approx(spl, abs=0.006)
        assert 0 <= out[bucket]["SPL"] <= out[bucket]["SR"] <= 100
        for name in ("SR", "SPL"):
            if len(set(cluster[chosen])) == 1:
                assert out[bucket][f"{name}_ci"] is None
                continue
            low, high = out[bucket][f"{name}_ci"]
            assert 0 <= low <= high <= 100


def test_collision_free_measures_count_what_collided_as_failed() -> None:
    success = np.array([True, True, False, True])
    shortest, length = np.array([5, 5, 5, 6]), np.array([10, 5, 5, 6])
    collided = np.array([False, True, True, False])
    out = metrics.summarise(success, shortest, length, np.arange(4), collided)["L>=5"]
    assert [out[name] for name in metrics.MEASURES] == [75, 62.5, 50, 37.5]
    assert out["CF-SR_ci"][0] <= 50 <= out["CF-SR_ci"][1]
    columns = dict(
        zip(metrics.COLUMNS, (success, shortest, length, np.arange(4), collided), strict=True)
    )
    other = {**columns, "collided": np.zeros(4, bool)}
    assert metrics.difference(columns, other)["L>=1"]["CF-SR"] == -25
    assert metrics.difference(columns, other)["L>=1"]["SR"] == 0


def test_spl_of_single_episodes() -> None:
    success = np.array([True, True, True, False, False])
    shortest = np.array([4, 4, 1, 4, 4])
    length = np.array([4, 16, 1, 4, 1])
    np.testing.assert_allclose(metrics.spl(success, shortest, length), [1, 0.25, 1, 0, 0])


def test_the_second_group_begins_at_five() -> None:
    shortest = np.array([1, 4, 5, 6])
    ones = np.ones(4, bool)
    out = metrics.summarise(ones, shortest, shortest, np.arange(4))
    assert (out["L>=1"]["n"], out["L>=5"]["n"]) == (4, 2)


def test_a_group_without_episodes_has_no_rate() -> None:
    out = metrics.summarise(np.ones(2, bool), np.array([1, 2]), np.array([1, 2]), np.arange(2))
    assert out["L>=5"] == {"SR": None, "SPL": None, "SR_ci": None, "SPL_ci": None, "n": 0}


def clustered(seed: int, clusters: int, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Episodes that succeed or fail together within their cluster: values [1, E], cluster [E]."""
    wins = np.random.default_rng(seed).random(clusters) < 0.5
    return np.repeat(100.0 * wins, size)[None], np.repeat(np.arange(clusters), size)


def width(values: np.ndarray, cluster: np.ndarray) -> float:
    low, high = metrics.cluster_interval(values, cluster)
    return float(high[0] - low[0])


def test_more_episodes_of_the_same_pairs_do_not_narrow_the_interval() -> None:
    once, many = clustered(0, 40, 1), clustered(0, 40, 25)
    for a, b in zip(metrics.cluster_interval(*once), metrics.cluster_interval(*many), strict=True):
        np.testing.assert_allclose(a, b)


def test_more_pairs_narrow_the_interval() -> None:
    assert width(*clustered(1, 400, 2)) < 0.5 * width(*clustered(1, 40, 20))


def test_the_interval_is_that_of_independent_pair_means() -> None:
    rng = np.random.default_rng(2)
    means = rng.normal(50, 10, 80)
    values = np.repeat(means, 5)[None] + rng.normal(0, 1, 400)
    low, high = metrics.cluster_interval(values, np.repeat(np.arange(80), 5))
    middle, error = values.mean(), means.std() / np.sqrt(80)
    # Two thousand resamples: the ends themselves scatter by a few per cent of the width.
    assert low[0] == pytest.approx(middle - 1.96 * error, abs=0.35 * error)
    assert high[0] == pytest.approx(middle + 1.96 * error, abs=0.35 * error)


def test_episodes_weigh_the_same_whatever_the_size_of_their_pair() -> None:
    # Fifty pairs of nine failures and fifty of one success: a mean of 10, not of 50.
    values = np.array([[0.0] * 450 + [100.0] * 50])
    cluster = np.concatenate([np.repeat(np.arange(50), 9), np.arange(50, 100)])
    low, high = metrics.cluster_interval(values, cluster)
    assert 5 < low[0] < 10 < high[0] < 20


def test_one_pair_alone_says_nothing_about_others() -> None:
    values, cluster = np.array([[0.0, 100.0, 100.0, 100.0]]), np.zeros(4, int)
    assert metrics.cluster_interval(values, cluster) is None
    low, high = metrics.cluster_interval(values, np.array([0, 0, 1, 1]))
    assert (low[0], high[0]) == (50, 100)


def test_intervals_are_the_same_on_every_call() -> None:
    sample = clustered(3, 30, 4)
    for a, b in zip(
        metrics.cluster_interval(*sample), metrics.cluster_interval(*sample), strict=True
    ):
        np.testing.assert_array_equal(a, b)


def columns(success, shortest, length, cluster) -> dict[str, np.ndarray]:
    return {"success": success, "shortest": shortest, "length": length, "cluster": cluster}


@st.composite
def pairs(draw: st.DrawFn) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Two agents in the same episodes."""
    success, shortest, length, cluster = draw(outcomes())
    count = len(success)
    wins = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)))
    extra = np.array(draw(st.lists(st.integers(0, 60), min_size=count, max_size=count)))
    taken = np.where(wins, shortest, 1) + extra
    return columns(success, shortest, length, cluster), columns(wins, shortest, taken, cluster)


@settings(max_examples=12)
@given(pairs())
def test_differences_are_those_of_a_loop_over_resampled_pairs(both: tuple) -> None:
    ours, theirs = both
    out = metrics.difference(ours, theirs)
    for bucket, least in (("L>=1", 1), ("L>=5", 5)):
        chosen = [i for i, shortest in enumerate(ours["shortest"]) if shortest >= least]
        assert out[bucket]["n"] == len(chosen)
        if not chosen:
            assert out[bucket]["SR"] is out[bucket]["SR_ci"] is None
            continue
        expected = oracle.paired_differences(ours, theirs, chosen)
        for name, (mean, ends) in zip(("SR", "SPL"), expected, strict=True):
            assert out[bucket][name] == pytest.approx(mean, abs=0.006)
            right = None if ends is None else pytest.approx([*ends], abs=0.006)
            assert out[bucket][f"{name}_ci"] == right


@given(outcomes())
def test_an_agent_does_not_differ_from_itself(episodes: tuple) -> None:
    out = metrics.difference(columns(*episodes), columns(*episodes))
    for bucket in out.values():
        if bucket["n"]:
            shown = "0.0" if bucket["SR_ci"] is None else "0.0 (0.0 to 0.0)"
            assert [metrics.shown(bucket, name) for name in ("SR", "SPL")] == [shown, shown]
            assert bucket["SR"] == bucket["SPL"] == 0
            assert bucket["SR_ci"] in (None, [0, 0])


@given(pairs())
def test_differences_the_other_way_round_are_the_same_with_the_other_sign(both: tuple) -> None:
    there, back = metrics.difference(*both), metrics.difference(*both[::-1])
    for bucket in there:
        if there[bucket]["n"]:
            for name in ("SR", "SPL"):
                assert there[bucket][name] == -back[bucket][name]
                if back[bucket][f"{name}_ci"] is None:
                    assert there[bucket][f"{name}_ci"] is None
                    continue
                low, high = back[bucket][f"{name}_ci"]
                assert there[bucket][f"{name}_ci"] == pytest.approx([-high, -low], abs=0.011)


def test_how_hard_an_episode_is_for_both_does_not_widen_the_interval_of_a_difference() -> None:
    rng = np.random.default_rng(0)
    cluster = np.repeat(np.arange(100), 5)
    easy = np.repeat(rng.random(100) < 0.5, 5)  # both find what is easy, and little else
    ours, theirs = (
        columns(easy ^ (rng.random(500) < 0.02), np.full(500, 6), np.full(500, 6), cluster)
        for _ in range(2)
    )
    paired = metrics.difference(ours, theirs)["L>=1"]["SR_ci"]
    alone = metrics.summarise(*ours.values())["L>=1"]["SR_ci"]
    assert paired[1] - paired[0] < 0.3 * (alone[1] - alone[0])


@pytest.mark.parametrize(
    ("bucket", "text"),
    [
        ({"SR": 1.25, "SR_ci": [-0.04, 12.0]}, "1.2 (0.0 to 12.0)"),
        ({"SR": -3.21, "SR_ci": [-5.0, -0.1]}, "-3.2 (-5.0 to -0.1)"),
        ({"SR": 1.25, "SR_ci": None}, "1.2"),
        ({"SR": None, "SR_ci": None}, "-"),
    ],
)
def test_a_mean_is_shown_with_its_interval(bucket: dict, text: str) -> None:
    assert metrics.shown(bucket, "SR") == text


def test_groups_hold_their_own_episodes_in_the_order_asked_for() -> None:
    columns = {
        "room": np.array(["b", "a", "b", "b"]),
        "success": np.array([True, False, False, True]),
        "shortest": np.array([5, 2, 3, 4]),
        "length": np.array([10, 2, 3, 4]),
        "cluster": np.arange(4),
    }
    found = metrics.grouped(columns, "room", ("b", "absent", "a"))
    assert list(found) == ["b", "a"]
    assert found["b"]["L>=1"]["SR"] == pytest.approx(66.67)
    assert found["b"]["L>=1"]["SPL"] == 50
    assert found["b"]["L>=5"] == {
        "SR": 100.0, "SPL": 50.0, "SR_ci": None, "SPL_ci": None, "n": 1
    }  # fmt: skip
    assert found["a"]["L>=1"]["SR"] == 0
