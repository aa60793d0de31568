"""What other detectors give: with their libraries where they are installed, and objects with the
documented fields."""

from __future__ import annotations

import math
import subprocess
import sys
from types import SimpleNamespace as Fields

import numpy as np
import pytest

from tdanet_jax.agent import detectors
from tdanet_jax.agent.detection import Detection

SIZE = (640, 480)
NAMES = {0: "mug", 1: "tv"}
#: Boxes in pixels, classes and scores; the last one reaches beyond the image.
BOXES = np.array([[64, 48, 128, 240], [320, 240, 700, 600]], np.float32)
CLASSES, SCORES = np.array([0, 1]), np.array([0.9, 0.25], np.float32)
EXPECTED = [Detection("mug", 0.1, 0.1, 0.2, 0.5, 0.9), Detection("tv", 0.5, 0.5, 1, 1, 0.25)]


def assert_same(found, expected=EXPECTED):
    assert [d.label for d in found] == [d.label for d in expected]
    for one, other in zip(found, expected, strict=True):
        box, wanted = ((d.x1, d.y1, d.x2, d.y2) for d in (one, other))
        assert box == pytest.approx(wanted, abs=1e-6)
        assert one.score == (other.score if other.score is None else pytest.approx(other.score))


def ultralytics(real, empty=False):
    rows = np.column_stack([BOXES, SCORES, CLASSES])[: 0 if empty else None]
    if real:
        torch = pytest.importorskip("torch")
        results = pytest.importorskip("ultralytics.engine.results")
        image = np.zeros((480, 640, 3), np.uint8)
        return results.Results(image, "", NAMES, boxes=torch.tensor(rows))
    boxes = Fields(xyxy=rows[:, :4], cls=rows[:, 5], conf=rows[:, 4])
    return Fields(boxes=boxes, names=NAMES, orig_shape=(480, 640))


def supervision(real, empty=False):
    kept = slice(0 if empty else None)
    given = {"xyxy": BOXES[kept], "confidence": SCORES[kept], "class_id": CLASSES[kept]}
    data = {"class_name": np.array(["mug", "tv"])[kept]}
    if real:
        library = pytest.importorskip("supervision")
        return library.Detections.empty() if empty else library.Detections(**given, data=data)
    return Fields(**given, data={} if empty else data)


def torchvision(real, empty=False):
    kept = slice(0 if empty else None)
    given = {"boxes": BOXES[kept], "labels": CLASSES[kept] + 1, "scores": SCORES[kept]}
    if real:
        torch = pytest.importorskip("torch")
        return {name: torch.tensor(values, requires_grad=name == "scores" and not empty)
                for name, values in given.items()}  # fmt: skip
    return given


def depthai(real, empty=False):
    library = pytest.importorskip("depthai") if real else None
    found = []
    for box, cls, score in zip(BOXES / [640, 480, 640, 480], CLASSES, SCORES, strict=True):
        one = library.ImgDetection() if library else Fields()
        one.label, one.confidence = int(cls), float(score)
        one.xmin, one.ymin, one.xmax, one.ymax = map(float, box)
        found.append(one)
    message = library.ImgDetections() if library else Fields()
    message.detections = [] if empty else found
    return message


def vision_msgs(version, empty=False, theta=0.0):
    """As in ROS 2 Humble and later, Galactic, Foxy and ROS 1."""
    found = []
    for (x1, y1, x2, y2), cls, score in zip(BOXES.tolist(), CLASSES, SCORES, strict=True):
        point = Fields(x=(x1 + x2) / 2, y=(y1 + y2) / 2)
        centre = Fields(position=point, theta=theta)
        if version != "humble":
            centre = Fields(**vars(point), theta=theta)
        guess = Fields(class_id=str(cls), score=float(score))
        less = Fields(class_id="7", score=0.01)
        results = [Fields(hypothesis=less, pose=None), Fields(hypothesis=guess, pose=None)]
        if version in ("foxy", "noetic"):
            number = str(cls) if version == "foxy" else int(cls)
            results = [Fields(id=number, score=float(score), pose=None)]
        box = Fields(center=centre, size_x=x2 - x1, size_y=y2 - y1)
        found.append(Fields(header=None, results=results, bbox=box, id="a track"))
    return Fields(header=None, detections=[] if empty else found)


