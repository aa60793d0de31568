"""Recurrent PPO in the manner of PureJaxRL, for any environment with gymnax 1.0's methods.

Nothing in `make_train` knows this environment. `python examples/recurrent_ppo.py` trains in the
rooms of split 18/4, and plays the test episodes.
"""

from __future__ import annotations

import time
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import optax
import tyro

import tdanet_jax
from tdanet_jax import TrainConfig
from tdanet_jax.env.environment import FlatObservations
from tdanet_jax.evaluation import policies


class Config(NamedTuple):
    """Trains in the rooms of a split, and plays its test episodes."""

    split: str = "18/4"
    """seen and unseen target classes"""
    validation: bool = False
    """train without the validation rooms and classes, and play the validation episodes"""
    seed: int = 0
    """of parameters, episodes and actions"""
    num_envs: int = 64
    num_steps: int = 32
    total_timesteps: int = 2_000_000
    minibatches: int = 4
    epochs: int = 2
    learning_rate: float = 5e-4
    gamma: float = 0.99
    gae_lambda: float = 0.95
    clip: float = 0.2
    entropy: float = 0.01
    value: float = 0.5
    max_grad_norm: float = 0.5
    hidden: int = 256

    @property
    def updates(self) -> int:
        """Rollouts in all."""
        return self.total_timesteps // (self.num_envs * self.num_steps)


class Network(nn.Module):
    """A dense layer, a GRU that begins anew where an episode does, an actor and a critic."""

    actions: int
    hidden: int

    @nn.compact
    def __call__(
        self, carry: jax.Array, obs: jax.Array, begun: jax.Array
    ) -> tuple[jax.Array, jax.Array, jax.Array]:
        """One step of all environments: carry [B, H], logits [B, A], value [B]."""
        x = nn.relu(nn.Dense(self.hidden)(obs))
        carry, x = nn.GRUCell(self.hidden)(jnp.where(begun[:, None], 0.0, carry), x)
        return carry, nn.Dense(self.actions)(x), nn.Dense(1)(x)[:, 0]


class Step(NamedTuple):
    """What one step of all environments leaves for the update."""

    obs: jax.Array
    begun: jax.Array
    action: jax.Array
    log_prob: jax.Array
    value: jax.Array
    reward: jax.Array
    done: jax.Array
    success: jax.Array


