"""The loop around training: when it saves, and whose progress it shows."""

from __future__ import annotations

import itertools
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tdanet_jax.config import LearnerConfig, NetworkConfig, TrainConfig
from tdanet_jax.training.callbacks import Callbacks
from tdanet_jax.workflows import train


class Counted:
    """A run that counts what is asked of it."""

    config = TrainConfig(checkpoint_minutes=2.0)
    pools = SimpleNamespace(unreached=0, close=lambda: None)

    def __init__(self) -> None:
        self.seconds, self.steps, self.saved = 0.0, 0, 0

    def save(self) -> None:
        self.saved += 1

    def wait_for_rooms(self, seconds: float) -> None:
        return None


class Shown(Callbacks):
    def __init__(self) -> None:
        self.runs: list[list[Any]] = []

    def on_rows(self, runs: Any, rows: Any) -> None:
        assert len(runs) == len(rows)
        self.runs.append([*runs])


def test_a_seed_that_catches_up_is_saved_and_shown() -> None:
    """The first one stands still meanwhile. A chunk takes 90 seconds; 120 go by between saves."""
    first, second = Counted(), Counted()
    first.steps, first.seconds = 20, 1000.0

    def chunks() -> Any:
        for number in itertools.count():
            trains = [second] if number < 4 else [first, second]
            for run in trains:
                run.seconds += 90.0
                run.steps += 5
            yield [{}] * len(trains)
            if number == 7:
                return

    shown = Shown()
    assert train._learn([first, second], chunks(), shown)
    assert shown.runs == [[second]] * 4 + [[first, second]] * 4
    # At first, after every second chunk, and in the end.
    assert (first.saved, second.saved) == (6, 6)


@pytest.mark.usefixtures("ithor")
def test_flags_that_change_nothing_are_noted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Noting(Callbacks):
        def on_note(self, text: str) -> None:
            said.append(text)

    def begin(*arguments: Any, **options: Any) -> None:
        raise ValueError("begun")

    said: list[str] = []
    monkeypatch.setattr(train, "Run", begin)
    config = TrainConfig(
        learner=LearnerConfig(clip_coef=0.1), network=NetworkConfig(inner_rate=1e-3)
    )
    with pytest.raises(ValueError, match="begun"):
        train.train(config, tmp_path / "run", callbacks=Noting())
    with pytest.raises(ValueError, match="begun"):  # and of seeds that train together, once
        train.train_together([(config, tmp_path / "a"), (config, tmp_path / "b")], Noting())
    notes = [
        "note: --inner-rate changes nothing for tdanet",
        "note: --clip-coef changes nothing with one optimiser step per update",
    ]
    assert said == [*notes, *notes]
