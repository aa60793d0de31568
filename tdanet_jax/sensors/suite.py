"""The sensors of an `ObservationSpec`, run together by environment, agent and network alike.

States and readings are dictionaries by sensor name, in the spec's order; all functions but `width`
and `blank` work on one episode.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp

from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.registry import SENSORS, find_make
from tdanet_jax.sensors.sensor import Frame, Motion, Sensor, Start

#: States or readings by sensor name.
ByName = Mapping[str, Any]


@functools.cache
def make(spec: ObservationSpec) -> dict[str, Sensor]:
    """The sensors by name.

    Raises:
      ValueError: a module cannot be imported or makes no `Sensor`, or a sensor lacks another that
        it requires.
    """
    out: dict[str, Sensor] = {}
    for name in spec.sensors:
        sensor = find_make("--sensors", name, SENSORS.get(name, name))()
        if not isinstance(sensor, Sensor):
            raise ValueError(f"--sensors {name}: `make` gives no Sensor")
        for missing in (required for required in sensor.REQUIRES if required not in out):
            raise ValueError(f"--sensors {name}: needs {missing} before it")
        out[name] = copy.copy(sensor)
        out[name].grid = spec.grid
    return out


def init(spec: ObservationSpec, start: Start) -> ByName:
    """The states at the start of an episode, before the first frame."""
    return {name: sensor.init(start) for name, sensor in make(spec).items()}


def update(spec: ObservationSpec, states: ByName, motion: Motion) -> ByName:
    """The states after an action."""
    return _in_order(spec, lambda sensor, name, done: sensor.update(states[name], motion, done))


def observe(spec: ObservationSpec, states: ByName, frame: Frame) -> ByName:
    """The states after a frame has been seen."""
    return _in_order(spec, lambda sensor, name, done: sensor.observe(states[name], frame, done))


def clear(spec: ObservationSpec, states: ByName, changed: jax.Array) -> ByName:
    """The states once the agent may have been given another target; `changed` is a bool."""
    return {name: sensor.clear(states[name], changed) for name, sensor in make(spec).items()}


def read(spec: ObservationSpec, states: ByName) -> ByName:
    """What the sensors say."""
    return {name: sensor.read(states[name], states) for name, sensor in make(spec).items()}


def features(spec: ObservationSpec, readings: ByName) -> jax.Array:
    """Readings with leading axes [...] as the network's input, [..., width] float32."""
    parts = [sensor.features(readings[name]) for name, sensor in make(spec).items()]
    return jnp.concatenate(parts, axis=-1)


def width(spec: ObservationSpec) -> int:
    """Length of `features`."""
    return sum(sensor.width for sensor in make(spec).values())


def blank(spec: ObservationSpec, batch: int) -> ByName:
    """The readings at the start of `batch` episodes that face along the grid's z axis."""
    zero = jnp.zeros(batch, jnp.int32)
    return jax.vmap(lambda start: read(spec, init(spec, start)))(Start(zero, zero))


def _in_order(spec: ObservationSpec, call: Callable[[Sensor, str, ByName], Any]) -> ByName:
    """`call(sensor, name, states of those before it)` for each sensor."""
    done: dict[str, Any] = {}
    for name, sensor in make(spec).items():
        done[name] = call(sensor, name, done)
    return done
