"""Reading `results.json`, which another machine may have written."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tdanet_jax.evaluation.metrics import BUCKETS, MEASURES
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.io.untrusted.jsons import number
from tdanet_jax.splits import GROUPS, OF_VALIDATION, split_name

#: Fields of text, and counts, with what they are at most.
_TEXTS = ("split", "model", "policy", "data_version")
_COUNTS = {"seed": 2**32, "episodes_trained": 1e15, "steps": 1e15}


def read(path: Path) -> dict[str, Any]:
    """The content of a run's `results.json`.

    Raises:
      FileError: there is none, or a field is not what it must be; the message names it.
    """
    results = jsons.load(path, links=False)
    check(path, results)
    return results


def check(path: Path, results: Any) -> None:
    """Raises FileError unless `results` has the fields that reports read, and they can be shown."""
    if not isinstance(results, dict):
        raise FileError(path, "not the results of a run")
    for name in _TEXTS:
        if not isinstance(results.get(name), str) or not results[name].isprintable():
            raise FileError(path, f"not the results of a run ({name} is not a line of text)")
    for name, most in _COUNTS.items():
        if number(path, results.get(name), name, most) < 0 or type(results[name]) is not int:
            raise FileError(path, f"{name} is not a count")
    name = results["split"].removesuffix(OF_VALIDATION)
    try:
        canonical = split_name(name, None)
    except ValueError as error:
        raise FileError(path, error) from None
    if canonical != name:  # it becomes part of the names of pictures
        raise FileError(path, f"split {results['split']}: not the name of a split")
    for name in ("data", "targets", "trained_targets"):
        if not isinstance(results.get(name), str | None):
            raise FileError(path, f"{name} is not text")
    check_groups(path, results, "")
    if results.get("seen") is None:
        raise FileError(path, "not the results of a run (no results for seen targets)")
    rooms = results.get("by_room")
    if not isinstance(rooms, dict):
        raise FileError(path, "by_room is not an object")
    for room, groups in rooms.items():
        check_groups(path, groups, f"by_room, {room}, ")


def check_groups(path: Path, groups: Any, where: str) -> None:
    """Checks the results by group: measures and number of episodes, intervals if there are."""
    if not isinstance(groups, Mapping):
        raise FileError(path, f"{where.rstrip(', ')}: not an object")
    for group in GROUPS:
        buckets = groups.get(group)
        for bucket in BUCKETS if buckets is not None else ():
            place = f"{where}{group}, {bucket}"
            part = buckets.get(bucket) if isinstance(buckets, dict) else None
            if not isinstance(part, dict):
                raise FileError(path, f"{place}: missing")
            number(path, part.get("n"), f"{place}, n", 1e9)
            for measure in MEASURES:
                if measure not in part and measure.startswith("CF-"):
                    continue  # files from before these were measured
                if measure not in part:
                    raise FileError(path, f"{place}, {measure}: missing")
                if part[measure] is not None:
                    ends = part.get(f"{measure}_ci") or []
                    if not isinstance(ends, list) or len(ends) not in (0, 2):
                        raise FileError(path, f"{place}, {measure}_ci: not an interval")
                    for value in (part[measure], *ends):
                        number(path, value, f"{place}, {measure}", 100)
