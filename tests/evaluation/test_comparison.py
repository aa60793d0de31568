"""Several results side by side: means over seeds, tables, pages, curves."""

import dataclasses
import statistics

import numpy as np
import pytest

from tdanet_jax.analysis import figures
from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.evaluation import comparison, metrics
from tdanet_jax.evaluation.comparison import Spread


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
        "share": point / 20,
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
    # Results from before collisions were counted have none of these figures.
    results[0]["seen"]["L>=1"] |= {"CF-SR": 51.0, "CF-SPL": 21.0}
    page = comparison.markdown("Three", results, ["a", "b", "c"])
    assert (
        "| a | 0 | 100 | sample | 70.0 | 35.0 | 51.0 | 21.0 | 60.0 | 17.5 | - | - | 50.0 |" in page
    )
    assert "| **tdanet, 2 seeds** |  |  | sample | 75.0 ± 7.1 |" in page
    assert "other, " not in page  # one seed needs no mean
    seen, unseen = "74.7 | 29.7 | - | - | 62.9 | 32.2", "62.5 | 25.3 | - | - | 47.4 | 23.8"
    assert f"| TDANet (paper) |  |  |  | {seen} | - | - | {unseen} | - | - |" in page
    assert "The worlds differ" in page


def test_a_page_without_rows_of_the_paper_does_not_speak_of_its_world():
    page = comparison.markdown("One", [result(split="open", unseen=False)], ["a"])
    assert "worlds differ" not in page


def test_the_page_says_which_targets_were_tested():
    others = [result(0) | {"targets": "Kettle,Mug"}, result(1) | {"targets": "Kettle,Mug"}]
    page = comparison.markdown("Two", others, ["a", "b"])
    assert "Targets: Kettle,Mug." in page
    assert "(paper)" not in page
    papers = [result(0) | {"targets": "paper"}, result(1)]  # the first results did not say it
    page = comparison.markdown("Two", papers, ["a", "b"])
    assert "Targets:" not in page
    assert "(paper)" in page


def test_other_tests_stand_in_other_tables():
    """Other rooms, or other targets: neither side by side nor in one mean."""
    houses = result(2, 20.0) | {"data": "house.npz", "data_version": "h"}
    copy = result(4, 25.0) | {"data": "copy/house.npz", "data_version": "h"}
    some = result(3, 30.0) | {"targets": "Mug,Vase"}
    results = [result(0), houses, some, result(1), copy]
    results = [r | {"run": name} for r, name in zip(results, "abcde", strict=True)]
    played = [records(range(3), [True, False, True]) for _ in results]
    found = comparison.with_differences(results, played)
    others = [r["difference"] and r["difference"]["to"] for r in found]
    assert others == [None, None, None, "a", "b"]
    page = comparison.markdown("Five", found, "abcde")
    _, paper, house, few = page.split("## Split 18/4")
    assert "**tdanet, 2 seeds**" in paper
    assert "| TDANet (paper) |" in paper
    assert "Rooms: the bundled ones, scene tables d." in paper
    assert "Rooms: house.npz, scene tables h." in house
    assert "| b | 0 |" in house
    assert "Targets: Mug,Vase." in few
    assert "(paper)" not in few
    assert "| e minus b |" in house
    assert "| d minus a |" in paper
    assert "minus" not in few
    assert "seeds**" not in few


def test_a_history_is_not_averaged_over_its_points():
    page = comparison.markdown("Two", [result(point=0), result(point=1)], ["a", "a"])
    assert "seeds" not in page


def records(starts, success, length=None):
    """Columns of one group of episodes of L = 6, one in each room."""
    count = len(starts)
    return {
        "seen": {
            "scene": np.array([f"FloorPlan{i}" for i in range(count)]),
            "target": np.array(["Mug"] * count),
            "x": np.array(starts, float), "z": np.zeros(count),
            "rotation": np.zeros(count, int), "horizon": np.zeros(count, int),
            "success": np.array(success, bool), "shortest": np.full(count, 6),
            "length": np.full(count, 6) if length is None else np.array(length),
            "cluster": np.arange(count),
        }
    }  # fmt: skip


