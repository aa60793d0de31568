"""Several results side by side: means over seeds, tables, pages, curves."""

import statistics

import pytest

from tdanet_jax import comparison, figures
from tdanet_jax.comparison import Spread


def bucket(sr, spl):
    return {"SR": sr, "SPL": spl, "SR_ci": [0, 100], "SPL_ci": [0, 100], "n": 10}


def result(seed=0, sr=50.0, split="18/4", model="tdanet", point=0, unseen=True):
    groups = {
        "seen": {"L>=1": bucket(sr, sr / 2), "L>=5": bucket(sr - 10, sr / 4)},
        "unseen": {"L>=1": bucket(sr - 20, sr / 5), "L>=5": bucket(None, None)} if unseen else None,
    }
    shown = {group: part for group, part in groups.items() if part is not None}
    return {
        "data": None, "data_version": "d", "split": split, "model": model, "policy": "sample",
        "seed": seed, "steps": 5120,
        "episodes_trained": 100 * (point + 1) + seed, "updates": 10 * point, "point": point,
        **groups, "by_room": {"kitchen": shown},
    }  # fmt: skip


def test_mean_and_deviation_over_seeds():
    values = [70.0, 72.0, 77.0]
    out = comparison.summary([result(seed, sr) for seed, sr in enumerate(values)])
    assert out["seeds"] == [0, 1, 2]
    assert out["seen"]["L>=1"]["SR"] == Spread(73.0, statistics.stdev(values))
    assert out["unseen"]["L>=1"]["SR"].mean == pytest.approx(53)
    assert out["unseen"]["L>=5"]["SR"] is None
    assert out["by_room"]["kitchen"]["seen"]["L>=5"]["SR"].mean == pytest.approx(63)
    assert str(out["seen"]["L>=1"]["SR"]) == "73.0 ± 3.6"


def test_one_seed_has_no_deviation_and_a_split_without_unseen_classes_no_unseen_figures():
    out = comparison.summary([result(split="22/0", unseen=False)])
    assert str(out["seen"]["L>=1"]["SR"]) == "50.0"
    assert out["unseen"] is None
    assert out["by_room"]["kitchen"]["unseen"] is None


def test_the_page_has_a_row_for_each_run_the_mean_and_the_paper():
    results = [result(0, 70.0), result(1, 80.0), result(0, 60.0, model="other")]
    page = comparison.markdown("Three", results, ["a", "b", "c"])
    assert "| a | 0 | 100 | sample | 70.0 | 35.0 | 60.0 | 17.5 | 50.0 | 14.0 | - | - |" in page
    assert "| **tdanet, 2 seeds** |  |  | sample | 75.0 ± 7.1 |" in page
    assert "other, " not in page  # one seed needs no mean
    assert "| TDANet (paper) |  |  |  | 74.7 | 29.7 | - | - | 62.5 | 25.3 | - | - |" in page
    assert "The worlds differ" in page


def test_a_page_without_rows_of_the_paper_does_not_speak_of_its_world():
    page = comparison.markdown("One", [result(split="22/0", unseen=False)], ["a"])
    assert "worlds differ" not in page


def test_a_history_is_not_averaged_over_its_points():
    page = comparison.markdown("Two", [result(point=0), result(point=1)], ["a", "a"])
    assert "seeds" not in page


def test_a_curve_has_the_points_that_all_seeds_share():
    first = [result(0, 10.0 * k, point=k) for k in (1, 2, 3)]
    second = [result(1, 10.0 * k + 4, point=k) for k in (2, 3, 4)]
    curve = comparison.curve("tdanet", [first, second])
    assert curve.episodes == [300.5, 400.5]
    seen = curve.values["seen", "SR"]
    assert [point.mean for point in seen] == [22.0, 32.0]
    assert seen[0].sd == pytest.approx(statistics.stdev([20, 24]))


def test_the_figure_is_drawn_with_and_without_unseen_targets(tmp_path):
    curves = [
        comparison.curve("a", [[result(s, 9.0 * k, point=k) for k in (1, 2, 3)] for s in (0, 1)]),
        comparison.curve("b", [[result(0, 5.0 * k, point=k, unseen=False) for k in (1, 2)]]),
    ]
    figures.evaluated_curves(curves, "Two", tmp_path / "curve.png")
    assert (tmp_path / "curve.png").stat().st_size > 10_000
