"""The network that a configuration describes."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.shared.adaptation import AdaptiveActorCritic
from tdanet_jax.registry import MODELS, find_make
from tdanet_jax.sensors import suite


def make_model(config: TrainConfig, classes: ClassVocabulary) -> ActorCritic:
    """The network of a configuration; its `spec` says what it is shown.

    Args:
      config: the run's configuration.
      classes: the vocabulary that the network is made for.

    Raises:
      ValueError: `config.model` names a module that cannot be imported or makes no `ActorCritic`,
        the model is not shown what a sensor needs, or a sensor cannot be made.
    """
    module, options = MODELS.get(config.model, (config.model, {}))
    # Dropout draws bytes. What is kept must be scaled by the same rate that is dropped.
    dropout = round(256 * config.network.dropout) / 256
    network = dataclasses.replace(config.network, dropout=dropout)
    dtype = jnp.dtype(resolve_precision(network).precision)
    model = find_make("--model", config.model, module)(network, classes, dtype, **options)
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
    if network.reach_threshold is not None and isinstance(model, AdaptiveActorCritic):
        raise ValueError(f"--reach-threshold: not with {config.model}, which adapts while it acts")
    suite.make(spec)  # a sensor that cannot be made is refused here, too
    return model.clone(
        spec=spec,
        reach_threshold=network.reach_threshold,
        temperature=network.temperature,
        done_bias=network.done_bias,
    )


def check_trained(config: TrainConfig, model: ActorCritic) -> None:
    """Raises ValueError, with one line that names the flag, if a part would never be trained."""
    steps = config.learner.rollout_steps
    if isinstance(model, AdaptiveActorCritic) and steps <= model.interval:
        raise ValueError(
            f"--rollout-steps {steps}: must be above {model.interval} for {config.model}, which "
            "learns to adapt from the steps that follow an inner step in the same rollout"
        )


def resolve_precision(config: NetworkConfig) -> NetworkConfig:
    """The configuration with `precision` "auto" replaced by what is fastest on this machine."""
    if config.precision != "auto":
        return config
    cpuinfo = Path("/proc/cpuinfo")
    on_cpu = jax.default_backend() == "cpu"
    has_amx = on_cpu and cpuinfo.exists() and "amx_bf16" in cpuinfo.read_text()
    fast = has_amx or not on_cpu
    return dataclasses.replace(config, precision="bfloat16" if fast else "float32")


def unused_flags(config: TrainConfig, classes: ClassVocabulary) -> list[str]:
    """The network's flags that are set but change nothing for this model, if it is not custom."""
    network, default = config.network, NetworkConfig()
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
    no_boxes = model.encoder.IMAGE and model.encoder.ROWS is None
    return [*flags, "--size-noise"] if config.learner.size_noise and no_boxes else flags
