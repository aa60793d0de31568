"""The output of other detectors, as the detections of an agent.

Imports none of their libraries: `read` recognises an output by its fields. It accepts the output
for one image of ultralytics, supervision, torchvision, depthai (versions 2 and 3), and
`vision_msgs/Detection2DArray` (ROS 1, and ROS 2 from Foxy on).

Labels are those that the detector gives. Where it gives numbers, `names` says what they mean.
Boxes are clipped to the image, and those outside of it left out; of turned boxes, the enclosing
ones are taken. A detection without a confidence has no score.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from tdanet_jax.agent.detection import Detection

#: What classes' numbers mean: by number, or a list in which they are indices.
Names = Mapping[Any, str] | Sequence[str]


def read(output: Any, image_size: Any = None, names: Names | None = None) -> list[Detection]:
    """The detections in one image.

    Args:
      output: of a detector; a list with the output for a single image, as ultralytics and
        torchvision give it; or a list of `Detection`, which is returned as it is.
      image_size: width and height in pixels, or anything that has them, such as a `CameraInfo`.
        supervision, torchvision and `vision_msgs` need it, because their boxes are in pixels.
      names: what the classes' numbers mean, in place of what the output says, or if it does not
        say; for torchvision `weights.meta["categories"]`.

    Raises:
      ValueError: the type is unknown, the size or the names are needed, or a box is none; the
        message is one line.
    """
    if isinstance(output, list | tuple):
        if all(isinstance(found, Detection) for found in output):
            return [*output]
        if len(output) != 1:
            kinds = ", ".join(sorted({_kind(one) for one in output}))
            raise ValueError(f"detections: a list of {len(output)} ({kinds}): {_KNOWN}")
        (output,) = output
    if _has(output, "orig_shape", "names", "boxes"):
        return _ultralytics(output, names)
    if _has(output, "xyxy", "confidence", "class_id"):
        return _supervision(output, image_size, names)
    if isinstance(output, Mapping) and {"boxes", "labels"} <= output.keys():
        return _torchvision(output, image_size, names)
    if _has(output, "detections"):
        first = next(iter(output.detections), None)
        if first is None or _has(first, "xmin", "label"):
            return _depthai(output, names)
        if _has(first, "bbox", "results"):
            return _vision_msgs(output, image_size, names)
    raise ValueError(f"detections: {_kind(output)} is not known: {_KNOWN}")


_KNOWN = (
    "give a list of Detection, or for one image the output of ultralytics, supervision, "
    "torchvision, depthai or vision_msgs"
)


def _kind(thing: Any) -> str:
    kind = type(thing)
    return kind.__name__ if kind.__module__ == "builtins" else f"{kind.__module__}.{kind.__name__}"


def _ultralytics(results: Any, names: Names | None) -> list[Detection]:
    """An `ultralytics.engine.results.Results`, with upright or with turned boxes."""
    found = results.boxes if results.boxes is not None else results.obb
    if found is None:
        raise ValueError("ultralytics: the results have no boxes; use a model that detects")
    height, width = results.orig_shape
    labels = [_label("ultralytics", c, names or results.names) for c in found.cls.tolist()]
    rows = zip(labels, found.xyxy.tolist(), found.conf.tolist(), strict=True)
    return in_image(rows, width, height)


def _supervision(detections: Any, image_size: Any, names: Names | None) -> list[Detection]:
    """A `supervision.Detections`; what its classes are called may be in its `data`."""
    width, height = _size("supervision", image_size)
    boxes = detections.xyxy.tolist()
    given = detections.data.get("class_name") if names is None else None
    classes = detections.class_id if given is None else given
    if classes is None:
        raise ValueError("supervision: the detections have neither class_name nor class_id")
    listed = classes if isinstance(classes, list) else classes.tolist()
    labels = [_label("supervision", cls, names) for cls in listed]
    scores = detections.confidence
    rated = [None] * len(boxes) if scores is None else scores.tolist()
    return in_image(zip(labels, boxes, rated, strict=True), width, height)


def _torchvision(
    output: Mapping[str, Any], image_size: Any, names: Names | None
) -> list[Detection]:
    """What a detection model of torchvision gives for one image."""
    width, height = _size("torchvision", image_size)
    boxes = output["boxes"].tolist()
    labels = [_label("torchvision", cls, names) for cls in output["labels"].tolist()]
    scores = output["scores"].tolist() if "scores" in output else [None] * len(boxes)
    return in_image(zip(labels, boxes, scores, strict=True), width, height)


def _depthai(message: Any, names: Names | None) -> list[Detection]:
    """A `depthai.ImgDetections` or `SpatialImgDetections`; version 3 may give `labelName`."""
    rows = []
    for found in message.detections:
        named = getattr(found, "labelName", "") if names is None else ""
        label = named or _label("depthai", found.label, names)
        rows.append((label, (found.xmin, found.ymin, found.xmax, found.ymax), found.confidence))
    return in_image(rows)


def _vision_msgs(message: Any, image_size: Any, names: Names | None) -> list[Detection]:
    """A `vision_msgs/Detection2DArray`.

    Of several hypotheses about one object, the likeliest counts. A detection without any is left
    out. A score of 0, which is what a message holds where a detector sets none, is no score.
    """
    width, height = _size("vision_msgs", image_size)
    rows = []
    for found in message.detections:
        # Since version 3 (Galactic), class and score are in `hypothesis`.
        guesses = [getattr(result, "hypothesis", result) for result in found.results]
        if not guesses:
            continue
        best = max(guesses, key=lambda guess: guess.score)
        cls = best.class_id if hasattr(best, "class_id") else best.id
        label = _label("vision_msgs", cls, names)
        rows.append((label, _upright(found.bbox), best.score or None))
    return in_image(rows, width, height)


def _upright(bbox: Any) -> tuple[float, ...]:
    """The corners of the upright box around a `vision_msgs/BoundingBox2D`, in pixels."""
    # Since version 4 (Humble), x and y are in `position`.
    centre = getattr(bbox.center, "position", bbox.center)
    sine, cosine = abs(math.sin(bbox.center.theta)), abs(math.cos(bbox.center.theta))
    wide = (bbox.size_x * cosine + bbox.size_y * sine) / 2
    high = (bbox.size_x * sine + bbox.size_y * cosine) / 2
    return centre.x - wide, centre.y - high, centre.x + wide, centre.y + high


def in_image(
    rows: Iterable[tuple[str, Sequence[float], float | None]],
    width: float = 1.0,
    height: float = 1.0,
) -> list[Detection]:
    """Detections from labels, boxes and scores, clipped, without those outside of the image.

    Args:
      rows: a label, the corners x1, y1, x2, y2, and a score or None.
      width: of the image, in the unit of the corners; by default they are shares.
      height: likewise.

    Raises:
      ValueError: a box is none, or a score is not from 0 to 1.
    """
    out = []
    for label, (left, top, right, bottom), score in rows:
        x1, y1, x2, y2 = left / width, top / height, right / width, bottom / height
        if x2 <= 0 or y2 <= 0 or x1 >= 1 or y1 >= 1:
            continue
        if score is not None and 1 < score < 1 + 1e-3:
            score = 1.0  # rounded
        out.append(Detection.clipped(label, x1, y1, x2, y2, score))
    return out


def _label(source: str, cls: Any, names: Names | None) -> str:
    """What a class is called."""
    if isinstance(cls, str) and not cls.isdigit():
        return names.get(cls, cls) if isinstance(names, Mapping) else cls
    if names is None:
        raise ValueError(
            f"{source}: class {cls}: say what the classes' numbers mean: "
            "detectors.read(output, names=...)"
        )
    number = int(cls)
    if isinstance(names, Mapping):
        found = next((names[key] for key in (number, str(number)) if key in names), None)
    else:
        found = names[number] if 0 <= number < len(names) else None
    if found is None:
        raise ValueError(f"{source}: class {number}: is not among the {len(names)} names")
    return found


def _size(source: str, size: Any) -> tuple[float, float]:
    """Width and height of an image in pixels."""
    if size is None:
        raise ValueError(
            f"{source}: its boxes are in pixels: say in an image of which size, "
            "detectors.read(output, image_size=(width, height))"
        )
    if _has(size, "width", "height"):
        size = size.width, size.height
    try:
        width, height = map(float, size)
    except (TypeError, ValueError):
        width = height = 0.0
    if not (0 < width < math.inf and 0 < height < math.inf):
        raise ValueError(f"{source}: image_size {size}: must be width and height, above 0")
    return width, height


def _has(thing: Any, *names: str) -> bool:
    return all(hasattr(thing, name) for name in names)
