"""One update on eight devices is the update on one; what cannot be laid out is refused."""

import dataclasses
import re
import subprocess
import sys
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest

from tdanet_jax.config import PRESETS, LearnerConfig, TrainConfig
from tdanet_jax.task import make_task
from tdanet_jax.training import cluster, devices, learner
from tdanet_jax.workflows import train as training

#: In a process of its own, which alone can split its CPU into eight devices.
EIGHT = """
import dataclasses, sys, jax, numpy as np
from tdanet_jax.training import devices
mesh = devices.connect(8)
from jax.sharding import Mesh
from tdanet_jax.training import learner
from tests.training.test_learner import CONFIG, MODEL, PARAMS, WORDS

parts = int(sys.argv[1])
config = dataclasses.replace(CONFIG, num_envs=24, num_minibatches=parts, imitation_weight=0.3)
init = jax.jit(lambda key: learner.init(key, config, MODEL, WORDS, PARAMS))
ends = []
for over in (Mesh(np.array(jax.devices()[:1]), (devices.AXIS,)), mesh):
    state = init(jax.random.key(0))
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
# What the actions led to.
for name in ("env_state", "bootstrap_only", "updates", "episodes", "target_seen"):
    same = jax.tree.map(np.array_equal, getattr(one, name), getattr(many, name))
    assert all(jax.tree.leaves(same)), name
np.testing.assert_array_equal(one.recurrent.is_first, many.recurrent.is_first)
close = lambda a, b: np.testing.assert_allclose(a, b, rtol=2e-4, atol=2e-6)
jax.tree.map(close, one.params, many.params)
jax.tree.map(close, one_metrics, many_metrics)
print("equal")
"""


@pytest.mark.slow
@pytest.mark.parametrize("minibatches", ["1", "3"])
def test_an_update_on_eight_devices_is_the_update_on_one(minibatches):
    command = [sys.executable, "-c", EIGHT, minibatches]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.stdout == "equal\n", done.stderr


def test_more_devices_than_there_are_is_one_clear_error():
    present = jax.local_device_count()  # this process uses its CPU already
    with pytest.raises(ValueError, match=f"--devices {present + 1}: this process has {present}"):
        devices.connect(present + 1)
    with pytest.raises(ValueError, match="--devices 0: must be positive"):
        devices.connect(0)


@pytest.mark.parametrize(
    ("environments", "count", "what"),
    [
        (256, 3, "255 or 258 environments can be, or 2 or 4 devices"),
        (256, 6, "252 or 258 environments can be, or 4 or 8 devices"),
        (256, 7, "252 or 259 environments can be, or 4 or 8 devices"),
        (2, 3, "3 environments can be, or 2 devices"),
    ],
)
def test_environments_that_cannot_be_divided_say_which_can(environments, count, what):
    with pytest.raises(ValueError, match=f"--num-envs {environments}: cannot") as error:
        devices.check_divides(environments, SimpleNamespace(size=count))
    assert str(error.value).endswith(f" {count} devices; {what}")
    devices.check_divides(256, SimpleNamespace(size=8))


def test_every_minibatch_must_be_divided():
    mesh = SimpleNamespace(size=8)
    devices.check_divides(48, mesh, minibatches=3)
    message = "--num-envs 24: must be a multiple of 16, --num-minibatches 2 times 8 devices"
    with pytest.raises(ValueError, match=message):
        devices.check_divides(24, mesh, minibatches=2)


def test_a_run_whose_minibatches_cannot_be_divided_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(devices, "connect", lambda count: SimpleNamespace(size=2))
    config = TrainConfig(learner=LearnerConfig(num_envs=10, num_minibatches=10))
    with pytest.raises(ValueError, match="--num-envs 10: must be a multiple of 20"):
        training.train(config, tmp_path / "run", device_count=2)


@pytest.mark.usefixtures("ithor")
@pytest.mark.parametrize(
    ("steps", "said"), [(6, "--rollout-steps 6: must be above 6 for li, "), (7, "begun")]
)
def test_a_network_that_never_learns_to_adapt_is_refused(tmp_path, monkeypatch, steps, said):
    def begin(*arguments):
        raise ValueError("begun")

    monkeypatch.setattr(training, "Run", begin)
    config = TrainConfig(model="li", learner=LearnerConfig(rollout_steps=steps))
    with pytest.raises(ValueError, match=said):
        training.train(config, tmp_path / "run")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("ithor")
