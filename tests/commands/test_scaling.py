"""How cost grows: rooms of all types, and files with the results."""

import json

import numpy as np
import pytest

from tdanet_jax.commands import scaling
from tdanet_jax.config import TrainConfig
from tdanet_jax.task import make_task
from tdanet_jax.tools import benchmarking


def test_few_rooms_hold_all_types(ithor, glove):
    task = make_task(TrainConfig(), ithor, glove)
    params = scaling.with_rooms(task, 4)
    assert (np.asarray(params.room_scenes)[:, 1] == 1).all()
    assert len(scaling.with_rooms(task, 81).room_scenes) == 4
    more = scaling.with_detections(params, params.max_detections + 9)
    assert len(more.row_class) == len(params.row_class) + 9


def test_the_sizes_that_are_measured_by_default_are_possible(ithor, glove):
    task = make_task(TrainConfig(), ithor, glove)
    scaling.measure(scaling.Command(), task)
    for size in ("classes", "detections"):
        least = min(getattr(scaling.Command(), size))
        with pytest.raises(ValueError, match=f"--{size} 9: the rooms need at least"):
            scaling.measure(scaling.Command(**{size: (9, least)}), task)


@pytest.mark.slow
def test_it_writes_figures_and_a_plot(tmp_path, monkeypatch, ithor):
    def cost(model, words, params, config, repeats):
        return {
            "steps_per_second": config.num_envs,
            "temporary_mb": len(words),
            "arguments_mb": 1.0,
        }

    monkeypatch.setattr(benchmarking, "update_cost", cost)
    sizes = ["--environments", "8", "16", "--rooms", "3", "--classes", "118", "--detections", "80"]
    scaling.main([*sizes, "--out", str(tmp_path / "out")])
    rows = [json.loads(line) for line in (tmp_path / "out/scaling.jsonl").read_text().splitlines()]
    assert [(row["size"], row["value"]) for row in rows] == [
        ("environments", 8), ("environments", 16), ("rooms", 3), ("classes", 118),
        ("detections", 80),
    ]  # fmt: skip
    assert (tmp_path / "out/scaling.png").stat().st_size > 10_000
