"""Every figure and sentence of the reports, against records in which no two columns agree.

The pages are written anew here, from `episodes.jsonl` by loops or from made-up results in which
every number occurs once, and must be equal line by line.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax.evaluation import comparison, metrics, paper, report
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.evaluation.paper import WORLDS_DIFFER, Rate
from tdanet_jax.evaluation.rollout import Records
from tdanet_jax.scenes import SceneTables
from tdanet_jax.vocabulary import ACTION_NAMES
from tests.support.handmade import Room, corridor, state, tables_of

Rows = Sequence[Mapping[str, Any]]

#: By group: position, heading in degrees, target, L, e, success.
EPISODES = {
    "seen": [
        (0, 0, "Mug", 1, 1, True), (0, 45, "Mug", 1, 3, True), (1, 90, "Mug", 6, 9, True),
        (2, 0, "Bread", 7, 11, False), (2, 90, "Bread", 5, 2, False), (1, 0, "Bread", 1, 5, True),
        (3, 45, "Mug", 8, 13, False), (4, 0, "Mug", 2, 1, False), (3, 180, "Bread", 9, 10, True),
        (6, 0, "Vase", 4, 17, True), (7, 90, "Vase", 12, 20, True), (6, 90, "Vase", 10, 25, False),
        (8, 0, "Mug", 11, 14, True),
    ],
    "unseen": [
        (0, 0, "Toaster", 1, 2, False), (1, 45, "Toaster", 5, 6, True),
        (3, 0, "Toaster", 6, 7, False), (6, 0, "Television", 3, 8, True),
        (7, 45, "Television", 14, 16, True), (7, 0, "Toaster", 2, 4, True),
        (8, 135, "Toaster", 15, 15, False),
    ],
}  # fmt: skip
MEASURES = ("SR", "SPL", "CF-SR", "CF-SPL")
#: 1,234 training episodes and so on: no number is another one's.
ORIGIN = report.Provenance(
    "18/4", "tdanet", "sample", 1234, 3, 7, 56789, "d4t4", image="a picture", sensors=("odometry",)
)
HEADS = " | ".join(f"{m} {b}" for b in ("L>=1", "L>=5") for m in (*MEASURES, "n")) + " |"


def collided(count: int) -> list[bool]:
    """The second of three episodes bumped into something, and so on."""
    return [i % 3 == 1 for i in range(count)]


def rooms() -> SceneTables:
    """Two kitchens and a living room of three points each."""
    kinds, classes = (
        ("kitchen", "kitchen", "living_room"),
        ("Bread", "Mug", "Television", "Toaster"),
    )
    objects = [("Mug", (0.0, 0.0, 0.0))]
    made = [Room(kind, corridor(3), objects, {}) for kind in kinds]
    return tables_of(made, (*classes, "Vase"), (*classes, "Vase"))


#: Some of the paper's rows.
PUBLISHED = (
    Rate("Random", "18/4", "seen", "L>=1", 9.5, 3.3),
    Rate("TDANet", "18/4", "seen", "L>=1", 74.7, 29.7),
    Rate("TDANet", "18/4", "unseen", "L>=1", 62.5, 25.3),
    Rate("TDANet", "18/4", "unseen", "L>=5", 47.4, 23.8),
)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of an evaluation with these episodes."""
    tables, played = rooms(), {}
    for group, episodes in EPISODES.items():
        place, heading, target, shortest, length, success = zip(*episodes, strict=True)
        pose = [state(p, h) for p, h in zip(place, heading, strict=True)]
        goal = [tables.targets.index(name) for name in target]
        actions = np.zeros((len(episodes), 25), np.int8)
        bumped = np.array(collided(len(episodes)))
        records = Records(np.array(shortest), np.array(length), np.array(success), actions, bumped)
        played[group] = Episodes(np.array(pose, np.int32), np.array(goal, np.int32)), records
    folder = tmp_path_factory.mktemp("written")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(paper, "RATES", PUBLISHED)
        report.results(ORIGIN, tables, played, folder)
    return folder


