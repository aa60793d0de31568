"""Names from files, made safe where they are shown: one function for each medium."""

from __future__ import annotations

import json
import re
from typing import Any

_MARKDOWN = re.compile(r"([\\`*\[\]|])")


def in_name(text: object) -> str:
    """A name without control characters, which a terminal would obey, and without line breaks."""
    return "".join(c if c.isprintable() else "?" for c in str(text))


def in_terminal(text: object) -> str:
    """Text for a terminal; its lines stay apart."""
    return "\n".join(map(in_name, str(text).split("\n")))


def in_line(text: object, longest: int | None = None) -> str:
    """Text for one line of a terminal, cut after `longest` characters."""
    line = " ".join(str(text).split())
    if longest is not None and len(line) > longest:
        line = line[:longest] + " ..."
    return in_terminal(line)


def in_figure(text: object) -> str:
    """Text for Matplotlib, which would read what is between dollar signs as a formula."""
    return in_terminal(text).replace("$", r"\$")


def in_markdown(text: object) -> str:
    """Text for a line or a cell of a table in Markdown: no markup, and no HTML."""
    plain = in_line(text).replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    return _MARKDOWN.sub(r"\\\1", plain)


def in_script(value: Any) -> str:
    """JSON that is safe inside a `script` element of HTML, whatever its strings contain."""
    text = json.dumps(value, separators=(",", ":"), allow_nan=False)
    for sign in "<>&":
        text = text.replace(sign, f"\\u{ord(sign):04x}")
    return text
