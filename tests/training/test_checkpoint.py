"""Checkpoints: complete or absent, checked when read, the newest sound one taken."""

from __future__ import annotations

import dataclasses
import functools
import shutil
import subprocess
import warnings
from collections.abc import Callable
from pathlib import Path

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.env.types import EnvParams
from tdanet_jax.io import files
from tdanet_jax.io.untrusted import npz, orbax
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.factory import make_model
from tdanet_jax.scenes import SceneTables
from tdanet_jax.training import checkpoint
from tdanet_jax.training.checkpoint import Checkpoints
from tdanet_jax.training.learner import TrainState, init
from tests.agent.test_agent import OLD_RUN
from tests.env.test_dynamics import params_of
from tests.support.handmade import lopsided


def network(width: int) -> ActorCritic:
    config = NetworkConfig(width=width, hidden=8, precision="float32")
    return make_model(TrainConfig(network=config), ClassVocabulary())


MODEL = network(8)
TABLES: SceneTables = lopsided()
PARAMS: EnvParams = params_of(TABLES)
WORDS = jnp.asarray(np.random.default_rng(0).normal(size=(len(TABLES.classes), 5)), jnp.float32)


def make_state(rows: int | None = None) -> TrainState:
    return init(jax.random.key(3), LearnerConfig(num_envs=4), MODEL, WORDS, PARAMS)


@functools.cache  # not when tests are collected, which every worker does
def first_state() -> TrainState:
    return jax.jit(make_state)()


def after(updates: int) -> TrainState:
    """A state that differs with the number of updates."""
    params = jax.tree.map(lambda x: x + updates, first_state().params)
    return first_state().replace(params=params, updates=jnp.int32(updates))


def plain(state: TrainState) -> TrainState:
    return state.replace(key=jax.random.key_data(state.key))


@pytest.fixture
def saved(tmp_path: Path) -> Checkpoints:
    """Two checkpoints, of 1 and of 2 updates."""
    checkpoints = Checkpoints(tmp_path)
    for updates in (1, 2):
        checkpoints.save(after(updates), {"seconds": 0.5 * updates, "data_version": "d"})
    return checkpoints


def restored(checkpoints: Checkpoints) -> int:
    """Restores, compares with what was saved, and returns its number of updates."""
    state, meta = checkpoints.restore(make_state)
    updates = int(state.updates)
    assert all(isinstance(leaf, np.ndarray) for leaf in jax.tree.leaves(state))
    chex.assert_trees_all_equal(state, plain(after(updates)))
    assert meta["seconds"] == 0.5 * updates
    return updates


def test_a_state_comes_back_bit_for_bit(saved: Checkpoints) -> None:
    assert saved.latest() == 2
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert restored(saved) == 2
        chex.assert_trees_all_equal(saved.snapshot().weights, after(2).params)


def test_the_newest_two_are_kept(saved: Checkpoints) -> None:
    saved.save(after(10), {})
    assert sorted(path.name for path in saved.folder.iterdir()) == ["10", "2"]


def test_checksums_are_what_sha256sum_reads(saved: Checkpoints) -> None:
    command = ["sha256sum", "--check", "--strict", "--quiet", checkpoint.CHECKSUMS]
    subprocess.run(command, cwd=saved.folder / "2", check=True)


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)


