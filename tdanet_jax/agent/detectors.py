"""What other detectors give, as the detections of an agent.

Imports none of their libraries: what counts is which fields an output has. `read` recognises its
type; it accepts the output for one image of ultralytics, supervision, torchvision, depthai, and
`vision_msgs/Detection2DArray` of ROS.

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
    """The detections in one image, from whatever output this module knows.

    Args:
      output: of a detector; a list with the output for a single image, as ultralytics and
        torchvision give it; or a list of `Detection`, which is returned as it is.
      image_size: width and height in pixels, or anything that has them, such as a `CameraInfo`.
        supervision, torchvision and `vision_msgs` need it, because their boxes are in pixels.
      names: what the classes' numbers mean, if the output does not say.

    Raises:
      ValueError: the type is unknown, the size or the names are needed, or a box is none; the
        message is one line.
    """
    if isinstance(output, list | tuple):
        if all(isinstance(found, Detection) for found in output):
            return [*output]
        if len(output) != 1:
            raise ValueError(f"detections: {len(output)} outputs; give that for one image")
        (output,) = output
    if _has(output, "orig_shape", "names", "boxes"):
        return from_ultralytics(output, names)
    if _has(output, "xyxy", "confidence", "class_id"):
        return from_supervision(output, image_size, names)
    if isinstance(output, Mapping) and {"boxes", "labels"} <= output.keys():
        return from_torchvision(output, image_size, names)
    if _has(output, "detections"):
        first = next(iter(output.detections), None)
        if first is None or _has(first, "xmin", "label"):
            return from_depthai(output, names)
        if _has(first, "bbox", "results"):
            return from_vision_msgs(output, image_size, names)
    kind = f"{type(output).__module__}.{type(output).__qualname__}"
    raise ValueError(
        f"detections: {kind} is not known; give a list of Detection, or the output of ultralytics, "
        "supervision, torchvision, depthai or vision_msgs"
    )


def from_ultralytics(results: Any, names: Names | None = None) -> list[Detection]:
    """An `ultralytics.engine.results.Results`, with upright or with turned boxes.

    Args:
      results: for one image.
      names: by class; by default the model's own.

    Raises:
      ValueError: it has no boxes, as of a model that classifies images.
    """
    found = results.boxes if results.boxes is not None else results.obb
    if found is None:
        raise ValueError("ultralytics: the results have no boxes; use a model that detects")
    height, width = results.orig_shape
    labels = [_label("ultralytics", c, names or results.names) for c in found.cls.tolist()]
    rows = zip(labels, found.xyxy.tolist(), found.conf.tolist(), strict=True)
    return in_image(rows, width, height)


def from_supervision(
    detections: Any, image_size: Any, names: Names | None = None
) -> list[Detection]:
    """A `supervision.Detections`, whose boxes are in pixels.

    Args:
      detections: in one image.
      image_size: as in `read`.
      names: by class; by default those in `data["class_name"]`.

    Raises:
      ValueError: the size or the names are missing.
    """
    width, height = _size("supervision", image_size)
    boxes = detections.xyxy.tolist()
    given = detections.data.get("class_name") if names is None else None
    classes = detections.class_id if given is None else given
    if classes is None:
        raise ValueError("supervision: the detections have neither class_name nor class_id")
    labels = [_label("supervision", cls, names) for cls in classes.tolist()]
    scores = detections.confidence
    listed = [None] * len(boxes) if scores is None else scores.tolist()
    return in_image(zip(labels, boxes, listed, strict=True), width, height)


def from_torchvision(
    output: Mapping[str, Any], image_size: Any, names: Names | None
) -> list[Detection]:
    """What a detection model of torchvision gives for one image: boxes, labels and scores.

    Args:
      output: for one image.
      image_size: as in `read`.
      names: by class, such as `weights.meta["categories"]`.

    Raises:
      ValueError: the size or the names are missing.
    """
    width, height = _size("torchvision", image_size)
    boxes = output["boxes"].tolist()
    labels = [_label("torchvision", cls, names) for cls in output["labels"].tolist()]
    scores = output["scores"].tolist() if "scores" in output else [None] * len(boxes)
    return in_image(zip(labels, boxes, scores, strict=True), width, height)


def from_depthai(message: Any, names: Names | None = None) -> list[Detection]:
    """A `depthai.ImgDetections` or `SpatialImgDetections`, of version 2 or 3.

    Args:
      message: of one image.
      names: by class; by default those that version 3 gives (`labelName`).

    Raises:
      ValueError: the names are missing.
    """
    rows = []
    for found in message.detections:
        named = getattr(found, "labelName", "") if names is None else ""
        label = named or _label("depthai", found.label, names)
        rows.append((label, (found.xmin, found.ymin, found.xmax, found.ymax), found.confidence))
    return in_image(rows)


def from_vision_msgs(message: Any, image_size: Any, names: Names | None = None) -> list[Detection]:
    """A `vision_msgs/Detection2DArray`, of any version from ROS 1 and ROS 2 Foxy on.

    Of several hypotheses about one object, the likeliest counts. A detection without any is left
    out. A score of 0, which is what a message holds where a detector sets none, is no score.

    Args:
      message: of one image.
      image_size: as in `read`.
      names: by class, which is a text that is often a number; not needed if it is a name.

    Raises:
      ValueError: the size or the names are missing.
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
        raise ValueError(f"{source}: class {cls}: give `names`, what the classes' numbers mean")
    number = int(cls)
    if isinstance(names, Mapping):
        found = next((names[key] for key in (number, str(number)) if key in names), None)
    else:
        found = names[number] if 0 <= number < len(names) else None
    if found is None:
        raise ValueError(f"{source}: class {number}: is not among the {len(names)} `names`")
    return found


def _size(source: str, size: Any) -> tuple[float, float]:
    """Width and height of an image in pixels."""
    if size is None:
        raise ValueError(f"{source}: boxes are in pixels: give `image_size`, width and height")
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
