"""`results.json` from another machine: read, or refused with the field's name."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import pytest

from tdanet_jax.evaluation import results_file
from tdanet_jax.io.untrusted import FileError

BUNDLED = Path(__file__).parents[2] / "agents" / "18-4-best" / "results.json"


def test_what_an_evaluation_wrote_is_read() -> None:
    assert results_file.read(BUNDLED) == json.loads(BUNDLED.read_text())


def test_results_of_a_validation_are_read(tmp_path: Path) -> None:
    content = json.loads(BUNDLED.read_text()) | {"split": "Mug,CD-validation"}
    (tmp_path / "results.json").write_text(json.dumps(content))
    assert results_file.read(tmp_path / "results.json") == content


@pytest.mark.parametrize(
    ("place", "value"),
    [
        ("split", "../../escaped"), ("split", "../../Mug"), ("split", "14/8,"),
        ("split", "-validation"),
        ("split", None), ("model", 3),
        ("policy", "a\x1b[2J"), ("data_version", None), ("seed", -1), ("seed", 0.5),
        ("seed", 10**400), ("steps", "many"), ("episodes_trained", True), ("data", 3),
        ("seen", None), ("seen", []), ("seen/L>=1", None), ("seen/L>=1/SR", 1e308),
        ("seen/L>=5/SPL", "x"), ("seen/L>=1/SR_ci", [1]), ("seen/L>=1/SPL_ci", [1, None]),
        ("unseen/L>=1/n", None), ("by_room", None), ("by_room/kitchen", 3),
        ("by_room/kitchen/seen/L>=1/SR", []),
    ],
)  # fmt: skip
def test_odd_fields_are_named(tmp_path: Path, place: str, value: Any) -> None:
    content = copy.deepcopy(json.loads(BUNDLED.read_text()))
    *parts, last = place.split("/")
    node = content
    for part in parts:
        node = node[part]
    node[last] = value
    path = tmp_path / "results.json"
    path.write_text(json.dumps(content))
    with pytest.raises(FileError, match=rf"results\.json: .*{last.split('_')[0]}") as caught:
        results_file.read(path)
    assert str(caught.value).isprintable()