def make_train(config: Config, env: Any, params: Any) -> Any:
    """`train(key) -> (weights, success rate of each update)`, to be jit-compiled."""
    network = Network(env.num_actions, config.hidden)
    optimiser = optax.chain(
        optax.clip_by_global_norm(config.max_grad_norm), optax.adam(config.learning_rate)
    )
    batch = config.num_envs
    reset = jax.vmap(env.reset, (0, None))
    step = jax.vmap(env.step, (0, 0, 0, None))

    def loss(weights: Any, carry: jax.Array, steps: Step, advantage: jax.Array) -> jax.Array:
        def forward(carry: jax.Array, at: Step) -> tuple[jax.Array, Any]:
            carry, logits, value = network.apply(weights, carry, at.obs, at.begun)
            return carry, (logits, value)

        _, (logits, value) = jax.lax.scan(forward, carry, steps)
        log_probs = jax.nn.log_softmax(logits)
        log_prob = jnp.take_along_axis(log_probs, steps.action[..., None], -1)[..., 0]
        ratio = jnp.exp(log_prob - steps.log_prob)
        scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
        clipped = jnp.clip(ratio, 1 - config.clip, 1 + config.clip)
        actor = -jnp.minimum(ratio * scaled, clipped * scaled).mean()
        critic = 0.5 * jnp.square(value - (steps.value + advantage)).mean()
        entropy = -(jnp.exp(log_probs) * log_probs).sum(-1).mean()
        return actor + config.value * critic - config.entropy * entropy

    def train(key: jax.Array) -> tuple[Any, jax.Array]:
        key, reset_key, network_key = jax.random.split(key, 3)
        obs, state = reset(jax.random.split(reset_key, batch), params)
        carry, begun = jnp.zeros((batch, config.hidden)), jnp.ones(batch, bool)
        weights = network.init(network_key, carry, obs, begun)

        def act(runner: tuple, key: jax.Array) -> tuple[tuple, Step]:
            weights, state, obs, begun, carry = runner
            action_key, step_key = jax.random.split(key)
            carry, logits, value = network.apply(weights, carry, obs, begun)
            action = jax.random.categorical(action_key, logits)
            log_prob = jnp.take_along_axis(jax.nn.log_softmax(logits), action[:, None], -1)[:, 0]
            keys = jax.random.split(step_key, batch)
            after, state, reward, terminated, truncated, info = step(keys, state, action, params)
            done = terminated | truncated
            kept = Step(obs, begun, action, log_prob, value, reward, done, info["success"])
            return (weights, state, after, done, carry), kept

        def update(runner: tuple, key: jax.Array) -> tuple[tuple, jax.Array]:
            (weights, opt_state), state, obs, begun, first = runner
            act_key, *epoch_keys = jax.random.split(key, 1 + config.epochs)
            keys = jax.random.split(act_key, config.num_steps)
            (_, state, obs, begun, carry), steps = jax.lax.scan(
                act, (weights, state, obs, begun, first), keys
            )
            _, _, last = network.apply(weights, carry, obs, begun)

            def back(after: tuple, at: Step) -> tuple[tuple, jax.Array]:
                advantage, value = after
                alive = 1.0 - at.done
                delta = at.reward + config.gamma * value * alive - at.value
                advantage = delta + config.gamma * config.gae_lambda * alive * advantage
                return (advantage, at.value), advantage

            _, advantages = jax.lax.scan(back, (jnp.zeros(batch), last), steps, reverse=True)

            def minibatch(train_state: tuple, chosen: jax.Array) -> tuple[tuple, None]:
                weights, opt_state = train_state
                part = jax.tree.map(lambda x: x[:, chosen], (steps, advantages))
                grads = jax.grad(loss)(weights, first[chosen], *part)
                changes, opt_state = optimiser.update(grads, opt_state)
                return (optax.apply_updates(weights, changes), opt_state), None

            def epoch(train_state: tuple, key: jax.Array) -> tuple[tuple, None]:
                parts = jax.random.permutation(key, batch).reshape(config.minibatches, -1)
                return jax.lax.scan(minibatch, train_state, parts)

            train_state, _ = jax.lax.scan(epoch, (weights, opt_state), jnp.stack(epoch_keys))
            succeeded = jnp.sum(steps.success & steps.done) / jnp.maximum(steps.done.sum(), 1)
            return (train_state, state, obs, begun, carry), succeeded

        runner = ((weights, optimiser.init(weights)), state, obs, begun, carry)
        runner, success = jax.lax.scan(update, runner, jax.random.split(key, config.updates))
        return runner[0][0], success

    return train


def score(config: Config, env: FlatObservations, weights: Any) -> dict[str, Any]:
    """The results of a trained network on the fixed test episodes; its actions are sampled."""
    network = Network(env.num_actions, config.hidden)

    def start(batch: int) -> tuple[jax.Array, jax.Array]:
        return jnp.zeros((batch, config.hidden)), jnp.ones(batch, bool)

    def act(memory: Any, key: jax.Array, obs: jax.Array) -> tuple[Any, jax.Array]:
        carry, begun = memory
        carry, logits, _ = network.apply(weights, carry, obs, begun)
        return (carry, jnp.zeros_like(begun)), jax.random.categorical(key, logits)

    return tdanet_jax.evaluate(policy=policies.on_vectors(start, act), config=task(config))


def task(config: Config) -> TrainConfig:
    """The rooms and classes."""
    return TrainConfig(split=config.split, validation=config.validation)


def main(config: Config) -> None:
    """Trains, and plays the test episodes."""
    env, params = tdanet_jax.make(f"ithor-{config.split}", config=task(config))
    flat = FlatObservations(env)
    key = jax.random.key(config.seed)
    train = jax.jit(make_train(config, flat, params)).lower(key).compile()
    began = time.time()
    weights, success = jax.block_until_ready(train(key))
    print(f"{config.total_timesteps / (time.time() - began):,.0f} steps per second")
    print(f"success in the last tenth of training: {success[-len(success) // 10 :].mean():.1%}")
    results = score(config, flat, weights)
    for group in ("seen", "unseen"):
        if results[group] is None:  # nothing is unseen in 22/0
            continue
        row = results[group]["L>=1"]
        print(f"{group}: SR {row['SR']:.1f}  SPL {row['SPL']:.1f}")


if __name__ == "__main__":
    main(tyro.cli(Config))
