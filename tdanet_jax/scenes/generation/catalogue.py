"""The bundled catalogue: models of furniture and of small objects, and how they are arranged.

It is made of ProcTHOR's asset database, placement annotations and asset groups. Models that any
iTHOR test room contains are left out.
"""

from __future__ import annotations

import dataclasses
import functools
import gzip
import json
import zipfile
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import assets
from tdanet_jax.scenes.scene import Scene
from tdanet_jax.splits import ITHOR_ROOMS, make_split

ASSET = "furniture.json.gz"
DATABASES = "procthor/databases"
#: What the annotations say about where furniture stands, by the names that they have for it.
SPOTS = {"corner": "inCorner", "edge": "onEdge", "middle": "inMiddle"}
#: The models of these are blocks of kitchens of another kind than iTHOR's.
OTHERS = ("CounterTop",)


@dataclasses.dataclass(frozen=True)
class Member:
    """An object of a group, placed relative to its parent. Metres and degrees; the front is +z.

    Attributes:
      object_class: its class.
      parent: index of the member that it belongs to, -1 for the first.
      side: of the parent, to which it is placed: -1, 0 or 1 along x, and along z.
      offset: from there, along x and z.
      align: which side of its own is there: -1 the lower, 0 its middle, 1 the upper; x and z.
      above: whether it stands on the parent.
      turn: clockwise seen from above.
      spread: by how much it varies, along x and z, and in degrees.
    """

    object_class: str
    parent: int
    side: tuple[int, int]
    offset: tuple[float, float]
    align: tuple[int, int]
    above: bool
    turn: float
    spread: tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Catalogue:
    """Models and arrangements.

    Attributes:
      models: class -> (width, height, depth) in metres [n, 3], the front along the depth.
      rooms: class -> for each model, the iTHOR training rooms that contain it.
      spots: class -> where it stands: any of corner, edge and middle.
      groups: arrangements of several objects; the first object is the root.
    """

    models: Mapping[str, np.ndarray]
    rooms: Mapping[str, tuple[frozenset[str], ...]]
    spots: Mapping[str, frozenset[str]]
    groups: tuple[tuple[Member, ...], ...]

    def sizes(self, name: str, known: Collection[str]) -> np.ndarray:
        """The models [n, 3] of a class that occur in no other iTHOR rooms than the known ones."""
        rooms = self.rooms.get(name, ())
        allowed = [i for i, own in enumerate(rooms) if own <= {*known}]
        return self.models[name][allowed] if allowed else np.zeros((0, 3))


@functools.cache
def load(path: Path | None = None) -> Catalogue:
    """The catalogue from its file, by default the bundled one."""
    content = json.loads(gzip.decompress((path or assets.path(ASSET)).read_bytes()))
    return Catalogue(
        models={
            name: np.array([model[:3] for model in models], np.float64) / 1000
            for name, models in content["models"].items()
        },
        rooms={
            name: tuple(frozenset(f"FloorPlan{n}" for n in model[3]) for model in models)
            for name, models in content["models"].items()
        },
        spots={name: frozenset(spots) for name, spots in content["spots"].items()},
        groups=tuple(
            tuple(
                Member(
                    object_class=member["class"],
                    **{key: _fixed(value) for key, value in member.items() if key != "class"},
                )
                for member in group
            )
            for group in content["groups"]
        ),
    )


def _fixed(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def build_asset(procthor_wheel: Path | str, out_dir: Path | str, rooms: list[Scene]) -> Path:
    """Writes the catalogue into `out_dir`; equal wheels give equal bytes.

    Args:
      rooms: the bundled rooms; classes of which no training room has any are left out.
    """
    split = make_split("22/0")
    test, train = {*split.eval_scenes}, {*split.train_scenes}
    classes = {o.object_class for room in rooms if room.name in train for o in room.objects}
    with zipfile.ZipFile(procthor_wheel) as wheel:

        def read(name: str) -> Any:
            return json.loads(wheel.read(f"{DATABASES}/{name}"))

        database, annotations = read("asset-database.json"), read("placement-annotations.json")
        names = sorted(name for name in wheel.namelist() if "/asset_groups/" in name)
        groups = [json.loads(wheel.read(name)) for name in names if name.endswith(".json")]
    models = {}
    for name in sorted(classes.intersection(database) - {*OTHERS}):
        models[name] = [
            [*(round(1000 * asset["boundingBox"][axis]) for axis in "xyz"), own]
            for asset in database[name]
            if not (found := {*asset.get("scenes", ())} & {*ITHOR_ROOMS}) & test
            for own in [sorted(int(room.removeprefix("FloorPlan")) for room in found)]
        ]
    spots = {
        name: [spot for spot, key in SPOTS.items() if annotations[key].get(name)]
        for name in sorted(classes.intersection(annotations["inCorner"]))
    }
    content = {
        "models": {name: found for name, found in models.items() if found},
        "spots": {name: found for name, found in spots.items() if found},
        "groups": [_members(group["assetMetadata"], group["treeData"]) for group in groups],
    }
    path = Path(out_dir) / ASSET
    text = json.dumps(content, separators=(",", ":"), sort_keys=True)
    path.write_bytes(gzip.compress(text.encode(), mtime=0))
    return path


def _members(
    records: Mapping[str, Any], trees: list[dict[str, Any]], parent: int = -1, first: int = 0
) -> list[dict[str, Any]]:
    """The members of a group, parents first.

    In ProcTHOR's files, x points to the left; anchors are the cells of a 3 x 3 grid over the
    parent, counted from its right and from its back.
    """
    found: list[dict[str, Any]] = []
    for tree in trees:
        record = records[str(tree["instanceId"])]
        position, spread = record["position"], record["randomness"]
        anchor, number = position["relativeAnchorToParent"], first + len(found)
        [name] = record["assetIds"]
        found.append(
            {
                "class": name,
                "parent": parent,
                "side": [1 - anchor % 3, anchor // 3 - 1] if parent >= 0 else [0, 0],
                "offset": [round(-position["x"], 3), round(position["z"], 3)]
                if parent >= 0
                else [0, 0],
                "align": [1 - position["xAlignment"], 1 - position["zAlignment"]],
                "above": position["verticalAlignment"] == "above",
                "turn": record["rotation"] % 360,
                "spread": [round(spread[key], 3) for key in ("dx", "dz", "dtheta")],
            }
        )
        found += _members(records, tree.get("children", []), number, number + 1)
    return found
