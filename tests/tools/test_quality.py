"""Time to quality: which evaluations pass, and what is said to have been spent."""

import json

import pytest

from tdanet_jax.commands import benchmark
from tdanet_jax.tools import quality

BAR = {"seen": (70.0, 30.0), "unseen": (60.0, 25.0)}
ENOUGH = {"seen": (70.0, 31.0), "unseen": (60.0, 25.0)}


def test_the_bar_is_that_of_the_papers_table():
    assert quality.papers_bar("18/4") == {"seen": (74.7, 29.7), "unseen": (62.5, 25.3)}


@pytest.mark.parametrize("group", ["seen", "unseen"])
@pytest.mark.parametrize("place", [0, 1])
def test_every_figure_counts(group, place):
    assert quality.passes(ENOUGH, BAR)
    figures = list(BAR[group])
    figures[place] -= 0.1
    assert not quality.passes({**ENOUGH, group: tuple(figures)}, BAR)


def evaluations(text):
    """One for each letter: p passes, f fails; `steps` counts them from 1."""
    return [
        (ENOUGH if letter == "p" else {**ENOUGH, "seen": (0.0, 0.0)}, {"steps": number})
        for number, letter in enumerate(text, start=1)
    ]


@pytest.mark.parametrize(
    ("text", "passed", "steps", "heard"),
    [("fpfpppp", True, 4, 5), ("pp", True, 1, 2), ("fpfpf", False, 5, 5), ("fp", False, 2, 2)],
)
def test_two_in_a_row_must_pass_and_the_first_of_them_counts(text, passed, steps, heard):
    left = iter(evaluations(text))
    done, spent, figures = quality.until_passed(left, BAR)
    assert (done, spent) == (passed, {"steps": steps})
    assert len(list(left)) == len(text) - heard
    assert quality.passes(figures, BAR) == (text[heard - 1] == "p")


@pytest.mark.slow
def test_a_run_out_of_budget_says_so(ithor, tmp_path):
    out = tmp_path / "figures.jsonl"
    flags = ["--parts", "quality", "--seeds", "3", "--most-steps", "1000", "--num-envs", "256"]
    benchmark.main([*flags, "--out", str(out)])
    row = json.loads(out.read_text().splitlines()[-1])
    assert (row["seed"], row["passed"], row["steps"]) == (3, False, 51_200)
    assert row["seen_sr"] < 50
    assert row["teraflop"] == pytest.approx(17.6e6 * 51_200 / 1e12, rel=0.02)
    assert 0 < row["seconds"] < row["all_seconds"]