#: Type -> an output by "real" or not and "empty" or not, and what `read` needs to be told.
TYPES = {
    "ultralytics": (ultralytics, {}),
    "supervision": (supervision, {"image_size": SIZE}),
    "torchvision": (torchvision, {"image_size": SIZE, "names": ["background", "mug", "tv"]}),
    "depthai": (depthai, {"names": NAMES}),
}


@pytest.mark.parametrize("real", [False, True], ids=["fields", "library"])
@pytest.mark.parametrize("name", TYPES)
def test_every_type_is_recognised(name, real):
    make, told = TYPES[name]
    assert_same(detectors.read(make(real), **told))
    assert_same(detectors.read([make(real)], **told))  # a list with the output for one image
    assert detectors.read(make(real, empty=True), **told) == []


def test_the_classes_of_supervision_may_be_a_list():
    given = supervision(real=False)
    given.data["class_name"] = given.data["class_name"].tolist()
    assert_same(detectors.read(given, image_size=SIZE))


@pytest.mark.parametrize("version", ["humble", "galactic", "foxy", "noetic"])
def test_every_version_of_the_messages_of_ros(version):
    info = Fields(width=640, height=480, k=[0.0] * 9)
    assert_same(detectors.read(vision_msgs(version), info, NAMES))
    assert_same(detectors.read(vision_msgs(version), info, {"0": "mug", "1": "tv"}))
    assert detectors.read(vision_msgs(version, empty=True)) == []
    named = vision_msgs("humble")
    for found, label in zip(named.detections, ("mug", "tv"), strict=True):
        found.results[-1].hypothesis.class_id = label
    assert_same(detectors.read(named, SIZE))
    assert_same(detectors.read(named, SIZE, {"mug": "mug", "9": "cup"}))


def test_without_a_confidence_there_is_no_score():
    plain = [Detection(d.label, d.x1, d.y1, d.x2, d.y2) for d in EXPECTED]
    unsure = supervision(real=False)
    unsure.confidence = None
    assert_same(detectors.read(unsure, SIZE), plain)
    boxes_alone = torchvision(real=False)
    del boxes_alone["scores"]
    assert_same(detectors.read(boxes_alone, SIZE, ["background", "mug", "tv"]), plain)
    message = vision_msgs("humble")
    for found in message.detections:
        found.results[:1] = []
        found.results[0].hypothesis.score = 0.0
    assert_same(detectors.read(message, SIZE, NAMES), plain)
    message.detections[0].results.clear()  # a box of nothing in particular
    assert_same(detectors.read(message, SIZE, NAMES), plain[1:])


@pytest.mark.parametrize("degrees", [30, -30, 90, 210])
def test_a_turned_box_becomes_the_one_around_it(degrees):
    angle = math.radians(degrees)
    box = Fields(center=Fields(x=320, y=240, theta=angle), size_x=100, size_y=40)
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    corners = [turn @ (x, y) + (320, 240) for x in (-50, 50) for y in (-20, 20)]
    low, high = np.min(corners, axis=0) / SIZE, np.max(corners, axis=0) / SIZE
    result = Fields(hypothesis=Fields(class_id="mug", score=0.5))
    message = Fields(detections=[Fields(results=[result], bbox=box)])
    assert_same(detectors.read(message, SIZE), [Detection("mug", *low, *high, 0.5)])


