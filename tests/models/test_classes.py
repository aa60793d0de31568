"""A run's vocabulary: what is known, and its file."""

import json

import numpy as np
import pytest

from tdanet_jax.models import classes
from tdanet_jax.models.classes import CLASSES_FILE, Classes, make_classes


def test_hidden_classes_are_named_but_not_known():
    made = make_classes(("Apple", "Mug", "Sofa", "Toaster"), {"Toaster", "Mug"})
    assert made == Classes(("Apple", "Mug", "Sofa", "Toaster"), known=(0, 2))


def test_edges_join_known_classes_once_with_the_larger_weight():
    adjacency = np.zeros((4, 4))
    adjacency[0, 2], adjacency[2, 0], adjacency[3, 2] = 0.5, 0.25, 1.0
    adjacency[1, 2] = adjacency[2, 1] = adjacency[0, 0] = 1.0
    made = make_classes(("Apple", "Mug", "Sofa", "Toaster"), {"Mug"}, adjacency)
    assert made.edges == ((0, 2, 0.5), (2, 3, 1.0))


@pytest.mark.parametrize(
    ("adjacency", "message"),
    [
        (np.zeros((3, 3)), r"shape \(3, 3\)"),
        (np.full((2, 2), -1.0), "at least 0"),
        (np.full((2, 2), np.nan), "at least 0"),
    ],
)
def test_a_graph_that_is_none_is_refused(adjacency, message):
    with pytest.raises(ValueError, match=message):
        make_classes(("Apple", "Mug"), (), adjacency)


def test_what_is_saved_is_loaded(tmp_path):
    made = make_classes(("Apple", "Mug", "Sofa"), {"Mug"}, np.full((3, 3), 0.5))
    assert made.edges
    made.save(tmp_path)
    assert classes.load(tmp_path) == made


def test_a_run_without_the_file_has_an_empty_vocabulary(tmp_path):
    assert classes.load(tmp_path) == Classes()


def test_a_file_from_before_there_was_a_graph_is_loaded(tmp_path):
    (tmp_path / CLASSES_FILE).write_text(json.dumps({"names": ["Apple", "Mug"], "known": [0]}))
    assert classes.load(tmp_path) == Classes(("Apple", "Mug"), (0,))


@pytest.mark.parametrize(
    "content",
    [
        "{",
        "[]",
        '{"names": ["Apple"]}',
        '{"names": ["Apple"], "known": [0], "edges": [[0, 0]]}',
        '{"names": ["Apple"], "known": [0], "edges": [[0, 0, "x"]]}',
    ],
)
def test_a_damaged_file_is_one_clear_error(tmp_path, content):
    (tmp_path / CLASSES_FILE).write_text(content)
    with pytest.raises(ValueError, match=r"classes\.json"):
        classes.load(tmp_path)
