"""The measured noise of a detector is that which the boxes were given."""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tdanet_jax.agent import measured_noise
from tdanet_jax.agent.detection import Detection
from tdanet_jax.commands import noise as command
from tdanet_jax.io.untrusted import FileError
from tdanet_jax.sense_noise import DETECTOR, NONE, SenseNoise

THINGS = ("Mug", "Bowl", "Sofa", "Chair", "Book")


def labelled(rng: np.random.Generator, images: int = 1500) -> list[list[Detection]]:
    """Images with up to four boxes of all sizes, one in each quarter, not at the border."""
    out = []
    for _ in range(images):
        quarters = rng.permutation(4)[: rng.integers(5)]
        out.append([])
        for quarter in quarters.tolist():
            size = 0.4 * rng.random(2) ** 2 + 0.01
            low = np.array(divmod(quarter, 2)) / 2 + 0.03 + rng.random(2) * (0.44 - size)
            out[-1].append(Detection(str(rng.choice(THINGS)), *low, *(low + size)))
    return out


def detected(
    rng: np.random.Generator, truth: list[list[Detection]], noise: SenseNoise
) -> list[list[Detection]]:
    """What a detector with this noise makes of the images, by the definitions of docs/noise.md."""
    level: dict[str, Any] = vars(noise)
    frames = []
    for there in truth:
        frame = []
        for one in there:
            tiny = math.exp(-math.sqrt((one.x2 - one.x1) * (one.y2 - one.y1)) / 0.1)
            if rng.random() > (1 - level["misses"]) * (1 - level["small_misses"] * tiny):
                continue
            size = np.array([one.x2 - one.x1, one.y2 - one.y1])
            centre = np.array([one.x1, one.y1]) + size / 2 + level["jitter"] * size * normal(rng)
            half = size * np.exp(level["jitter"] * normal(rng)) / 2
            others = [name for name in THINGS if name != one.label]
            wrong = rng.random() < level["swaps"]
            sure = max(rng.random(2)) * (1 - tiny / 2)
            frame.append(
                Detection.clipped(
                    str(rng.choice(others)) if wrong else one.label,
                    *(centre - half), *(centre + half), 1 - level["scores"] * (1 - sure),
                )
            )  # fmt: skip
        again = [one for one in frame if rng.random() < level["duplicates"]]
        false = [Detection("Mug", 0.48, 0.0, 0.52, 0.02)] * rng.poisson(level["false_positives"])
        frames.append([*frame, *again, *false])
    return frames


def normal(rng: np.random.Generator) -> np.ndarray:
    return rng.standard_normal(2)


@pytest.mark.parametrize(
    "noise",
    [
        NONE,
        DETECTOR,
        SenseNoise(misses=0.4, duplicates=0.2),
        SenseNoise(small_misses=0.8, false_positives=0.7, scores=0.5),
        SenseNoise(swaps=0.2, jitter=0.05),
    ],
    ids=str,
)
def test_it_finds_the_levels_that_the_boxes_were_given(noise: SenseNoise) -> None:
    rng = np.random.default_rng(0)
    truth = labelled(rng)
    found = measured_noise.measure(truth, detected(rng, truth, noise))
    for name, level in vars(noise).items():
        tolerance = {
            "small_misses": 0.1,
            "misses": 0.03,
            "false_positives": 0.06,
            "duplicates": 0.03,
        }.get(name, 0.02)
        assert getattr(found.noise, name) == pytest.approx(level, abs=tolerance), name
    assert found.images == 1500
    assert found.objects == sum(map(len, truth))


def box(label: str, x: float, score: float | None = None) -> Detection:
    return Detection(label, x, 0.4, x + 0.1, 0.5, score)