def test_differences_are_to_the_first_that_played_the_same_episodes():
    here, there = (0, 1, 2, 3), (0, 1, 2, 4)
    played = [
        records(here, (0, 1, 0, 1)), records(there, (1, 1, 1, 1)), records(here, (1, 1, 0, 1)),
        records(there, (0, 0, 0, 0)), records(here, (0, 1, 0, 1)), records(here, (0, 1, 0, 1)),
    ]  # fmt: skip
    results = [result(seed) | {"run": f"runs/{seed}"} for seed in range(6)]
    results[5]["data_version"] = "e"  # the same starts, in other rooms
    found = [r["difference"] for r in comparison.with_differences(results, played)]
    assert [d and d["to"] for d in found] == [None, None, "runs/0", "runs/1", "runs/0", None]
    assert found[2]["unseen"] is None
    assert (
        found[2]["seen"]["L>=5"] == metrics.difference(played[2]["seen"], played[0]["seen"])["L>=5"]
    )
    assert [d["seen"]["L>=1"]["SR"] for d in found if d] == [25, -100, 0]
    assert found[4]["seen"]["L>=1"]["SPL_ci"] == [0, 0]
    alone = comparison.with_differences(
        [results[0], results[2] | {"split": "22/0"}], played[::2][:2]
    )
    assert [r["difference"] for r in alone] == [None, None]


def test_the_page_has_a_row_for_every_difference():
    played = [records(range(3), (0, 1, 0)), records(range(3), (1, 1, 1), (6, 12, 6))]
    results = [result(seed) | {"run": f"runs/{name}"} for seed, name in enumerate("ab")]
    page = comparison.markdown("Two", comparison.with_differences(results, played), ["a", "b"])
    low, high = metrics.difference(played[1]["seen"], played[0]["seen"])["L>=1"]["SR_ci"]
    assert f"| b minus a |  |  | sample | 66.7 ({low:.1f} to {high:.1f}) | 50.0 (" in page
    assert (
        page.index("| b | ") < page.index("| b minus a |") < page.index("| **tdanet, 2 seeds** |")
    )
    assert "Differences: in the same episodes, 95 % intervals (paired bootstrap)." in page
    assert "minus" not in comparison.markdown("Two", results, ["a", "b"])


def of(seed=0, sr=50.0, **values):
    """A result of a run with the given values in place of the defaults."""
    config = TrainConfig(seed=seed, **values)
    return {**result(seed, sr, model=config.model), "settings": comparison.settings(config)}


def test_settings_are_the_flags_without_the_seed_and_what_only_looks_and_keeps():
    config = TrainConfig(minutes=10.0, learner=LearnerConfig(num_envs=8))
    found = comparison.settings(config)
    assert (found["--minutes"], found["--num-envs"], found["--rows"]) == (10.0, 8, "object")
    kept = dataclasses.replace(config, seed=3, history=0, chunk_updates=1, checkpoint_minutes=9.0)
    assert comparison.settings(kept) == found
    assert comparison.settings(dataclasses.replace(config, minutes=11.0)) != found


def test_seeds_of_one_configuration_share_a_label():
    results = [of(0), of(1), of(2) | {"steps": 9999}]  # the same minutes reach other steps
    assert comparison.labels(results, "abc") == ["tdanet"] * 3


def test_other_flags_are_another_configuration_and_are_said():
    results = [
        of(0), of(1, network=NetworkConfig(rows="class"), minutes=10.0),
        of(2, learner=LearnerConfig(amsgrad=True)), of(3, model="ssnet"),
    ]  # fmt: skip
    assert comparison.labels(results, "abcd") == [
        "tdanet, no --minutes, no --amsgrad, --rows object",
        "tdanet, --minutes 10.0, no --amsgrad, --rows class",
        "tdanet, no --minutes, --amsgrad, --rows object",
        "ssnet",
    ]
    zero = comparison.labels([of(0), of(0, network=NetworkConfig(dropout=0.5))], "ab")
    assert zero == ["tdanet, --dropout 0.0", "tdanet, --dropout 0.5"]


