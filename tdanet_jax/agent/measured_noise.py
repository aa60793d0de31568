"""The noise of a detector, measured on labelled images. Imports no JAX.

The result is a `SenseNoise`, with which agents can be evaluated and trained (docs/noise.md).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.agent.detection import Detection
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.sense_noise import SMALL_SIDE, SenseNoise, highest

_SIZE = ("width", "height")
#: What is likely to be wrong if categories do not fit.
NUMBERS = (
    "do both files number categories alike? ultralytics writes the model's numbers, from 1 (older "
    "versions from 0)"
)


@dataclasses.dataclass(frozen=True)
class Measured:
    """What was counted, and the noise that follows from it.

    Attributes:
      images: number of images.
      objects: labelled objects in them.
      found: objects with a detection, under any label.
      mislabelled: objects found with another label than their own.
      duplicated: detections of an object that has one already.
      invented: all other detections.
      noise: the levels, rounded to three digits.
    """

    images: int
    objects: int
    found: int
    mislabelled: int
    duplicated: int
    invented: int
    noise: SenseNoise


def measure(
    truth: Sequence[Sequence[Detection]], found: Sequence[Sequence[Detection]], iou: float = 0.5
) -> Measured:
    """The noise of a detector, from labelled objects and detections in the same images.

    Detections are matched to objects with an overlap of at least `iou`, the largest overlap first,
    and those with the same label before others. `misses` and `small_misses` have the largest
    likelihood; `jitter` is the root mean square of the errors of centres and sides, of boxes that
    do not touch the border of the image; `scores` fits the mean score of right detections. Every
    wrong label counts as one of `swaps`. `truncation` and motion are not measured.

    Args:
      truth: the objects in each image, one list per image, labelled as the detector labels them.
      found: the detector's detections in each image, above its threshold.
      iou: the least overlap, intersection over union, from 0 to 1.

    Raises:
      ValueError: the lists differ in length, there is no object, or `iou` is not between 0 and 1.
    """
    if len(truth) != len(found):
        raise ValueError(f"{len(truth)} labelled images and {len(found)} with detections")
    if not 0 < iou < 1:
        raise ValueError(f"iou {iou}: must be between 0 and 1")
    objects = sum(map(len, truth))
    if not objects:
        raise ValueError("no labelled object in any image")
    sides, hit, errors, right = [], [], [], []
    mislabelled = duplicated = invented = 0
    for there, seen in zip(truth, found, strict=True):
        chosen, extra = _match(there, seen, iou)
        for i, thing in enumerate(there):
            sides.append(np.sqrt((thing.x2 - thing.x1) * (thing.y2 - thing.y1)))
            hit.append(i in chosen)
        for i, k in chosen.items():
            mislabelled += there[i].label != seen[k].label
            errors += _errors(there[i], seen[k])
            score = seen[k].score
            if there[i].label == seen[k].label and score is not None:
                right.append((there[i], score))
        duplicated += extra
        invented += len(seen) - len(chosen) - extra
    matched = sum(hit)
    misses, small = _miss_rates(np.array(sides), np.array(hit))
    levels = {
        "misses": misses,
        "small_misses": small,
        "false_positives": invented / len(truth),
        "duplicates": duplicated / max(matched, 1),
        "swaps": mislabelled / max(matched, 1),
        "jitter": float(np.sqrt(np.mean(np.square(errors)))) if errors else 0.0,
        "scores": _uncertainty(right),
    }
    noise = _noise(levels)
    return Measured(len(truth), objects, matched, mislabelled, duplicated, invented, noise)


def from_confusion(matrix: np.ndarray, images: int) -> SenseNoise:
    """The noise that a detector's confusion matrix tells: misses, swaps and false positives.

    Args:
      matrix: [C + 1, C + 1], counts; row: what was detected, column: what is there, the last row
        and column: nothing. As ultralytics' `results.confusion_matrix.matrix`.
      images: number of images that it counts.

    Raises:
      ValueError: the matrix is not of this form, or counts no object.
    """
    matrix = np.asarray(matrix, float)
    if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or len(matrix) < 2:
        raise ValueError(f"confusion matrix of shape {matrix.shape}: must be [C + 1, C + 1]")
    if not (np.isfinite(matrix).all() and (matrix >= 0).all() and matrix[:, :-1].sum() > 0):
        raise ValueError("confusion matrix: must hold counts of at least one object")
    if images < 1:
        raise ValueError(f"images {images}: must be positive")
    found = matrix[:-1, :-1]
    levels = {
        "misses": matrix[-1, :-1].sum() / matrix[:, :-1].sum(),
        "swaps": (found.sum() - np.trace(found)) / max(found.sum(), 1),
        "false_positives": matrix[:-1, -1].sum() / images,
    }
    return _noise(levels)


def _noise(levels: Mapping[str, float]) -> SenseNoise:
    """Levels rounded to three digits, as far as levels go."""
    return SenseNoise(**{n: min(round(float(x), 3), highest(n)) for n, x in levels.items()})


def read_coco(
    truth: Path | str, found: Path | str, least_score: float = 0.25
) -> tuple[list[list[Detection]], list[list[Detection]]]:
    """Labelled objects and detections in COCO's formats, for `measure`.

    Args:
      truth: file with `images`, `annotations` and `categories`. Crowds (`iscrowd`) are left out.
      found: file with a list of `image_id`, `category_id`, `bbox` and `score`, as ultralytics'
        `val(save_json=True)` and torchvision's references write it. An image is named by its id, or
        as ultralytics does, by its file.
      least_score: detections below it are left out.

    Raises:
      FileError: a file is missing, no JSON, or not of this form; the message names the entry.
    """
    truth, found = Path(truth), Path(found)
    whole = jsons.load(truth)
    lists = {
        name: _entries(truth, whole.get(name) if isinstance(whole, dict) else None, f"{name}: ")
        for name in ("images", "annotations", "categories")
    }
    names: dict[Any, str] = {}
    for i, one in enumerate(lists["categories"]):
        key = _key(truth, f"categories, {i}", one, "id")
        if not isinstance(name := one.get("name"), str):
            raise FileError(truth, f"categories, {i}, name: not a string")
        names[key] = name
    sizes: dict[Any, list[float]] = {}
    by_file: dict[int | str, Any] = {}  # image ids as ultralytics writes them
    twice: set[int | str] = set()
    there: dict[Any, list[Detection]] = {}
    for i, one in enumerate(lists["images"]):
        at = f"images, {i}"
        number = _key(truth, at, one, "id")
        sizes[number] = [jsons.number(truth, one.get(n), f"{at}, {n}", 1e5) for n in _SIZE]
        there[number] = []
        if isinstance(one.get("file_name"), str):
            stem = _number_of(Path(one["file_name"]).stem)
            if stem in by_file:
                twice.add(stem)
            by_file[stem] = number
        if min(sizes[number]) <= 0:
            raise FileError(truth, f"{at}: width and height must be positive")
    seen: dict[Any, list[Detection]] = {number: [] for number in there}
    for i, one in enumerate(lists["annotations"]):
        if not one.get("iscrowd"):
            _add(truth, f"annotations, {i}", one, names, sizes, there)
    listed = _entries(found, jsons.load(found))
    ids = {_key(found, str(i), one, "image_id") for i, one in enumerate(listed)}
    if ids <= {*by_file} and (other := {name for name in ids if by_file[name] != name}):
        if ids <= {*sizes}:
            raise FileError(
                found,
                f"image {min(other, key=str)}: is the id of one image and the file name of "
                "another; number the images as their files",
            )
        if shared := ids & twice:
            raise FileError(found, f"image {min(shared, key=str)}: two images have this file name")
        listed = [{**one, "image_id": by_file[one["image_id"]]} for one in listed]
    for i, one in enumerate(listed):
        score = jsons.number(found, one.get("score"), f"{i}, score", 1)
        if score >= least_score:
            _add(found, str(i), one, names, sizes, seen, max(score, 0.0))
    return [*there.values()], [*seen.values()]


def _number_of(stem: str) -> int | str:
    """What ultralytics calls an image: its file's name, as a number if it is one."""
    return int(stem) if stem.isdecimal() else stem


