"""The original offline data in miniature, written by hand and not by the exporter.

Two kitchens of three points in a row along z at x = -0.001 m, whose keys therefore begin with
"-0.00", as the reference controller wrote them. Class names are those of AI2-THOR 1.0.
"""

from __future__ import annotations

import contextlib
import io
import json
import pickle
import sys
import types
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

POINTS = [{"x": -0.001, "y": 0.9, "z": 0.25 * i} for i in range(3)]
KEYS = [
    f"-0.00|{z}|{rotation}|{horizon}"
    for z in ("0.00", "0.25", "0.50")
    for rotation in range(0, 360, 45)
    for horizon in (0, 30)
]
MUG, TABLE, APPLE = "Mug|+00.00|+01.00|+01.50", "TableTop|+00.10|+00.50|+01.50", "Apple|a|b|c"
#: A second mug, in view from the last point alone and never within reach.
BOXES: dict[str, dict[str, list[int]]] = {
    "-0.00|0.25|0|0": {"Mug": [140, 150, 160, 170], "TableTop": [100, 160, 200, 300]},
    "-0.00|0.50|0|0": {"Mug": [5, 150, 15, 160, 130, 140, 170, 180], "Apple": [0, 0, 10, 20]},
}
VISIBLE = {MUG: ["-0.00|0.50|0|0"], TABLE: ["-0.00|0.25|0|0", "-0.00|0.50|0|0"], APPLE: []}
#: Starts and targets of the published list; the last is in a scene that is not there.
EPISODES = [("FloorPlan21", 0.0, 45, "Mug"), ("FloorPlan21_physics", 0.5, 180, "Mug"),
            ("FloorPlan430", 0.5, 180, "Mirror")]  # fmt: skip


def old_links() -> list[dict[str, int]]:
    """The moves along the row, as networkx 1 wrote links: places in the list of nodes."""
    links = []
    for i in range(len(KEYS)):
        point, rotation, horizon = i // 16, i // 2 % 8, i % 2
        targets = [point * 16 + (rotation + 1) % 8 * 2 + horizon,
                   point * 16 + (rotation - 1) % 8 * 2 + horizon, i + 1 - 2 * horizon]  # fmt: skip
        if rotation == 0 and point < 2:
            targets.append(i + 16)
        if rotation == 4 and point > 0:
            targets.append(i - 16)
        links += [{"source": i, "target": target} for target in targets]
    return links


def write_room(folder: Path) -> None:
    """One room with every file of the layout but the features."""
    folder.mkdir(parents=True)
    graph = {"directed": True, "multigraph": False, "graph": {}, "links": old_links(),
             "nodes": [{"id": key} for key in KEYS]}  # fmt: skip
    for name, content in (
        ("grid.json", POINTS),
        ("graph.json", graph),
        ("visible_object_map.json", VISIBLE),
        ("objects_bb.json", {key: BOXES.get(key, {}) for key in KEYS}),
    ):
        (folder / name).write_text(json.dumps(content))


def write_all(root: Path) -> Path:
    """A training and a test kitchen with everything that lies next to them; returns the scenes'
    folder, which is two folders below the episodes, as in the reference."""
    scenes = root / "data" / "thor_v1_offline_data"
    write_room(scenes / "FloorPlan1")
    write_room(scenes / "FloorPlan21_physics")
    parents = {"Kitchen": {"Mug": {"TableTop": 0.25, "Sink": 0.5, "Toaster": 0.4}}}
    (root / "data" / "c2p_prob.json").write_text(json.dumps(parents))
    gcn = root / "data" / "gcn"
    gcn.mkdir()
    (gcn / "objects.txt").write_text("Apple\nMug\nTableTop\nTelephone\n")
    split = root / "test_val_split"
    split.mkdir()
    with fake_torch():
        (gcn / "adjmat.dat").write_bytes(torch_save(np.arange(16).reshape(4, 4)))
        (split / "kitchen_test.pkl").write_bytes(pickle.dumps(episodes(EPISODES)))
        (split / "notes.pkl").write_bytes(b"of another kind, not read")
        (split / "kitchen_val.pkl").write_bytes(pickle.dumps(episodes(EPISODES[:1])))
    return scenes


def episodes(listed: list[tuple[str, float, int, str]]) -> list[dict[str, Any]]:
    """Records as the published lists hold them; needs `fake_torch`."""
    module = sys.modules["datasets.offline_controller_with_small_rotation"]
    records = []
    for scene, z, rotation, target in listed:
        state = module.ThorAgentState()
        state.__dict__.update(x=-0.0, y=0.9, z=z, rotation=rotation, horizon=0)
        vector = Tensor(np.arange(300, dtype=np.float32), 2, (4,), (1,))
        records.append(
            {
                "scene": scene,
                "state": state,
                "goal_object_type": target,
                "task_data": [MUG],
                "glove_embedding": vector,
                "room": "Kitchen",
            }
        )
    return records


class FloatStorage:
    """Pickles as torch 1's storage does: a call with the bytes that torch.save gives for it."""

    def __init__(self, values: np.ndarray) -> None:
        self.values = values

    def __reduce__(self) -> Any:
        return sys.modules["torch.storage"]._load_from_bytes, (torch_save(self),)


class Tensor:
    """Pickles as torch 1's tensor does."""

    def __init__(
        self, values: np.ndarray, first: int, size: tuple[int, ...], stride: tuple[int, ...]
    ) -> None:
        self.arguments = (FloatStorage(values), first, size, stride, False, OrderedDict())

    def __reduce__(self) -> Any:
        return sys.modules["torch._utils"]._rebuild_tensor_v2, self.arguments


def torch_save(value: Any) -> bytes:
    """torch.save's older format: magic, version, system, the value, and the storages' numbers."""
    out = io.BytesIO()
    for head in (0x1950A86A20F9469CFC6C, 1001, {"protocol_version": 1001, "little_endian": True}):
        pickle.dump(head, out, protocol=2)
    storages: list[FloatStorage] = []

    class Pickler(pickle.Pickler):
        def persistent_id(self, item: Any) -> Any:
            if not isinstance(item, FloatStorage):
                return None
            storages.append(item)
            return ("storage", FloatStorage, str(id(item)), "cpu", len(item.values), None)

    Pickler(out, protocol=2).dump(value)
    pickle.dump([str(id(item)) for item in storages], out, protocol=2)
    for item in storages:
        out.write(len(item.values).to_bytes(8, "little") + item.values.astype("<f4").tobytes())
    return out.getvalue()


@contextlib.contextmanager
def fake_torch() -> Iterator[None]:
    """Modules under the names that the published pickles hold, while it lasts."""

    def _rebuild_tensor_v2(*arguments: Any) -> None:
        raise AssertionError("called")

    def _load_from_bytes(data: bytes) -> None:
        raise AssertionError("called")

    state = type("ThorAgentState", (), {})
    homes: dict[str, list[Any]] = {
        "torch": [FloatStorage],
        "torch._utils": [_rebuild_tensor_v2],
        "torch.storage": [_load_from_bytes],
        "datasets": [],
        "datasets.offline_controller_with_small_rotation": [state],
    }
    before = {name: sys.modules.get(name) for name in homes}
    for name, members in homes.items():
        sys.modules[name] = types.ModuleType(name)
        for member in members:
            member.__module__, member.__qualname__ = name, member.__name__
            setattr(sys.modules[name], member.__name__, member)
    try:
        yield
    finally:
        for name, module in before.items():
            del sys.modules[name]
            if module is not None:
                sys.modules[name] = module
