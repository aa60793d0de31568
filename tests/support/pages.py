"""The pages of the documentation and their code blocks, so that tests can run what they show.

A comment directly above a block says what becomes of it: `<!-- not run: reason -->`,
`<!-- from path -->` for an excerpt of a file, or a name by which a test of its own takes it.
Without a comment a Python block is executed and a shell block is parsed (`tests/docs`).
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
#: Every page, by its path from the root.
PAGES = sorted(
    str(path.relative_to(ROOT))
    for path in (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS.rglob("*.md"))
)
BLOCK = re.compile(
    r"(?:^<!-- ([^\n]+) -->\n)?^```(\w*)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE
)


class Block(NamedTuple):
    """A fenced block of code."""

    note: str  # the comment above it, or ""
    language: str
    code: str
    line: int  # of its first line of code in the page


def blocks(page: str) -> list[Block]:
    """All blocks of a page, from top to bottom."""
    text = (ROOT / page).read_text()
    found = []
    for match in BLOCK.finditer(text):
        line = text.count("\n", 0, match.start(3)) + 1
        found.append(Block(match[1] or "", match[2], match[3], line))
    return found


def block(page: str, name: str) -> str:
    """The code on a page of `docs` below the comment of this name."""
    (found,) = (one.code for one in blocks(f"docs/{page}") if one.note == name)
    return found


def prose(page: str) -> str:
    """A page without its blocks of code."""
    return BLOCK.sub("", (ROOT / page).read_text())