def test_what_is_counted() -> None:
    truth = [[box("Mug", 0.2), box("Bowl", 0.6)], [], [box("Sofa", 0.3)]]
    found = [
        [box("Bowl", 0.201), box("Mug", 0.21), box("Mug", 0.2), box("Cup", 0.61)],
        [box("Sofa", 0.1)],
        [],
    ]
    counted = measured_noise.measure(truth, found)
    # The mug's own label goes before a better box; the bowl is called a cup; the sofa is missed.
    assert dataclasses.replace(counted, noise=NONE) == measured_noise.Measured(
        images=3, objects=3, found=2, mislabelled=1, duplicated=2, invented=1, noise=NONE
    )
    noise = counted.noise
    assert (noise.swaps, noise.false_positives) == (0.5, 0.333)
    assert noise.duplicates == 0.5  # as far as the level goes
    assert noise.scores == 0  # there are none


def test_boxes_at_the_border_say_nothing_of_jitter() -> None:
    cut = Detection("Mug", 0.0, 0.4, 0.1, 0.5)
    seen = Detection("Mug", 0.0, 0.4, 0.13, 0.5)
    assert measured_noise.measure([[cut]], [[seen]]).noise.jitter == 0
    inside = [Detection("Mug", d.x1 + 0.1, d.y1, d.x2 + 0.1, d.y2) for d in (cut, seen)]
    expected = math.sqrt((0.15**2 + math.log(1.3) ** 2) / 4)
    [thing, wide] = inside
    assert measured_noise.measure([[thing]], [[wide]]).noise.jitter == round(expected, 3)


