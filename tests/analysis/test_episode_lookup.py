"""Episodes by name: found where they exist, refused with a message where they do not."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tdanet_jax.analysis.episode_lookup import Start, find, name_ranges, read_record, read_records
from tdanet_jax.vocabulary import ACTION_NAMES
from tests.support.handmade import houses
from tests.support.oracle import World


def test_a_start_is_the_nearest_point_with_the_heading(ithor):
    spots = ithor.position[ithor.position_scene == ithor.scenes.index("FloorPlan228")]
    x, _, z = spots[7]
    episode = find(ithor, "FloorPlan228", "Laptop", Start(x + 0.1, z - 0.1, -45, 30))
    pose = int(episode.pose[0])
    np.testing.assert_allclose(ithor.position[pose // 16], spots[7])
    assert pose % 16 == 7 * 2 + 1
    assert ithor.targets[episode.target[0]] == "Laptop"


@pytest.mark.parametrize("label", ["laptop", "LAPTOP_1", "notebook computer"])
def test_a_target_goes_by_any_of_its_names(ithor, label):
    assert find(ithor, "FloorPlan228", label) == find(ithor, "FloorPlan228", "Laptop")


def test_drawn_starts_follow_the_seed_and_can_reach_the_target(ithor):
    drawn = [find(ithor, "FloorPlan29", "Mug", seed=seed) for seed in range(20)]
    for episode in drawn:
        pose = int(episode.pose[0])
        assert ithor.scenes[ithor.position_scene[pose // 16]] == "FloorPlan29"
        assert ithor.distance[pose, episode.target[0]] >= 0
    assert len({int(episode.pose[0]) for episode in drawn}) > 5
    assert find(ithor, "FloorPlan29", "Mug", seed=3).pose == drawn[3].pose


def test_a_start_in_a_house_is_in_a_room_of_any_type():
    tables = houses()
    drawn = {int(find(tables, "Room1", "Mug", seed=seed).pose[0]) // 16 for seed in range(40)}
    assert drawn == World(tables, {}, (1, 1, 1, 1)).valid_starts(1, "Mug") == {4, 5}
    drawn = {int(find(tables, "Room0", "Mug", seed=seed).pose[0]) // 16 for seed in range(40)}
    assert drawn == {0, 1, 2, 3}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("FloorPlan31", "Mug"), "no such room; there are FloorPlan1-30, FloorPlan201-230"),
        (("FloorPlan228", "Toaster"), "Toaster: no target that can be seen in FloorPlan228"),
        (("FloorPlan228", "Sofa"), "RemoteControl"),
        (("FloorPlan228", "Laptop", Start(0, 0, 30)), "rotation 30: not a multiple of 45"),
        (("FloorPlan228", "Laptop", Start(0, 0, 0, 20)), "horizon 20: not among 0, 30 degrees"),
    ],
)  # fmt: skip
def test_what_is_not_there_is_refused_with_what_is(ithor, arguments, message):
    with pytest.raises(ValueError, match=message) as refused:
        find(ithor, *arguments)
    assert "\n" not in str(refused.value)


def test_a_start_far_from_every_reachable_point_is_refused_with_the_nearest(ithor):
    here = ithor.position_scene == ithor.scenes.index("FloorPlan228")
    x, _, z = min(ithor.position[here].tolist())
    find(ithor, "FloorPlan228", "Laptop", Start(x - 0.5, z, 0))
    with pytest.raises(ValueError, match="start at") as refused:
        find(ithor, "FloorPlan228", "Laptop", Start(x - 1, z, 0))
    assert str(refused.value) == (
        f"start at x {x - 1:g}, z {z:g}: 1.00 m from the nearest reachable point in FloorPlan228, "
        f"x {x:g}, z {z:g}; at most 0.5 m"
    )
    with pytest.raises(ValueError, match="start at x nan"):
        find(ithor, "FloorPlan228", "Laptop", Start(float("nan"), z, 0))


def test_a_start_that_cannot_reach_the_target_is_refused(ithor):
    index = ithor.scenes.index("FloorPlan204")
    states = np.flatnonzero(np.repeat(ithor.position_scene == index, 16))
    lost = next(
        (s, g)
        for g in np.flatnonzero(ithor.distance[states].max(axis=0) >= 0)
        for s in states[::16]
        if ithor.distance[s, g] < 0
    )
    x, _, z = ithor.position[lost[0] // 16]
    with pytest.raises(ValueError, match="out of reach from x"):
        find(ithor, "FloorPlan204", ithor.targets[lost[1]], Start(x, z, 0))


def test_names_in_short():
    names = ("A1", "A2", "A3", "A7", "Room", "B2", "B4", "B5")
    assert name_ranges(names) == "A1-3, A7, Room, B2, B4-5"
    assert name_ranges(()) == ""


def test_damaged_records_are_refused_by_line(some_rooms, opinionated_run, tmp_path):
    good = json.loads((opinionated_run / "episodes.jsonl").read_text().splitlines()[0])
    bad = {
        "recorded on other scene tables": good | {"L": good["L"] + 1},
        "'Jump': no action; there are MoveAhead": good | {"actions": ["Jump"]},
        "no actions": good | {"actions": []},
        "no such room": good | {"scene": "FloorPlan999"},
        "x is not a number": {key: value for key, value in good.items() if key != "x"},
        "z is not a number": good | {"z": "north"},
        "not the record of an episode": [1, 2],
        "group is not one of seen, unseen": good | {"group": "both"},
    }
    far = good | {"x": good["x"] + 0.02}
    lines = [json.dumps(row) for row in [*bad.values(), far]] + ["{"]
    (tmp_path / "episodes.jsonl").write_text("\n".join(lines) + "\n")
    messages = [*bad, "recorded on other scene tables", "Expecting property name"]
    for i, message in enumerate(messages):
        with pytest.raises(ValueError, match=message) as refused:
            read_record(tmp_path, i, some_rooms)
        assert f"line {i + 1}: " in str(refused.value)
    with pytest.raises(ValueError, match=f"no episode {len(lines)}; there are 0 to "):
        read_record(tmp_path, len(lines), some_rooms)
    with pytest.raises(ValueError, match="no such file; a run writes it when training ends"):
        read_record(tmp_path / "nowhere", 0, some_rooms)
    record = read_record(opinionated_run, 0, some_rooms)
    assert [ACTION_NAMES[action] for action in record.actions] == good["actions"]
    assert record.group == good["group"]


def test_all_records_are_those_of_each_line(some_rooms, opinionated_run, tmp_path):
    records = read_records(opinionated_run, some_rooms)
    assert len(records) == 8
    for i, record in enumerate(records):
        alone = read_record(opinionated_run, i, some_rooms)
        assert (record.episode, record.group) == (alone.episode, alone.group)
        np.testing.assert_array_equal(record.actions, alone.actions)
    text = (opinionated_run / "episodes.jsonl").read_text()
    (tmp_path / "episodes.jsonl").write_text(text + "{}\n")
    with pytest.raises(ValueError, match=r"line 9: x is not a number"):
        read_records(tmp_path, some_rooms)
    (tmp_path / "episodes.jsonl").write_text("")
    with pytest.raises(ValueError, match=r"episodes.jsonl: no episodes"):
        read_records(tmp_path, some_rooms)
