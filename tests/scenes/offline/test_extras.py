"""Parents, class graph and published episodes, and how a task uses them."""

from __future__ import annotations

import json
import os
import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.env import zero_shot
from tdanet_jax.evaluation import episodes
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.scenes.dataset import Rooms
from tdanet_jax.scenes.offline import extras, importer
from tdanet_jax.scenes.offline.extras import ImportedRoom
from tdanet_jax.task import make_task
from tdanet_jax.vocabulary import ROOM_TYPES
from tdanet_jax.words import WordVectors
from tests.support import original


@pytest.fixture
def rooms(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Rooms:
    monkeypatch.setenv("TDANET_CACHE", str(tmp_path / "cache"))
    scenes = original.write_all(tmp_path / "original")
    return importer.read_folder(scenes, lambda share, line: None)


def test_extras_next_to_the_scenes_are_found(rooms: Rooms) -> None:
    found = rooms.extras
    assert found is not None
    assert found.parents == {"kitchen": {"Mug": {"TableTop": 0.25, "Sink": 0.5, "Toaster": 0.4}}}
    assert [(e.part, e.scene, e.z, e.rotation, e.horizon, e.target) for e in found.episodes] == [
        ("test", "FloorPlan21", 0.0, 45, 0, "Mug"),
        ("test", "FloorPlan21", 0.5, 180, 0, "Mug"),
        ("val", "FloorPlan21", 0.0, 45, 0, "Mug"),
    ]
    graph = found.class_graph(("Mug", "Sink", "Apple"))
    assert graph is not None
    assert graph.tolist() == [[5, 0, 4], [0, 0, 0], [1, 0, 0]]  # of 0 to 15, row by row


def test_a_task_takes_published_parents_and_episodes(rooms: Rooms, glove: WordVectors) -> None:
    task = make_task(TrainConfig(), rooms.tables, glove, rooms.extras)
    mug, table = task.tables.targets.index("Mug"), task.tables.classes.index("TableTop")
    # Sink is no class of these rooms, Toaster is unseen; R_p is taken as it is.
    assert task.train_params.parent_class[mug].tolist() == [table, -1, -1]
    assert task.train_params.parent_reward[mug].tolist() == [0.25, 0, 0]
    lists = episodes.load(task.tables, task.split, task.extras)
    assert list(lists) == ["seen"]
    assert lists["seen"].pose.tolist() == [48 + 2, 48 + 32 + 8]
    assert set(lists["seen"].target) == {mug}
    assert task.classes.edges
    # The table that is visible without a box is no detection: five of six rows a room.
    assert task.tables.row_start[-1] == 12
    assert task.eval_params.row_start[-1] == 10
    merged = TrainConfig(network=NetworkConfig(rows="class"))
    params = make_task(merged, rooms.tables, glove, rooms.extras).eval_params
    assert params.row_start[-1] == 8  # the two mugs of a view are one
    assert params.row_start[80:82].tolist() == [6, 8]


def test_without_published_episodes_they_are_drawn(rooms: Rooms, glove: WordVectors) -> None:
    task = make_task(TrainConfig(), rooms.tables, glove, extras.Extras())
    first = episodes.load(task.tables, task.split, task.extras)
    again = episodes.load(task.tables, task.split, task.extras)
    assert len(first["seen"]) == episodes.EPISODES_PER_ROOM_TYPE
    np.testing.assert_array_equal(first["seen"].pose, again["seen"].pose)
    assert {task.tables.scenes[i] for i in task.tables.position_scene[first["seen"].pose >> 4]} == {
        "FloorPlan21"
    }


def test_rooms_that_a_split_cannot_use(rooms: Rooms, glove: WordVectors) -> None:
    with pytest.raises(ValueError, match="none of the evaluation rooms of split 18/4"):
        make_task(TrainConfig(), rooms.tables.subset(["FloorPlan1"]), glove, rooms.extras)
    blind = zero_shot.hide_classes(rooms.tables, {"Mug"})
    with pytest.raises(ValueError, match="no room holds a target class that can be reached"):
        make_task(TrainConfig(), blind, glove, rooms.extras)


def test_broken_parents(tmp_path: Path) -> None:
    path = tmp_path / "c2p_prob.json"
    for content, reason in (
        ({"Hall": {}}, "room 'Hall' is not one of"),
        ({"Kitchen": []}, "no targets"),
        ({"Kitchen": {"Mug": 3}}, "no parents"),
        ({"Kitchen": {"Mug": {"Sink": "x"}}}, "Sink is not a number"),
        ({"Kitchen": {"Mug": {"Sink": -1}}}, "a reward below 0"),
        ([], "not a JSON object"),
    ):
        path.write_text(json.dumps(content))
        with pytest.raises(FileError, match=rf"c2p_prob\.json: .*{reason}"):
            extras.read_parents(path)


def test_targets_next_to_the_scenes(tmp_path: Path) -> None:
    path = tmp_path / "targets.json"
    path.write_text('{"LivingRoom": ["Vase", "Mug"], "shop": ["Mug"]}')
    types = {*ROOM_TYPES, "shop"}
    found = extras.read_targets(path, {"Mug", "Vase"}, types)
    assert found == {"living_room": ("Mug", "Vase"), "shop": ("Mug",)}
    for content in ('["Mug"]', '{"shop": "Mug"}', '{"shop": [1]}', '{"shop": ["Kettle"]}'):
        path.write_text(content)
        with pytest.raises(FileError, match=r"targets\.json: "):
            extras.read_targets(path, {"Mug", "Vase"}, types)
    for content, reason in (
        ('{"attic": ["Mug"]}', "attic: no room is of this type"),
        ('{"Kitchen": ["Mug"], "kitchen": ["Vase"]}', "kitchen: is there twice"),
    ):
        path.write_text(content)
        with pytest.raises(FileError, match=rf"targets\.json: {reason}"):
            extras.read_targets(path, {"Mug", "Vase"}, types)


def test_targets_above_the_scenes_are_those_of_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Prometheus has a file of this name, too."""
    monkeypatch.setenv("TDANET_CACHE", str(tmp_path / "cache"))
    scenes = original.write_all(tmp_path / "original")
    for place in (scenes.parent, scenes.parent.parent):
        (place / "targets.json").write_text('[{"targets": ["localhost"]}]')
    found = importer.read_folder(scenes, lambda share, line: None).extras
    assert found is not None
    assert found.targets == {}
    (scenes / "targets.json").write_text('{"kitchen": ["Mug"]}')
    found = importer.read_folder(scenes.parent, lambda share, line: None).extras
    assert found is not None
    assert found.targets == {"kitchen": ("Mug",)}


def test_broken_graphs(tmp_path: Path) -> None:
    names, matrix = tmp_path / "objects.txt", tmp_path / "adjmat.dat"
    for text, value, reason in (
        ("A\nB\n", np.eye(3), r"adjmat\.dat: shape \(3, 3\) is not that of 2 classes"),
        ("A\nA\n", np.eye(2), r"objects\.txt: not a list of distinct class names"),
        ("", np.eye(0), r"objects\.txt: not a list"),
        ("A\nB\tC\n", np.eye(2), r"objects\.txt: class B.C: has a control character"),
        ("A\nB\n", np.full((2, 2), np.nan), r"adjmat\.dat: holds NaN"),
        ("A\nB\n", -np.eye(2), r"adjmat\.dat: holds .* a weight below 0"),
        ("A\nB\n", {"a": 1}, r"adjmat\.dat: something other than an array"),
    ):
        names.write_text(text)
        matrix.write_bytes(original.torch_save(value))
        with pytest.raises(FileError, match=reason):
            extras.read_graph(names, matrix)


class Command:
    """A pickle that would make a file."""

    def __init__(self, made: Path) -> None:
        self.made = made

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.made}",)


def test_broken_episodes(tmp_path: Path, known: dict[str, ImportedRoom]) -> None:
    path, made = tmp_path / "kitchen_test.pkl", tmp_path / "made"
    with original.fake_torch():
        [good] = original.episodes([("FloorPlan1", 0.25, 90, "Mug")])
        [inside] = original.episodes([("FloorPlan1", float("nan"), 90, "Mug")])
        cases = [
            ([good], None),
            (good, "not a list of episodes"),
            ([3], "episode 0: no scene, state and goal_object_type"),
            ([{**good, "scene": 3}], "scene or goal_object_type is not text"),
            ([{**good, "state": {"x": 0}}], "its state is not a ThorAgentState"),
            ([{**good, "glove_embedding": "text"}], "something other than an array"),
            ([inside], "z is not finite"),
            ([good, Command(made)], "system"),
        ]
        written = [(pickle.dumps(content), reason) for content, reason in cases]
    for data, reason in written:
        path.write_bytes(data)
        if reason is None:
            assert len(extras.read_episodes(path, known)[0]) == 1
            continue
        with pytest.raises(FileError, match=rf"kitchen_test\.pkl: .*{reason}"):
            extras.read_episodes(path, known)
    assert not made.exists()
    (tmp_path / "kitchen_train.pkl").write_bytes(written[0][0])
    with pytest.raises(FileError, match="not named"):
        extras.read_episodes(tmp_path / "kitchen_train.pkl", known)


@pytest.fixture
def known(rooms: Rooms) -> dict[str, ImportedRoom]:
    return {"FloorPlan1": ImportedRoom(extras.Grid(rooms.tables.position[:3]), {"Mug"}, "kitchen")}


def test_episodes_that_do_not_fit_are_left_out_and_named(
    tmp_path: Path, known: dict[str, ImportedRoom]
) -> None:
    listed = [
        ("FloorPlan1", 0.25, 90, "Mug"),
        *[("FloorPlan1", 0.3 + i, 90, "Mug") for i in range(4)],  # between points
        ("FloorPlan1", 0.75, 90, "Mug"),  # past the last
        ("FloorPlan1", 0.25, 91, "Mug"),
        ("FloorPlan1", 0.25, 360, "Mug"),
        ("FloorPlan2-1", 0.25, 90, "Mug"),
        ("../../etc\n/passwd", 0.25, 90, "Mug"),
        ("FloorPlan1", 0.25, 90, "Toaster"),
        ("FloorPlan1_physics", 0.5, 0, "Mug"),
    ]
    folder = tmp_path / "lists" / "test_val_split"
    folder.mkdir(parents=True)
    with original.fake_torch():
        (folder / "kitchen_test.pkl").write_bytes(pickle.dumps(original.episodes(listed)))
    found, lines = extras.read_extras([tmp_path / "lists"], known)
    assert [(e.scene, e.z) for e in found.episodes] == [("FloorPlan1", 0.25), ("FloorPlan1", 0.5)]
    of = "of kitchen_test.pkl"
    assert [line.removeprefix(f"{folder}: ") for line in lines] == [
        "2 episodes",
        "5 episodes left out, start off the grid of grid.json: "
        f"episode 1 {of} (FloorPlan1 -0.00|0.30|90|0 Mug), "
        f"episode 2 {of} (FloorPlan1 -0.00|1.30|90|0 Mug), "
        f"episode 3 {of} (FloorPlan1 -0.00|2.30|90|0 Mug), ...",
        "2 episodes left out, rotation or horizon not one of the task's: "
        f"episode 6 {of} (FloorPlan1 -0.00|0.25|91|0 Mug), "
        f"episode 7 {of} (FloorPlan1 -0.00|0.25|360|0 Mug)",
        "2 episodes left out, in rooms that were not imported: "
        f"episode 8 {of} (FloorPlan2-1 -0.00|0.25|90|0 Mug), "
        f"episode 9 {of} (../../etc?/passwd -0.00|0.25|90|0 Mug)",
        "1 episodes left out, target not in the room: "
        f"episode 10 {of} (FloorPlan1 -0.00|0.25|90|0 Toaster)",
    ]
