"""The bundled rooms: made from (synthetic) wheels, read back; from the real ones bit by bit."""

from __future__ import annotations

import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax import poses
from tdanet_jax.io import assets
from tdanet_jax.io.untrusted import npz
from tdanet_jax.scenes import SceneError, ithor, metadata, reachable
from tdanet_jax.scenes.scene import CAMERA_ABOVE_AGENT
from tdanet_jax.scenes.visibility import geometry
from tdanet_jax.splits import SCENE_NUMBERS
from tdanet_jax.tools import build_assets
from tdanet_jax.vocabulary import IGNORED, ROOM_TYPES, VISIBILITY_DISTANCE

WHEELS = os.environ.get("TDANET_WHEELS")  # folder with the wheels of build_assets.SOURCES
needs_wheels = pytest.mark.skipif(not WHEELS, reason="TDANET_WHEELS names no folder of wheels")


def record(draw: np.random.Generator, number: int, agent: np.ndarray) -> dict[str, Any]:
    """A made-up metadata record of AI2-THOR's shape."""
    middle, size = draw.uniform(-3, 3, 3), draw.uniform(0.1, 1, 3)
    low, high = middle - size / 2, middle + size / 2
    corners = [
        (x, y, z)
        for y in (low[1], high[1])
        for x, z in ((low[0], low[2]), (high[0], low[2]), (high[0], high[2]), (low[0], high[2]))
    ]
    return {
        "objectId": f"Apple|{number}",
        "objectType": "Apple",
        "axisAlignedBoundingBox": {
            "center": dict(zip("xyz", middle.tolist(), strict=True)),
            "size": dict(zip("xyz", size.tolist(), strict=True)),
        },
        "objectOrientedBoundingBox": {"cornerPoints": corners} if number % 2 else None,
        "position": dict(zip("xyz", middle.tolist(), strict=True)),
        "rotation": {"x": 0.0, "y": 90.0, "z": -1.5},
        "distance": float(np.linalg.norm(middle - agent)),
        "parentReceptacles": ["Apple|0", "Floor|1"] if number == 3 else None,
        "openable": number == 1,
        "isOpen": number == 1,
        "pickupable": number == 2,
        "visible": number == 0,
    }


