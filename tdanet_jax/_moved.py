"""Where modules are now: the names of version 0.1 work until 0.3, those of 0.2 until 0.4, with a
warning."""

from __future__ import annotations

import importlib
import importlib.abc
import importlib.machinery
import importlib.util
import pkgutil
import sys
import warnings
from collections.abc import Sequence
from types import ModuleType
from typing import Any

#: Modules that kept their names, by the packages in which they are now.
_PACKAGES = {
    "agent": "ai2thor",
    "analysis": "attention episode_lookup figures pictures replay trace",
    "env": "reward zero_shot",
    "evaluation": "comparison episodes metrics paper policies report",
    "workflows": "sweep",
    "io": "assets files untrusted",
    "models": "classes",
    "sensors": "detections odometry triangulation",
    "training": "checkpoint devices history learner",
}
#: Moved since version 0.2.
_LATER = {
    "evaluation.evaluate": "workflows.evaluate",
    "evaluation.sweep": "workflows.sweep",
    "evaluation.sweep_report": "workflows.sweep_report",
    "training.train": "workflows.train",
}
#: Old name -> new name, below `tdanet_jax`.
MOVED = (
    _LATER
    | {name: f"{new}.{name}" for new, names in _PACKAGES.items() for name in names.split()}
    | {
        "evaluation.evaluate_lists": "evaluation.rollout.evaluate_lists",
        "graph": "models.class_graph",
        "measure": "tools.benchmarking",
        "parameters": "models.parameter_count",
        "returns": "training.gae",
        "saved": "evaluation.saved_networks",
        "scenes.poses": "poses",
    }
)


def attribute(name: str) -> Any:
    """What has moved, as an attribute of its old package: `from tdanet_jax import episodes`."""
    if name in MOVED:
        return pkgutil.resolve_name(_warn(name, stacklevel=4))
    raise AttributeError(f"tdanet_jax has no {name}")


def _warn(name: str, stacklevel: int) -> str:
    """Warns of an old name; returns the new one."""
    new = f"tdanet_jax.{MOVED[name]}"
    until = "0.4" if name in _LATER else "0.3"
    message = f"tdanet_jax.{name} is now {new}; the old name works until version {until}"
    warnings.warn(message, DeprecationWarning, stacklevel=stacklevel)
    return new


class _Finder(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Finds the new module under an old name."""

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        package, _, name = fullname.partition(".")
        if package != "tdanet_jax" or name not in MOVED:
            return None
        return importlib.util.spec_from_loader(fullname, self)

    def create_module(self, spec: importlib.machinery.ModuleSpec) -> ModuleType:
        return importlib.import_module(_warn(spec.name.partition(".")[2], stacklevel=3))

    def exec_module(self, module: ModuleType) -> None:
        """The module is loaded already; it gets its own spec back."""
        module.__spec__ = importlib.util.spec_from_loader(module.__name__, module.__loader__)


sys.meta_path.append(_Finder())
