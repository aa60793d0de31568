"""MkDocs hook: turns LaTeX into MathML when the site is built; pages need no script for it."""

from __future__ import annotations

import html
import re
from typing import Any

from latex2mathml.converter import convert

#: What the extension `pymdownx.arithmatex` leaves of `$...$` and `$$...$$`.
MATH = re.compile(r'<(span|div) class="arithmatex">\\[(\[](.*?)\\[)\]]</\1>', re.DOTALL)


def on_page_content(content: str, **_: Any) -> str:
    """Replaces every formula of a rendered page."""

    def mathml(found: re.Match[str]) -> str:
        display = "block" if found[1] == "div" else "inline"
        return convert(html.unescape(found[2]), display=display)

    return MATH.sub(mathml, content)
