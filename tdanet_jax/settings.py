"""The base of dataclasses of settings: plain values, checked types. Imports no NumPy and no JAX."""

from __future__ import annotations

import dataclasses
import math
import os
from typing import Any, Literal, get_args, get_origin, get_type_hints


@dataclasses.dataclass(frozen=True)
class Settings:
    """Base of dataclasses of settings. NumPy's numbers become Python's, and paths text."""

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if type(value).__module__ == "numpy" and value.shape == ():
                object.__setattr__(self, field.name, value.item())
            elif isinstance(value, os.PathLike):
                object.__setattr__(self, field.name, os.fspath(value))

    def check_types(self) -> None:
        """Raises ValueError, with one line that names the flag, if a value is not of its type."""
        for name, kind in get_type_hints(type(self)).items():
            if not fits(value := getattr(self, name), kind):
                wanted = in_words(kind, value)
                raise ValueError(f"--{name.replace('_', '-')} {value}: must be {wanted}")


def fits(value: Any, kind: Any) -> bool:
    """Whether a value is of a field's type; numbers must be finite."""
    if get_origin(kind) is Literal:
        return value in get_args(kind)
    if get_origin(kind) is tuple:
        return isinstance(value, tuple) and all(fits(one, get_args(kind)[0]) for one in value)
    if get_args(kind):
        return any(fits(value, one) for one in get_args(kind))
    if kind is float:
        return type(value) in (int, float) and abs(value) < 1e300
    return isinstance(value, kind) and isinstance(value, bool) == (kind is bool)


def in_words(kind: Any, value: Any) -> str:
    """A field's type, for an error about a value that does not fit it: a whole number."""
    if get_origin(kind) is Literal:
        return f"one of {', '.join(map(str, get_args(kind)))}"
    if get_origin(kind) is tuple:
        return "a tuple of strings"  # the only one that there is
    if get_args(kind):  # float | None
        return in_words(get_args(kind)[0], value)
    if kind is float and type(value) is float and not math.isfinite(value):
        return "finite"
    if kind is float and type(value) in (int, float):
        return "between -1e300 and 1e300"
    words = {int: "a whole number", float: "a number", bool: "True or False", str: "a string"}
    return words.get(kind, f"a {kind.__name__}")
