"""Griffe extension: a comment at a field or constant is its documentation.

reward: jax.Array  # [T, B] float32, reward of each step

#: Actions after which a test episode is truncated.
TEST_STEP_LIMITS = ...
"""

from __future__ import annotations

import io
import tokenize
from typing import Any

import griffe


class FieldComments(griffe.Extension):
    """Documents attributes that lack a docstring with their comments."""

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_: Any) -> None:
        """Called for every attribute that is found."""
        if attr.docstring is None and attr.lineno is not None and attr.endlineno is not None:
            lines = attr.lines_collection[attr.filepath]
            text = _behind(lines[attr.lineno - 1 : attr.endlineno]) or _above(lines, attr.lineno)
            if text:
                attr.docstring = griffe.Docstring(text, lineno=attr.lineno, parent=attr)


def _behind(lines: list[str]) -> str:
    """The comment at the end of a statement."""
    source = io.StringIO("\n".join(line.strip() for line in lines))
    tokens = list(tokenize.generate_tokens(source.readline))
    return " ".join(t.string[1:].strip() for t in tokens if t.type == tokenize.COMMENT)


def _above(lines: list[str], lineno: int) -> str:
    """The block of `#:` lines above line `lineno`, counted from 1."""
    found: list[str] = []
    for line in reversed(lines[: lineno - 1]):
        if not line.strip().startswith("#:"):
            break
        found.insert(0, line.strip()[2:].strip())
    return " ".join(found)
