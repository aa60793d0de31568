"""Untrusted JSON: no NaN, a limit on size, and large objects read one member at a time."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import numpy as np

from tdanet_jax.io.untrusted import FileError, regular
from tdanet_jax.io.untrusted.budgets import excess

_SPACE = " \t\n\r"
#: Escapes; then strings, whether or not they end. What is left of a document without them shows
#: its nesting, up to the first backslash outside of a string, where decoding ends.
_ESCAPES, _STRINGS = re.compile(r"\\.", re.DOTALL), re.compile(r'"[^"]*"?')
_NOT_BRACKETS = re.compile(r"[^\[\]{}]+")


def load(path: Path, links: bool = True, nan: bool = False) -> Any:
    """The content of a JSON file.

    Args:
      links: whether `path` may be a link, as a file that the user named may be.
      nan: whether NaN and Infinity, which are not JSON, are accepted.

    Raises:
      FileError: the file is missing, not JSON, or exceeds a budget.
    """
    return parse(path, _text(path, links), nan)


def load_lines(path: Path, links: bool = True) -> Iterator[tuple[int, Any]]:
    """Number (from 1) and content of each line of a file of JSON lines; None if it is not JSON."""
    for number, line in enumerate(_text(path, links, "replace").splitlines(), 1):
        try:
            yield number, parse(path, line)
        except FileError:
            yield number, None


def parse(path: Path | str, text: str, nan: bool = False) -> Any:
    """The value of a JSON text; NaN and Infinity are refused unless `nan`.

    Raises:
      FileError: it is not JSON, or exceeds a budget; the message begins with `path`.
    """
    _check_nesting(path, text)
    try:
        return (json.JSONDecoder() if nan else _decoder()).decode(text)
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"not JSON ({error})") from None


def _check_nesting(path: Path | str, text: str, counted: bool = True) -> None:
    """Raises FileError if a JSON text holds too many lists and objects, or too deep ones."""
    brackets = _NOT_BRACKETS.sub("", _STRINGS.sub("", _ESCAPES.sub("", text))).encode()
    if not brackets:
        return
    steps = np.frombuffer(brackets, np.uint8) & 2  # of the four, opening ones alone have this bit
    values, depth = int((steps > 0).sum()), int(np.cumsum(steps.astype(np.int32) - 1).max())
    for reason in (
        excess("values", values if counted else 0, f"{values} lists and objects"),
        excess("depth", depth, f"lists and objects {depth} deep"),
    ):
        if reason:
            raise FileError(path, reason)


def members(path: Path) -> Iterator[tuple[str, Any]]:
    """Names and values of the object in a JSON file, decoded one after the other.

    Raises:
      FileError: the file is missing, too large, or not a JSON object.
    """
    text = _text(path)
    _check_nesting(path, text, counted=False)  # one member after the other is in memory
    decoder = _decoder()
    at = _skip(text, 0)
    if text[at : at + 1] != "{":
        raise FileError(path, "not a JSON object")
    at = _skip(text, at + 1)
    if text[at : at + 1] == "}":
        return _end(path, text, at + 1)
    while True:
        try:
            name, at = decoder.raw_decode(text, at)
            at = _skip(text, at)
            if not isinstance(name, str) or text[at : at + 1] != ":":
                raise ValueError("a member without a name")
            value, at = decoder.raw_decode(text, _skip(text, at + 1))
        except (ValueError, RecursionError) as error:
            raise FileError(path, f"not JSON ({error})") from None
        yield name, value
        at = _skip(text, at)
        mark, at = text[at : at + 1], _skip(text, at + 1)
        if mark == "}":
            return _end(path, text, at)
        if mark != ",":
            raise FileError(path, f"not JSON (it breaks off at character {at})")


def number(path: Path | str, value: Any, what: str, most: float) -> float:
    """`value` as a float, if it is a finite number of magnitude `most` at most.

    Raises:
      FileError: it is not; the message names `what`.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise FileError(path, f"{what} is not a number")
    if not -most <= value <= most:  # NaN as well
        raise FileError(path, f"{what} is not finite or above {most:g}")
    return float(value)


def _text(path: Path, links: bool = True, errors: str = "strict") -> str:
    try:
        return regular.read_text(path, links, errors)
    except FileNotFoundError:
        raise FileError(path, "no such file") from None


def _decoder() -> json.JSONDecoder:
    return json.JSONDecoder(parse_constant=_refuse)


def _refuse(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number in JSON")


def _skip(text: str, at: int) -> int:
    while text[at : at + 1] and text[at] in _SPACE:
        at += 1
    return at


def _end(path: Path, text: str, at: int) -> None:
    if _skip(text, at) != len(text):
        raise FileError(path, "not JSON (something follows the object)")
