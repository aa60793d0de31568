"""`tdanet serve`: one line in, one line out."""

from __future__ import annotations

import codecs
import io
import json
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tdanet_jax.agent.navigator import NavigatorConfig
from tdanet_jax.commands import serve
from tests.agent.test_agent import OLD_RUN

FRAME = {"detections": [{"label": "sink", "box": [0.1, 0.3, 0.5, 0.8]}], "blocked": False}
START = FRAME | {"target": "mug"}


def serve_lines(monkeypatch: pytest.MonkeyPatch, lines: list[bytes], *flags: str) -> None:
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(b"".join(lines))))
    serve.main(["--checkpoint", str(OLD_RUN), *flags])


def test_every_line_has_an_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(serve, "LONGEST", 400)
    lines = [json.dumps(frame).encode() + b"\n" for frame in (START, FRAME, FRAME)]
    long = b'{"target": "' + b"x" * 1000 + b'"}\n'
    bad = [b"\xff\n", b"\n", long]
    flags = "--max-steps 2 --forbid Done --hfov 69 --vfov 55"
    serve_lines(monkeypatch, [codecs.BOM_UTF8 + lines[0], *bad, *lines[1:]], *flags.split())
    said, told = capsys.readouterr()
    replies = [json.loads(line) for line in said.splitlines()]
    assert [reply.get("steps") for reply in replies] == [1, None, None, 2, None]
    assert replies[1]["error"].startswith("line 2: not JSON")
    assert replies[2]["error"] == "line 4: longer than 400 bytes"
    assert replies[3]["finished"]
    assert replies[4]["error"] == "line 6: no episode has begun, or it is over: give a target"
    assert told.startswith("ready: sees 69 degrees across and 55 down")


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"horizons": (30,)}, r"--horizons \[30\]: must be whole degrees"),
        ({"turn": 50}, "--turn 50: choose one of"),
        ({"grid_size": 5}, "--grid-size 5: must be from"),
        ({"hfov": 200, "vfov": 50}, "--hfov 200: must be between 5 and 180"),
        ({"hfov": 50, "vfov": 200}, "--vfov 200: must be between 5 and 180"),
        ({"hfov": 50, "aspect": 0}, "--aspect 0: must be between 0 and 100"),
        ({"hfov": 50, "aspect": 50}, "--aspect: vfov 1.0.*: must be between 5 and 180"),
        ({"hfov": 50}, "--hfov: give either vfov, in degrees, or aspect"),
        ({"horizon": 95.0}, "--horizon 95.0: must be between -90 and 90"),
    ],
)
def test_a_camera_or_grid_that_cannot_be_is_refused_with_its_flag(
    fields: dict[str, Any], message: str
) -> None:
    command = serve.Command("a", NavigatorConfig(), **fields)
    with pytest.raises(ValueError, match=f"^{message}"):
        _ = command.camera, command.grid


def test_further_words_and_names(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    (tmp_path / "more.txt").write_text(f"qwertzu {' '.join(['0.1'] * 50)}\n")
    (tmp_path / "mine.json").write_text('{"Mug": ["Humpen"]}')
    frames = [START | {"target": name} for name in ("qwertzu", "humpen")]
    serve_lines(
        monkeypatch,
        [json.dumps(frame).encode() + b"\n" for frame in frames],
        "--words", str(tmp_path / "more.txt"), "--synonyms", str(tmp_path / "mine.json"),
    )  # fmt: skip
    replies = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [reply["steps"] for reply in replies] == [1, 1]
