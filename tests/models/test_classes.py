"""A run's vocabulary: known classes, class graph and file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tdanet_jax.models.classes import (
    CLASSES_FILE,
    ClassVocabulary,
    load_vocabulary,
    make_vocabulary,
)

NAMES = ("Apple", "Bed", "Mug", "Sink", "Sofa")


def test_hidden_classes_are_named_but_not_known() -> None:
    made = make_vocabulary(("Apple", "Mug", "Sofa", "Toaster"), {"Toaster", "Mug"})
    assert made == ClassVocabulary(("Apple", "Mug", "Sofa", "Toaster"), known=(0, 2))


def test_edges_join_known_classes_once_with_the_larger_weight() -> None:
    adjacency = np.zeros((4, 4))
    adjacency[0, 2], adjacency[2, 0], adjacency[3, 2] = 0.5, 0.25, 1.0
    adjacency[1, 2] = adjacency[2, 1] = adjacency[0, 0] = 1.0
    made = make_vocabulary(("Apple", "Mug", "Sofa", "Toaster"), {"Mug"}, adjacency)
    assert made.edges == ((0, 2, 0.5), (2, 3, 1.0))


@pytest.mark.parametrize(
    ("adjacency", "message"),
    [
        (np.zeros((3, 3)), r"shape \(3, 3\)"),
        (np.full((2, 2), -1.0), "at least 0"),
        (np.full((2, 2), np.nan), "at least 0"),
    ],
)
def test_an_invalid_graph_is_refused(adjacency: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_vocabulary(("Apple", "Mug"), (), adjacency)


def test_what_is_saved_is_loaded(tmp_path: Path) -> None:
    made = make_vocabulary(("Apple", "Mug", "Sofa"), {"Mug"}, np.full((3, 3), 0.5))
    assert made.edges
    made.save(tmp_path)
    assert load_vocabulary(tmp_path) == made


def test_a_run_without_the_file_has_an_empty_vocabulary(tmp_path: Path) -> None:
    assert load_vocabulary(tmp_path) == ClassVocabulary()


def test_an_old_file_without_a_graph_is_loaded(tmp_path: Path) -> None:
    (tmp_path / CLASSES_FILE).write_text(json.dumps({"names": ["Apple", "Mug"], "known": [0]}))
    assert load_vocabulary(tmp_path) == ClassVocabulary(("Apple", "Mug"), (0,))


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"names": ["Apple"]}',
        '{"names": ["Apple"], "known": [0], "edges": [[0, 0]]}',
        '{"names": ["Apple"], "known": [0], "edges": [[0, 0, "x"]]}',
        '{"names": ["Apple"], "known": [0], "edges": [[0, 0, -1]]}',
        '{"names": ["Apple"], "known": [0], "edges": [[0, 0, 1e400]]}',
        '{"names": ["Apple", "Mug"], "known": [0], "edges": [[0, 1, 1]]}',
        '{"names": ["Apple"], "known": [0, 0]}',
        '{"names": ["Apple"], "known": [1]}',
        '{"names": ["Apple"], "known": [true]}',
        '{"names": ["Apple"], "known": [[]]}',
        '{"names": ["\\u001b[2J"], "known": [0]}',
        '{"names": 3, "known": [0]}',
    ],
)
def test_a_damaged_file_is_one_clear_error(tmp_path: Path, content: str) -> None:
    (tmp_path / CLASSES_FILE).write_text(content)
    with pytest.raises(ValueError, match=r"classes\.json"):
        load_vocabulary(tmp_path)


def test_the_normalised_adjacency_is_symmetric_with_self_loops() -> None:
    classes = ClassVocabulary(NAMES, (0, 2, 3), ((0, 2, 1.0), (2, 3, 0.5)))
    found = classes.normalised_adjacency()
    degree = np.array([2.0, 2.5, 1.5])
    expected = np.array([[1, 1, 0], [1, 1, 0.5], [0, 0.5, 1]]) / np.sqrt(np.outer(degree, degree))
    np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_without_edges_the_normalised_adjacency_is_the_identity() -> None:
    np.testing.assert_array_equal(ClassVocabulary(NAMES, (1, 4)).normalised_adjacency(), np.eye(2))