def test_turned_boxes_of_ultralytics():
    torch = pytest.importorskip("torch")
    results = pytest.importorskip("ultralytics.engine.results")
    turned = torch.tensor([[320, 240, 100, 40, math.pi / 6, 0.5, 0]])
    found = results.Results(np.zeros((480, 640, 3), np.uint8), "", NAMES, obb=turned)
    wide, high = (100 * math.cos(math.pi / 6) + 20, 50 + 40 * math.cos(math.pi / 6))
    box = [0.5 - wide / 1280, 0.5 - high / 960, 0.5 + wide / 1280, 0.5 + high / 960]
    assert_same(detectors.read(found), [Detection("mug", *box, 0.5)])


def test_the_name_that_depthai_gives_is_taken():
    message = depthai(real=False)
    for found, name in zip(message.detections, ("mug", "tv"), strict=True):
        found.labelName = name
    assert_same(detectors.read(message))
    other = detectors.read(message, names=["cup", "screen"])
    assert [d.label for d in other] == ["cup", "screen"]
    library = pytest.importorskip("depthai")
    real = library.ImgDetection()
    real.labelName, real.label, real.xmax, real.ymax = "mug", 3, 0.5, 0.5
    assert [d.label for d in detectors.read(Fields(detections=[real]))] == ["mug"]


def test_boxes_outside_of_the_image_are_left_out():
    boxes = np.array([[-50, 10, -5, 50], [700, 10, 720, 50], [10, -9, 20, 0], [-5, -5, 5, 5.0]])
    output = {"boxes": boxes, "labels": np.zeros(4, int), "scores": np.full(4, 1.0000001)}
    (found,) = detectors.read(output, SIZE, ["mug"])
    assert (found.x1, found.y1, found.score) == (0, 0, 1)


def test_detections_are_returned_as_they_are():
    assert detectors.read(EXPECTED) == EXPECTED
    assert detectors.read(()) == []


@pytest.mark.parametrize(
    ("output", "told", "message"),
    [
        (torchvision(False), {"names": ["a", "b", "c"]}, "torchvision: its boxes are in pixels"),
        (torchvision(False), {"image_size": SIZE}, "torchvision: class 1: say what the"),
        (torchvision(False), {"image_size": SIZE, "names": ["a"]}, "class 1: is not among the 1"),
        (torchvision(False), {"image_size": 640}, "torchvision: image_size 640: must be width and"),
        (torchvision(False), {"image_size": (640, 0)}, r"image_size \(640, 0\): must be width"),
        (supervision(False), {}, "supervision: .* detectors.read\\(output, image_size=\\(width"),
        (depthai(False), {}, r"depthai: class 0: .*detectors.read\(output, names="),
        (vision_msgs("foxy"), {"names": NAMES}, "vision_msgs: its boxes are in pixels"),
        (vision_msgs("foxy"), {"image_size": SIZE}, "vision_msgs: class 0: say"),
        ([ultralytics(False)] * 2, {}, r"a list of 2 \(types.SimpleNamespace\): .* for one image"),
        (Fields(boxes=None, obb=None, names={}, orig_shape=(1, 1)), {}, "results have no boxes"),
        (np.zeros((3, 6)), {}, "detections: numpy.ndarray is not known: give a list of Detection"),
        (
            {"boxes": np.full((1, 4), np.nan), "labels": np.zeros(1)},
            {"image_size": SIZE, "names": ["mug"]},
            "mug at .*: corners must be finite",
        ),
        (
            Fields(xyxy=BOXES, class_id=None, confidence=None, data={}),
            {"image_size": SIZE},
            "supervision: the detections have neither class_name nor class_id",
        ),
    ],
)
def test_what_cannot_be_read_is_refused_in_one_line(output, told, message):
    with pytest.raises(ValueError, match=message) as refused:
        detectors.read(output, **told)
    assert "\n" not in str(refused.value)


def test_no_library_is_imported():
    code = "import sys\nfrom tdanet_jax.agent import detectors\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not {"jax", "torch", "numpy"} & {*done.stdout.split()}