@pytest.mark.parametrize(
    ("truth", "found", "iou", "message"),
    [
        ([[box("Mug", 0.2)]], [], 0.5, "1 labelled images and 0 with detections"),
        ([[]], [[box("Mug", 0.2)]], 0.5, "no labelled object in any image"),
        ([[box("Mug", 0.2)]], [[]], 1.0, "iou 1.0: must be between 0 and 1"),
    ],
)
def test_what_cannot_be_measured_is_refused(
    truth: Any, found: Any, iou: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        measured_noise.measure(truth, found, iou)


def test_a_confusion_matrix_tells_misses_swaps_and_false_positives() -> None:
    matrix = np.array([[70, 5, 8], [10, 60, 4], [20, 35, 0]])
    noise = measured_noise.from_confusion(matrix, images=30)
    assert noise == SenseNoise(misses=0.275, swaps=0.103, false_positives=0.4)
    with pytest.raises(ValueError, match=r"shape \(2, 3\): must be"):
        measured_noise.from_confusion(matrix[:2], 30)
    with pytest.raises(ValueError, match="at least one object"):
        measured_noise.from_confusion(np.zeros((3, 3)), 30)
    with pytest.raises(ValueError, match="images 0: must be positive"):
        measured_noise.from_confusion(matrix, 0)


TRUTH: dict[str, Any] = {
    "images": [{"id": 7, "width": 200, "height": 100}, {"id": 8, "width": 100, "height": 100}],
    "categories": [{"id": 1, "name": "mug"}, {"id": 5, "name": "sofa"}],
    "annotations": [
        {"image_id": 7, "category_id": 1, "bbox": [20, 10, 40, 20]},
        {"image_id": 7, "category_id": 1, "bbox": [0, 0, 200, 100], "iscrowd": 1},
        {"image_id": 8, "category_id": 5, "bbox": [90, 0, 40, 50]},
    ],
}
FOUND = [
    {"image_id": 7, "category_id": 1, "bbox": [22, 10, 40, 20], "score": 0.75},
    {"image_id": 8, "category_id": 5, "bbox": [120, 0, 40, 50], "score": 0.9},
    {"image_id": 8, "category_id": 1, "bbox": [0, 0, 5, 5], "score": 0.1},
]


def written(folder: Path, truth: Any, found: Any) -> tuple[Path, Path]:
    for name, content in (("truth", truth), ("found", found)):
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder / "truth.json", folder / "found.json"


def test_files_in_cocos_formats_are_read(tmp_path: Path) -> None:
    truth, found = measured_noise.read_coco(*written(tmp_path, TRUTH, FOUND))
    assert truth == [[Detection("mug", 0.1, 0.1, 0.3, 0.3)], [Detection("sofa", 0.9, 0, 1, 0.5)]]
    # One box lies outside of its image, another's score is too low.
    assert found == [[Detection("mug", 0.11, 0.1, 0.31, 0.3, 0.75)], []]


@pytest.mark.parametrize(
    "files", [("a.jpg", "b.jpg"), ("000012.jpg", "13.png"), ("8.jpg", "9.jpg")]
)
def test_images_may_be_named_by_their_files(tmp_path: Path, files: tuple[str, str]) -> None:
    """As ultralytics names them: "a", or 12 if the name is a number."""
    pairs = zip(TRUTH["images"], files, strict=True)
    images = [{**image, "file_name": f"shots/{name}"} for image, name in pairs]
    stems = [Path(name).stem for name in files]
    called = [int(stem) if stem.isdecimal() else stem for stem in stems]
    named = dict(zip((7, 8), called, strict=True))
    renamed = [{**one, "image_id": named[one["image_id"]]} for one in FOUND]
    expected = measured_noise.read_coco(*written(tmp_path, TRUTH, FOUND))
    truth = {**TRUTH, "images": images}
    assert measured_noise.read_coco(*written(tmp_path, truth, renamed)) == expected
    assert measured_noise.read_coco(*written(tmp_path, truth, FOUND)) == expected


def test_images_that_ids_and_files_name_differently_are_refused(tmp_path: Path) -> None:
    files = {7: "8.jpg", 8: "7.jpg"}
    images = [{**image, "file_name": files[image["id"]]} for image in TRUTH["images"]]
    with pytest.raises(FileError, match="image 7: is the id of one image and the file name of an"):
        measured_noise.read_coco(*written(tmp_path, {**TRUTH, "images": images}, FOUND))
    images = [{**image, "file_name": f"{image['id']}/1.jpg"} for image in TRUTH["images"]]
    found = [{**one, "image_id": 1} for one in FOUND]
    with pytest.raises(FileError, match="image 1: two images have this file name"):
        measured_noise.read_coco(*written(tmp_path, {**TRUTH, "images": images}, found))


@pytest.mark.parametrize(
    ("truth", "found", "message"),
    [
        ({**TRUTH, "images": 3}, FOUND, r"truth.json: images: not a list of objects"),
        (TRUTH, {"a": 1}, r"found.json: not a list of objects"),
        (TRUTH, [{**FOUND[0], "image_id": 9}], "found.json: 0: image 9 is not in the labels"),
        (TRUTH, [{**FOUND[0], "category_id": 0}], "category 0 is not in the labels; do both files"),
        (TRUTH, [FOUND[0], {**FOUND[0], "bbox": [1, 2]}], "found.json: 1, bbox: not four numbers"),
        (TRUTH, [{**FOUND[0], "score": 2}], "found.json: 0, score is not finite or above 1"),
        ({**TRUTH, "images": [{"id": 7, "width": 0, "height": 5}]}, FOUND, "must be positive"),
        ({**TRUTH, "categories": [{"id": []}]}, FOUND, "categories, 0, id: not a number"),
        ({**TRUTH, "categories": [{"id": 1}]}, FOUND, "categories, 0, name: not a string"),
    ],
)
def test_an_odd_file_is_one_line_that_names_the_entry(
    truth: Any, found: Any, message: str, tmp_path: Path
) -> None:
    with pytest.raises(FileError, match=message) as error:
        measured_noise.read_coco(*written(tmp_path, truth, found))
    assert "\n" not in str(error.value)


def test_the_command_prints_levels_that_noise_takes(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    truth, found = written(tmp_path, TRUTH, FOUND)
    command.main(["--truth", str(truth), "--found", str(found)])
    assert capsys.readouterr().out.split("\n")[:2] == [
        "2 images, 2 objects: 1 found, of these 0 with a wrong label; 0 duplicates and 0 false "
        "positives",
        "--noise misses=0.5,jitter=0.025,scores=0.661",  # 0.25 / (1 - 2 / 3 (1 - e^-2 / 2)),
    ]
    truth, found = written(tmp_path, TRUTH, [{**one, "category_id": 5} for one in FOUND])
    command.main(["--truth", str(truth), "--found", str(found)])
    assert "most labels are wrong: do both files number categories" in capsys.readouterr().err
