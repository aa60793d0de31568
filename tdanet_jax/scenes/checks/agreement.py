"""Agreement of the tables with AI2-THOR's `visible` flags in the default frames.

The rules of visibility were chosen to agree with these flags, see `visibility/rules.py`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from tdanet_jax.scenes.scene import Scene
from tdanet_jax.scenes.visibility.build import detect
from tdanet_jax.scenes.visibility.rules import Rules


@dataclass(frozen=True)
class Confusion:
    """Counts of our yes-or-no answers against those of a reference."""

    tp: int = 0  # both yes
    fp: int = 0  # ours only
    fn: int = 0  # the reference's only

    def __add__(self, other: Confusion) -> Confusion:
        return Confusion(self.tp + other.tp, self.fp + other.fp, self.fn + other.fn)

    @property
    def errors(self) -> int:
        """Number of answers that differ."""
        return self.fp + self.fn

    @property
    def precision(self) -> float:
        """Share of our yeses that the reference confirms."""
        return self.tp / max(self.tp + self.fp, 1)

    @property
    def recall(self) -> float:
        """Share of the reference's yeses that are ours."""
        return self.tp / max(self.tp + self.fn, 1)

    @property
    def f1(self) -> float:
        """Harmonic mean of precision and recall."""
        return 2 * self.tp / max(2 * self.tp + self.errors, 1)


def default_frame(scene: Scene, rules: Rules) -> np.ndarray:
    """Which objects the rules call visible in the scene's default frame: [O] bool."""
    assert scene.default_position is not None
    assert scene.default_rotation is not None
    found = detect(scene, rules, scene.default_position[None])
    view = scene.grid.from_degrees(0, scene.default_rotation, 0)
    result = np.zeros(len(scene.objects), bool)
    result[found.owner[(found.state == view) & found.visible]] = True
    return result


def by_class(scenes: Iterable[Scene], rules: Rules) -> dict[str, Confusion]:
    """Agreement with AI2-THOR's flags in the default frames, by object class."""
    result: defaultdict[str, Confusion] = defaultdict(Confusion)
    for scene in scenes:
        theirs = np.array([bool(item.visible) for item in scene.objects])
        ours = default_frame(scene, rules)
        cases = np.stack([ours & theirs, ours & ~theirs, theirs & ~ours], axis=1).astype(int)
        for item, case in zip(scene.objects, cases.tolist(), strict=True):
            result[item.object_class] += Confusion(*case)
    return result


def table(
    rooms: Mapping[str, Sequence[Scene]],
    groups: Mapping[str, Collection[str]],
    rules: Rules,
    most: int,
) -> Iterator[str]:
    """The lines of a table of the agreement.

    Args:
      rooms: what a column is called -> its rooms.
      groups: what a row is called -> its classes.
      most: number of single classes that are listed, those with the most errors.
    """
    columns = [by_class(scenes, rules) for scenes in rooms.values()]
    errors = {
        name: sum(column.get(name, Confusion()).errors for column in columns)
        for name in {name for column in columns for name in column}
    }
    worst = sorted((name for name in errors if errors[name]), key=lambda n: (-errors[n], n))[:most]
    heads = [f"{len(scenes):>10} {kind} rooms" for kind, scenes in rooms.items()]
    yield "AI2-THOR's own `visible` flags in the default frame of each room. both: visible to"
    yield "AI2-THOR and here, us: here alone, it: to AI2-THOR alone"
    yield f"{'':18}" + "".join(f"{head:29}" for head in heads).rstrip()
    yield f"{'':18}" + " both  us  it prec  rec    F1 " * len(columns)
    rows = {"all classes": errors, **groups, **{f"  {name}": (name,) for name in worst}}
    for title, members in rows.items():
        line = f"{title:18}"
        for column in columns:
            c = sum((column[name] for name in members if name in column), Confusion())
            line += f" {c.tp:4} {c.fp:3} {c.fn:3} {c.precision:.2f} {c.recall:.2f} {c.f1:.3f} "
        yield line
