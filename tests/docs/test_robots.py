"""Blocks of the page on robots that need what only a robot has."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

import tdanet_jax
from tdanet_jax import Agent, Camera, Navigator, NavigatorConfig
from tdanet_jax.agent import lines
from tests.agent import test_detectors as outputs
from tests.support.pages import ROOT, block


@pytest.fixture(scope="module")
def agent() -> Agent:
    return tdanet_jax.load(ROOT / "agents" / "18-4-best")


def test_each_detector_is_read_as_its_line_says() -> None:
    background = ["background", "mug", "tv"]
    names: dict[str, Any] = {
        "image": None,
        "yolo": lambda image: [outputs.ultralytics(False)],
        "found": outputs.supervision(False),
        "rcnn": lambda images: [outputs.torchvision(False) for _ in images],
        "weights": outputs.Fields(meta={"categories": background}),
        "message": outputs.depthai(False),
        "array": outputs.vision_msgs("humble"),
        "camera_info": outputs.Fields(width=640, height=480),
    }
    read = 0
    for line in block("robots.md", "detectors").splitlines():
        exec(line, names)
        if line.startswith("seen = "):
            outputs.assert_same(names.pop("seen"))
            read += 1
    assert read == 5


def test_further_words(
    glove: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, agent: Agent
) -> None:
    numbers = " ".join(map(str, glove.embed("sink", None)))
    (tmp_path / "glove.6B.50d.txt").write_text(f"zwieback {numbers}\n")
    (tmp_path / "agents").symlink_to(ROOT / "agents")
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"tdanet_jax": tdanet_jax}
    exec(block("robots.md", "further words"), names)
    assert names["agent"].knows("zwieback")
    assert not agent.knows("zwieback")
    assert names["agent"].labels.resolve("notebook pc") == "Laptop"


def test_the_exchange(agent: Agent) -> None:
    config = NavigatorConfig(forbid=("LookUp", "LookDown"))
    navigator, number, answer = Navigator(agent, Camera(69, 55), config), 0, None
    for line in block("robots.md", "exchange").splitlines():
        mark, _, text = line.partition(" ")
        if mark == ">":
            number += 1
            answer = lines.answer(navigator, text, f"line {number}")
        else:
            assert json.loads(text) == answer
    assert number == 4
