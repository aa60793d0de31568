"""Pictures of rooms and episodes are whole, and the default view of a room shows much."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from matplotlib.image import imread
from PIL import Image, ImageSequence

from tdanet_jax.analysis import pictures
from tdanet_jax.scenes import floor_plan, tabulation
from tests.analysis.test_drawing import walk
from tests.support import toy


def is_orange(pixels):
    return (np.abs(pixels[..., :3] - np.array([213, 94, 0]) / 255) < 0.05).all(axis=-1)


def test_every_player_has_a_panel(some_rooms, tmp_path):
    plan, made = floor_plan.of_room(some_rooms, "FloorPlan229"), walk(some_rooms, True)
    pictures.trajectories([made, made], plan, some_rooms, tmp_path / "paths.png")
    orange = is_orange(imread(tmp_path / "paths.png"))
    wide = orange.shape[1]
    assert wide > 800
    assert orange[:, : wide // 2].sum() > 100
    assert orange[:, wide // 2 :].sum() > 100


@pytest.mark.slow
def test_an_animation_has_a_frame_for_each_step_and_stays_at_the_end(some_rooms, tmp_path):
    plan, made = floor_plan.of_room(some_rooms, "FloorPlan229"), walk(some_rooms, True)
    short = dataclasses.replace(made, pose=made.pose[:3], actions=np.array([0, 5]))
    pictures.animation([made, short], plan, some_rooms, tmp_path / "episode.gif")
    with Image.open(tmp_path / "episode.gif") as file:
        frames = [
            (frame.info["duration"], is_orange(np.array(frame.convert("RGB")) / 255))
            for frame in ImageSequence.Iterator(file)
        ]
    durations, orange = zip(*frames, strict=True)
    assert durations == (*[500] * 6, 3000)
    assert orange[5].sum() > orange[0].sum() + 100  # the path has grown
    high, wide = orange[0].shape
    assert not any(shown[:, int(0.65 * wide) :].any() for shown in orange)  # the camera's view
    assert all(shown[: high // 2].any() and shown[high // 2 :].any() for shown in orange)


def test_views_of_an_episode_without_attention(some_rooms, tmp_path):
    pictures.attention_episode(walk(some_rooms, True), some_rooms, tmp_path / "views.png")
    assert imread(tmp_path / "views.png").std() > 0.01


def test_the_most_telling_view():
    apples = [toy.thing("Apple", (-0.8, toy.CAMERA, -0.8), number=i) for i in range(3)]
    others = [toy.thing(name, (1.0, toy.CAMERA, z)) for name, z in (("Mug", 0.4), ("Bowl", -0.4))]
    tables = tabulation.build([toy.room(toy.line(1), *apples, *others)])
    to_the_right = 2 * 2  # two classes, not three apples
    assert pictures.most_telling_state(tables) == to_the_right


def test_a_room_is_drawn(tmp_path):
    scene = toy.random_room(np.random.default_rng(1))
    pictures.room(scene, tabulation.build([scene]), 0, tmp_path / "room.png")
    assert is_orange(imread(tmp_path / "room.png")).sum() > 50  # the agent
    assert (tmp_path / "room.png").stat().st_size > 20_000
