"""Training does not grow. Slow: `pytest -m slow tests/system/test_soak.py`; an hour: soak.py."""

import pytest

from tests.system import soak


@pytest.mark.slow
def test_five_minutes_of_training_grow_nothing() -> None:
    found = soak.soak(5.0, [])
    print(found)
    assert found["rows_complete"]
    assert found["files_per_hour"] < 1
    assert found["threads_per_hour"] < 1
    # In two and a half minutes the allocator's own noise is some MB.
    assert found["resident_mb_per_hour"] < 200