def test_other_rooms_or_actions_are_apart():
    results = [of(0), of(1) | {"data_version": "e"}]
    assert comparison.labels(results, "ab") == ["tdanet, scene tables d", "tdanet, scene tables e"]
    results = [of(0), of(1) | {"policy": "greedy"}]
    assert comparison.labels(results, "ab") == [
        "tdanet, --policy sample",
        "tdanet, --policy greedy",
    ]
    results = [of(0), of(1) | {"split": "14/8"}]  # stand under headings of their own
    assert comparison.labels(results, "ab") == ["tdanet", "tdanet"]


def test_that_an_agent_senses_its_way_or_its_target_is_always_said():
    way, both = NetworkConfig(odometry=True), NetworkConfig(odometry=True, triangulation=True)
    sensing, sighting = ([of(seed, network=senses) for seed in (0, 1)] for senses in (way, both))
    assert comparison.labels(sensing, "ab") == ["tdanet, --odometry"] * 2
    assert comparison.labels(sighting, "ab") == ["tdanet, --odometry, --triangulation"] * 2
    assert comparison.labels([of(0), of(1)], "ab") == ["tdanet"] * 2
    assert comparison.labels([of(0), sensing[0], sighting[0]], "abc") == [
        "tdanet, no --odometry, no --triangulation",
        "tdanet, --odometry, no --triangulation",
        "tdanet, --odometry, --triangulation",
    ]


def test_twice_the_same_seed_is_no_sample_of_seeds():
    results = [of(0), of(1), of(0, 60.0)]
    assert comparison.labels(results, "abc") == ["tdanet, a", "tdanet, b", "tdanet, c"]
    page = comparison.markdown("Three", results, "abc")
    assert "seeds**" not in page
    assert "±" not in page


def test_the_page_has_a_mean_for_every_configuration():
    wide = {"network": NetworkConfig(width=16)}
    results = [of(0, 70.0), of(1, 72.0), of(0, 30.0, **wide), of(1, 32.0, **wide)]
    page = comparison.markdown("Four", results, "abcd")
    assert "| **tdanet, --width 512, 2 seeds** |  |  | sample | 71.0 ± 1.4 |" in page
    assert "| **tdanet, --width 16, 2 seeds** |  |  | sample | 31.0 ± 1.4 |" in page


def test_results_of_before_have_no_settings_and_are_compared_by_the_rest():
    assert comparison.labels([result(0), result(1)], "ab") == ["tdanet", "tdanet"]


def test_a_curve_of_histories_of_other_lengths_meets_at_shares_of_the_budget():
    ten = [result(0, 10.0 * k, point=k) | {"share": k / 10} for k in range(1, 11)]
    twenty = [result(1, 5.0 * k, point=k) for k in range(1, 21)]
    curve = comparison.curve("tdanet", [ten, twenty])
    assert [point.mean for point in curve.values["seen", "SR"]] == [10.0 * k for k in range(1, 11)]


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


def test_what_was_counted_is_written_under_the_panels_of_the_data_curve(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(figures.drawing, "save", lambda figure, *rest: drawn.append(figure))
    found = {group: {"SR": 90.0, "SPL": 50.0} for group in ("seen", "unseen")}
    points = [
        ("rooms", "real", 64, found),
        ("rooms", "more", 640, found),
        ("targets", "", 9, found),
    ]
    figures.data_curve(points, tmp_path / "curve.png")
    axes = np.reshape(drawn[0].axes, (2, 4))
    assert [axis.get_xlabel() for axis in axes[0]] == [""] * 4
    assert [axis.get_xlabel() for axis in axes[1]] == ["rooms"] * 2 + ["targets"] * 2
    for row, measure in zip(axes, ("SR", "SPL"), strict=True):
        for axis, group in zip(row, ("seen", "unseen") * 2, strict=True):
            assert axis.get_ylabel() == f"{group} targets, {measure}, per cent"
            assert {*axis.lines[0].get_ydata()} == {found[group][measure]}
