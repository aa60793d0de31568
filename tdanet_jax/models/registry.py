"""Models by name, and the network that a configuration describes.

Imports no JAX until a network is made, so that a configuration can check names.
"""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tdanet_jax.config import NetworkConfig, TrainConfig
    from tdanet_jax.models.actor_critic import ActorCritic
    from tdanet_jax.models.classes import ClassVocabulary

#: Models by name: the module that makes each, and the settings that it is made with.
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


def make_model(config: TrainConfig, classes: ClassVocabulary) -> ActorCritic:
    """The network of a configuration; its `spec` says what it is shown.

    Args:
      config: the run's configuration.
      classes: the vocabulary that the network is made for.

    Raises:
      ValueError: `config.model` names a module that cannot be imported or makes no `ActorCritic`,
        or the model is not shown what a sensor needs.
    """
    import jax.numpy as jnp

    from tdanet_jax.models.actor_critic import ActorCritic

    module_name, options = MODELS.get(config.model, (config.model, {}))
    try:
        module = importlib.import_module(module_name)
    except (ImportError, TypeError) as error:  # TypeError: a name that begins with a dot
        raise ValueError(f"--model {config.model}: {error}") from None
    if not hasattr(module, "make"):
        raise ValueError(f"--model {config.model}: the module has no function `make`")
    network = config.network
    dtype = jnp.dtype(resolve_precision(network).precision)
    model = module.make(network, classes, dtype, **options)
    if not isinstance(model, ActorCritic):
        raise ValueError(f"--model {config.model}: `make` gives no ActorCritic")
    encoder, asked = model.encoder, network.spec
    spec = dataclasses.replace(
        asked,
        rows=encoder.ROWS or asked.rows,
        image=("features" if encoder.maps else "raster") if encoder.IMAGE else None,
        sensors=tuple(dict.fromkeys((*asked.sensors, *model.spec.sensors))),
    )
    spec.check(config.model)
    return model.clone(spec=spec)


def resolve_precision(config: NetworkConfig) -> NetworkConfig:
    """The configuration with `precision` "auto" replaced by what is fastest on this machine."""
    import jax

    if config.precision != "auto":
        return config
    cpuinfo = Path("/proc/cpuinfo")
    on_cpu = jax.default_backend() == "cpu"
    has_amx = on_cpu and cpuinfo.exists() and "amx_bf16" in cpuinfo.read_text()
    fast = has_amx or not on_cpu
    return dataclasses.replace(config, precision="bfloat16" if fast else "float32")


def unused_flags(config: TrainConfig, classes: ClassVocabulary) -> list[str]:
    """The network's flags that are set but change nothing for this model, if it is not custom."""
    network, default = config.network, type(config.network)()
    if config.model not in MODELS:
        return []
    model = make_model(config, classes)
    other_precision = {"float32": "bfloat16", "bfloat16": "float32"}

    def is_unused(name: str) -> bool:
        if name == "rows":
            return model.encoder.ROWS is not None
        if name == "image":
            return not model.encoder.IMAGE
        value: Any = getattr(network, name)
        other: Any = other_precision[value] if name == "precision" else getattr(default, name)
        values: dict[str, Any] = {name: other}
        changed = dataclasses.replace(network, **values)
        return model == make_model(dataclasses.replace(config, network=changed), classes)

    always_used = ("word_norm", "odometry", "triangulation", "sensors")
    names = (field.name for field in dataclasses.fields(network) if field.name not in always_used)
    chosen = [name for name in names if getattr(network, name) != getattr(default, name)]
    flags = [f"--{name.replace('_', '-')}" for name in chosen if is_unused(name)]
    return [*flags, "--size-noise"] if config.learner.size_noise and model.encoder.IMAGE else flags