@pytest.fixture(scope="module")
def rows(written: Path) -> Rows:
    return [json.loads(line) for line in (written / "episodes.jsonl").read_text().splitlines()]


def test_the_records_are_those_of_the_episodes(rows: Rows) -> None:
    expected = [
        (group, f"Room{place // 3}", "living_room" if place > 5 else "kitchen", target,
         0.25 * place, 0.0, heading, 0, shortest, length, success, bumped)
        for group, episodes in EPISODES.items()
        for (place, heading, target, shortest, length, success), bumped
        in zip(episodes, collided(len(episodes)), strict=True)
    ]  # fmt: skip
    names = ("group", "scene", "room", "target", "x", "z", "rotation", "horizon", "L", "e",
             "success", "collided")  # fmt: skip
    assert [tuple(row[name] for name in names) for row in rows] == expected
    assert [len(row["actions"]) for row in rows] == [row["e"] for row in rows]


def figures(rows: Iterable[Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """SR, SPL and their intervals over (room, target) pairs, by bucket."""
    out = {}
    for bucket, least in (("L>=1", 1), ("L>=5", 5)):
        chosen = [row for row in rows if row["L"] >= least]
        if not chosen:
            out[bucket] = dict.fromkeys([*MEASURES, *(f"{m}_ci" for m in MEASURES)]) | {"n": 0}
            continue
        rate = [100.0 * row["success"] for row in chosen]
        spl = [100.0 * row["success"] * row["L"] / max(row["L"], row["e"]) for row in chosen]
        pairs = sorted({(row["scene"], row["target"]) for row in chosen})
        cluster = np.array([pairs.index((row["scene"], row["target"])) for row in chosen])
        free = [[v * (not row["collided"]) for v, row in zip(values, chosen, strict=True)]
                for values in (rate, spl)]  # fmt: skip
        ends = metrics.cluster_interval(np.array([rate, spl, *free]), cluster)
        assert (ends is None) == (len(pairs) == 1)
        out[bucket] = {"n": len(chosen)}
        for i, values in enumerate((rate, spl, *free)):
            mean = sum(values) / len(values)
            out[bucket][MEASURES[i]] = pytest.approx(mean, abs=0.006)
            interval = ends and pytest.approx([end[i] for end in ends], abs=0.006)
            out[bucket][f"{MEASURES[i]}_ci"] = interval
    return out


def chosen(rows: Rows, **values: str) -> list[Mapping[str, Any]]:
    return [row for row in rows if all(row[name] == value for name, value in values.items())]


def test_results_are_those_of_loops_over_the_records(written: Path, rows: Rows) -> None:
    out = json.loads((written / "results.json").read_text())
    for group in EPISODES:
        assert out[group] == figures(chosen(rows, group=group))
    for key, field in (("by_room", "room"), ("by_target", "target")):
        found = {(row[field], row["group"]) for row in rows}
        assert {(name, group) for name, parts in out[key].items() for group in parts} == found
        for name, group in found:
            expected = figures(chosen(rows, group=group, **{field: name}))
            assert out[key][name][group] == expected
    for group in EPISODES:
        taken = [action for row in chosen(rows, group=group) for action in row["actions"]]
        assert out["actions"][group] == {
            name: pytest.approx(100 * taken.count(name) / len(taken), abs=0.006)
            for name in ACTION_NAMES
        }
    origin = {
        "split": "18/4", "model": "tdanet", "policy": "sample", "episodes_trained": 1234, "seed": 3,
        "evaluation_seed": 7, "steps": 56789, "data_version": "d4t4", "data": None,
        "image": "a picture", "sensors": ["odometry"], "odometry": True, "triangulation": False,
        "departures": None, "targets": "paper", "commit": report.code_version(),
        "version": report.RESULTS_VERSION,
    }  # fmt: skip
    assert {name: out[name] for name in origin} == origin


def cells(first: Sequence[str], buckets: Mapping[str, Mapping[str, Any]]) -> str:
    """A row of `results.md`."""
    out = [*first]
    for bucket in ("L>=1", "L>=5"):
        part = buckets[bucket]
        for name in MEASURES:
            if part[name] is None:
                out.append("-")
            elif part[f"{name}_ci"] is None:
                out.append(f"{part[name]:.1f}")
            else:
                low, high = part[f"{name}_ci"]
                out.append(f"{part[name]:.1f} ({low:.1f} to {high:.1f})")
        out.append(str(part["n"]))
    return f"| {' | '.join(out)} |"


def test_the_page_of_results_line_by_line(written: Path, rows: Rows) -> None:
    """Its figures are those of `results.json`, which has been compared with the records."""
    out = json.loads((written / "results.json").read_text())
    page = [line for line in (written / "results.md").read_text().splitlines() if line]
    rule = f"|{'---|' * 12}"
    split = {
        title: metrics.summarise(*(np.array([r[n] for r in part]) for n in ("success", "L", "e")),
                                 np.unique([r["scene"] + r["target"] for r in part],
                                           return_inverse=True)[1],
                                 np.array([r["collided"] for r in part]))
        for title, part in (
            ("Television", chosen(rows, group="unseen", target="Television")),
            ("without Television", chosen(rows, group="unseen", target="Toaster")),
        )
    }  # fmt: skip
    assert page == [
        "# tdanet, --odometry, split 18/4, seed 3",
        "1,234 training episodes, 56,789 environment steps; sample actions, evaluation seed 7; "
        f"scene tables d4t4, code {report.code_version()}.",
        "Image: a picture.",
        "SR and SPL in percent, with 95 % bootstrap intervals over (room, target) pairs. "
        "CF-SR and CF-SPL count episodes in which a MoveAhead was blocked as failed.",
        f"| Targets | Agent | {HEADS}",
        rule,
        cells(("seen", "**tdanet, --odometry (ours)**"), out["seen"]),
        "| seen | Random (paper) | 9.5 | 3.3 | - | - |  | - | - | - | - |  |",
        "| seen | TDANet (paper) | 74.7 | 29.7 | - | - |  | - | - | - | - |  |",
        cells(("unseen", "**tdanet, --odometry (ours)**"), out["unseen"]),
        "| unseen | TDANet (paper) | 62.5 | 25.3 | - | - |  | 47.4 | 23.8 | - | - |  |",
        WORLDS_DIFFER,
        "Unseen classes with a near-synonym known in training (Television: TVStand) apart:",
        f"| Targets | Classes | {HEADS}",
        rule,
        *(cells(("unseen", title), buckets) for title, buckets in split.items()),
        # Of 13 seen episodes three have L = 1, two e = 1 and eight end in success; of 7 unseen
        # ones, one has L = 1.
        "Target in view at the start (L = 1), seen: 23.1 % of episodes.",
        "Target in view at the start (L = 1), unseen: 14.3 % of episodes.",
        *(f"Actions taken, {group}: "
          + ", ".join(f"{name} {share:.1f} %" for name, share in out["actions"][group].items())
          + "." for group in EPISODES),
        "## By room",
        f"| Room | Group | {HEADS}",
        rule,
        *(cells((room, group), out["by_room"][room][group])
          for room in ("kitchen", "living_room") for group in EPISODES),
        "## By target",
        f"| Target | Group | {HEADS}",
        rule,
        *(cells((target, group), out["by_target"][target][group])
          for target, group in (("Toaster", "unseen"), ("Bread", "seen"), ("Mug", "seen"),
                                ("Television", "unseen"), ("Vase", "seen"))),
    ]  # fmt: skip


def distinct(start: float) -> dict[str, Any]:
    """A result's groups, whose sixteen figures are sixteen numbers from `start` on."""
    number = itertools.count(start, 1.5)
    return {
        group: {
            bucket: {measure: next(number) for measure in MEASURES} | {"n": 40}
            for bucket in ("L>=1", "L>=5")
        }
        for group in ("seen", "unseen")
    }


def made_up(seed: int, start: float, policy: str = "sample", split: str = "18/4") -> dict[str, Any]:
    """A result in which no number is another one's."""
    return {
        "split": split, "model": "tdanet", "policy": policy, "seed": seed, "data": None,
        "data_version": "d", "run": f"runs/{seed}", "steps": 5000 + seed, "updates": 2000 + seed,
        "episodes_trained": 3000 + seed, **distinct(start),
        "by_room": {"kitchen": distinct(start + 20), "bedroom": distinct(start + 40)},
    }  # fmt: skip


COLUMNS = " | ".join(
    f"{g} {m} {b}" for g in ("seen", "unseen") for b in ("L>=1", "L>=5") for m in MEASURES
)


def numbers(start: float, text: str = "{:.1f}") -> str:
    """The sixteen cells of `distinct(start)`."""
    return " | ".join(text.format(start + 1.5 * i) for i in range(16))


def test_the_page_of_a_comparison_line_by_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(paper, "RATES", PUBLISHED)
    results = [made_up(0, 10.0), made_up(1, 30.0), made_up(5, 60.0, "greedy", "14/8")]
    gap = {
        group: {
            bucket: {m: v for m, v in part.items() if m != "n"}
            | {f"{m}_ci": [part[m] - 8, part[m] + 9] for m in ("SR", "CF-SR")}
            | {f"{m}_ci": [part[m] - 6, part[m] + 7] for m in ("SPL", "CF-SPL")}
            for bucket, part in buckets.items()
        }
        for group, buckets in distinct(-3.0).items()
    }
    results[1]["difference"] = {"to": "runs/0", **gap}
    shown = [
        f"{v:.1f} ({v - 8 + 2 * (i % 2):.1f} to {v + 9 - 2 * (i % 2):.1f})"
        for i, v in enumerate(-3.0 + 1.5 * i for i in range(16))
    ]
    page = comparison.markdown("Title", results, ["a", "b", "c"])
    head = f"| Agent | Updates | Training episodes | Actions | {COLUMNS} |"
    assert [line for line in page.splitlines() if line] == [
        "# Title",
        "SR and SPL in percent, test rooms. CF-SR and CF-SPL count episodes in which a MoveAhead "
        "was blocked as failed.",
        "## Split 18/4",
        head,
        f"|{'---|' * 20}",
        f"| a | 2,000 | 3,000 | sample | {numbers(10.0)} |",
        f"| b | 2,001 | 3,001 | sample | {numbers(30.0)} |",
        f"| b minus a |  |  | sample | {' | '.join(shown)} |",
        f"| **tdanet, 2 seeds** |  |  | sample | {numbers(20.0, '{:.1f} ± 14.1')} |",
        f"| Random (paper) |  |  |  | 9.5 | 3.3 {'| - ' * 14}|",
        f"| TDANet (paper) |  |  |  | 74.7 | 29.7 {'| - ' * 6}"
        "| 62.5 | 25.3 | - | - | 47.4 | 23.8 | - | - |",
        "Differences: in the same episodes, 95 % intervals (paired bootstrap).",
        WORLDS_DIFFER,
        "## Split 14/8",
        head,
        f"|{'---|' * 20}",
        f"| c | 2,005 | 3,005 | greedy | {numbers(60.0)} |",
    ]


def test_a_curve_has_each_figure_at_its_own_point() -> None:
    def point(seed: int, start: float, number: int) -> dict[str, Any]:
        trained = 100 * number + 1 + 4 * seed
        return made_up(seed, start + 10 * number) | {
            "share": number / 4, "episodes_trained": trained
        }  # fmt: skip

    runs = [[point(seed, 10.0 + 4 * seed, number) for number in (1, 2)] for seed in (0, 1)]
    found = comparison.curve("label", runs)
    assert found.episodes == [103.0, 203.0]
    for i, key in enumerate(
        (("seen", "SR"), ("seen", "SPL"), *[None] * 6, ("unseen", "SR"), ("unseen", "SPL"))
    ):
        if key is not None:
            means = [spread.mean for spread in found.values[key] if spread is not None]
            assert means == [22.0 + 1.5 * i, 32.0 + 1.5 * i]


def test_the_code_is_that_of_the_first_call() -> None:
    assert report.code_version() is report.code_version()
