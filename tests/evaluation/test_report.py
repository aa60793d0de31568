"""The shape of results.json, the records next to it, and the page."""

import dataclasses
import json

import numpy as np
import pytest

from tdanet_jax.evaluation import report
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.evaluation.metrics import MEASURES
from tdanet_jax.evaluation.rollout import Records
from tdanet_jax.vocabulary import ALL_TARGETS

BUCKET = {*MEASURES, *(f"{measure}_ci" for measure in MEASURES), "n"}
TOP = [
    "version", "split", "model", "policy", "episodes_trained", "seen", "unseen", "by_room",
    "by_target", "actions", "seed", "evaluation_seed", "steps", "data_version", "data", "image",
    "sensors", "departures", "targets", "trained_targets", "odometry", "triangulation", "commit",
]  # fmt: skip


@pytest.fixture(scope="module")
def played(ithor):
    """Three episodes a group, from real rooms: one success in four actions, two failures."""
    goal = ALL_TARGETS.index("Mug")
    reach = np.flatnonzero((ithor.distance[:, goal] == 3) & (ithor.state_scene < 30))
    episodes = Episodes(reach[:3].astype(np.int32), np.full(3, goal, np.int32))
    actions = np.full((3, 200), -1, np.int8)
    actions[:, :4] = [[0, 1, 2, 5], [0, 0, 0, 5], [3, 4, 1, 5]]
    actions[0, 4:8] = -1
    records = Records(
        shortest=np.array([4, 4, 4]),
        length=np.array([4, 4, 4]),
        success=np.array([True, False, False]),
        actions=actions,
        collided=np.array([False, True, False]),
    )
    return {"seen": (episodes, records)}


@pytest.fixture
def written(played, ithor, tmp_path):
    provenance = report.Provenance("18/4", "tdanet", "sample", 10, 3, 7, 200, ithor.data_version)
    return tmp_path, report.results(provenance, ithor, played, tmp_path)


def test_intervals_of_the_open_benchmark_resample_classes(ithor) -> None:
    """Two classes in many rooms, one always found, one never: the interval is all of 0 to 100."""
    first = [int(np.flatnonzero(ithor.state_scene == scene)[0]) for scene in range(60)]
    goals = np.arange(60) % 2
    chosen = Episodes(np.array(first, np.int32), goals.astype(np.int32))
    actions = np.full((60, 200), -1, np.int8)
    actions[:, 0] = 5
    records = Records(np.ones(60, int), np.ones(60, int), goals == 1, actions, np.zeros(60, bool))
    found = {}
    for split in ("open", "18/4"):
        origin = report.Provenance(split, "random", "random", 0, 0, 0, 0, ithor.data_version)
        found[split] = report.results(origin, ithor, {"seen": (chosen, records)})
    wide, narrow = (found[split]["seen"]["L>=1"]["SR_ci"] for split in found)
    assert wide == [0.0, 100.0]
    assert narrow[1] - narrow[0] < 40
    assert found["open"]["by_target"] == found["18/4"]["by_target"]


def test_results_have_the_documented_shape(written):
    folder, out = written
    assert json.loads((folder / "results.json").read_text()) == out
    assert list(out) == TOP
    assert out["unseen"] is None
    assert set(out["seen"]) == {"L>=1", "L>=5"}
    assert set(out["seen"]["L>=1"]) == BUCKET
    assert out["by_room"] == {"kitchen": {"seen": out["seen"]}}
    assert out["by_target"] == {"Mug": {"seen": out["seen"]}}
    assert out["actions"] == {
        "seen": {
            "MoveAhead": 33.33, "RotateLeft": 16.67, "RotateRight": 8.33, "LookUp": 8.33,
            "LookDown": 8.33, "Done": 25.0,
        },
    }  # fmt: skip
    page = (folder / "results.md").read_text()
    assert "Actions taken, seen: MoveAhead 33.3 %, RotateLeft 16.7 %, RotateRight 8.3 %," in page


def test_the_report_says_how_it_can_be_made_again(played, ithor, tmp_path):
    shown = report.Provenance(
        "18/4", "savn", "sample", 1, 0, 7, 2, ithor.data_version, "rooms.npz", "a map"
    )
    out = report.results(shown, ithor, played, tmp_path)
    names = ("seed", "evaluation_seed", "data", "image")
    assert [out[name] for name in names] == [0, 7, "rooms.npz", "a map"]
    page = (tmp_path / "results.md").read_text()
    assert "sample actions, evaluation seed 7;" in page
    assert "\nData: rooms.npz.\nImage: a map.\n" in page


