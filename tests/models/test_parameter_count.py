"""Parameter counts: those of a network, and the published ones layer by layer."""

import jax
import jax.numpy as jnp
import pytest

from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.models import parameter_count
from tdanet_jax.models.classes import ClassVocabulary
from tdanet_jax.models.factory import make_model
from tdanet_jax.registry import MODELS

NAMES = tuple(f"Class{i}" for i in range(9))


@pytest.mark.parametrize(
    ("name", "published"), [("tdanet", 3.08), ("mjolnir-o", 3.42), ("ssnet", 2.00)]
)
def test_the_published_counts_are_met(name, published):
    assert parameter_count.as_published(name).published / parameter_count.UNIT == pytest.approx(
        published, rel=0.01
    )


def test_the_published_counts_by_hand():
    """Every layer that the published code registers, in its own sizes."""
    lstm = lambda inputs: 4 * 512 * (inputs + 512 + 2)  # noqa: E731
    heads = 512 * 6 + 6 + 512 + 1
    action = 6 * 10 + 10
    inputs = 512 + 10
    tdanet = 2 * (303 * 512 + 512) + 3 * (512 * 512 + 512) + action + lstm(inputs) + heads
    assert parameter_count.as_published("tdanet").published == tdanet == 3_224_653
    inputs = 97 * 5 + 6
    ssnet = 3 * 25 + action + lstm(inputs) + heads + (2 * inputs * 6 + 6) + 97 * 300
    assert parameter_count.as_published("ssnet").published == ssnet
    inputs = 10 + 101 * 5 + 512
    graph = 101 * 101 + 2 * 401 * 401 + 401 * 5 + 10 + 101 * 512 + 512
    mjolnir = graph + action + lstm(inputs) + heads + (2 * inputs * 6 + 6) + 101 * 300
    assert parameter_count.as_published("mjolnir-o").published == mjolnir == 3_588_301
    inputs = 7 * 7 * 64 + 512
    image = 512 * 64 + 64 + 300 * 64 + 64 + 138 * 64 + 64
    resnet = 512 * 1000 + 1000
    mjolnir = image + graph + action + lstm(inputs) + heads + (2 * inputs * 6 + 6) + 101 * 300
    assert parameter_count.as_published("mjolnir-r").published == mjolnir + resnet


@pytest.mark.parametrize("name", MODELS)
def test_the_trained_count_is_what_an_optimiser_changes(name):
    config = TrainConfig(model=name, network=NetworkConfig(width=8, hidden=6))
    model = make_model(config, ClassVocabulary(NAMES, tuple(range(7))))
    weights = jax.eval_shape(model.initialise, jax.random.key(0), jnp.ones((9, 5)))
    found = parameter_count.count(model, 9, 5)
    assert found.trained == sum(leaf.size for leaf in jax.tree.leaves(weights))
    assert found.published == found.trained + sum(found.extra.values())
