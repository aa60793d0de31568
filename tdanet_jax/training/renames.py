"""What arrays were called in files of format 1; files of format 2 have the names of today."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import TypeVar

T = TypeVar("T")

#: Patterns of old names (`params/lstm/kernel`) and their successors; all are applied, in order.
_RENAMES = tuple(
    (re.compile(pattern), name)
    for pattern, name in (
        # The state of a run.
        (r"^held$", "bootstrap_only"),
        (r"^previous$", "recurrent/prev_action_probs"),
        (r"^fresh$", "recurrent/is_first"),
        (r"^carry/", "recurrent/carry/"),
        (r"^env_state/trail/sighting/", "env_state/sensors/triangulation/"),
        (r"^env_state/trail/", "env_state/sensors/odometry/"),
        # The state of a network that adapts.
        (r"^(recurrent/carry)/own/", r"\1/per_environment/"),
        (r"^(recurrent/carry)/pairs/", r"\1/outer_products/"),
        (r"^(recurrent/carry/steps)/inputs$", r"\1/lstm_inputs"),
        (r"^(recurrent/carry/steps)/gates$", r"\1/gate_inputs"),
        (r"^(recurrent/carry/steps)/given/", r"\1/step_inputs/"),
        (r"(/step_inputs)/previous$", r"\1/prev_action_probs"),
        (r"(/step_inputs)/fresh$", r"\1/is_first"),
        (r"(/step_inputs)/keep$", r"\1/dropout_mask"),
        (r"(/step_inputs/obs)/odometry/target$", r"\1/sensors/triangulation"),
        (r"(/step_inputs/obs)/odometry/", r"\1/sensors/odometry/"),
        # Parameters, and the optimiser's moments of them.
        (r"(^|/)lstm/kernel_aside$", r"\1lstm/kernel_skip"),
    )
)  # fmt: skip


def renamed(arrays: Mapping[str, T], written: int) -> dict[str, T]:
    """Arrays by the names of today, from a file of format `written`."""
    return dict(arrays) if written > 1 else {_renamed(name): x for name, x in arrays.items()}


def _renamed(name: str) -> str:
    for pattern, successor in _RENAMES:
        name = pattern.sub(successor, name)
    return name