def halve(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


DAMAGES = [
    (which, damage)
    for which in (checkpoint.ARRAYS, checkpoint.META, checkpoint.CHECKSUMS)
    for damage in (flip, halve, Path.unlink)
    if (which, damage) != (checkpoint.CHECKSUMS, Path.unlink)  # the first versions wrote none
]


@pytest.mark.parametrize(("which", "damage"), DAMAGES)
def test_a_damaged_checkpoint_is_passed_over_and_said_so(
    saved: Checkpoints, which: str, damage: Callable[[Path], None]
) -> None:
    folder = saved.folder / "2"
    damage(folder / which)
    with pytest.warns(UserWarning, match="damaged checkpoint") as caught:
        assert restored(saved) == 1
    [message] = [str(warning.message) for warning in caught]
    assert str(folder) in message
    assert message.endswith("; taking checkpoint 1 in its place")
    assert "\n" not in message
    # The run goes on from there, past the damaged one, which it then replaces.
    saved.save(after(2), {"seconds": 1.0, "data_version": "d"})
    assert restored(saved) == 2


def test_a_damaged_checkpoint_does_not_outlive_the_next(saved: Checkpoints) -> None:
    saved.save(after(9), {})
    flip(saved.folder / "9" / checkpoint.META)
    saved.save(after(3), {"seconds": 1.5, "data_version": "d"})
    assert sorted(path.name for path in saved.folder.iterdir()) == ["2", "3"]
    assert restored(saved) == 3


def test_a_checkpoint_of_a_newer_version_is_not_passed_over(
    saved: Checkpoints, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(checkpoint, "FORMAT", checkpoint.FORMAT + 1)
        saved.save(after(3), {})
    with pytest.raises(ValueError, match="a newer tdanet_jax wrote it"):
        saved.restore(make_state)


def test_all_damaged_is_one_clear_line(saved: Checkpoints) -> None:
    for step in "12":
        flip(saved.folder / step / checkpoint.META)
    with pytest.raises(ValueError, match="2: damaged checkpoint") as caught:
        saved.restore(make_state)
    assert "\n" not in str(caught.value)


def test_a_checkpoint_without_checksums_is_read(saved: Checkpoints) -> None:
    (saved.folder / "2" / checkpoint.CHECKSUMS).unlink()
    assert restored(saved) == 2


def test_an_old_one_that_crashes_its_reader_is_passed_over(
    saved: Checkpoints, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(orbax, "_CHILD", "import os; os.abort()")
    shutil.copytree(OLD_RUN / "checkpoints" / "2", saved.folder / "5")
    with pytest.warns(UserWarning, match=r"5: unreadable checkpoint \(state: crashed") as caught:
        assert restored(saved) == 2
    [message] = [str(warning.message) for warning in caught]
    assert message.endswith("; taking checkpoint 2 in its place")


def test_what_is_half_written_is_no_checkpoint(saved: Checkpoints) -> None:
    (saved.folder / "2").rename(saved.folder / f"{files.PARTIAL}2")
    assert saved.latest() == 1
    assert restored(saved) == 1


def test_no_checkpoint(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    assert checkpoints.latest() is None
    with pytest.raises(ValueError, match="no checkpoint"):
        checkpoints.restore(make_state)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("part", ["state", "checksums", "rename"])
def test_a_checkpoint_that_cannot_be_written_leaves_those_before_it(
    saved: Checkpoints, part: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        if part == "state":
            patch.setattr(checkpoint.np, "savez", full)
        elif part == "checksums":
            patch.setattr(checkpoint, "_checksums", full)
        else:
            patch.setattr(Path, "rename", full)
        with pytest.raises(ValueError, match="3: checkpoint not written") as caught:
            saved.save(after(3), {})
    assert "No space left" in str(caught.value)
    assert "the one before it is 2" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert sorted(path.name for path in saved.folder.iterdir()) == ["1", "2"]
    assert restored(saved) == 2


def test_a_checkpoint_of_another_network_is_refused(saved: Checkpoints) -> None:
    wider = network(9)
    config = dataclasses.replace(LearnerConfig(), num_envs=4)
    with pytest.raises(ValueError, match="unreadable checkpoint"):
        saved.restore(lambda rows: init(jax.random.key(0), config, wider, WORDS, PARAMS))


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever reads an array fails."""

    def read(*_: object, **__: object) -> None:
        raise AssertionError("the arrays are read")

    monkeypatch.setattr(npz, "_array", read)


@pytest.mark.usefixtures("unread")
@pytest.mark.parametrize("budget", ["unpacked=1000", "arrays=3"])
def test_budgets_hold_before_any_array_is_read(
    saved: Checkpoints, monkeypatch: pytest.MonkeyPatch, budget: str
) -> None:
    monkeypatch.setenv("TDANET_BUDGETS", budget)
    with pytest.raises(ValueError, match=r"2: unreadable checkpoint \(.* more than \d+; if"):
        saved.snapshot()


@pytest.mark.usefixtures("unread")
def test_the_shapes_of_another_network_are_seen_before_any_array_is_read(
    saved: Checkpoints,
) -> None:
    config = LearnerConfig(num_envs=4)
    with pytest.raises(ValueError, match=r"unreadable checkpoint \(.* is float32\(.*, not"):
        saved.restore(lambda rows: init(jax.random.key(0), config, network(9), WORDS, PARAMS))


def test_a_run_may_go_on_with_more_than_a_stranger_may_send(
    saved: Checkpoints, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its configuration says how much there is."""
    monkeypatch.setenv("TDANET_BUDGETS", "unpacked=1000")
    assert restored(saved) == 2


def test_every_type_of_a_state_comes_back_and_others_are_refused(tmp_path: Path) -> None:
    checkpoints = Checkpoints(tmp_path)
    kinds = ("float32", "float16", "int8", "uint16", "int32", "uint32", "bool")
    odd = {name: jnp.ones((), name) for name in kinds} | {"none": jnp.zeros((0, 3))}
    state = after(1).replace(recurrent=odd)
    meta = {"seconds": 0.5, "data_version": "d"}
    checkpoints.save(state, meta)
    again, _ = checkpoints.restore(lambda rows: make_state().replace(recurrent=odd))
    chex.assert_trees_all_equal(again, plain(state))
    chex.assert_trees_all_equal_shapes_and_dtypes(again, plain(state))
    half = after(2).replace(recurrent={"carry": jnp.ones(3, jnp.bfloat16)})
    with pytest.raises(ValueError, match="2: recurrent/carry is bfloat16, which npz cannot hold"):
        checkpoints.save(half, meta)
    assert [path.name for path in checkpoints.folder.iterdir()] == ["1"]


def test_anybody_can_open_it_with_numpy(saved: Checkpoints) -> None:
    arrays = np.load(saved.folder / "2" / "state.npz")
    np.testing.assert_array_equal(arrays["params/actor/kernel"], after(2).params["actor"]["kernel"])
    assert int(arrays["updates"]) == 2


@pytest.mark.parametrize(
    "meta",
    [{}, {"seconds": "1", "data_version": "d"}, {"seconds": 10**400, "data_version": "d"},
     {"seconds": -1.0, "data_version": "d"}, {"seconds": 1.0}, {"seconds": 1.0, "data_version": 3},
     {"seconds": 1.0, "data_version": "\x1b[2J"}],
)  # fmt: skip
def test_odd_progress_is_one_clear_line(tmp_path: Path, meta: dict) -> None:
    checkpoints = Checkpoints(tmp_path)
    checkpoints.save(after(1), meta)
    odd = r"checkpoints/1: unreadable checkpoint \(meta\.json: (seconds|data_version) is "
    for read in (checkpoints.snapshot, lambda: checkpoints.restore(make_state)):
        with pytest.raises(ValueError, match=odd) as caught:
            read()
        assert str(caught.value).isprintable()


@pytest.mark.parametrize("rows", [2**15 + 1, "many", True])
def test_rows_that_cannot_be_are_refused(tmp_path: Path, rows: object) -> None:
    checkpoints = Checkpoints(tmp_path)
    meta = {"seconds": 1.0, "data_version": "d", "max_detections": rows}
    checkpoints.save(after(1), meta)
    with pytest.raises(ValueError, match=r"unreadable checkpoint .*max_detections"):
        checkpoints.restore(make_state)
