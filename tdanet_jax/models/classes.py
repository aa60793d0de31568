"""The object classes that a network is made for: a run's `classes.json`."""

from __future__ import annotations

import dataclasses
import json
import os
from collections.abc import Collection
from pathlib import Path
from typing import Any

import numpy as np

from tdanet_jax.io import files
from tdanet_jax.io.untrusted import FileError, jsons
from tdanet_jax.io.untrusted.jsons import number

CLASSES_FILE = "classes.json"
#: Classes in a file, at most; the tables of rooms have room for 127.
MOST_NAMES = 1000


@dataclasses.dataclass(frozen=True)
class ClassVocabulary:
    """The vocabulary of a run.

    Attributes:
      names: the C classes, in the order of the scene tables.
      known: indices of those that training may know; a model with a row per class has rows for
        these alone.
      edges: the class graph between known classes: (i, j, weight) with i < j, indices of `names`.
        Self loops are implied. `tdanet_jax.models.class_graph` builds it.
    """

    names: tuple[str, ...] = ()
    known: tuple[int, ...] = ()
    edges: tuple[tuple[int, int, float], ...] = ()

    def save(self, run: Path | str) -> None:
        """Writes `classes.json` into a run's folder."""
        run = Path(run)
        files.write_text(run / CLASSES_FILE, json.dumps(dataclasses.asdict(self)) + "\n")

    def normalised_adjacency(self) -> np.ndarray:
        """The class graph, ready for graph convolutions: [n, n] float32, in the order of `known`.

        D^-1/2 (A + I) D^-1/2 with D the row sums of A + I (Kipf and Welling 2017), as in the
        published code of MJOLNIR.
        """
        node = {cls: i for i, cls in enumerate(self.known)}
        weights = np.eye(len(node))
        for i, j, weight in self.edges:
            weights[node[i], node[j]] = weights[node[j], node[i]] = weight
        scale = 1 / np.sqrt(weights.sum(axis=1))
        return (scale[:, None] * weights * scale).astype(np.float32)


def make_vocabulary(
    names: tuple[str, ...], hidden: Collection[str], adjacency: np.ndarray | None = None
) -> ClassVocabulary:
    """The vocabulary of tables with these classes, of which `hidden` are kept from training.

    Args:
      names: the C classes.
      hidden: names that training must not know; they get no edge either.
      adjacency: [C, C] class graph, no weight negative; where it is not symmetric, the larger
        weight counts. None gives a graph without edges.

    Raises:
      ValueError: the adjacency has another shape, or a weight that is negative or not finite.
    """
    known = tuple(i for i, name in enumerate(names) if name not in hidden)
    if adjacency is None:
        return ClassVocabulary(names, known)
    if adjacency.shape != (len(names), len(names)):
        raise ValueError(f"class graph of shape {adjacency.shape}: must be a row per class")
    if not (np.isfinite(adjacency) & (adjacency >= 0)).all():
        raise ValueError("class graph: every weight must be a number of at least 0")
    weights = np.maximum(adjacency, adjacency.T)
    edges = tuple(
        (i, j, float(weights[i, j])) for i in known for j in known if i < j and weights[i, j]
    )
    return ClassVocabulary(names, known, edges)


def load_vocabulary(run: Path | str) -> ClassVocabulary:
    """The vocabulary of a run; an empty one if it has no `classes.json`.

    Runs from before the file existed hold a TDANet, which needs no vocabulary.

    Raises:
      ValueError: the file is unreadable; the message names it.
    """
    run = Path(run)
    path = run / CLASSES_FILE
    if run.is_file():
        raise FileError(run, "not the folder of a run")
    if not os.path.lexists(path):
        return ClassVocabulary()
    values = jsons.load(path, links=False)
    if not isinstance(values, dict):
        raise FileError(path, "not a vocabulary")
    names: Any = values.get("names")
    known: Any = values.get("known")
    edges: Any = values.get("edges", [])  # the first versions wrote none
    if not isinstance(names, list) or len(names) > MOST_NAMES:
        raise FileError(path, f"names: not a list of up to {MOST_NAMES} classes")
    if not all(isinstance(name, str) and name.isprintable() for name in names):
        raise FileError(path, "names: a class that is not a line of text")
    if not _are_among(known, range(len(names))) or len(set(known)) < len(known):
        raise FileError(path, "known: not a list of different indices of names")
    if not isinstance(edges, list):
        raise FileError(path, "edges: not a list")
    for edge in edges:
        if not isinstance(edge, list) or len(edge) != 3 or not _are_among(edge[:2], known):
            raise FileError(path, "edges: not two indices of known classes and a weight each")
        if number(path, edge[2], "edges: a weight", 1e9) < 0:
            raise FileError(path, "edges: a weight below 0")
    triples = tuple((i, j, float(weight)) for i, j, weight in edges)
    return ClassVocabulary(tuple(names), tuple(known), triples)


def _are_among(values: Any, allowed: Collection[int]) -> bool:
    """Whether `values` is a list of whole numbers that are all `allowed`."""
    return isinstance(values, list) and all(type(v) is int and v in allowed for v in values)
