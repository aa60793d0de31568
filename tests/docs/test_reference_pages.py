"""The reference pages agree with the code, and their figures with each other."""

from __future__ import annotations

import dataclasses
import json
import re
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tdanet_jax.evaluation.report import FLAGS, Provenance
from tdanet_jax.scenes import SceneTables
from tdanet_jax.scenes.visibility.rules import RULES
from tests.support.pages import DOCS

ROOT = DOCS.parent
PAGES = ("data", "scenes", "evaluation", "analysis", "results", "trials", "speed", "reliability")


def text(page: str) -> str:
    return (DOCS / f"{page}.md").read_text()


def section(page: str, title: str) -> str:
    """What is below a heading, up to the next one of its level or above."""
    found = re.search(rf"^(#+) {re.escape(title)}$", text(page), re.MULTILINE)
    assert found is not None, title
    rest = text(page)[found.end() :]
    end = re.search(rf"^#{{1,{len(found[1])}}} ", rest, re.MULTILINE)
    return rest[: end.start()] if end else rest


def rows(part: str) -> Iterator[list[str]]:
    """The cells of every line of the tables in a part of a page."""
    for line in part.splitlines():
        if line.startswith("| "):
            yield [cell.strip() for cell in line.strip("|").split(" | ")]


def code(part: str) -> list[str]:
    """The inline code of a part of a page."""
    outside = re.sub(r"^```.*?^```", "", part, flags=re.DOTALL | re.MULTILINE)
    return re.findall(r"`([^`]+)`", outside)


def named(part: str) -> set[str]:
    """What the first cells of a part's tables name in backticks."""
    return {name for cells in rows(part) for name in code(cells[0])}


def test_fields_of_the_results() -> None:
    told = named(section("evaluation", "Fields of `results.json`")) - {"Field"}
    groups = {"seen", "unseen", "by_room", "by_target", "actions"}
    fields = {field.name for field in dataclasses.fields(Provenance)}
    assert told == {*fields, *groups, *FLAGS, "version", "commit"}


def test_fields_of_the_records() -> None:
    (line,) = (c[1] for c in rows(section("evaluation", "What it writes")) if "one record" in c[1])
    with (ROOT / "agents/18-4-best/episodes.jsonl").open() as file:
        written = list(json.loads(file.readline()))
    assert re.findall(r"`(\w+)`", line) == written


def test_fields_of_the_tables() -> None:
    fields = {field.name for field in dataclasses.fields(SceneTables)}
    assert named(section("scenes", "The scene tables")) == fields


def test_the_rules_of_the_rooms() -> None:
    told = {cells[0]: cells[1] for cells in rows(section("scenes", "The rules"))}
    figures = {
        "Reach": f"within {RULES.reach} m",
        "Slivers": f"{100 * RULES.sliver:g} %",
        "Carved": f"within {RULES.standing} m",
        "Plates": f"top {100 * RULES.thickness:g} cm",
        "Inset": f"{100 * RULES.inset:g} %",
        "Walls": f"more than {RULES.void} m",
    }
    for rule, figure in figures.items():
        assert figure in told[rule]
    for rule, classes in {
        "Fronts": RULES.fronts,
        "Carved": RULES.carved,
        "Closed": RULES.closed,
        "Plates": RULES.plates,
    }.items():
        assert classes == set(re.findall(r"\b[A-Z]\w+", told[rule])) - {"L", "U"}


@pytest.mark.parametrize("title", ["Three seeds of ten minutes", "Odometry", "Triangulation"])
def test_means_and_deviations_are_those_of_the_seeds(title: str) -> None:
    """To the last digit that is shown: the seeds' own figures are rounded."""
    seeds: list[list[float]] = []
    checked = 0
    for cells in rows(section("trials", title)):
        figures = [float(cell.split()[0]) for cell in cells[1:5] if re.match(r"\d+\.\d", cell)]
        if cells[0] in ("0", "1", "2"):
            seeds.append(figures)
        elif cells[0] == "mean ± sd":
            assert len(seeds) == 3
            for cell, values in zip(cells[1:5], zip(*seeds, strict=True), strict=True):
                mean, deviation = map(float, cell.split(" ± "))
                assert mean == pytest.approx(statistics.fmean(values), abs=0.101)
                assert deviation == pytest.approx(statistics.stdev(values), abs=0.101)
                checked += 1
            seeds = []
    assert checked == 4


def test_figures_of_the_bundled_agent() -> None:
    found = json.loads((ROOT / "agents/18-4-best/results.json").read_text())
    told = " ".join(section("results", "The bundled agents").split())
    pairs = [found[group]["L>=1"] for group in ("seen", "unseen")]
    assert " and ".join(f"{pair['SR']:.1f} / {pair['SPL']:.1f}" for pair in pairs) in told
    seen, unseen = (f"{pair['SR']:.1f} / {pair['SPL']:.1f}" for pair in pairs)
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert f"`18-4-best` has {seen} seen and {unseen} unseen" in readme


