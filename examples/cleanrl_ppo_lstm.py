"""PPO with an LSTM in the manner of CleanRL's `ppo_atari_lstm.py`: one file, PyTorch, Gymnasium.

`pip install torch -e '.[gymnasium]'`, then `python examples/cleanrl_ppo_lstm.py`: trains in
the rooms of split 18/4, and plays the test episodes.
"""

from __future__ import annotations

import random
import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import tyro
from gymnasium.vector import VectorEnv
from torch import nn, optim
from torch.distributions.categorical import Categorical

import tdanet_jax
from tdanet_jax import TrainConfig
from tdanet_jax.env.gymnasium import NavigationVectorEnv
from tdanet_jax.evaluation import policies

State = tuple[torch.Tensor, torch.Tensor]  # of the LSTM: hidden and cell, [1, B, H] each


@dataclass
class Args:
    """Trains in the rooms of a split, and plays its test episodes."""

    split: str = "18/4"
    """seen and unseen target classes"""
    validation: bool = False
    """train without the validation rooms and classes, and play the validation episodes"""
    seed: int = 0
    """seed of the experiment"""
    torch_deterministic: bool = True
    """choose deterministic algorithms on a GPU"""
    cuda: bool = True
    """use a GPU if there is one"""
    total_timesteps: int = 2_000_000
    """environment steps in all"""
    learning_rate: float = 5e-4
    """the learning rate of the optimizer"""
    num_envs: int = 64
    """the number of environments that step together"""
    num_steps: int = 32
    """the number of steps in each environment per rollout"""
    anneal_lr: bool = True
    """let the learning rate fall linearly to 0"""
    gamma: float = 0.99
    """the discount factor"""
    gae_lambda: float = 0.95
    """lambda of generalized advantage estimation"""
    num_minibatches: int = 4
    """the number of minibatches; each has all steps of some environments"""
    update_epochs: int = 2
    """the number of passes over a rollout"""
    norm_adv: bool = True
    """normalize advantages"""
    clip_coef: float = 0.2
    """the clipping coefficient of the probability ratio"""
    ent_coef: float = 0.01
    """coefficient of the entropy"""
    vf_coef: float = 0.5
    """coefficient of the value loss"""
    max_grad_norm: float = 0.5
    """the maximum norm of the gradient"""


def layer_init(layer: nn.Linear, std: float = np.sqrt(2), bias_const: float = 0.0) -> nn.Linear:
    """Orthogonal weights and constant biases."""
    nn.init.orthogonal_(layer.weight, std)
    nn.init.constant_(layer.bias, bias_const)
    return layer


class Agent(nn.Module):
    """A dense layer, an LSTM, an actor and a critic."""

    def __init__(self, envs: VectorEnv, hidden: int = 256) -> None:
        super().__init__()
        size = int(np.prod(envs.single_observation_space.shape))
        self.network = nn.Sequential(layer_init(nn.Linear(size, hidden)), nn.ReLU())
        self.lstm = nn.LSTM(hidden, hidden)
        for name, parameter in self.lstm.named_parameters():
            if "bias" in name:
                nn.init.zeros_(parameter)
            else:
                nn.init.orthogonal_(parameter)
        self.actor = layer_init(nn.Linear(hidden, int(envs.single_action_space.n)), std=0.01)
        self.critic = layer_init(nn.Linear(hidden, 1), std=1.0)

    def initial_state(self, batch: int) -> State:
        """The memory with which episodes begin."""
        zeros = self.critic.weight.new_zeros(1, batch, self.lstm.hidden_size)
        return zeros, zeros

    def get_states(
        self, x: torch.Tensor, lstm_state: State, done: torch.Tensor
    ) -> tuple[torch.Tensor, State]:
        """Hidden states [T*B, H] of observations [T*B, size]; `done` [T*B]: an episode begins."""
        batch = lstm_state[0].shape[1]
        steps = self.network(x).reshape(-1, batch, self.lstm.input_size)
        outputs = []
        for step, begun in zip(steps, done.reshape(-1, batch), strict=True):
            kept = (1.0 - begun).view(1, -1, 1)
            state = (kept * lstm_state[0], kept * lstm_state[1])
            output, lstm_state = self.lstm(step.unsqueeze(0), state)
            outputs.append(output)
        return torch.cat(outputs).flatten(0, 1), lstm_state

    def get_value(self, x: torch.Tensor, lstm_state: State, done: torch.Tensor) -> torch.Tensor:
        """Values [T*B, 1]."""
        return self.critic(self.get_states(x, lstm_state, done)[0])

    def get_action_and_value(
        self,
        x: torch.Tensor,
        lstm_state: State,
        done: torch.Tensor,
        action: torch.Tensor | None = None,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, State]:
        """Actions, their log-probabilities, entropies, values, and the memory after them."""
        hidden, lstm_state = self.get_states(x, lstm_state, done)
        probs = Categorical(logits=self.actor(hidden))
        if action is None:
            action = probs.sample()
        return action, probs.log_prob(action), probs.entropy(), self.critic(hidden), lstm_state