def _entries(path: Path, listed: Any, at: str = "") -> list[dict[str, Any]]:
    if not isinstance(listed, list) or not all(isinstance(one, dict) for one in listed):
        raise FileError(path, f"{at}not a list of objects")
    return listed


def _key(path: Path, at: str, entry: dict[str, Any], name: str) -> int | str:
    key = entry.get(name)
    if isinstance(key, bool) or not isinstance(key, int | str):
        raise FileError(path, f"{at}, {name}: not a number or a string")
    return key


def _add(
    path: Path,
    at: str,
    entry: dict[str, Any],
    names: dict[Any, str],
    sizes: dict[Any, list[float]],
    lists: dict[Any, list[Detection]],
    score: float | None = None,
) -> None:
    """Appends an entry's box to the list of its image; boxes outside of it are left out."""
    image, category = (_key(path, at, entry, name) for name in ("image_id", "category_id"))
    if image not in sizes:
        raise FileError(path, f"{at}: image {image} is not in the labels")
    if category not in names:
        raise FileError(path, f"{at}: category {category} is not in the labels; {NUMBERS}")
    box = entry.get("bbox")
    if not isinstance(box, list) or len(box) != 4:
        raise FileError(path, f"{at}, bbox: not four numbers")
    x, y, width, height = (jsons.number(path, number, f"{at}, bbox", 1e6) for number in box)
    wide, high = sizes[image]
    inside = -width < x < wide and -height < y < high
    if width > 0 and height > 0 and inside:
        corners = (x / wide, y / high, (x + width) / wide, (y + height) / high)
        lists[image].append(Detection.clipped(names[category], *corners, score))


