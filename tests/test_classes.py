"""A run's vocabulary: what is known, and its file."""

import pytest

from tdanet_jax import classes
from tdanet_jax.classes import CLASSES_FILE, Classes, make_classes


def test_hidden_classes_are_named_but_not_known():
    made = make_classes(("Apple", "Mug", "Sofa", "Toaster"), {"Toaster", "Mug"})
    assert made == Classes(("Apple", "Mug", "Sofa", "Toaster"), known=(0, 2))


def test_what_is_saved_is_loaded(tmp_path):
    made = make_classes(("Apple", "Mug"), {"Mug"})
    made.save(tmp_path)
    assert classes.load(tmp_path) == made


def test_a_run_without_the_file_has_an_empty_vocabulary(tmp_path):
    assert classes.load(tmp_path) == Classes()


@pytest.mark.parametrize("content", ["{", "[]", '{"names": ["Apple"]}'])
def test_a_damaged_file_is_one_clear_error(tmp_path, content):
    (tmp_path / CLASSES_FILE).write_text(content)
    with pytest.raises(ValueError, match=r"classes\.json"):
        classes.load(tmp_path)
