"""No random key serves two purposes: all uses are recorded while programs run, and none repeats.

A use is drawing from a key, splitting it, or folding a number into it. A key is drawn from or split
once in all, and each number is folded into it once. Keys are told apart by their bits, so a key
that is made twice, in whichever way, is noticed as well.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import define_prng_impl, threefry_prng_impl

from tdanet_jax.config import LearnerConfig
from tdanet_jax.env.params import make_params
from tdanet_jax.env.reward import no_parents
from tdanet_jax.evaluation import policies, rollout
from tdanet_jax.evaluation.episodes import Episodes
from tdanet_jax.models.actor_critic import ActorCritic
from tdanet_jax.models.tdanet import TDANetEncoder
from tdanet_jax.observation_spec import ObservationSpec
from tdanet_jax.training import learner
from tests.support import handmade, samples

#: What was done with which key: ("draw or split",), or ("fold", number), and the key's two words.
Use = tuple[Any, ...]
used: Counter[Use] = Counter()


def note(key: Any, *what: Any) -> None:
    """Records a use of a key [2], when the program gets there."""

    def record(key: np.ndarray, *what: Any) -> None:
        used[*(x if isinstance(x, str) else int(x) for x in what), *key.tolist()] += 1

    name, *numbers = what
    jax.debug.callback(lambda key, *numbers: record(key, name, *numbers), key, *numbers)


def _split(key: Any, shape: tuple[int, ...]) -> Any:
    note(key, "draw or split")
    return threefry_prng_impl.split(key, shape)


def _random_bits(key: Any, width: int, shape: tuple[int, ...]) -> Any:
    note(key, "draw or split")
    return threefry_prng_impl.random_bits(key, width, shape)


def _fold_in(key: Any, number: Any) -> Any:
    note(key, "fold", number)
    return threefry_prng_impl.fold_in(key, number)


#: JAX's default random numbers, with every use of a key recorded.
RECORDED = define_prng_impl(
    key_shape=(2,), seed=threefry_prng_impl.seed, split=_split, random_bits=_random_bits,
    fold_in=_fold_in, name="recorded", tag="rec",
)  # fmt: skip

MODEL = ActorCritic(TDANetEncoder(width=4, dropout=0.5), hidden=4)
WORDS = samples.normal(2, 3)
TABLES = handmade.lopsided()
TARGETS = {"kitchen": ("Mug", "Bread"), "bedroom": ("Mug",)}
ENVS, STEPS = 3, 4


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every key that is made from a seed has its uses recorded."""
    key = jax.random.key
    monkeypatch.setattr(jax.random, "key", lambda seed: key(seed, impl=RECORDED))
    used.clear()


def uses() -> Counter[Use]:
    """The uses so far, none of them twice."""
    jax.effects_barrier()
    repeated = {use: times for use, times in used.items() if times > 1}
    assert not repeated, f"used more than once: {repeated}"
    return used


def test_no_key_repeats_in_a_run_of_two_updates() -> None:
    config = LearnerConfig(num_envs=ENVS, rollout_steps=STEPS)
    limits, spec = (3,) * 4, ObservationSpec()
    params = make_params(TABLES, TARGETS, no_parents(TABLES), limits, spec, size_noise=0.5)
    state = jax.jit(learner.init, static_argnums=(1, 2))(
        jax.random.key(0), config, MODEL, WORDS, params
    )
    before = uses().total()
    assert before > ENVS + 1
    learner.make_train(config, MODEL, 2)(state, jnp.zeros(2), WORDS, params)
    # An update: fold, split into steps. A step: split in three, draw actions, draw dropout, split
    # into resets. A reset: draw the episode, fold, draw the noise of the sizes.
    assert uses().total() - before == 2 * (2 + STEPS * (4 + ENVS * 3))


EPISODES = Episodes(np.array([0, 0, 2], np.int32), np.array([0, 1, 0], np.int32))


@pytest.mark.parametrize("policy", [policies.random(), policies.network(MODEL, WORDS)])
def test_no_key_repeats_in_an_evaluation(policy: policies.Policy) -> None:
    params = make_params(TABLES, TARGETS, no_parents(TABLES), (4,) * 4, ObservationSpec())
    weights = samples.parameters(MODEL, WORDS)
    weights["actor"]["bias"] = weights["actor"]["bias"].at[-1].set(-9.0)  # nobody says Done
    lists = {"seen": EPISODES, "unseen": EPISODES}
    records = rollout.evaluate_lists(policy, weights, params, lists, seed=5)
    steps = sum(int(found.length.max()) for _, found in records.values())
    assert uses().total() >= len(lists) + 2 * steps >= len(lists) + 4
    used.clear()
    two = jax.tree.map(lambda x: jnp.stack([x, x]), weights)
    rollout.evaluate_stacked(policy, two, params, lists, (5, 6), batched=False)
    assert uses().total() >= 2 * len(lists)