def test_a_run_that_is_refused_leaves_nothing(tmp_path, monkeypatch):
    """Whether what it lacks is found before its folder is made, or after."""
    out = tmp_path / "new" / "run"
    config = TrainConfig(learner=LearnerConfig(num_envs=3))
    with monkeypatch.context() as patch:
        patch.setattr(devices, "connect", lambda count: SimpleNamespace(size=2))
        with pytest.raises(ValueError, match="2 or 4 environments can be, or 1 or 3 devices"):
            training.train(config, out, device_count=2)
    assert list(tmp_path.iterdir()) == []

    def refuse(*arguments):
        assert out.is_dir()
        raise ValueError("too large for this device")

    monkeypatch.setattr(training, "Run", refuse)
    with pytest.raises(ValueError, match="too large"):
        training.train(config, out)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("platform", "error", "what"),
    [
        ("cuda", AssertionError(), "JAX_PLATFORMS=cuda: JAX finds no such device here$"),
        ("gpu", RuntimeError("no rocm\nmore"), r"JAX_PLATFORMS=gpu: JAX .* here \(no rocm\)$"),
        (None, RuntimeError("no cpu"), r"^JAX cannot be started \(no cpu\)$"),
    ],
)
def test_a_jax_that_cannot_be_started_is_one_clear_error(monkeypatch, platform, error, what):
    def fail():
        raise error

    monkeypatch.setattr(jax, "devices", fail)
    monkeypatch.delenv(devices.PLATFORMS, raising=False)
    if platform is not None:
        monkeypatch.setenv(devices.PLATFORMS, platform)
    with pytest.raises(ValueError, match=what):
        devices.connect()


@pytest.mark.parametrize(
    ("address", "processes", "process", "what"),
    [
        ("host0", "2", "0", "JAX_COORDINATOR_ADDRESS=host0: must be HOST:PORT"),
        ("host0:", "2", "0", "JAX_COORDINATOR_ADDRESS=host0:: must be HOST:PORT"),
        (":1234", "2", "0", "JAX_COORDINATOR_ADDRESS=:1234: must be HOST:PORT"),
        ("host0:http", "2", "0", "JAX_COORDINATOR_ADDRESS=host0:http: must be HOST:PORT"),
        ("host0:99999", "2", "0", "JAX_COORDINATOR_ADDRESS=host0:99999: must be HOST:PORT"),
        ("host0:1234", "2", "2", "JAX_PROCESS_ID=2: must be from 0 to 1, below JAX_NUM_PROCESSES"),
        ("host0:1234", "2", "-1", "JAX_PROCESS_ID=-1: must be from 0 to 1"),
        ("host0:1234", "2", "1", "JAX_COORDINATOR_ADDRESS=host0:1234: no answer$"),
    ],
)
def test_processes_that_cannot_join_are_one_clear_error(
    monkeypatch, address, processes, process, what
):
    def initialize(cluster_detection_method, **arguments):
        assert cluster_detection_method == "deactivate"  # also within a launcher
        raise RuntimeError("no answer\nmore")

    monkeypatch.setattr(jax.distributed, "initialize", initialize)
    monkeypatch.setenv("XLA_FLAGS", "")  # restored afterwards
    for name, value in (
        (devices.ADDRESS, address), (devices.PROCESSES, processes), (devices.PROCESS, process)
    ):  # fmt: skip
        monkeypatch.setenv(name, value)
    with pytest.raises(ValueError, match=what):
        devices.connect()


def test_a_launcher_says_who_is_who(monkeypatch):
    heard = []
    monkeypatch.setattr(jax.distributed, "initialize", lambda **arguments: heard.append(arguments))
    monkeypatch.setenv("XLA_FLAGS", "")
    for name, variable in cluster.LAUNCHERS.items():
        for count, several in (("1", False), ("2", True)):
            with monkeypatch.context() as patch:
                patch.setenv(variable, count)
                assert cluster.several() == several
                devices.connect()
            assert heard == [{"cluster_detection_method": name}] * several
        heard.clear()
    for variable in cluster.LAUNCHERS.values():  # mpirun in a step of SLURM
        monkeypatch.setenv(variable, "2")
    assert cluster.launcher() == "ompi"
    cluster.leave()
    devices.connect()
    assert heard == []
    monkeypatch.setenv("SLURM_NTASKS", "2")  # a job script, which is one process
    assert not cluster.several()


def test_ones_own_variables_come_before_a_launchers(monkeypatch):
    monkeypatch.setenv("SLURM_STEP_NUM_TASKS", "2")
    monkeypatch.setenv(devices.ADDRESS, "host0")
    assert cluster.several()
    with pytest.raises(ValueError, match="JAX_COORDINATOR_ADDRESS=host0: must be"):
        devices.connect()


def test_a_launcher_that_jax_cannot_read_is_one_clear_error(monkeypatch):
    monkeypatch.setenv("OMPI_COMM_WORLD_SIZE", "2")
    monkeypatch.setenv("XLA_FLAGS", "")
    with pytest.raises(ValueError, match=r"^OMPI_COMM_WORLD_SIZE=2: .*; set JAX_COORDINATOR_ADDR"):
        devices.connect()


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