def test_the_report_names_the_sensors(played, ithor, tmp_path):
    shown = report.Provenance("18/4", "tdanet", "sample", 1, 0, 7, 2, ithor.data_version)
    for sensors, name in (
        (("odometry",), "tdanet, --odometry"),
        (("odometry", "triangulation"), "tdanet, --odometry, --triangulation"),
        (("my_lab.compass",), "tdanet, --sensors my_lab.compass"),
    ):
        shown = dataclasses.replace(shown, sensors=sensors)
        out = report.results(shown, ithor, played, tmp_path)
        assert out["sensors"] == list(sensors)
        for flag in ("odometry", "triangulation"):
            assert out[flag] == (flag in sensors)
        page = (tmp_path / "results.md").read_text()
        assert page.startswith(f"# {name}, split 18/4")
        assert f"| **{name} (ours)** |" in page


def test_a_folder_that_is_not_there_is_made(played, ithor, tmp_path):
    shown = report.Provenance("18/4", "tdanet", "sample", 10, 3, 7, 200, ithor.data_version)
    report.results(shown, ithor, played, tmp_path / "one" / "two")
    assert sorted(path.name for path in (tmp_path / "one" / "two").iterdir()) == [
        "episodes.jsonl", "results.json", "results.md"
    ]  # fmt: skip


def test_percentages_run_from_0_to_100_and_an_empty_bucket_is_null(written):
    _, out = written
    assert out["seen"]["L>=1"]["SR"] == pytest.approx(100 / 3, abs=0.01)
    assert out["seen"]["L>=1"]["SPL"] == pytest.approx(100 / 3, abs=0.01)
    assert out["seen"]["L>=5"] == {**dict.fromkeys(BUCKET), "n": 0}
    assert out["seen"]["L>=1"]["CF-SR"] == out["seen"]["L>=1"]["SR"]  # the one that collided failed


def test_one_record_per_episode(written, played, ithor):
    folder, _ = written
    rows = [json.loads(line) for line in (folder / "episodes.jsonl").read_text().splitlines()]
    assert len(rows) == 3
    first = rows[0]
    assert first["actions"] == ["MoveAhead", "RotateLeft", "RotateRight", "Done"]
    assert (first["L"], first["e"], first["success"], first["target"]) == (4, 4, True, "Mug")
    pose = played["seen"][0].pose[0]
    assert first["scene"] == ithor.scenes[ithor.state_scene[pose]]
    assert first["rotation"] == 45 * (pose // 2 % 8)


def test_the_page_shows_the_paper_beside_ours_and_says_that_the_worlds_differ(written):
    page = (written[0] / "results.md").read_text()
    assert "TDANet (paper) | 74.7 | 29.7" in page
    assert "The worlds differ" in page
    assert "33.3" in page


def test_unseen_classes_with_a_near_synonym_are_reported_apart(ithor, tmp_path):
    goals = [ALL_TARGETS.index(name) for name in ("ToiletPaper", "Laptop")]
    poses = [np.flatnonzero(ithor.distance[:, goal] == 2)[0] for goal in goals]
    episodes = Episodes(np.array(poses, np.int32), np.array(goals, np.int32))
    actions = np.full((2, 200), -1, np.int8)
    actions[:, :3] = [0, 0, 5]
    records = Records(
        np.array([3, 3]), np.array([3, 3]), np.array([True, False]), actions, np.zeros(2, bool)
    )
    provenance = report.Provenance("18/4", "tdanet", "sample", 10, 3, 7, 200, ithor.data_version)
    played = {"seen": (episodes, records), "unseen": (episodes, records)}
    report.results(provenance, ithor, played, tmp_path)
    page = (tmp_path / "results.md").read_text()
    assert "| unseen | ToiletPaper | 100.0 | 100.0 |" in page
    assert "| unseen | without ToiletPaper | 0.0 | 0.0 |" in page
    assert "known in training (ToiletPaper: ToiletPaperHanger, PaperTowelRoll) apart" in page
