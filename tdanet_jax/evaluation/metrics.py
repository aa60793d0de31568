"""Success rate and SPL, with confidence intervals (the paper's Eqs. 4 and 5)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

#: Success rate and SPL; and with each episode in which a MoveAhead was blocked counted as failed.
MEASURES = ("SR", "SPL", "CF-SR", "CF-SPL")
#: What reports say of the last two.
COLLISION_FREE = "CF-SR and CF-SPL count episodes in which a MoveAhead was blocked as failed."
#: What `summarise` takes, by the names of columns.
COLUMNS = ("success", "shortest", "length", "cluster", "collided")
#: The two groups of episodes that the literature reports: L at least 1, and at least 5.
BUCKETS = {"L>=1": 1, "L>=5": 5}
BOOTSTRAP_SAMPLES = 2_000
CONFIDENCE = 0.95


def spl(success: np.ndarray, shortest: np.ndarray, length: np.ndarray) -> np.ndarray:
    """Success weighted by path length of each episode: S * L / max(L, e), in [0, 1]."""
    return success * shortest / np.maximum(shortest, length)


def summarise(
    success: np.ndarray,
    shortest: np.ndarray,
    length: np.ndarray,
    cluster: np.ndarray,
    collided: np.ndarray | None = None,
) -> dict[str, dict[str, object]]:
    """SR and SPL in percent, per bucket of L.

    Args:
      success: [E] bool.
      shortest: [E] L, including Done.
      length: [E] e, including Done.
      cluster: [E] int, the (room, target) pair of each episode. Episodes of a pair are correlated,
        so the intervals resample pairs, not episodes.
      collided: [E] bool, whether a MoveAhead was blocked; without it, CF-SR and CF-SPL are missing.

    Returns:
      bucket -> each of `MEASURES`, its interval (SR_ci, [low, high]), and n; None where n is 0, and
      no interval where all episodes are of one cluster.
      The collision-free measures, CF-SR and CF-SPL, count episodes that collided as failed.
    """
    return _averages(_rates(success, shortest, length, collided), shortest, cluster)


def difference(
    ours: Mapping[str, np.ndarray], theirs: Mapping[str, np.ndarray]
) -> dict[str, dict[str, object]]:
    """The difference between two agents in the same episodes, ours minus theirs, per bucket of L.

    The paired bootstrap: the differences of single episodes are averaged and resampled, so that an
    episode that is hard for both does not widen the intervals.

    Args:
      ours: the `COLUMNS` of the episodes (`summarise`).
      theirs: the same of the other agent.

    Returns:
      As `summarise`, in percentage points.
    """
    mine, other = (
        _rates(column["success"], column["shortest"], column["length"], column.get("collided"))
        for column in (ours, theirs)
    )
    return _averages(mine - other, theirs["shortest"], theirs["cluster"])


def _rates(
    success: np.ndarray, shortest: np.ndarray, length: np.ndarray, collided: np.ndarray | None
) -> np.ndarray:
    """Each of `MEASURES` of each episode in percent, [4, E]; [2, E] if collisions are unknown."""
    wins = [success] if collided is None else [success, success & ~collided]
    parts = [each for won in wins for each in (won, spl(won, shortest, length))]
    return 100.0 * np.stack(parts).astype(np.float64)


def _averages(
    values: np.ndarray, shortest: np.ndarray, cluster: np.ndarray
) -> dict[str, dict[str, object]]:
    """Means and intervals of the first M of `MEASURES` of each episode [M, E], per bucket of L."""
    measures = MEASURES[: len(values)]
    out: dict[str, dict[str, object]] = {}
    for name, least in BUCKETS.items():
        chosen = shortest >= least
        count = int(chosen.sum())
        if count == 0:
            nothing = (*measures, *(f"{measure}_ci" for measure in measures))
            out[name] = {**dict.fromkeys(nothing), "n": 0}
            continue
        bounds = cluster_interval(values[:, chosen], cluster[chosen])
        mean = values[:, chosen].mean(axis=1)
        out[name] = {
            **dict(zip(measures, map(_round, mean), strict=True)),
            **{
                f"{measure}_ci": None if bounds is None else [_round(b[i]) for b in bounds]
                for i, measure in enumerate(measures)
            },
            "n": count,
        }
    return out


def shown(bucket: Mapping[str, Any], measure: str) -> str:
    """A mean and its interval, if there is one, as in every table: 75.1 (70.2 to 80.0)."""
    if bucket.get(measure) is None:
        return "-"
    if (ends := bucket.get(f"{measure}_ci")) is None:
        return f"{bucket[measure]:z.1f}"
    low, high = ends
    return f"{bucket[measure]:z.1f} ({low:z.1f} to {high:z.1f})"


def cluster_interval(
    values: np.ndarray, cluster: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Percentile bootstrap interval of means, resampling whole clusters.

    Args:
      values: [M, E], M quantities.
      cluster: [E] int.

    Returns:
      Lower and upper bound, [M] each; None of a single cluster, which says nothing of others.
    """
    _, member = np.unique(cluster, return_inverse=True)
    clusters = int(member.max()) + 1
    if clusters == 1:
        return None
    sums = np.stack([np.bincount(member, row, clusters) for row in values])  # [M, clusters]
    sizes = np.bincount(member, minlength=clusters)
    rng = np.random.default_rng(0)
    drawn = rng.multinomial(clusters, np.full(clusters, 1 / clusters), BOOTSTRAP_SAMPLES)
    means = (drawn @ sums.T) / (drawn @ sizes)[:, None]  # [samples, M]
    tail = 50 * (1 - CONFIDENCE)
    low, high = np.percentile(means, [tail, 100 - tail], axis=0)
    return low, high


def grouped(
    columns: Mapping[str, np.ndarray], key: str, names: Iterable[str]
) -> dict[str, dict[str, dict[str, object]]]:
    """`summarise` for each value of a column that occurs, in the order of `names`."""
    out = {}
    for name in names:
        chosen = columns[key] == name
        if chosen.any():
            out[name] = summarise(*(columns[c][chosen] for c in COLUMNS if c in columns))
    return out


def _round(value: float) -> float:
    return round(float(value), 2) + 0.0  # no minus zero