def train(args: Args, envs: VectorEnv) -> Agent:
    """The agent after `total_timesteps`."""
    if args.num_envs % args.num_minibatches:
        raise ValueError("--num-envs: must be a multiple of --num-minibatches")
    random.seed(args.seed)
    np.random.seed(args.seed)  # noqa: NPY002 (CleanRL's own form)
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    device = torch.device("cuda" if torch.cuda.is_available() and args.cuda else "cpu")
    agent = Agent(envs).to(device)
    optimizer = optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5)

    shape = (args.num_steps, args.num_envs)
    obs = torch.zeros(shape + envs.single_observation_space.shape, device=device)
    actions = torch.zeros(shape, dtype=torch.long, device=device)
    logprobs, rewards, dones, values = (torch.zeros(shape, device=device) for _ in range(4))

    first_obs, _ = envs.reset(seed=args.seed)
    next_obs = torch.tensor(first_obs, device=device)
    next_done = torch.zeros(args.num_envs, device=device)
    next_lstm_state = agent.initial_state(args.num_envs)
    num_iterations = args.total_timesteps // (args.num_envs * args.num_steps)
    start_time = time.time()

    for iteration in range(1, num_iterations + 1):
        initial_lstm_state = next_lstm_state
        if args.anneal_lr:
            frac = 1.0 - (iteration - 1.0) / num_iterations
            optimizer.param_groups[0]["lr"] = frac * args.learning_rate

        successes = []
        for step in range(args.num_steps):
            obs[step], dones[step] = next_obs, next_done
            with torch.no_grad():
                action, logprob, _, value, next_lstm_state = agent.get_action_and_value(
                    next_obs, next_lstm_state, next_done
                )
            actions[step], logprobs[step], values[step] = action, logprob, value.flatten()
            observed, reward, terminated, truncated, infos = envs.step(action.cpu().numpy())
            done = terminated | truncated
            rewards[step] = torch.tensor(reward, device=device)
            next_obs = torch.tensor(observed, device=device)
            next_done = torch.tensor(done, dtype=torch.float32, device=device)
            successes += infos["final_info"]["success"][infos["_final_info"]].tolist()

        # As in CleanRL, an episode that was truncated counts as one that ended.
        with torch.no_grad():
            next_value = agent.get_value(next_obs, next_lstm_state, next_done).flatten()
        advantages = torch.zeros_like(rewards)
        advantage = torch.zeros_like(next_value)
        for t in reversed(range(args.num_steps)):
            last = t == args.num_steps - 1
            nextnonterminal = 1.0 - (next_done if last else dones[t + 1])
            nextvalues = next_value if last else values[t + 1]
            delta = rewards[t] + args.gamma * nextvalues * nextnonterminal - values[t]
            advantage = delta + args.gamma * args.gae_lambda * nextnonterminal * advantage
            advantages[t] = advantage
        returns = advantages + values

        for _ in range(args.update_epochs):
            shuffled = torch.randperm(args.num_envs, device=device)
            for envinds in shuffled.chunk(args.num_minibatches):
                _, newlogprob, entropy, newvalue, _ = agent.get_action_and_value(
                    obs[:, envinds].flatten(0, 1),
                    (initial_lstm_state[0][:, envinds], initial_lstm_state[1][:, envinds]),
                    dones[:, envinds],
                    actions[:, envinds].flatten(),
                )
                ratio = (newlogprob - logprobs[:, envinds].flatten()).exp()
                mb_advantages = advantages[:, envinds].flatten()
                if args.norm_adv:
                    spread = mb_advantages.std() + 1e-8
                    mb_advantages = (mb_advantages - mb_advantages.mean()) / spread
                clipped = ratio.clamp(1 - args.clip_coef, 1 + args.clip_coef)
                pg_loss = -torch.min(mb_advantages * ratio, mb_advantages * clipped).mean()
                v_loss = 0.5 * (newvalue.flatten() - returns[:, envinds].flatten()).square().mean()
                loss = pg_loss - args.ent_coef * entropy.mean() + args.vf_coef * v_loss

                optimizer.zero_grad()
                loss.backward()
                nn.utils.clip_grad_norm_(agent.parameters(), args.max_grad_norm)
                optimizer.step()

        global_step = iteration * args.num_envs * args.num_steps
        if iteration % 10 == 0 or iteration == num_iterations:
            success = np.mean(successes) if successes else np.nan
            speed = int(global_step / (time.time() - start_time))
            print(f"global_step={global_step}, success={success:.2f}, SPS={speed}", flush=True)
    return agent


def score(agent: Agent, config: TrainConfig | None = None) -> dict[str, Any]:
    """The results of a trained agent on the fixed test episodes; its actions are sampled."""
    device = next(agent.parameters()).device
    memory: dict[str, Any] = {}

    def start(batch: int) -> None:
        memory.update(state=agent.initial_state(batch), done=torch.zeros(batch, device=device))

    @torch.no_grad()
    def predict(vectors: np.ndarray) -> np.ndarray:
        x = torch.tensor(vectors, device=device)
        action, *_, memory["state"] = agent.get_action_and_value(x, memory["state"], memory["done"])
        return action.cpu().numpy()

    return tdanet_jax.evaluate(policy=policies.on_host(predict, start), config=config)


def main(args: Args) -> None:
    """Trains, and plays the test episodes."""
    config = TrainConfig(split=args.split, validation=args.validation)
    envs = NavigationVectorEnv(args.num_envs, f"ithor-{args.split}", config=config)
    agent = train(args, envs)
    envs.close()
    results = score(agent, config)
    for group in ("seen", "unseen"):
        if results[group] is None:  # nothing is unseen in 22/0
            continue
        row = results[group]["L>=1"]
        print(f"{group}: SR {row['SR']:.1f}  SPL {row['SPL']:.1f}")


if __name__ == "__main__":
    main(tyro.cli(Args))