def three_seeds(row: str) -> list[dict[str, Any]]:
    """The results of three seeds of an agent, rows of the scoreboard."""
    paths = [ROOT / f"results/{row}-{seed}/results.json" for seed in range(3)]
    return [json.loads(path.read_text()) for path in paths]


def means(found: list[dict[str, Any]], bucket: str, form: str) -> tuple[str, ...]:
    """Seen SR and SPL, and unseen ones.

    Args:
      found: the results of each seed.
      bucket: of shortest paths: "L>=1".
      form: of a mean, {0}, and a standard deviation, {1}.
    """
    out = []
    for group in ("seen", "unseen"):
        for measure in ("SR", "SPL"):
            values = [results[group][bucket][measure] for results in found]
            out.append(form.format(statistics.fmean(values), statistics.stdev(values)))
    return tuple(out)


@pytest.mark.parametrize(
    ("row", "sentence"),
    [
        ("18-4-paper-inputs", "`--preset paper-inputs` | {} | {} | {} | {} |"),
        ("18-4-best", "`--preset best` | {} | {} | {} | {} |"),
        ("18-4-best-half", "--hidden 256 --steps 6000000` reach {} / {} seen and {} / {} unseen."),
        ("14-8-best", "three seeds of `--preset best` reach {} / {} seen and {} / {} unseen"),
        ("14-8-paper-inputs-context", "half the width reach {} / {} and {} / {} there."),
    ],
)
def test_the_readme_gives_the_means_of_three_seeds(row: str, sentence: str) -> None:
    readme = " ".join((ROOT / "README.md").read_text().split())
    assert sentence.format(*means(three_seeds(row), "L>=1", "{0:.1f}")) in readme


@pytest.mark.parametrize(
    ("row", "heading", "opening"),
    [
        ("18-4-paper-inputs", "The paper's inputs", "L >= 5"),
        ("18-4-best", "Half the width", "L >= 5, the preset as it is"),
        ("14-8-best", "Zero-shot split 14/8", "L >= 5, the preset as it is"),
        ("14-8-best-half", "Zero-shot split 14/8", "L >= 5, half the width"),
        ("14-8-paper-inputs-context", "Zero-shot split 14/8", "L >= 5, with context"),
    ],
)
def test_means_of_three_seeds_on_longer_paths(row: str, heading: str, opening: str) -> None:
    told = " ".join(section("results", heading).split())
    figures = means(three_seeds(row), "L>=5", "{0:.1f} ± {1:.1f}")
    sentence = "{}: seen SR {}, SPL {}; unseen SR {}, SPL {}."
    assert sentence.format(opening, *figures) in told


def test_rates_of_the_unseen_classes_of_split_14_8() -> None:
    found = three_seeds("14-8-best")
    heads, rates = (
        cells[1:]
        for cells in rows(section("results", "Zero-shot split 14/8"))
        if cells[0] in ("", "these")
    )
    for name, rate in zip(heads, rates, strict=True):
        each = [results["by_target"][name]["unseen"]["L>=1"]["SR"] for results in found]
        assert rate == f"{statistics.fmean(each):.1f}"


def test_figures_of_the_agent_of_the_open_benchmark() -> None:
    found = json.loads((ROOT / "results/open-best-half-0/results.json").read_text())
    told = " ".join(section("results", "The open-vocabulary benchmark").split())
    seen, unseen = (found[group]["L>=5"] for group in ("seen", "unseen"))
    assert (
        f"For L >= 5, seen SR is {seen['SR']:.1f} and SPL {seen['SPL']:.1f}, unseen "
        f"{unseen['SR']:.1f} and {unseen['SPL']:.1f}."
    ) in told
    rates = {
        name: groups["unseen"]["L>=1"]["SR"]
        for name, groups in found["by_target"].items()
        if groups.get("unseen")
    }
    rare = sorted((name for name, rate in rates.items() if rate < 90), key=lambda n: -rates[n])
    assert (len(rates), len(rare)) == (19, 4)
    *first, last = (f"{name} ({rates[name]:.0f} %)" for name in rare)
    assert f"The other four are {', '.join(first)} and {last}." in told
    everywhere = f"{found['unseen']['L>=1']['SR']:.0f} %"
    assert f"`open-best` finds them in {everywhere} of" in " ".join(
        (ROOT / "README.md").read_text().split()
    )


def test_the_pages_show_no_path_of_anybody() -> None:
    for page in PAGES:
        assert not re.search(r"/(home|tmp|root|work)/", text(page)), page
    assert Path(DOCS / "scaling.png").exists()
