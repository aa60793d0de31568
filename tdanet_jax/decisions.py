"""How a trained network decides, in place of what its run says. Imports neither JAX nor NumPy."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

from tdanet_jax.settings import Settings

#: For each field of `Decisions`: whether a number can be its value, and how an error says it.
_RANGES: dict[str, tuple[Callable[[float], bool], str]] = {
    "reach_threshold": (lambda value: 0 <= value < 1, "be at least 0 and below 1"),
    "temperature": (lambda value: 0.01 <= value <= 100, "be between 0.01 and 100"),
    "done_bias": (lambda value: abs(value) <= 100, "be between -100 and 100"),
}


@dataclasses.dataclass(frozen=True)
class Decisions(Settings):
    """How a trained network decides: settings of `NetworkConfig` on which training does not depend.

    None leaves the run's.
    """

    reach_threshold: float | None = None
    """Probability of reach from which Done is allowed, instead of the run's; only for runs that
    were trained with one. 0 allows Done everywhere."""
    temperature: float | None = None
    """Temperature at which actions are sampled, instead of the run's: the lower, the more often the
    most probable one is taken. No effect on greedy actions."""
    done_bias: float | None = None
    """What is added to the logit of Done, instead of the run's: the higher, the earlier the agent
    says it."""

    @property
    def replaced(self) -> dict[str, Any]:
        """The values that replace the run's, by name."""
        values = {name: getattr(self, name) for name in _RANGES}
        return {name: value for name, value in values.items() if value is not None}

    def check(self, policy: object = None) -> None:
        """Raises ValueError, with one line that names the flag, if a value is out of range.

        Args:
          policy: how actions are chosen; "greedy" has no temperature.
        """
        self.check_types()
        for name, value in self.replaced.items():
            holds, wanted = _RANGES[name]
            if not holds(value):
                raise ValueError(f"--{name.replace('_', '-')} {value}: must {wanted}")
        if policy == "greedy" and self.temperature is not None:
            raise ValueError("--temperature: has no effect on --policy greedy")


#: The run's own.
OWN_DECISIONS = Decisions()
