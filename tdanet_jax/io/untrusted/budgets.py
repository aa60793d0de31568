"""How much of an untrusted file is taken in: limits that are checked before memory is used."""

from __future__ import annotations

import dataclasses
import math
import os

#: Environment variable that raises (or lowers) limits: "unpacked=16e9,values=1e8".
VARIABLE = "TDANET_BUDGETS"


@dataclasses.dataclass(frozen=True)
class Budgets:
    """The limits for one file. Whoever trusts a larger one raises them through `TDANET_BUDGETS`."""

    size: float = 2 << 30
    """Bytes of a file of text, JSON or pickles."""
    values: float = 20e6
    """Lists and objects of a JSON document, steps of a pickle."""
    depth: float = 100
    """Levels of nested lists and objects in JSON."""
    arrays: float = 10e3
    """Arrays in a file of rooms, a point of a history, or a checkpoint."""
    unpacked: float = 4 << 30
    """Bytes of all these arrays together."""
    expansion: float = 200
    """Unpacked bytes per byte of a file that unpacks to more than 64 MiB. Rooms expand 3-fold."""
    patches: float = 1e6
    """Patches on the surfaces of a room's objects, in which visibility is computed."""
    tests: float = 1e12
    """Pairs of a line of sight and a box of one room; 10^12 take about half an hour."""


def budgets() -> Budgets:
    """The limits, with those that `TDANET_BUDGETS` sets.

    Raises:
      ValueError: the variable names an unknown limit or a value that is not positive.
    """
    given = {}
    for word in filter(None, os.environ.get(VARIABLE, "").split(",")):
        name, _, text = word.partition("=")
        try:
            given[name] = float(text)
        except ValueError:
            given[name] = math.nan
        if not given[name] > 0:
            raise ValueError(f"{VARIABLE}: {word}: not NAME=NUMBER")
    if unknown := given.keys() - {field.name for field in dataclasses.fields(Budgets)}:
        raise ValueError(f"{VARIABLE}: {min(unknown)}: no such limit")
    return dataclasses.replace(Budgets(), **given)


def excess(name: str, amount: float, what: str) -> str:
    """Why a file that exceeds the limit called `name` is refused, and how to allow it; or ""."""
    most = getattr(budgets(), name)
    if amount <= most:
        return ""
    return f"{what}, more than {most:.15g}; if you trust the file, set {VARIABLE}={name}={amount:g}"


def unpacking_excess(arrays: int, unpacked: int, packed: int) -> str:
    """Why arrays of so many bytes are not unpacked from so many bytes of a file; or ""."""
    factor = 0.0 if unpacked <= 64 << 20 else unpacked / max(packed, 1)
    return (
        excess("arrays", arrays, f"{arrays} arrays")
        or excess("unpacked", unpacked, f"unpacks to {unpacked} bytes")
        or excess("expansion", factor, f"unpacks to {factor:.0f} times its size")
    )
