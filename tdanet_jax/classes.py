"""What a network knows of the object classes when it is made: a run's `classes.json`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection
from pathlib import Path

CLASSES_FILE = "classes.json"


@dataclasses.dataclass(frozen=True)
class Classes:
    """The vocabulary of a run.

    Attributes:
      names: the C classes, in the order of the scene tables.
      known: indices of those that training may know; a model with a row per class has rows for
        these alone.
    """

    names: tuple[str, ...] = ()
    known: tuple[int, ...] = ()

    def save(self, run: Path) -> None:
        """Writes `classes.json` into a run's folder."""
        (run / CLASSES_FILE).write_text(json.dumps(dataclasses.asdict(self)) + "\n")


def make_classes(names: tuple[str, ...], hidden: Collection[str]) -> Classes:
    """The vocabulary of tables with these classes, of which `hidden` are kept from training."""
    return Classes(names, tuple(i for i, name in enumerate(names) if name not in hidden))


def load(run: Path) -> Classes:
    """The vocabulary of a run; an empty one if it has no `classes.json`.

    Runs written before there was that file hold a TDANet, which needs no vocabulary.

    Raises:
      ValueError: the file is unreadable; the message names it.
    """
    path = run / CLASSES_FILE
    try:
        values = json.loads(path.read_text())
        return Classes(tuple(values["names"]), tuple(values["known"]))
    except FileNotFoundError:
        return Classes()
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: not a vocabulary of this version: {error}") from None
