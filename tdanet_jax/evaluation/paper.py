"""Results of the paper (Lian and Zhang, RA-L 2024, arXiv 2404.08353), to show next to ours.

Only some rows of its tables. Where they are shown, a note says that the worlds differ (`worlds`).
"""

from __future__ import annotations

from typing import NamedTuple

from tdanet_jax.io.escaping import in_markdown
from tdanet_jax.targets import PAPER

WORLDS_DIFFER = (
    "The worlds differ: the paper used AI2-THOR 1.0.1 and its own test episodes; these rooms are "
    "rebuilt from the metadata of a later version."
)


def worlds(data: str | None) -> str:
    """The note on the paper's rows; `data` is a file of rooms other than the bundled ones."""
    return WORLDS_DIFFER if data is None else f"These rooms are those of {in_markdown(data)}."


class Rate(NamedTuple):
    """SR and SPL in percent of one agent, on one group of targets, in one bucket of L."""

    agent: str
    split: str
    group: str
    bucket: str
    sr: float
    spl: float


#: Table I. The paper trained for 6 M episodes.
RATES = (
    Rate("Random", "18/4", "seen", "L>=1", 11.2, 5.1),
    Rate("TDANet", "18/4", "seen", "L>=1", 74.7, 29.7),
    Rate("TDANet", "18/4", "unseen", "L>=1", 62.5, 25.3),
)

#: Parameters in units of 2^20, which is how the published tables count.
PARAMETERS = {"TDANet": 3.08, "MJOLNIR-o": 3.42, "SSNet": 2.00}

#: Models by the paper's names.
NAMES = {
    "tdanet": "TDANet",
    "mjolnir-o": "MJOLNIR-o",
    "ssnet": "SSNet",
    "random": "Random",
}


def rates(
    split: str, targets: str | None = PAPER
) -> dict[str, dict[str, dict[str, dict[str, float]]]]:
    """The paper's agents on a split: name -> group -> bucket -> measure; none for other targets.

    Args:
      targets: of `results.json`; the first results have none.
    """
    out: dict[str, dict[str, dict[str, dict[str, float]]]] = {}
    for rate in RATES if targets in (None, PAPER) else ():
        if rate.split == split:
            groups = out.setdefault(rate.agent, {})
            groups.setdefault(rate.group, {})[rate.bucket] = {"SR": rate.sr, "SPL": rate.spl}
    return out