@pytest.fixture(scope="module")
def wheels(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two wheels like the real ones, with six apples in every room."""
    folder = tmp_path_factory.mktemp("wheels")
    draw = np.random.default_rng(0)
    content: dict[str, list[list[dict[str, Any]]]] = {f"{room}s": [] for room in ROOM_TYPES}
    with zipfile.ZipFile(folder / "layouts.whl", "w") as wheel:
        for room in ROOM_TYPES:
            for number in SCENE_NUMBERS[room]:
                agent = np.array([0.25 * (number % 4), 0.9, -0.5])
                content[f"{room}s"].append([record(draw, i, agent) for i in range(6)])
                layout = io.BytesIO()
                np.save(layout, np.array([(0.25, 0.5), (0.0, -0.25), (0.0, 0.0)]))
                name = ithor.LAYOUT.format(name=f"FloorPlan{number}")
                wheel.writestr(name, layout.getvalue())
    with zipfile.ZipFile(folder / "metadata.whl", "w") as wheel:
        wheel.writestr(ithor.METADATA, json.dumps(content))
    return folder / "metadata.whl", folder / "layouts.whl"


def test_written_and_read_back(wheels: tuple[Path, Path], tmp_path: Path) -> None:
    path = ithor.build_asset(*wheels, tmp_path)
    scenes = ithor.load_scenes(path)
    assert len(scenes) == 120
    with zipfile.ZipFile(wheels[0]) as wheel:
        source = json.loads(wheel.read(ithor.METADATA))
    for i in (0, 31, 119):
        room, number = ROOM_TYPES[i // 30], i % 30
        scene = scenes[i]
        assert scene.room_type == room
        assert scene.name == f"FloorPlan{SCENE_NUMBERS[room][number]}"
        agent = [0.25 * (SCENE_NUMBERS[room][number] % 4), 0.9, -0.5]
        assert np.allclose(scene.default_position, agent, atol=1e-4)
        published = np.array([[0, 0.9, -0.25], [0, 0.9, 0], [0.25, 0.9, 0.5]])
        objects = [metadata.parse_object(scene.name, r) for r in source[f"{room}s"][number]]
        added = reachable.complete(published, objects)
        assert len(added)
        points = np.concatenate([published, added])
        assert scene.points.round(4).tolist() == sorted(points.round(4).tolist())
        for item, original in zip(scene.objects, source[f"{room}s"][number], strict=True):
            parsed = metadata.parse_object(scene.name, original)
            assert np.allclose(item.box, parsed.box, atol=1e-4)
            assert (item.corners is None) == (parsed.corners is None)
            if parsed.corners is not None:
                assert np.allclose(item.corners, parsed.corners, atol=1e-4)
            for field in (
                "object_id", "object_class", "rotation", "openable", "is_open", "pickupable",
                "parents", "visible",
            ):  # fmt: skip
                assert getattr(item, field) == getattr(parsed, field), field


def test_equal_wheels_give_equal_bytes(wheels: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    first = ithor.build_asset(*wheels, tmp_path / "a").read_bytes()
    assert ithor.build_asset(*wheels, tmp_path / "b").read_bytes() == first


def test_contradicting_distances_are_noticed() -> None:
    draw = np.random.default_rng(0)
    records = [record(draw, i, np.zeros(3)) for i in range(6)]
    assert np.allclose(ithor.locate_agent(records), 0, atol=1e-6)
    records[2]["distance"] += 0.1
    with pytest.raises(SceneError, match="contradict"):
        ithor.locate_agent(records)


def test_bundled_rooms() -> None:
    scenes = ithor.load_scenes()
    names = [f"FloorPlan{number}" for room in ROOM_TYPES for number in SCENE_NUMBERS[room]]
    assert [scene.name for scene in scenes] == names
    published = ithor.published_points()
    assert list(published) == names
    assert sum(int(published[scene.name].sum()) for scene in scenes) == 14_642
    assert sum(len(scene.points) for scene in scenes) == 18_344
    assert sum(len(scene.objects) for scene in scenes) == 5_550
    for scene in scenes:
        assert published[scene.name].shape == (len(scene.points),)
        assert len(np.unique(scene.points, axis=0)) == len(scene.points)
        # The default poses lie on the grid, at the agent's height.
        assert scene.default_position is not None
        assert np.abs(scene.points - scene.default_position).max(axis=1).min() < 1e-3


def test_flagged_objects_lie_in_the_default_view() -> None:
    # With the inferred rotation (almost) every object that AI2-THOR flags is in the view.
    inside = flagged = 0
    for scene in ithor.load_scenes():
        assert scene.default_rotation is not None
        assert scene.default_position is not None
        x, z = poses.STEPS[scene.default_rotation // 45]
        for item in scene.objects:
            if item.visible:
                origin, edges = geometry.box_frame(item.box, item.corners)
                points = geometry.lattice(origin[None], edges[None])[0] - scene.default_position
                depth, side = (
                    points[:, 0] * x + points[:, 2] * z,
                    points[:, 0] * z - points[:, 2] * x,
                )
                up = points[:, 1] - CAMERA_ABOVE_AGENT
                inside += bool(((np.abs(side) < depth) & (np.abs(up) < depth)).any())
                flagged += 1
                assert np.hypot(points[:, 0], points[:, 2]).min() < VISIBILITY_DISTANCE + 0.2
    assert flagged > 500
    assert inside >= 0.98 * flagged


def test_no_pickles_in_the_asset() -> None:
    for array in npz.read(assets.path(ithor.ASSET)).values():
        assert array.dtype != object


@needs_wheels
def test_the_asset_regenerates_bit_by_bit(tmp_path: Path) -> None:
    build_assets.build(tmp_path, Path(str(WHEELS)))
    listed = json.loads((tmp_path / assets.CHECKSUMS).read_text())
    bundled = json.loads((assets.folder() / assets.CHECKSUMS).read_text())
    assert listed.items() <= bundled.items()
    assert ithor.ASSET in listed


@needs_wheels
def test_robothor_objects_parse() -> None:
    with zipfile.ZipFile(build_assets.fetch(build_assets.PROCTHOR, Path(str(WHEELS)))) as wheel:
        content = json.loads(wheel.read(ithor.METADATA))["robothor"]
    assert len(content) == 75
    spots = np.array([(0.0, 0.9, 0.0)])
    for i, records in enumerate(content):
        scene = metadata.parse_scene(f"RoboTHOR{i}", 1, records, spots)
        kept = [r for r in records if r["objectType"] not in IGNORED]
        assert len(scene.objects) == len(kept)
