"""How cost grows: the rooms that are repeated are rooms, and what is measured is written."""

import json

import numpy as np

from experiments import scaling
from tdanet_jax.config import TrainConfig
from tdanet_jax.scenes.visibility.geometry import action_distances, transitions
from tdanet_jax.task import make_task
from tdanet_jax.tools import benchmarking


def test_joined_rooms_are_the_rooms_twice(some_rooms):
    both = scaling.joined([some_rooms, some_rooms])
    half = len(some_rooms.position)
    names = [f"{name}-1" for name in some_rooms.scenes]
    second = both.subset(names)
    for field in ("next_position", "position_scene", "row_start", "row_object", "object_scene"):
        np.testing.assert_array_equal(getattr(second, field), getattr(some_rooms, field))
    np.testing.assert_array_equal(both.next_position[half:], some_rooms.next_position + half)
    goals = both.distance == 0
    np.testing.assert_array_equal(
        action_distances(transitions(both.next_position), goals), both.distance
    )


def test_few_rooms_hold_all_types(ithor, glove):
    task = make_task(TrainConfig(), ithor, glove)
    params = scaling.with_rooms(task, 4)
    assert (np.asarray(params.room_scenes)[:, 1] == 1).all()
    more = scaling.with_detections(params, params.max_detections + 9)
    assert len(more.row_class) == len(params.row_class) + 9


def test_it_writes_figures_and_a_plot(tmp_path, monkeypatch, ithor):
    def cost(model, words, params, count, repeats):
        return {"steps_per_second": count, "temporary_mb": len(words), "arguments_mb": 1.0}

    monkeypatch.setattr(benchmarking, "update_cost", cost)
    sizes = ["--environments", "8", "16", "--rooms", "3", "--classes", "118", "--detections", "80"]
    scaling.main([*sizes, "--out", str(tmp_path / "out")])
    rows = [json.loads(line) for line in (tmp_path / "out/scaling.jsonl").read_text().splitlines()]
    assert [(row["size"], row["value"]) for row in rows] == [
        ("environments", 8), ("environments", 16), ("rooms", 3), ("classes", 118),
        ("detections", 80),
    ]  # fmt: skip
    assert (tmp_path / "out/scaling.png").stat().st_size > 10_000
