"""The catalogue of models: nothing of a test room, and groups as ProcTHOR's authors made them."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.scenes import ithor
from tdanet_jax.scenes.generation import catalogue
from tdanet_jax.splits import make_split
from tdanet_jax.tools import build_assets

WHEELS = os.environ.get("TDANET_WHEELS")


def test_no_model_is_in_a_test_room() -> None:
    split, found = make_split("22/0"), catalogue.load()
    rooms = set().union(*(own for models in found.rooms.values() for own in models))
    assert rooms == {*split.train_scenes}
    assert sum(map(len, found.models.values())) > 1000
    assert all(len(found.models[name]) == len(found.rooms[name]) for name in found.models)
    assert all((sizes > 0).all() and (sizes < 5).all() for sizes in found.models.values())


@pytest.mark.skipif(WHEELS is None, reason="TDANET_WHEELS names no folder with the wheels")
def test_it_is_what_the_database_says(tmp_path: Path) -> None:
    wheel = build_assets.fetch(build_assets.PROCTHOR, Path(str(WHEELS)))
    path = catalogue.build_asset(wheel, tmp_path, ithor.load_scenes())
    built, bundled = catalogue.load(path), catalogue.load()
    assert built.groups == bundled.groups
    assert built.rooms == bundled.rooms
    with zipfile.ZipFile(wheel) as file:
        database = json.loads(file.read("procthor/databases/asset-database.json"))
    test = {*make_split("22/0").eval_scenes}
    for name, sizes in bundled.models.items():
        allowed = [a for a in database[name] if not test & {*a.get("scenes", ())}]
        wanted = [[a["boundingBox"][axis] for axis in "xyz"] for a in allowed]
        np.testing.assert_allclose(sizes, wanted, atol=0.0006)


def test_validation_takes_no_model_of_the_rooms_that_it_evaluates_in() -> None:
    found, names = catalogue.load(), make_split("22/0", True).train_scenes
    every = make_split("22/0").train_scenes
    fewer = found.sizes("Bed", names)
    assert 0 < len(fewer) < len(found.sizes("Bed", every)) == len(found.models["Bed"])
    for size, own in zip(found.models["Bed"], found.rooms["Bed"], strict=True):
        assert (size == fewer).all(axis=1).any() or own - {*names}
    assert found.sizes("Unheard", names).shape == (0, 3)


def test_chairs_face_their_table_and_the_sofa_its_television() -> None:
    for members in catalogue.load().groups:
        for member in members[1:]:
            parent = members[member.parent]
            toward = -np.array(member.side, float)
            ahead = np.array([np.sin(np.radians(member.turn)), np.cos(np.radians(member.turn))])
            if (parent.object_class, member.object_class) in {
                ("DiningTable", "Chair"), ("TVStand", "Sofa"), ("Desk", "Chair")
            }:  # fmt: skip
                assert ahead @ toward > 0.9
            if (
                member.object_class == "ArmChair"
            ):  # at a side of the sofa, both before the television
                assert np.sign(ahead[0]) == toward[0]
                assert ahead[1] < 0