def _match(
    there: Sequence[Detection], seen: Sequence[Detection], iou: float
) -> tuple[dict[int, int], int]:
    """Object -> its detection, and the number of detections of objects that have one."""
    overlap = _overlaps(there, seen)
    same = np.array([[a.label == b.label for b in seen] for a in there], bool).reshape(
        overlap.shape
    )
    pairs = np.argwhere(overlap >= iou)
    best_first = np.lexsort((-overlap[tuple(pairs.T)], ~same[tuple(pairs.T)]))
    chosen: dict[int, int] = {}
    used: set[int] = set()
    for i, k in pairs[best_first].tolist():
        if i not in chosen and k not in used:
            chosen[i] = k
            used.add(k)
    again = {k for _, k in pairs.tolist()} - used
    return chosen, len(again)


def _overlaps(there: Sequence[Detection], seen: Sequence[Detection]) -> np.ndarray:
    """Intersection over union of every object [N] and detection [M], [N, M]."""
    a, b = (
        np.array([(d.x1, d.y1, d.x2, d.y2) for d in boxes]).reshape(-1, 4)
        for boxes in (there, seen)
    )
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    common = np.clip(high - low, 0, None).prod(-1)
    (of_a, of_b) = ((boxes[:, 2:] - boxes[:, :2]).prod(-1) for boxes in (a, b))
    union = of_a[:, None] + of_b - common
    return common / np.maximum(union, 1e-12)


def _errors(thing: Detection, seen: Detection) -> list[float]:
    """Errors of centre and sides, as shares of the sides; none at the border of the image."""
    if min(thing.x1, thing.y1) <= 0.005 or max(thing.x2, thing.y2) >= 0.995:
        return []
    wide, high = thing.x2 - thing.x1, thing.y2 - thing.y1
    if min(wide, high, seen.x2 - seen.x1, seen.y2 - seen.y1) <= 0:
        return []
    return [
        (seen.x1 + seen.x2 - thing.x1 - thing.x2) / 2 / wide,
        (seen.y1 + seen.y2 - thing.y1 - thing.y2) / 2 / high,
        float(np.log((seen.x2 - seen.x1) / wide)),
        float(np.log((seen.y2 - seen.y1) / high)),
    ]


def _miss_rates(side: np.ndarray, hit: np.ndarray) -> tuple[float, float]:
    """`misses` and `small_misses` of the largest likelihood, on a grid of hundredths.

    Args:
      side: [N], square roots of areas as shares of the image.
      hit: [N] bool.
    """
    rates = np.linspace(0, 1, 101)
    tiny = np.exp(-side / SMALL_SIDE)
    bins = 200
    which = np.minimum((tiny * bins).astype(int), bins - 1)
    count, hits, total = (np.bincount(which, x, bins) for x in (None, hit, tiny))
    mean, lost = total / np.maximum(count, 1), count - hits
    found = (1 - rates[:, None, None]) * (1 - rates[:, None] * mean)  # [misses, small, bin]
    found = np.clip(found, 1e-9, 1 - 1e-9)
    likelihood = (hits * np.log(found) + lost * np.log1p(-found)).sum(-1)
    misses, small = np.unravel_index(likelihood.argmax(), likelihood.shape)
    return float(rates[misses]), float(rates[small])


def _uncertainty(right: Sequence[tuple[Detection, float]]) -> float:
    """`scores`: how far the mean score of right detections is from 1, in terms of the model."""
    if not right:
        return 0.0
    side = np.array([np.sqrt((d.x2 - d.x1) * (d.y2 - d.y1)) for d, _ in right])
    expected = 2 / 3 * (1 - np.exp(-side / SMALL_SIDE) / 2)
    missing = 1 - np.mean([score for _, score in right])
    return float(np.clip(missing / (1 - expected.mean()), 0, 1))
