"""Policies on fixed episodes, metrics, and reports."""

from __future__ import annotations

from typing import Any

from tdanet_jax import _moved


def __getattr__(name: str) -> Any:
    return _moved.attribute(f"evaluation.{name}")
