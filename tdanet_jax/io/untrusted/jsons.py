"""Untrusted JSON: no NaN, a limit on size, and large objects read one member at a time."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

from tdanet_jax.io import files
from tdanet_jax.io.untrusted import FileError

#: Bytes of the largest file that is read; the raw metadata of one scene is some hundred million.
LARGEST = 2 << 30
_SPACE = " \t\n\r"


def load(path: Path) -> Any:
    """The content of a JSON file; NaN and Infinity are refused.

    Raises:
      FileError: the file is missing, too large or not JSON.
    """
    text = _text(path)
    try:
        return _decoder().decode(text)
    except (ValueError, RecursionError) as error:
        raise FileError(path, f"not JSON ({error})") from None


def members(path: Path) -> Iterator[tuple[str, Any]]:
    """Names and values of the object in a JSON file, decoded one after the other.

    Raises:
      FileError: the file is missing, too large, or not a JSON object.
    """
    text = _text(path)
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


def _text(path: Path) -> str:
    if not path.is_file():
        raise FileError(path, "no such file")
    if path.stat().st_size > LARGEST:
        raise FileError(path, f"larger than {LARGEST >> 30} GiB")
    try:
        return files.read_text(path)
    except UnicodeDecodeError as error:
        raise FileError(path, f"not JSON ({error})") from None


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
