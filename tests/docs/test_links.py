"""Links between the pages lead somewhere, also for who reads them outside of the site."""

from __future__ import annotations

import re

import pytest

from tests.support.pages import BLOCK, PAGES, ROOT, prose

#: Headings of the API reference are made from the code.
REFERENCE = "docs/reference/"


def anchors(page: str) -> set[str]:
    """What the headings of a page are called in links."""
    headings = re.findall(r"^#+ (.+)$", BLOCK.sub("", (ROOT / page).read_text()), re.MULTILINE)
    words = [re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings]
    return {re.sub(r"\s", "-", heading) for heading in words}


@pytest.mark.parametrize("page", [*PAGES, "CHANGELOG.md"])
def test_links_lead_somewhere(page: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        file = (ROOT / page).parent / path if path else ROOT / page
        assert file.exists(), f"{page}: {target}"
        where = str(file.resolve().relative_to(ROOT))
        if anchor and not where.startswith(REFERENCE):
            assert anchor in anchors(where), f"{page}: {target}"
