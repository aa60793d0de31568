"""Points of a run's history on disk."""

import dataclasses
import itertools

import chex
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.training import history
from tdanet_jax.training.history import Snapshot

WEIGHTS = {
    "actor": {"kernel": np.float32([[1, 2], [3, 4]]), "bias": np.float32([0.1, -0.2])},
    "encoder": {"linear": {"kernel": np.float32([[5]])}},
}
SNAPSHOT = Snapshot(WEIGHTS, updates=120, episodes=77, seconds=1.5, point=3, data_version="abc")


def test_what_is_written_is_read(tmp_path):
    path = history.write(tmp_path, SNAPSHOT)
    assert history.points(tmp_path) == [path]
    again = history.read(path)
    chex.assert_trees_all_equal(again.weights, WEIGHTS)
    assert dataclasses.replace(again, weights=None) == dataclasses.replace(SNAPSHOT, weights=None)


def test_points_are_in_order_and_those_behind_a_checkpoint_are_dropped(tmp_path):
    for updates in (900, 1000, 80):
        history.write(tmp_path, dataclasses.replace(SNAPSHOT, updates=updates))
    (tmp_path / "history" / ".partial-17-00000990.npz").write_bytes(b"half")
    assert [int(path.stem) for path in history.points(tmp_path)] == [80, 900, 1000]
    history.drop_after(tmp_path, 900)
    assert [path.name for path in sorted((tmp_path / "history").iterdir())] == [
        "00000080.npz", "00000900.npz"
    ]  # fmt: skip


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"nonsense"])
def test_a_damaged_file_is_named_in_one_line(tmp_path, content):
    path = tmp_path / "00000001.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"00000001\.npz: not an npz archive") as caught:
        history.read(path)
    assert "\n" not in str(caught.value)


def test_a_cut_file_is_named(tmp_path):
    path = history.write(tmp_path, SNAPSHOT)
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(ValueError, match=r"00000120\.npz: not an npz archive"):
        history.read(path)


def test_a_missing_file_and_one_of_something_else_are_named(tmp_path):
    with pytest.raises(ValueError, match="no such file"):
        history.read(tmp_path / "00000001.npz")
    other = tmp_path / "other.npz"
    np.savez(other, a=np.zeros(2))
    with pytest.raises(ValueError, match=r"other\.npz: not a point of a run's history"):
        history.read(other)


def test_a_newer_format_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(history, "FORMAT", history.FORMAT + 1)
    path = history.write(tmp_path, SNAPSHOT)
    monkeypatch.undo()
    with pytest.raises(ValueError, match="format 3, this version reads 2"):
        history.read(path)


@given(st.lists(st.floats(0.001, 0.3), min_size=1, max_size=40), st.integers(0, 25))
def test_every_point_falls_due_once_and_in_order(steps, points):
    """However a budget is spent, the points that are skipped are those passed in one stride."""
    shares = np.cumsum([0.0, *steps]).tolist()
    found = [history.due(a, b, points) for a, b in itertools.pairwise(shares)]
    due = [point for point in found if point]
    assert due == sorted(set(due))
    assert all(1 <= point <= points for point in due)
    if points and shares[-1] >= 1:
        assert due[-1] == points
    if max(steps) * points < 1 <= points and shares[-1] >= 1:
        assert due == list(range(1, points + 1))


def test_parameters_must_fit_the_configuration(tmp_path):
    path = history.write(tmp_path, SNAPSHOT)
    weights = history.read(path).weights
    history.check_fit(path, weights, WEIGHTS)
    other = {"actor": {"kernel": np.zeros((2, 3)), "bias": np.zeros(2)}, "encoder": {}}
    for one, two, message in (
        (weights, other, r"actor/kernel is \(2, 2\), not \(2, 3\)"),
        (other, weights, r"actor/kernel is \(2, 3\), not \(2, 2\)"),
        (weights, {}, r"actor/bias is \(2,\), not a parameter"),
        ({}, weights, r"actor/bias is missing, not \(2,\)"),
    ):
        with pytest.raises(ValueError, match=f"does not fit the run's configuration: {message}"):
            history.check_fit(path, one, two)


@pytest.mark.parametrize(
    "change",
    [{"@updates": np.array("7")}, {"@updates": np.array(0.5)}, {"@episodes": np.array(-1)},
     {"@seconds": np.array(np.nan)}, {"@point": np.zeros(3)}, {"@data_version": np.array(3)},
     {"@data_version": np.array("\x1b[2J")}, {"@format": np.array("x")}, {"actor": np.ones(3)},
     {"/".join("a" * 30): np.ones(3)}, {"actor/bias": np.array(["text"])}],
)  # fmt: skip
def test_odd_fields_are_named_in_one_line(tmp_path, change):
    path = history.write(tmp_path, SNAPSHOT)
    with np.load(path) as data:
        content = dict(data)
    np.savez(path, **{**content, **change})
    with pytest.raises(ValueError, match=r"00000120\.npz: ") as caught:
        history.read(path)
    assert str(caught.value).isprintable()
