"""Counts of operations: of small programs by hand, of models against the sizes of their layers."""

import jax
import jax.numpy as jnp
import pytest

from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.env import dynamics
from tdanet_jax.task import load_task
from tdanet_jax.tools.arithmetic import forward_macs, product_macs

A, B = jnp.zeros((2, 3)), jnp.zeros((3, 5))
SQUARE = jnp.zeros((3, 3))


@pytest.mark.parametrize(
    ("program", "arguments", "expected"),
    [
        (lambda a, b: a @ b, (A, B), 2 * 3 * 5),
        (lambda a, b: a[0] @ b, (A, B), 3 * 5),
        (lambda a, b: (a + 1) * b[:2, :3], (A, B), 0),
        (lambda a, b: jnp.einsum("ij,kj->k", a, b), (A, SQUARE), 3 * 3),
        (lambda a, b: jax.vmap(lambda row: row @ b)(a), (A, B), 2 * 3 * 5),
        (lambda a, b: jax.jit(lambda x: x @ b @ b.T)(a), (A, B), 2 * 2 * 3 * 5),
        (lambda a, b: jax.lax.scan(lambda x, _: (x @ b, x), a, length=7), (A, SQUARE), 7 * 2 * 9),
        (  # 4 places, 5 channels out of 3, over 2 places each
            lambda a, b: jax.lax.conv(jnp.ones((1, 3, 5)), jnp.ones((5, 3, 2)), (1,), "VALID"),
            (A, B),
            4 * 5 * 3 * 2,
        ),
        (
            lambda a, b: jax.lax.cond(a[0, 0] > 0, lambda: a @ b, lambda: a @ b @ b),
            (A, SQUARE),
            3 * 2 * 9,
        ),
    ],
)
def test_products_by_hand(program, arguments, expected):
    assert product_macs(jax.make_jaxpr(program)(*arguments).jaxpr) == expected


def counted(model="tdanet", **network):
    """The count for a small network, the shapes of its weights, and its task."""
    config = NetworkConfig(width=32, hidden=48, precision="float32", **network)
    task = load_task(TrainConfig(model=model, network=config))
    shapes = task.model.parameter_shapes(*task.train_words.shape)
    return forward_macs(task.model, task.train_words, task.train_params), shapes, task


def sizes(shapes):
    """The number of weights in matrices."""
    return sum(leaf.size for leaf in jax.tree.leaves(shapes) if leaf.ndim == 2)


@pytest.mark.parametrize("senses", [(), ("odometry",), ("odometry", "triangulation")])
def test_tdanet_multiplies_by_the_kernels_that_a_step_uses(senses, ithor):
    """All kernels but W_L's, which is used once per update, and attention to each detection."""
    macs, shapes, task = counted(**dict.fromkeys(senses, True))
    del shapes["encoder"]["attention"]
    obs, _ = jax.eval_shape(dynamics.reset, jax.random.key(0), task.train_params)
    columns, words = obs.boxes.shape[-1], task.train_words.shape[1]
    # Scores, and the means of boxes and of word vectors.
    attention = len(obs.classes) * (2 * columns + words)
    assert macs == sizes(shapes) + attention


def test_mjolnir_multiplies_its_graph_by_the_nodes(ithor):
    """Three convolutions A X W of n nodes, the first of what they share, and a fourth of ten."""
    macs, shapes, task = counted("mjolnir-o")
    graph = shapes.pop("encoder")["graph"]
    nodes, width, units = len(task.model.encoder.classes.known), *graph["kernels_2"]["kernel"].shape
    first = nodes * width
    second = nodes * width * width + nodes * nodes * width
    third = nodes * width * units + nodes * nodes * units
    fourth = nodes * 2 * units + nodes * nodes + sizes(graph["mapping"])
    assert macs == sizes(shapes) + first + second + third + fourth


@pytest.mark.parametrize("more", ["sp", "savn"])
def test_graphs_and_inner_steps_add_to_the_image(more, ithor):
    assert counted(more)[0] > counted("baseline")[0]
