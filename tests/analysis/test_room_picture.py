"""Views are chosen and pictures are written."""

from pathlib import Path

import numpy as np

from tdanet_jax.analysis import room_picture
from tdanet_jax.scenes import tables
from tests.support import toy


def test_the_most_telling_view() -> None:
    apples = [toy.thing("Apple", (-0.8, toy.CAMERA, -0.8), number=i) for i in range(3)]
    others = [toy.thing(name, (1.0, toy.CAMERA, z)) for name, z in (("Mug", 0.4), ("Bowl", -0.4))]
    t = tables.build([toy.room(toy.line(1), *apples, *others)])
    assert (
        room_picture.most_telling_state(t) == 2 * 2
    )  # to the right: two classes, not three apples


def test_a_picture_is_written(tmp_path: Path) -> None:
    scene = toy.random_room(np.random.default_rng(1))
    path = tmp_path / "room.png"
    room_picture.draw(scene, tables.build([scene]), 0, path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size > 20_000
