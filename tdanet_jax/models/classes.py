"""The object classes that a network is made for: a run's `classes.json`."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Collection
from pathlib import Path

import numpy as np

from tdanet_jax.io import files

CLASSES_FILE = "classes.json"


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
    try:
        values = json.loads(files.read_text(path))
        edges = tuple((int(i), int(j), float(w)) for i, j, w in values.get("edges", ()))
        return ClassVocabulary(tuple(values["names"]), tuple(values["known"]), edges)
    except FileNotFoundError:
        return ClassVocabulary()
    except OSError as error:
        raise ValueError(f"{path}: {error.strerror}") from None
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path}: not a vocabulary of this version: {error}") from None
