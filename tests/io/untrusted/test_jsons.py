"""Untrusted JSON files."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.io.untrusted import FileError, jsons

values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner,
                                                                max_size=3),
    max_leaves=6,
)  # fmt: skip


@given(st.dictionaries(st.text(max_size=5), values, max_size=4), st.sampled_from([None, 2]))
def test_members_are_those_of_the_object(
    tmp_path_factory: pytest.TempPathFactory, content: dict, indent: int | None
) -> None:
    path = tmp_path_factory.getbasetemp() / "a.json"
    path.write_text(json.dumps(content, indent=indent), encoding="utf-8")
    assert dict(jsons.members(path)) == content == jsons.load(path)


@pytest.mark.parametrize(
    "text",
    ["", "{", '{"a": 1', '{"a": 1,', '{"a": 1,}', '{"a" 1}', '{"a": NaN}', '{"a": -Infinity}',
     '{"a": 1} {}', "[1]", '{1: 2}', '{"a": ' + "9" * 5000 + "}"],
)  # fmt: skip
def test_what_is_not_a_json_object_is_refused_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(FileError, match=r"a\.json: not ") as error:
        list(jsons.members(path))
    assert "\n" not in str(error.value)
    if text not in ("[1]",):
        with pytest.raises(FileError, match=r"a\.json: not JSON"):
            jsons.load(path)


def test_missing_and_undecodable_files(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"b\.json: no such file"):
        jsons.load(tmp_path / "b.json")
    (tmp_path / "c.json").write_bytes(b'{"a": "\xff"}')
    with pytest.raises(FileError, match=r"c\.json: not UTF-8"):
        jsons.load(tmp_path / "c.json")


@pytest.mark.parametrize("value", [float("inf"), float("nan"), 10**400, -11, True, "1", None])
def test_numbers(value: object) -> None:
    assert jsons.number("f", -9.5, "it", 10) == -9.5
    with pytest.raises(FileError, match="f: it is not"):
        jsons.number("f", value, "it", 10)


def test_messages_are_one_printable_line() -> None:
    message = str(FileError("a\nb", "bad\n\x1b[31m" + "x" * 1000))
    assert message.isprintable()
    assert len(message) < 300


@pytest.mark.parametrize(
    "text", ['{"a": ' + "[" * 100_000, '{"[]": ' + '{"]": ' * 101 + "0" + "}" * 102]
)
def test_deep_nesting_is_refused_before_it_is_decoded(tmp_path: Path, text: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    for read in (jsons.load, lambda path: list(jsons.members(path))):
        with pytest.raises(FileError, match=r"a\.json: lists and objects \d+ deep, more than 100"):
            read(path)


@given(values)
def test_brackets_in_strings_are_no_nesting(value: object) -> None:
    text = json.dumps({"\\": ["[" * 300, '\\"' + "{" * 300, value]})
    assert jsons.parse("f", text) == json.loads(text)


@pytest.mark.parametrize("text", ['"' + '\\"' * 500_000, "[" + "[]," * 500_000 + "[]]"])
def test_whatever_is_long_is_read_in_linear_time(text: str) -> None:
    with contextlib.suppress(FileError):
        jsons.parse("f", text)  # in quadratic time, it would take hours


def test_budgets_are_raised_through_the_environment(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.json"
    path.write_text("[[], [], {}]")
    monkeypatch.setenv("TDANET_BUDGETS", "values=3")
    with pytest.raises(FileError, match="set TDANET_BUDGETS=values=4"):
        jsons.load(path)
    monkeypatch.setenv("TDANET_BUDGETS", "values=4,size=12")
    assert jsons.load(path) == [[], [], {}]
    monkeypatch.setenv("TDANET_BUDGETS", "size=11")
    with pytest.raises(FileError, match="has 12 bytes, more than 11"):
        jsons.load(path)
    for wrong in ("values=", "values=nan", "values=-1", "value=3", "x"):
        monkeypatch.setenv("TDANET_BUDGETS", wrong)
        with pytest.raises(ValueError, match="TDANET_BUDGETS: "):
            jsons.load(path)


def test_lines_that_are_cut_short_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.jsonl").write_text('{"a": 1}\n{"a"\n[2]\n')
    assert list(jsons.load_lines(tmp_path / "a.jsonl")) == [(1, {"a": 1}), (2, None), (3, [2])]
