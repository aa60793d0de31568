"""One update on eight devices is the update on one; what cannot be laid out is refused."""

import dataclasses
import os
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import pytest

from tdanet_jax.config import PRESETS, TrainConfig
from tdanet_jax.task import make_task
from tdanet_jax.training import devices, learner

#: In a process of its own, which alone can split its CPU into eight devices.
EIGHT = """
import dataclasses, jax, numpy as np
from tdanet_jax.training import devices
mesh = devices.connect(8)
from jax.sharding import Mesh
from tdanet_jax.training import learner
from tests.training.test_learner import CONFIG, MODEL, PARAMS, WORDS

config = dataclasses.replace(CONFIG, num_envs=24)
ends = []
for over in (Mesh(np.array(jax.devices()[:1]), (devices.AXIS,)), mesh):
    state = learner.init(jax.random.key(0), config, MODEL, WORDS, PARAMS)
    layout = devices.layout(state, over)
    state = jax.device_put(state, layout)
    words, params = jax.device_put((WORDS, PARAMS), devices.everywhere(over))
    chunk = learner.make_train(config, MODEL, 1, (layout, devices.everywhere(over)))
    chunk = chunk.lower(state, jax.numpy.zeros(2), words, params).compile()
    # Devices add up their gradients. What each has seen stays where it is.
    exchanges = ("all-gather", "all-to-all", "collective-permute")
    assert not [name for name in exchanges if name in chunk.as_text()]
    assert ("all-reduce" in chunk.as_text()) == (over.size > 1)
    after, metrics = chunk(state, jax.numpy.zeros(2), words, params)
    assert {len(x.sharding.device_set) for x in jax.tree.leaves(after)} == {over.size}
    probs = after.recurrent.prev_action_probs
    assert probs.addressable_shards[0].data.shape == (24 // over.size, 6)
    ends.append(jax.device_get((after.replace(key=0), metrics)))
(one, one_metrics), (many, many_metrics) = ends
for name in ("env_state", "bootstrap_only", "updates", "episodes"):  # what the actions led to
    same = jax.tree.map(np.array_equal, getattr(one, name), getattr(many, name))
    assert all(jax.tree.leaves(same)), name
np.testing.assert_array_equal(one.recurrent.is_first, many.recurrent.is_first)
close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-6)
jax.tree.map(close, one.params, many.params)
jax.tree.map(close, one_metrics, many_metrics)
print("equal")
"""


def test_an_update_on_eight_devices_is_the_update_on_one():
    environment = os.environ | {"PYTHONPATH": os.getcwd()}
    done = subprocess.run(
        [sys.executable, "-c", EIGHT], capture_output=True, text=True, env=environment
    )
    assert done.stdout == "equal\n", done.stderr


def test_more_devices_than_there_are_is_one_clear_error():
    present = jax.local_device_count()  # this process uses its CPU already
    with pytest.raises(ValueError, match=f"--devices {present + 1}: this machine has {present}"):
        devices.connect(present + 1)
    with pytest.raises(ValueError, match="--devices 0: must be positive"):
        devices.connect(0)


def test_a_process_that_does_not_know_its_number_is_one_clear_error(monkeypatch):
    monkeypatch.setenv(devices.ADDRESS, "localhost:1234")
    with pytest.raises(ValueError, match=f"{devices.PROCESSES} and {devices.PROCESS}"):
        devices.connect()


def test_a_process_on_its_own_agrees_with_itself():
    assert devices.is_lead()
    assert devices.from_lead(0.1) == 0.1
    assert devices.anywhere(True)
    assert not devices.anywhere(False)


@pytest.mark.parametrize(
    ("model", "preset"),
    [
        pytest.param("tdanet", "default", marks=pytest.mark.slow),  # best: the same and more
        ("tdanet", "best"),
        pytest.param("mjolnir-r", "default", marks=pytest.mark.slow),
        pytest.param("savn", "default", marks=pytest.mark.slow),
    ],
)
def test_an_update_can_be_lowered_for_a_gpu(some_rooms, glove, model, preset, monkeypatch):
    # Not what it computes there, which needs one: that no part of it exists on CPUs alone.
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    base = PRESETS[preset]
    learning = dataclasses.replace(base.learner, num_envs=4, rollout_steps=6)
    network = dataclasses.replace(base.network, precision="bfloat16")
    config = TrainConfig(model=model, network=network, learner=learning)
    task = make_task(config, some_rooms, glove)
    arguments = task.train_words, task.train_params
    state = jax.eval_shape(
        lambda: learner.init(jax.random.key(0), learning, task.model, *arguments)
    )
    traced = learner.make_train(learning, task.model, 1).trace(state, jnp.zeros(2), *arguments)
    program = traced.lower(lowering_platforms=("cuda",)).as_text()
    assert "dot_general" in program
    # GPUs scatter in any order. Sums of floats would differ from run to run, unless each is of one
    # number, as is the gradient of the chosen action's log-probability.
    scatters = re.findall(r"stablehlo\.scatter.*?\}\) : \(tensor<([\w]+)>", program, re.DOTALL)
    bodies = re.findall(r"stablehlo\.scatter.*?\}\) :", program, re.DOTALL)
    sums = [to for to, body in zip(scatters, bodies, strict=True) if "stablehlo.add" in body]
    assert sums == ["6x4x6xf32"]
