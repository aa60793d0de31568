"""Models and sensors by name. Imports no JAX, so that a configuration can check names."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

#: Models: the module that makes each, and the settings that it is made with.
MODELS: Mapping[str, tuple[str, Mapping[str, Any]]] = {
    "tdanet": ("tdanet_jax.models.tdanet", {}),
    "tdanet-no-ta": ("tdanet_jax.models.tdanet", {"target_attention": False}),
    "tdanet-no-sa": ("tdanet_jax.models.tdanet", {"siamese": False}),
    "tdanet-no-ta-sa": ("tdanet_jax.models.tdanet", {"target_attention": False, "siamese": False}),
    "ssnet": ("tdanet_jax.models.ssnet", {}),
    "mjolnir-o": ("tdanet_jax.models.mjolnir", {}),
    "mjolnir-r": ("tdanet_jax.models.mjolnir", {"image": True}),
    "baseline": ("tdanet_jax.models.baseline", {}),
    "sp": ("tdanet_jax.models.sp", {"width": 256}),
    "sp-wide": ("tdanet_jax.models.sp", {"width": 1024}),
    "savn": ("tdanet_jax.models.savn", {}),
    "li": ("tdanet_jax.models.li", {}),
}
#: Sensors: the module that makes each.
SENSORS: Mapping[str, str] = {
    "odometry": "tdanet_jax.sensors.odometry",
    "triangulation": "tdanet_jax.sensors.triangulation",
    "robust-triangulation": "tdanet_jax.sensors.robust_triangulation",
}


def find_make(flag: str, name: str, module: str) -> Callable[..., Any]:
    """The function `make` of a model's or sensor's module.

    Args:
      flag: the flag that asks for it, for the message.
      name: the flag's value.
      module: dotted name.

    Raises:
      ValueError: the module cannot be imported, or has no such function.
    """
    try:
        found = importlib.import_module(module)
    except (ImportError, TypeError) as error:  # TypeError: a name that begins with a dot
        raise ValueError(f"{flag} {name}: {error}") from None
    if not hasattr(found, "make"):
        raise ValueError(f"{flag} {name}: the module has no function `make`")
    make: Callable[..., Any] = found.make
    return make
