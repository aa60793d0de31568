"""Results of the paper (Lian and Zhang, RA-L 2024, arXiv 2404.08353), to show next to ours.

All rows of its Tables I to V. Where they are shown, a note says that the worlds differ (`worlds`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from tdanet_jax.evaluation.metrics import BUCKETS
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


#: Table I: all 22 classes are seen. SR and SPL for L >= 1, then for L >= 5, as in all tables.
_SEEN_22_0 = {
    "Random": (11.2, 5.1, 1.1, 0.5),
    "Baseline": (35.0, 10.3, 25.0, 10.5),
    "SP": (35.4, 10.9, 23.8, 10.7),
    "SAVN": (35.7, 9.3, 23.9, 9.4),
    "MJOLNIR-r": (54.8, 19.2, 41.7, 18.9),
    "MJOLNIR-o": (65.3, 21.1, 50.0, 20.9),
    "SSNet": (63.7, 22.8, 42.9, 21.3),
    "Li et al.": (71.0, 19.6, 61.9, 24.2),
    "TDANet": (78.2, 30.6, 67.0, 33.4),
}
#: Table III, split 18/4. It does not say which MJOLNIR it compares with.
_UNSEEN_18_4 = {
    "Random": (10.8, 2.1, 0.9, 0.3),
    "Baseline": (16.9, 8.7, 5.3, 3.1),
    "MJOLNIR": (20.7, 7.1, 10.6, 4.5),
    "SSNet": (28.6, 9.0, 12.5, 5.6),
    "TDANet": (62.5, 25.3, 47.4, 23.8),
}
_SEEN_18_4 = {
    "Random": (9.5, 3.3, 1.0, 0.4),
    "Baseline": (17.7, 8.3, 5.3, 2.6),
    "MJOLNIR": (51.9, 16.5, 33.0, 14.2),
    "SSNet": (59.0, 19.7, 38.6, 18.3),
    "TDANet": (74.7, 29.7, 62.9, 32.2),
}
#: Table III, split 14/8.
_UNSEEN_14_8 = {
    "Random": (8.2, 3.5, 0.5, 0.1),
    "Baseline": (14.6, 4.9, 4.9, 2.8),
    "MJOLNIR": (12.3, 5.1, 6.0, 3.6),
    "SSNet": (21.5, 7.0, 13.0, 6.7),
    "TDANet": (53.4, 20.5, 41.1, 20.7),
}
_SEEN_14_8 = {
    "Random": (8.9, 3.0, 0.5, 0.3),
    "Baseline": (30.4, 9.7, 11.5, 5.2),
    "MJOLNIR": (52.7, 22.3, 26.8, 14.9),
    "SSNet": (59.3, 24.5, 35.2, 19.3),
    "TDANet": (77.1, 31.0, 64.2, 33.6),
}
#: Table IV. Its complete TDANet is not quite that of Table I.
_ABLATED_22_0 = {
    "TDANet without TA and SA": (50.0, 13.9, 36.8, 14.7),
    "TDANet without TA": (58.9, 15.8, 41.6, 15.1),
    "TDANet without SA": (76.3, 28.2, 62.7, 30.4),
    "TDANet in Table IV": (78.8, 30.6, 67.7, 33.4),
}
#: Table V; its complete TDANet is that of Table III.
_ABLATED_SEEN_18_4 = {
    "TDANet without TA and SA": (42.1, 10.6),
    "TDANet without TA": (56.5, 15.7),
    "TDANet without SA": (63.3, 20.0),
}
_ABLATED_UNSEEN_18_4 = {
    "TDANet without TA and SA": (8.1, 1.2),
    "TDANet without TA": (17.0, 4.2),
    "TDANet without SA": (14.2, 2.1),
}

_TABLES: tuple[tuple[str, str, Mapping[str, Sequence[float]]], ...] = (
    ("22/0", "seen", _SEEN_22_0),
    ("22/0", "seen", _ABLATED_22_0),
    ("18/4", "seen", _SEEN_18_4),
    ("18/4", "seen", _ABLATED_SEEN_18_4),
    ("18/4", "unseen", _UNSEEN_18_4),
    ("18/4", "unseen", _ABLATED_UNSEEN_18_4),
    ("14/8", "seen", _SEEN_14_8),
    ("14/8", "unseen", _UNSEEN_14_8),
)

#: Tables I and III to V. TA is target attention, SA the Siamese comparison. Table I trained for
#: 6 M episodes, and gives standard deviations of TDANet alone: 0.8, 0.8, 1.2 and 0.8.
RATES = tuple(
    Rate(agent, split, group, bucket, figures[i], figures[i + 1])
    for split, group, rows in _TABLES
    for agent, figures in rows.items()
    for i, bucket in zip(range(0, len(figures), 2), BUCKETS, strict=False)
)

#: Table II: parameters in units of 2^20, which is how the published tables count.
PARAMETERS = {"TDANet": 3.08, "MJOLNIR-o": 3.42, "SSNet": 2.00}
#: Table II: milliseconds of one decision on an NVIDIA GeForce RTX 3060.
MILLISECONDS = {"TDANet": 0.6, "MJOLNIR-o": 0.6, "SSNet": 0.5}

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
